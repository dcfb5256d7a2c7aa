# SPDX-License-Identifier: Apache-2.0
"""`openarm perceive` on the topics of a RealSense, of a graph and in a bag."""

from __future__ import annotations

import array
from threading import Thread

import cv2
import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from tf2_msgs.msg import TFMessage

from openarm_bringup.bags.bag import BagWriter
from openarm_bringup.bags.ros.listener import from_profile
from openarm_bringup.commands.perceive import perceive
from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code
from openarm_common.ros.convert import info_from_intrinsics, matrix_to_transform
from openarm_common.ros.images import array_to_image, image_to_array, lens_from_info
from openarm_common.ros.node import QOS_SENSOR
from openarm_perception.geometry.depth import DepthLimits
from openarm_perception.ros.frames import (
    COMPRESSED,
    IMAGE,
    INFO,
    CameraChoice,
    CameraTopics,
    FrameBuilder,
    camera_topics,
)
from tests.refusals import refused

pytestmark = pytest.mark.requirement("R-19")

LENS = Intrinsics(160, 120, 140.0, 140.0, 79.5, 59.5)
#: Camera 0.7 m over the table, looking straight down; a red box of 80 x 60 x 50 mm.
DISTANCE, HALF, HEIGHT = 0.7, (0.04, 0.03), 0.05
TOPICS = tuple(f"/camera/camera/{end}" for end in (
    "color/image_raw", "aligned_depth_to_color/image_raw", "color/camera_info"))  # fmt: skip


def messages(t_ns: int, scale: float = 0.001) -> tuple[Image, Image, CameraInfo]:
    v, u = np.mgrid[:120, :160]
    x, y = (u - LENS.cx) / LENS.fx * (DISTANCE - HEIGHT), (v - LENS.cy) / LENS.fy * (DISTANCE - HEIGHT)
    on = (np.abs(x) < HALF[0]) & (np.abs(y) < HALF[1])
    rgb = np.full((120, 160, 3), 180, np.uint8)
    rgb[on] = (210, 20, 20)
    counts = np.round(np.where(on, DISTANCE - HEIGHT, DISTANCE) / scale).astype(np.uint16)
    frame = "camera_color_optical_frame"
    return (
        array_to_image(rgb, "rgb8", frame, t_ns),
        array_to_image(counts, "16UC1", frame, t_ns),
        info_from_intrinsics(LENS, frame, t_ns),
    )


KINDS = dict(zip(TOPICS, (IMAGE, IMAGE, INFO), strict=True))


def frame_of(color, depth, info, limits: DepthLimits, scale: float | None = None):
    builder = FrameBuilder(camera_topics(KINDS), limits, CameraChoice(depth_scale=scale))
    return [builder.take(topic, message) for topic, message in zip(TOPICS, (color, depth, info), strict=True)][-1]


def check(data: dict[str, object], off: float = 0.005) -> None:
    (one,) = data["clusters"]  # type: ignore[misc]
    assert (one["shape"], one["color"]) == ("box", "red")
    assert one["size"] == pytest.approx([0.06, 0.08, 0.05], abs=off)  # a pixel


def test_the_topics_of_a_running_camera_are_perceived_from_the_first_frame_that_can_be_read(ros, tmp_path):
    kinds = (Image, Image, CameraInfo)
    senders = [ros.node.create_publisher(kind, topic, 5) for kind, topic in zip(kinds, TOPICS, strict=True)]
    found = []
    thread = Thread(target=lambda: found.append(perceive(out=tmp_path / "out", timeout=30.0)))
    thread.start()
    sent = 0

    def ended() -> bool:
        nonlocal sent
        sent += 1
        frame = messages(sent * 33_000_000)
        if sent < 5:
            frame[0].encoding = "unknown"
        for sender, message in zip(senders, frame, strict=True):
            sender.publish(message)
        return not thread.is_alive()

    ros.spin_until(ended, what="the command")
    thread.join()
    (outcome,) = found
    check(outcome.data)
    assert (tmp_path / "out" / "index.html").exists()


def test_a_graph_without_a_camera_is_answered_with_what_is_expected(ros):
    error = refused("no depth camera with the names that drivers use; cameras: none", perceive, timeout=0.2)
    assert error.code is Code.NOTHING_DETECTED
    assert "choose topics by --color, --depth and --info; image topics: none" in error.message


@pytest.fixture
def bag(tmp_path):
    path = tmp_path / "bag"
    with BagWriter(path, {}) as writer:
        for topic, kind in zip(TOPICS, ("Image", "Image", "CameraInfo"), strict=True):
            writer.add_topic(topic, f"sensor_msgs/msg/{kind}", from_profile(QOS_SENSOR))
        color, _, info = messages(1_000_000_000)
        late = messages(1_040_000_000)
        for topic, t_s, message in (
            (TOPICS[2], 0, info), (TOPICS[0], 1, color), (TOPICS[1], 2, late[1]), (TOPICS[0], 3, late[0]),
        ):  # fmt: skip
            writer.write(topic, t_s * 1_000_000_000, serialize_message(message))
    return path


def test_a_bag_gives_the_first_frame_whose_images_are_of_the_same_time(bag):
    check(perceive(bag).data)
    check(perceive(next(bag.glob("*.mcap")), camera="camera/camera").data)
    refused(r"from 2\.5 s on: nothing on /camera/camera/aligned_depth", perceive, bag, start=2.5)
    refused(r"no depth camera 'wrist'.*cameras: /camera/camera", perceive, bag, camera="wrist")
    refused(r"--depth /none is no topic with .*; image topics: /camera/camera/aligned", perceive, bag, depth="/none")


def test_cameras_are_chosen_by_their_namespace():
    two = {**KINDS, "/overhead/color/image_raw": IMAGE, "/overhead/color/camera_info": INFO}
    two["/overhead/depth/image_raw"] = IMAGE
    assert camera_topics(two, CameraChoice("overhead")).depth == "/overhead/depth/image_raw"
    assert camera_topics(two, CameraChoice("/camera/camera"))[:3] == TOPICS
    refused("several cameras: /camera/camera, /overhead", camera_topics, two)
    chosen = camera_topics(two, CameraChoice("overhead", depth=TOPICS[1]))
    assert chosen[:2] == ("/overhead/color/image_raw", TOPICS[1])


@pytest.mark.parametrize(
    ("color", "depth", "info", "others"),
    [
        ("/camera/camera/color/image_raw", "/camera/camera/aligned_depth_to_color/image_raw",
         "/camera/camera/color/camera_info", ("/camera/camera/depth/image_rect_raw",)),
        ("/camera/color/image_rect_raw", "/camera/aligned_depth_to_color/image_raw", "/camera/color/camera_info", ()),
        ("/zed/zed_node/rgb/image_rect_color", "/zed/zed_node/depth/depth_registered",
         "/zed/zed_node/rgb/camera_info", ("/zed/zed_node/rgb_raw/image_raw_color", "/zed/zed_node/left/image_rect")),
        ("/zed/zed_node/rgb/color/rect/image", "/zed/zed_node/depth/depth_registered",
         "/zed/zed_node/rgb/color/rect/camera_info", ("/zed/zed_node/left/color/rect/image",)),
        ("/oak/rgb/image_raw", "/oak/stereo/image_raw", "/oak/rgb/camera_info", ("/oak/left/image_rect",)),
        ("/rgb/image_raw", "/depth_to_rgb/image_raw", "/rgb/camera_info",
         ("/depth/image_raw", "/rgb_to_depth/image_raw", "/ir/image_raw")),
        ("/camera/rgb/image_rect_color", "/camera/depth_registered/image_raw", "/camera/rgb/camera_info",
         ("/camera/depth/image", "/camera/rgb/image_color")),
        ("/camera/color/image_raw/compressed", "/camera/depth/image_raw/compressedDepth", "/camera/color/camera_info",
         ()),
        ("/rgbd/image", "/rgbd/depth_image", "/rgbd/camera_info", ()),
    ],
)  # fmt: skip
@pytest.mark.requirement("M-08")
def test_the_topics_of_drivers_are_found_by_themselves(color, depth, info, others):
    """Names of realsense2_camera, the D405, zed_wrapper 4 and 5, depthai, Azure Kinect, openni, image_transport, gz."""
    kind = {name: COMPRESSED if "compressed" in name else IMAGE for name in (color, depth, *others)}
    assert camera_topics({**kind, info: INFO})[:3] == (color, depth, info)


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.requirement("M-08")
def test_compressed_topics_of_any_name_are_perceived(tmp_path, named):
    color, depth, info = messages(0)
    rgb, z = image_to_array(color), image_to_array(depth)
    jpeg = CompressedImage(header=color.header, format="rgb8; jpeg compressed bgr8")
    jpeg.data = array.array("B", cv2.imencode(".jpg", rgb[..., ::-1])[1].tobytes())
    png = CompressedImage(header=depth.header, format="16UC1; compressedDepth png")
    png.data = array.array("B", bytes(12) + cv2.imencode(".png", z)[1].tobytes())
    space = "/top" if named else "/cam/color/image_raw"
    topics = (f"{space}/compressed", "/deep" if named else "/cam/depth/image_raw/compressedDepth",
              "/lens" if named else "/cam/color/camera_info")  # fmt: skip
    write(tmp_path / "bag", dict(zip(topics, (jpeg, png, info), strict=True)))
    options = dict(zip(("color", "depth", "info"), topics, strict=True)) if named else {}
    check(perceive(tmp_path / "bag", **options).data)
    if named:
        refused(r"image topics: /deep, /top/compressed; camera_info topics: /lens", perceive, tmp_path / "bag")


def write(path, by_topic) -> None:
    with BagWriter(path, {}) as writer:
        for topic, message in by_topic.items():
            kind = f"{type(message).__module__.split('.')[0]}/msg/{type(message).__name__}"
            writer.add_topic(topic, kind, from_profile(QOS_SENSOR))
            writer.write(topic, 0, serialize_message(message))


@pytest.mark.parametrize("away", [None, (0.05, -0.02, 0.0)])
@pytest.mark.requirement("M-02")
def test_depth_of_another_camera_is_aligned_or_refused(tmp_path, away):
    """The depth camera has other intrinsics, and stands next to the colour camera; the box is where colour sees it."""
    of_depth = Intrinsics(200, 140, 150.0, 150.0, 95.0, 72.0)
    x0, y0, _ = away or (0.0, 0.0, 0.0)
    v, u = np.mgrid[:140, :200]
    top = DISTANCE - HEIGHT
    x, y = (u - of_depth.cx) / of_depth.fx * top + x0, (v - of_depth.cy) / of_depth.fy * top + y0
    z = np.where((np.abs(x) < HALF[0]) & (np.abs(y) < HALF[1]), top, DISTANCE)
    color, _, info = messages(0)
    frame = "camera_depth_optical_frame" if away else color.header.frame_id
    depth = array_to_image(np.round(z * 1000).astype(np.uint16), "16UC1", frame, 0)
    by_topic = {
        "/camera/color/image_raw": color, "/camera/color/camera_info": info, "/camera/depth/image_rect_raw": depth,
        "/camera/depth/camera_info": info_from_intrinsics(of_depth, frame, 0),
    }  # fmt: skip
    if away:
        write(tmp_path / "untied", by_topic)
        refused("and /tf_static does not tie them; take depth that the driver aligns", perceive, tmp_path / "untied")
        edges = TFMessage(transforms=[
            matrix_to_transform("camera_link", color.header.frame_id, np.eye(4), 0),
            matrix_to_transform("camera_link", frame, se3.make(None, away), 0),
        ])  # fmt: skip
        by_topic = {"/tf_static": edges, **by_topic}
    write(tmp_path / "bag", by_topic)
    data = perceive(tmp_path / "bag").data
    check(data, 0.01 if away else 0.005)  # the box hides a strip from the other camera
    (one,) = data["clusters"]
    assert one["centre"][:2] == pytest.approx([0.0, 0.0], abs=0.004)


@pytest.mark.parametrize(
    ("color", "depth"),
    [
        ("rgb/image_rect_color", "depth_registered/image_rect_raw"),
        ("rgb/image_rect_color", "depth_registered/image"),
        ("qhd/image_color_rect", "qhd/image_depth_rect"),
        ("rectified", "z"),
    ],
)
@pytest.mark.requirement("M-01")
def test_rectified_images_are_not_rectified_again(tmp_path, color, depth):
    """Their CameraInfo has the distortion of the lens: of image_proc, of kinect2_bridge, or named freely."""
    rgb, z, info = messages(0)
    info.d, info.distortion_model = [0.3, -0.2, 0.0, 0.0, 0.0], "plumb_bob"
    names = (f"/c/{color}", f"/c/{depth}")
    infos = {f"{name.rpartition('/')[0]}/camera_info": info for name in names}
    write(tmp_path / "bag", {names[0]: rgb, names[1]: z, **infos})
    check(perceive(tmp_path / "bag", color=names[0], depth=names[1]).data)


@pytest.mark.requirement("M-01", "M-02")
def test_what_names_of_topics_do_not_say_is_said_by_options(tmp_path):
    rgb, z, info = messages(0)
    info.d, info.distortion_model = [20.0, 0.0, 0.0, 0.0, 0.0], "plumb_bob"
    z.header.frame_id = "somewhere"
    (tmp_path / "k.png").touch()
    write(tmp_path / "bag", {"/c/color/image_raw": rgb, "/c/color/camera_info": info, "/c/depth/image_raw": z})
    refused("or type --registered yes where it lies on the pixels of colour", perceive, tmp_path / "bag")
    check(perceive(tmp_path / "bag", registered="yes", rectified="yes").data)
    (one,) = perceive(tmp_path / "bag", registered="yes").data["clusters"]
    assert one["size"][1] < 0.078
    write(tmp_path / "plain", {"/c/color/image_rect": rgb, "/c/color/camera_info": info, "/c/depth/image_raw": z})
    (again,) = perceive(tmp_path / "plain", registered="yes", rectified="no").data["clusters"]
    assert again["size"] == one["size"]
    topics = {"/c/color/image_raw": rgb, "/c/color/camera_info": info, "/c/depth_registered/image_raw": z}
    write(tmp_path / "named", topics)
    assert perceive(tmp_path / "named").data["clusters"]
    refused("the depth has no camera_info; take depth", perceive, tmp_path / "named", registered="no")
    refused("are for topics of a bag", perceive, tmp_path / "k.png", tmp_path / "k.png", rectified="yes")


@pytest.mark.requirement("M-01")
def test_a_frame_keeps_the_lens_of_its_depth_which_is_that_of_a_background():
    color, depth, info = messages(0)
    info.d, info.distortion_model = [-0.2, 0.05, 0.0, 0.0, 0.0], "plumb_bob"
    found = frame_of(color, depth, info, DepthLimits())
    assert (found.lens, found.intrinsics) == (lens_from_info(info), LENS)


@pytest.mark.requirement("M-02")
def test_a_lens_of_a_file_is_that_of_depth_on_its_pixels_too(tmp_path):
    """The CameraInfo of the depth, with the driver's intrinsics, does not move it to other pixels."""
    color, depth, info = messages(0)
    info.k[0] = info.k[4] = info.p[0] = info.p[5] = 150.0
    topics = ("/c/color/image_raw", "/c/aligned_depth_to_color/image_raw", "/c/aligned_depth_to_color/camera_info")
    write(tmp_path / "bag", dict(zip(topics, (color, depth, info), strict=True)))
    write(tmp_path / "alone", dict(zip(topics[:2], (color, depth), strict=True)))
    (tmp_path / "k.yaml").write_text(f"width: 160\nheight: 120\nk: {LENS.matrix.ravel().tolist()}\n")
    found, alone = (perceive(tmp_path / name, info=str(tmp_path / "k.yaml")).data for name in ("bag", "alone"))
    check(found)
    assert found == alone


@pytest.mark.requirement("M-01")
def test_raw_colour_of_a_stereo_pair_meets_its_rectified_depth_by_the_rotation_of_camera_info():
    """The pixels of colour are those of OpenCV, as `rectifyPoint` of image_geometry has them."""
    color, depth, info = messages(0)
    R = se3.exp_so3(np.array([0.02, -0.03, 0.05]))
    info.r, info.d, info.distortion_model = R.ravel().tolist(), [-0.2, 0.05, 0.0, 0.0, 0.0], "plumb_bob"
    pixels = np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), axis=-1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(pixels, LENS.matrix, np.array(info.d), R=R, P=LENS.matrix)
    column, row = straight.reshape(120, 160, 2).astype(np.float32).transpose(2, 0, 1)
    raw = cv2.remap(image_to_array(color), column, row, cv2.INTER_NEAREST)
    topics = CameraTopics("/c/left/image_raw", "/c/left/depth_rect", "/c/left/camera_info")
    builder = FrameBuilder(topics, DepthLimits())
    assert builder.take(topics.color, array_to_image(raw, "rgb8", color.header.frame_id, 0)) is None
    assert builder.take(topics.depth, depth) is None
    found = builder.take(topics.info, info)
    red = (found.rgb[..., 0] > 150) & (found.rgb[..., 1] < 100)
    on = np.abs((found.points @ R.T)[..., 2] - (DISTANCE - HEIGHT)) < 0.01
    assert np.count_nonzero(red) > 180
    assert np.count_nonzero(red ^ on) < 0.12 * np.count_nonzero(red)  # the rim


@pytest.mark.requirement("M-02")
def test_registered_depth_is_not_moved_again_whatever_its_frame_is_called(tmp_path):
    color, depth, info = messages(0)
    depth.header.frame_id = "depth_optical"
    edge = matrix_to_transform(color.header.frame_id, "depth_optical", se3.make(None, (0.05, 0.0, 0.0)), 0)
    by_topic = {"/tf_static": TFMessage(transforms=[edge]), "/c/color/image_raw": color, "/c/color/camera_info": info}
    by_topic |= {"/c/depth_registered/image_raw": depth, "/c/depth_registered/camera_info": info}
    write(tmp_path / "bag", by_topic)
    data = perceive(tmp_path / "bag").data
    check(data)
    assert data["clusters"][0]["centre"][0] == pytest.approx(0.0, abs=0.002)


@pytest.mark.requirement("M-08")
def test_a_bag_without_camera_info_is_read_with_a_file_of_intrinsics(tmp_path):
    color, depth, _ = messages(0)
    write(tmp_path / "bag", {"/c/color/image_raw": color, "/c/depth/image_raw": depth})
    refused("no camera_info next to /c/color/image_raw; give its topic, or a file", perceive, tmp_path / "bag")
    (tmp_path / "k.txt").write_text(f"{LENS.fx} {LENS.fy} {LENS.cx} {LENS.cy}")
    (tmp_path / "k.yaml").write_text(f"width: 160\nheight: 120\nk: {LENS.matrix.ravel().tolist()}\n")
    check(perceive(tmp_path / "bag", info=str(tmp_path / "k.yaml")).data)


@pytest.mark.requirement("M-08")
def test_a_frame_that_is_damaged_gives_way_to_a_later_one(tmp_path):
    color, depth, info = messages(0)
    jpeg = CompressedImage(header=color.header, format="jpeg", data=array.array("B", b"\xff\xd8\xff cut"))
    later = messages(100_000_000)
    good = CompressedImage(header=later[0].header, format="jpeg")
    good.data = array.array("B", cv2.imencode(".jpg", image_to_array(later[0])[..., ::-1])[1].tobytes())
    names = ("/c/color/image_raw/compressed", "/c/depth/image_raw", "/c/color/camera_info")
    with BagWriter(tmp_path / "bag", {}) as writer:
        for topic, kind in zip(names, ("CompressedImage", "Image", "CameraInfo"), strict=True):
            writer.add_topic(topic, f"sensor_msgs/msg/{kind}", from_profile(QOS_SENSOR))
        for k, message in enumerate((jpeg, depth, info, good, later[1])):
            topic = names[{CompressedImage: 0, Image: 1, CameraInfo: 2}[type(message)]]
            writer.write(topic, k, serialize_message(message))
    check(perceive(tmp_path / "bag").data)


@pytest.mark.requirement("M-02")
def test_depth_in_another_frame_without_intrinsics_is_refused(tmp_path):
    color, depth, info = messages(0)
    depth.header.frame_id = "camera_depth_optical_frame"
    write(tmp_path / "bag", {"/c/color/image_raw": color, "/c/color/camera_info": info, "/c/depth": depth})
    refused("the depth has no camera_info; take depth that the driver aligns", perceive, tmp_path / "bag")


def test_every_encoding_is_scaled_as_said():
    color, depth, info = messages(0, scale=0.0001)
    near = frame_of(color, depth, info, DepthLimits(), 0.0001)
    assert np.nanmax(near.points[..., 2]) == pytest.approx(DISTANCE, abs=1e-4)
    frame = color.header.frame_id
    metres = array_to_image(np.nan_to_num(near.points[..., 2]), "32FC1", frame, 0)
    again = frame_of(color, metres, info, DepthLimits())
    np.testing.assert_allclose(again.points[..., 2], near.points[..., 2])
    in_mm = array_to_image(np.nan_to_num(near.points[..., 2]) * np.float32(1000), "32FC1", frame, 0)
    again = frame_of(color, in_mm, info, DepthLimits(), 0.001)
    np.testing.assert_allclose(again.points[..., 2], near.points[..., 2], rtol=1e-5)


def test_what_does_not_belong_together_is_refused():
    color, depth, info = messages(0)
    info.width = 320
    said = "depth image is 160x120 pixels, but its intrinsics .* are of 320x120"
    refused(said, frame_of, color, depth, info, DepthLimits())
    info.k = np.zeros(9)
    refused("is not calibrated", frame_of, color, depth, info, DepthLimits())
    builder = FrameBuilder(camera_topics(KINDS), DepthLimits())
    assert builder.take(TOPICS[0], color) is None
    assert builder.missing() == f"nothing on {TOPICS[1]}, {TOPICS[2]}"


def test_colour_and_depth_of_different_times_make_no_frame():
    topics = camera_topics(KINDS)
    (color, _, info), (_, late, _), (_, near, _) = messages(0), messages(100_000_000), messages(10_000_000)
    builder = FrameBuilder(topics, DepthLimits())
    for topic, message in ((topics.color, color), (topics.info, info), (topics.depth, late)):
        assert builder.take(topic, message) is None
    assert builder.missing().startswith("no colour and depth image of the same time: the nearest are 100 ms apart")
    assert builder.take(topics.depth, near) is not None
