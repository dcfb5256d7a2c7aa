# SPDX-License-Identifier: Apache-2.0
"""`openarm perceive`: a recorded frame, what is printed and written, what is refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from rclpy.serialization import serialize_message

from openarm_bringup import cli
from openarm_bringup.bags.bag import BagWriter
from openarm_bringup.bags.ros.listener import from_profile
from openarm_common.camera.cameras import Intrinsics
from openarm_common.ros.convert import info_from_intrinsics
from openarm_common.ros.images import array_to_image
from openarm_common.ros.node import QOS_SENSOR
from openarm_perception.frames.cloud_fields import Cloud
from openarm_perception.frames.pcd import read_pcd, write_pcd
from openarm_perception.geometry.depth import Deprojector, DepthLimits
from tests.openarm_bringup.commands import answer_of

pytestmark = pytest.mark.requirement("R-19")

LENS = Intrinsics(160, 120, 140.0, 140.0, 79.5, 59.5)
#: Camera 0.7 m over the table, looking straight down; a red box of 80 x 60 x 50 mm.
DISTANCE, HALF, HEIGHT = 0.7, (0.04, 0.03), 0.05


@pytest.fixture
def files(tmp_path: Path) -> tuple[str, ...]:
    """Colour, depth in 0.1 mm, intrinsics."""
    v, u = np.mgrid[:120, :160]
    x, y = (u - LENS.cx) / LENS.fx * (DISTANCE - HEIGHT), (v - LENS.cy) / LENS.fy * (DISTANCE - HEIGHT)
    on = (np.abs(x) < HALF[0]) & (np.abs(y) < HALF[1])
    z = np.where(on, DISTANCE - HEIGHT, DISTANCE)
    color = np.full((120, 160, 3), 180, np.uint8)
    color[on] = (20, 20, 210)
    cv2.imwrite(str(tmp_path / "c.png"), color)
    cv2.imwrite(str(tmp_path / "z.png"), np.round(z * 1e4).astype(np.uint16))
    (tmp_path / "k.yaml").write_text(f"fx: {LENS.fx}\nfy: {LENS.fy}\ncx: {LENS.cx}\ncy: {LENS.cy}\n")
    points = Deprojector(DepthLimits()).organised(z.astype(np.float32), LENS)
    write_pcd(tmp_path / "a.pcd", Cloud(points, np.ascontiguousarray(color[..., ::-1]), None))
    return str(tmp_path / "c.png"), str(tmp_path / "z.png"), "--info", str(tmp_path / "k.yaml")


def test_a_box_is_found_measured_and_drawn(files, tmp_path, capsys):
    out = tmp_path / "a" / "out"
    code, answer = answer_of(capsys, "perceive", *files, "--depth-scale", "0.0001", "--out", str(out))
    assert (code, answer["success"], answer["frame"]) == (0, True, "camera")
    (one,) = answer["clusters"]
    assert (one["shape"], one["color"], one["cut"]) == ("box", "red", "")
    assert one["size"] == pytest.approx([0.06, 0.08, 0.05], abs=0.005)  # a pixel
    assert one["centre"] == pytest.approx([0.0, 0.0, DISTANCE - HEIGHT / 2], abs=0.003)
    (detection,) = answer["detections"]
    assert (detection["label"], detection["cluster"]) == ("red", 1)
    names = ("overlay.png", "labels.png", "label.png", "depth.png", "color.png", "index.html")
    assert sorted(Path(path).name for path in answer["written"]) == sorted(names)
    label = cv2.imread(str(out / "label.png"), cv2.IMREAD_UNCHANGED)
    assert label.dtype == np.uint16
    assert np.count_nonzero(label) == one["pixels"]
    assert "x 50</td>" in (out / "index.html").read_text()


def test_a_table_is_printed(files, capsys):
    assert cli.run(["perceive", *files, "--depth-scale", "0.0001"]) == 0
    shown = capsys.readouterr().out
    assert "edges [mm]" in shown
    assert "red     box" in shown
    assert "1 on a plane" in shown


def test_a_cloud_gives_the_same(files, tmp_path, capsys):
    _, of_images = answer_of(capsys, "perceive", *files, "--depth-scale", "0.0001")
    code, answer = answer_of(capsys, "perceive", str(tmp_path / "a.pcd"))
    assert code == 0
    (a,), (b,) = of_images["clusters"], answer["clusters"]
    assert b["size"] == pytest.approx(a["size"], abs=5e-4)
    assert b["centre"] == pytest.approx(a["centre"], abs=5e-4)


def flat(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The points of a cloud (1, n, 3) in another order, and their colours."""
    cloud = read_pcd(path)
    order = np.random.default_rng(0).permutation(cloud.points[..., 0].size)
    assert cloud.rgb is not None
    return cloud.points.reshape(-1, 3)[order][None], cloud.rgb.reshape(-1, 3)[order][None]


def test_clouds_that_are_no_images_give_the_same(files, tmp_path, capsys):
    """In any order; in millimetres with x forward; and from above, with z up and the origin elsewhere."""
    _, known = answer_of(capsys, "perceive", str(tmp_path / "a.pcd"))
    points, rgb = flat(tmp_path / "a.pcd")
    path = tmp_path / "b.pcd"
    write_pcd(path, Cloud(points, rgb, None))
    code, answer = answer_of(capsys, "perceive", str(path))
    assert (code, answer["clusters"]) == (0, known["clusters"])
    assert "projected into one of 160x120" in answer["message"]
    body = points @ np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], np.float32) * 1000.0
    write_pcd(path, Cloud(body, rgb, None))
    assert "--unit mm" in answer_of(capsys, "perceive", str(path))[1]["message"]
    assert "--cloud-frame body" in answer_of(capsys, "perceive", str(path), "--unit", "mm")[1]["message"]
    _, answer = answer_of(capsys, "perceive", str(path), "--unit", "mm", "--cloud-frame", "body")
    (one,) = answer["clusters"]
    assert one["size"] == pytest.approx(known["clusters"][0]["size"], abs=1e-3)
    up = points * np.float32((1, -1, -1)) + np.float32((0.5, -0.2, 1.1))
    write_pcd(path, Cloud(up, rgb, None))
    code, answer = answer_of(capsys, "perceive", str(path), "--cloud-frame", "base")
    (one,) = answer["clusters"]
    assert (answer["frame"], one["color"]) == ("base", "red")
    assert one["centre"] == pytest.approx([0.5, -0.2, 1.1 - DISTANCE + HEIGHT / 2], abs=0.005)
    assert one["size"] == pytest.approx(known["clusters"][0]["size"], abs=0.01)
    assert "looks down from" in answer["message"]
    code, answer = answer_of(capsys, "perceive", str(path), "--cloud-frame", "base", "--pose", files[3])
    assert (code, "expected none" in answer["message"]) == (2, True)


def test_what_would_be_seen_through_the_table_is_said(files, tmp_path, capsys):
    """A cloud with z up, near enough to its z axis, looks like one of a camera that is below the table."""
    points, rgb = flat(tmp_path / "a.pcd")
    write_pcd(tmp_path / "b.pcd", Cloud(points * np.float32((1, -1, -1)) + np.float32((0, 0, 1.3)), rgb, None))
    _, answer = answer_of(capsys, "perceive", str(tmp_path / "b.pcd"))
    assert answer["clusters"] == []
    assert "below that plane: where z is up type --cloud-frame base" in answer["message"]


def test_a_pose_gives_the_base_frame_and_a_background_what_is_new(files, tmp_path, capsys):
    (tmp_path / "pose.txt").write_text("1 0 0 0.3\n0 -1 0 0\n0 0 -1 1.1\n0 0 0 1\n")
    pose = ("--depth-scale", "0.0001", "--pose", str(tmp_path / "pose.txt"))
    _, answer = answer_of(capsys, "perceive", *files, *pose)
    assert answer["frame"] == "base"
    assert answer["clusters"][0]["centre"] == pytest.approx([0.3, 0.0, 0.425], abs=0.003)
    code, answer = answer_of(capsys, "perceive", *files, *pose, "--background", files[1])
    assert (code, answer["clusters"]) == (0, [])
    np.save(tmp_path / "z.npy", cv2.imread(files[1], cv2.IMREAD_UNCHANGED))
    argv = (files[0], str(tmp_path / "z.npy"), *files[2:], *pose, "--background", str(tmp_path / "z.npy"))
    code, answer = answer_of(capsys, "perceive", *argv)
    assert (code, answer["clusters"]) == (0, [])


@pytest.mark.parametrize(
    ("argv", "exit_code", "words"),
    [
        (("{c}",), 2, "no depth image"),
        (("{c}", "{z}"), 2, "no --info"),
        (("{p}", "{z}"), 2, "no --info"),
        (("{p}", "--info", "{k}"), 2, "is a cloud"),
        (("{p}", "--depth", "/depth"), 2, "are for topics"),
        (("{c}", "{z}", "{z}", "--info", "{k}"), 2, "expected COLOUR DEPTH"),
        (("{z}", "{c}", "--info", "{k}"), 1, "is it the depth?"),
        (("{c}", "{z}", "--info", "{z}"), 1, "is no text"),
        (("{c}", "{z}", "--info", "{k}", "--depth-scale", "0"), 2, "depth scale"),
        (("{c}", "{z}", "--info", "{k}", "--near", "2", "--far", "1"), 2, "near"),
        (("{c}", "{z}", "--info", "{k}", "--pose", "{k}"), 1, "four rows"),
        (("{c}", "{z}", "--info", "{k}", "--depth-scale", "0.0001", "--out", "{k}"), 2, "no folder"),
        (("{c}", "{z}", "--info", "{k}", "--depth-scale", "0.00001"), 1, "of which 0% lie within"),
        (("{c}", "{z}", "--info", "{k}", "--depth-scale", "0.00001"), 1, "type --near 0.06"),
        (("{c}", "{z}", "--info", "{k}"), 1, "depths are 7 to 7 m (5th to 95th percentile), of which 0%"),
        (("{c}", "{z}", "--info", "{k}"), 1, "within --near 0.1 and --far 3: type --far 7.4"),
        (("{p}", "--far", "0.5"), 1, "type --far 0.8"),
        (("{k}.pcd",), 2, "there is no file or bag"),
        (("{c}", "{z}", "--info", "{k}", "--frames", "2"), 2, "--frames 2: expected 1, or more of a bag"),
    ],
)
def test_what_is_wrong_is_said_in_a_sentence(files, tmp_path, capsys, argv, exit_code, words):
    names = {"c": files[0], "z": files[1], "k": files[3], "p": str(tmp_path / "a.pcd")}
    code, answer = answer_of(capsys, "perceive", *(each.format(**names) for each in argv))
    assert (code, answer["success"]) == (exit_code, False)
    assert words in str(answer["message"])


def test_the_cloud_is_left_as_it_is(files, tmp_path, capsys):
    before = read_pcd(tmp_path / "a.pcd").points.copy()
    answer_of(capsys, "perceive", str(tmp_path / "a.pcd"), "--far", "0.68")
    assert np.array_equal(read_pcd(tmp_path / "a.pcd").points, before)


@pytest.mark.parametrize("count", [0.0001, 0.0002, 0.01])
@pytest.mark.requirement("M-02")
def test_depth_in_another_unit_is_noticed(files, tmp_path, capsys, count):
    """A D405 counts in 0.1 mm, the sets of TUM in 0.2 mm: read as mm the table is metres away; centimetres are near."""
    z = cv2.imread(files[1], cv2.IMREAD_UNCHANGED).astype(float) * 1e-4 * (0.4 if count == 0.0001 else 1.0)
    cv2.imwrite(str(tmp_path / "counts.png"), np.round(z / count).astype(np.uint16))
    argv = (files[0], str(tmp_path / "counts.png"), *files[2:])
    _, answer = answer_of(capsys, "perceive", *argv)
    assert f"--depth-scale {count:g}" in str(answer["message"])
    code, answer = answer_of(capsys, "perceive", *argv, "--depth-scale", str(count))
    assert code == 0
    assert "--depth-scale" not in str(answer["message"])
    assert answer["depths"] == pytest.approx(np.percentile(z, (5, 95)), abs=max(1e-3, count / 2))


@pytest.mark.requirement("M-02")
def test_floats_in_millimetres_are_noticed(files, tmp_path, capsys):
    z = cv2.imread(files[1], cv2.IMREAD_UNCHANGED).astype(np.float32) * np.float32(0.1)
    cv2.imwrite(str(tmp_path / "z.tiff"), z)
    argv = (files[0], str(tmp_path / "z.tiff"), *files[2:])
    code, answer = answer_of(capsys, "perceive", *argv)
    assert code == 1
    assert "--depth-scale 0.001 (millimetres) makes it 0.7 m" in str(answer["message"])
    code, answer = answer_of(capsys, "perceive", *argv, "--depth-scale", "0.001")
    assert (code, len(answer["clusters"])) == (0, 1)


@pytest.mark.requirement("M-09")
@pytest.mark.parametrize(("axes", "R"), [("opengl", np.diag([1.0, -1.0, -1.0])), ("base_y", None)])
def test_clouds_with_y_up_are_read(files, tmp_path, capsys, axes, R):
    """As the RealSense Viewer writes them, with z backward; and of something that stands on the ground."""
    points = read_pcd(tmp_path / "a.pcd").points.reshape(1, -1, 3)
    if R is None:  # optical: x right, y down the table, z down; the cloud: x right, y up, z towards the viewer
        R = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    write_pcd(tmp_path / "b.pcd", Cloud((points @ R.T).astype(np.float32), None, None))
    code, answer = answer_of(capsys, "perceive", str(tmp_path / "b.pcd"))
    assert (code, f"--cloud-frame {axes}" in str(answer["message"])) == (1, True)
    code, answer = answer_of(capsys, "perceive", str(tmp_path / "b.pcd"), "--cloud-frame", axes)
    assert code == 0
    (one,) = answer["clusters"]
    assert one["size"] == pytest.approx([0.06, 0.08, 0.05], abs=0.01)


def test_no_number_of_the_table_is_cut(files, capsys):
    assert cli.run(["perceive", *files, "--depth-scale", "0.0001"]) == 0
    assert "…" not in capsys.readouterr().out


def test_a_folder_that_cannot_be_written_is_named(files, capsys):
    code, answer = answer_of(capsys, "perceive", *files, "--depth-scale", "0.0001", "--out", "/proc/none")
    assert (code, "--out /proc/none is no folder to write to" in str(answer["message"])) == (2, True)


def test_objects_have_ids_across_the_frames_of_a_bag(tmp_path, capsys):
    """Two boxes; one is taken away, something hides the table, and another is put elsewhere."""
    v, u = np.mgrid[:120, :160]
    boxes = {"a": (-0.15, 0.0), "b": (0.12, 0.05), "c": (0.1, -0.1)}
    topics = ("/c/color/image_raw", "/c/depth/image_raw", "/c/color/camera_info")
    with BagWriter(tmp_path / "bag", {}) as bag:
        for topic, kind in zip(topics, ("Image", "Image", "CameraInfo"), strict=True):
            bag.add_topic(topic, f"sensor_msgs/msg/{kind}", from_profile(QOS_SENSOR))
        for k, there in enumerate(("ab", "ab", "b", "", "bc", "cb")):
            z = np.full((120, 160), DISTANCE if there else 0.05, np.float32)
            for x, y in (boxes[name] for name in there):
                d = DISTANCE - HEIGHT
                on_x, on_y = (u - LENS.cx) / LENS.fx * d - x, (v - LENS.cy) / LENS.fy * d - y
                z[(np.abs(on_x) < HALF[0]) & (np.abs(on_y) < HALF[1])] = d
            t_ns = k * 200_000_000
            color = array_to_image(np.full((120, 160, 3), 180, np.uint8), "rgb8", "c", t_ns)
            depth = array_to_image(z, "32FC1", "c", t_ns)
            info = info_from_intrinsics(LENS, "c", t_ns)
            for topic, message in zip(topics, (color, depth, info), strict=True):
                bag.write(topic, t_ns, serialize_message(message))
    code, answer = answer_of(capsys, "perceive", str(tmp_path / "bag"), "--frames", "9")
    assert code == 0
    assert [one["t"] for one in answer["frames"]] == [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    assert "no plane" in answer["frames"][3]["message"]
    ids = [
        {name: one["object"] for one in frame["clusters"] for name, at in boxes.items() if near(one["centre"], at)}
        for frame in answer["frames"]
    ]
    a, b = ids[0]["a"], ids[0]["b"]
    assert ids == [{"a": a, "b": b}, {"a": a, "b": b}, {"b": b}, {}, {"b": b, "c": "3"}, {"b": b, "c": "3"}]
    assert {a, b} == {"1", "2"}
    assert "3 objects in 6 frames" in answer["message"]
    code, answer = answer_of(capsys, "perceive", str(tmp_path / "bag"))
    assert "frames" not in answer


def near(centre: list[float], at: tuple[float, float]) -> bool:
    return abs(centre[0] - at[0]) < 0.02 and abs(centre[1] - at[1]) < 0.02
