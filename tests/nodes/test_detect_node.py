# SPDX-License-Identifier: Apache-2.0
"""Node `detector` against a camera made of rectangles: flat images, exact depth."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from openarm_interfaces.srv import MeasureTable
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image, JointState
from vision_msgs.msg import Detection2DArray
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import info_from_intrinsics, ns_to_stamp, pose_to_matrix, stamp_to_ns
from openarm_common.ros.images import array_to_image, image_to_array
from openarm_common.ros.node import QOS_LATCHED, QOS_SENSOR
from openarm_perception.ros import detector_node
from openarm_perception.ros.detector_node import DetectNode
from tests.nodes.detect_bench import MS, TABLE, TOP, Bench, FakeCamera, Watch

BASE_FRAME = RobotDescription.load().base


@pytest.fixture
def bench(ros) -> Bench:
    """A detector on the overhead camera."""
    return Bench(ros, camera=FakeCamera(ros))


@pytest.mark.requirement("A-31", "A-63", "B-01", "B-29")
def test_a_box_is_found_where_it_stands(bench) -> None:
    """Position, size and yaw in the base frame, at the stamp of the image, through the pinhole and the mount."""
    message = bench.detect()
    assert message.header.frame_id == BASE_FRAME
    assert stamp_to_ns(message.header.stamp) % (200 * MS) == 0
    (found,) = message.detections
    assert found.id.isdecimal()
    assert found.results[0].hypothesis.class_id == "red"
    assert 0.5 < found.results[0].hypothesis.score <= 1.0
    T = pose_to_matrix(found.bbox.center)
    np.testing.assert_allclose(T[:3, 3], (0.30, -0.20, TABLE + 0.025), atol=0.001)
    np.testing.assert_allclose(np.abs(T[:3, 0]), (0.0, 1.0, 0.0), atol=0.02)  # x along the smaller extent
    np.testing.assert_allclose(T[:3, 2], (0.0, 0.0, 1.0), atol=1e-9)
    size = found.bbox.size
    np.testing.assert_allclose((size.x, size.y, size.z), (0.04, 0.06, 0.05), atol=0.0015)
    assert found.results[0].pose.covariance[0] > 0.0
    # twice the focal length in the CameraInfo, half the size: the node has no other source
    K = bench.camera.K
    bench.camera.K = replace(K, fx=2.0 * K.fx, fy=2.0 * K.fy)
    assert bench.detect().detections[0].bbox.size.y == pytest.approx(0.03, rel=0.05)


@pytest.mark.requirement("N-03")
def test_objects_are_missed_by_injection_while_the_node_runs(bench) -> None:
    """All of them, or a share of the frames; the same seed and stamps miss the same."""
    assert len(bench.detect().detections) == 1

    def set_faults(**values: float) -> bool:
        answers = bench.node.set_parameters([Parameter(f"faults.{k}", value=v) for k, v in values.items()])
        return all(answer.successful for answer in answers)

    def becomes(count: int) -> None:
        """An answer to a frame from before the change may still be on its way."""
        bench.pump(lambda: len(bench.watch.got[-1].detections) == count, f"frames with {count} objects")

    assert set_faults(miss_share=1.0)
    becomes(0)
    assert not set_faults(miss_share=-0.5)
    assert set_faults(miss_share=0.5, seed=3)
    bench.watch.got.clear()
    bench.detect()
    bench.pump(lambda: {len(m.detections) for m in bench.watch.got} == {0, 1}, "frames with the object and without")
    faults = bench.node.config.faults
    for message in bench.watch.got[1:]:
        expected = len(faults.seen(["red"], stamp_to_ns(message.header.stamp)))
        assert len(message.detections) == expected
    assert set_faults(miss_share=0.0)
    bench.watch.got.clear()
    bench.detect()
    becomes(1)


@pytest.mark.requirement("B-31", "B-62")
def test_without_a_depth_topic_an_object_of_known_height_is_found_by_its_silhouette(ros) -> None:
    camera = FakeCamera(ros)
    ros.node.destroy_publisher(camera.pubs.pop("depth"))
    bench = Bench(ros, camera=camera, depth_topic="", **{"localizer.heights": ["red=0.05"]})
    (found,) = bench.detect().detections
    np.testing.assert_allclose(pose_to_matrix(found.bbox.center)[:3, 3], (0.30, -0.20, TABLE + 0.025), atol=0.001)
    size = found.bbox.size
    np.testing.assert_allclose((size.x, size.y, size.z), (0.04, 0.06, 0.05), atol=0.0015)


@pytest.mark.requirement("B-31")
def test_a_camera_without_depth_is_named_with_what_to_do(ros, monkeypatch) -> None:
    monkeypatch.setattr(detector_node, "_PATIENCE", 0.2)
    camera = FakeCamera(ros)
    bench = Bench(ros, camera=camera)
    ros.node.destroy_publisher(camera.pubs.pop("depth"))
    bench.said("no depth on /overhead/depth/image_raw; with a camera that has none set depth_topic")


@pytest.mark.requirement("B-63")
def test_the_height_of_the_table_is_measured_from_its_surface_or_a_block(ros, bench) -> None:
    """The detector is configured with 0.41 m; the camera sees 0.40 m."""
    camera = FakeCamera(ros)
    camera.publish_mount()
    node = ros.start(partial(DetectNode, namespace="other"), table_height=0.41)
    client = ros.node.create_client(MeasureTable, "/other/detector/measure_table")

    def ask(**fields) -> MeasureTable.Response:
        """With an image that is fresh, however busy the machine is."""
        for _ in range(5):
            bench.pump(lambda: node.measurable, "an image")
            answer = ros.call(client, MeasureTable.Request(**fields))
            if answer.code != "NOT_READY":
                return answer
        raise AssertionError(answer.message)

    early = ros.call(client, MeasureTable.Request())
    assert (early.success, early.code) == (False, "NOT_READY")
    ros.spin_until(lambda: camera.pubs["depth"].get_subscription_count() == 2, what="it listens because it was asked")
    surface = ask()
    assert surface.success, surface.message
    assert surface.height == pytest.approx(TABLE, abs=0.0005)
    assert surface.tilt < 0.002
    assert surface.std < 0.001
    assert surface.points > 10_000
    block = ask(block_height=0.048, label="red")  # the block is given 2 mm too low
    assert block.success, block.message
    assert block.height == pytest.approx(TOP - 0.048, abs=0.0005)
    assert f"{block.height:.4f} m high; the detector takes it for 0.4100 m" in block.message
    for fields, text in (({"block_height": 3.0}, "0.005 .. 0.5"), ({"block_height": 0.05, "label": "blue"}, "'blue'")):
        assert text in ask(**fields).message
    ros.spin_until(lambda: not node.measurable, what="the newest image is old")
    assert ros.call(client, MeasureTable.Request()).code == "NOT_READY"


@pytest.mark.requirement("B-04", "A-61")
def test_boxes_in_the_image_by_their_centre_and_pictures_and_markers_for_people(ros, bench) -> None:
    """Class, score, and the middle of the box in pixels, in the optical frame; a body and a text for each object."""
    boxes = Watch(ros, Detection2DArray, "/detections_2d")
    pictures = Watch(ros, Image, "/detection_image", QOS_SENSOR)
    markers = Watch(ros, MarkerArray, "/detection_markers")
    bench.pump(lambda: boxes.got and pictures.got and markers.got, "a detection in the image, a picture and markers")
    message = boxes.got[-1]
    assert message.header.frame_id == "overhead_color_optical_frame"
    (box,) = message.detections
    assert (box.bbox.center.position.x, box.bbox.center.position.y) == (319.5, 239.5)
    rows, columns = bench.camera.patch
    assert (box.bbox.size_x, box.bbox.size_y) == (columns.stop - columns.start, rows.stop - rows.start)
    assert box.results[0].hypothesis.class_id == "red"
    picture = image_to_array(pictures.got[-1])
    assert picture.shape == (480, 640, 3)
    assert (picture != bench.camera.rgb).any()
    wiped, body, text = markers.got[-1].markers
    assert (wiped.action, body.type, text.type) == (Marker.DELETEALL, Marker.CUBE, Marker.TEXT_VIEW_FACING)
    assert re.fullmatch(rf"red [01]\.\d\d #{box.id}", text.text)


def test_a_detector_that_was_started_again_gives_no_id_of_before(ros) -> None:
    bench = Bench(ros, camera=FakeCamera(ros))
    before = {d.id for d in bench.detect().detections}
    assert {d.id for d in bench.detect().detections} == before
    ros.executor.remove_node(bench.node)
    again = Bench(ros, camera=bench.camera)
    again.t_ns = bench.t_ns
    assert before.isdisjoint(d.id for d in again.detect().detections)


@pytest.mark.requirement("A-61")
def test_an_empty_table_is_an_answer(bench) -> None:
    """An empty array with the stamp of the image."""
    bench.camera.rgb[:] = (180, 176, 170)
    assert bench.detect("an empty answer").detections == []


@pytest.mark.requirement("B-69")
def test_images_are_subscribed_to_only_while_detections_have_a_subscriber(ros) -> None:
    """No subscription without demand; demand by any output starts it, its end ends it."""
    camera = FakeCamera(ros)
    ros.add(DetectNode())
    ros.spin_until(lambda: ros.node.count_subscribers("/tf_static") == 1, what="the detector is up")
    assert camera.unwatched()
    watch = Watch(ros, MarkerArray, "/detection_markers")
    ros.spin_until(camera.watched, what="the camera is listened to")
    ros.node.destroy_subscription(watch.subscription)
    ros.spin_until(camera.unwatched, what="the camera is let go")


@pytest.mark.requirement("B-28", "B-30", "B-34", "A-31")
def test_what_does_not_fit_is_named_and_dropped(bench) -> None:
    """Encodings, sizes, frames, a CameraInfo without calibration; the next good frame is answered."""
    for text, stream, make in (
        ("encoding 'nv24'", "color", _relabel),
        ("valid: rgb8, bgr8", "color", lambda cam, t: array_to_image(cam.rgb[..., 0], "mono8", cam.frame, t)),
        (
            "depth image is 320x240",
            "depth",
            lambda cam, t: array_to_image(np.ascontiguousarray(cam.depth[::2, ::2]), "32FC1", cam.frame, t),
        ),
        ("colour image is 320x240", "color", lambda cam, t: array_to_image(cam.rgb[::2, ::2], "rgb8", cam.frame, t)),
        (
            "depth encoding 'mono8' is not supported; valid: 16UC1, mono16, 32FC1",
            "depth",
            lambda cam, t: array_to_image(np.zeros((480, 640), np.uint8), "mono8", cam.frame, t),
        ),
        ("not calibrated", "info", _info),
        ("'overhead_link', expected the optical frame", "info", lambda cam, t: _info(cam, t, frame="overhead_link")),
        ("depth is in frame", "depth", lambda cam, t: array_to_image(cam.depth, "32FC1", "other_optical_frame", t)),
    ):
        bench.said(text, **{stream: partial(make, bench.camera)})
    assert bench.watch.got == []
    assert bench.detect().detections


def _relabel(camera: FakeCamera, t_ns: int) -> Image:
    message = array_to_image(camera.rgb, "rgb8", camera.frame, t_ns)
    message.encoding = "nv24"
    return message


def _info(camera: FakeCamera, t_ns: int, frame: str = "") -> CameraInfo:
    info = info_from_intrinsics(camera.K, frame or camera.frame, t_ns)
    if not frame:
        info.k = [0.0] * 9
    return info


@pytest.mark.requirement("A-32", "R-15")
def test_what_is_seen_with_wrong_intrinsics_is_an_obstacle_but_no_target_and_diagnostics_say_why(ros, bench) -> None:
    """Those of the configuration are loosely compared; those of the calibration to five pixels, while there are any."""
    calibrated = ros.node.create_publisher(CameraInfo, "/calibration/overhead/camera_info", QOS_LATCHED)
    right = bench.camera.K

    def variances() -> float:
        (found,) = bench.detect().detections
        return found.results[0].pose.covariance[0]

    def status() -> tuple[int, str]:
        (status,) = (s for s in bench.diagnostics.got[-1].status if s.name == "detector: status")
        return int.from_bytes(status.level), {v.key: v.value for v in status.values}["code"]

    assert variances() > 0.0
    bench.camera.K = replace(right, fx=1.1 * right.fx, fy=1.1 * right.fy)
    assert variances() == -1.0, "one frame is no alarm"
    bench.said("INTRINSICS_MISMATCH: camera_info (fx 457.3, fy 457.3, cx 319.5, cy 239.5) is up to 40 pixels off")
    assert variances() == -2.0
    ros.spin_until(lambda: status() == (2, "INTRINSICS_MISMATCH"), what="diagnostics with the code")
    bench.camera.K = replace(right, cx=right.cx + 8.0)
    assert variances() > 0.0
    calibrated.publish(info_from_intrinsics(right, bench.camera.frame, 0))
    bench.said("that its mount was calibrated with")
    bench.camera.K = right
    assert variances() > 0.0
    calibrated.publish(CameraInfo())
    bench.camera.K = replace(right, cx=right.cx + 8.0)
    bench.pump(lambda: bench.watch.got[-1].detections[0].results[0].pose.covariance[0] > 0.0, "no record, no refusal")


@pytest.mark.requirement("B-33", "B-60")
def test_without_a_mount_the_frame_is_skipped_with_a_warning(ros) -> None:
    """No transform, no detection: the frame is named on /diagnostics; with the mount there, detections come."""
    bench = Bench(ros, camera=FakeCamera(ros), mounted=False, transform_wait=0.1)
    bench.said("frame skipped: pose of the camera at its stamp: frame 'overhead_color_optical_frame'")
    assert bench.watch.got == []
    bench.camera.publish_mount()
    assert bench.detect().detections


def arm(t_ns: int, q: float, speed: float = 0.0) -> JointState:
    """A joint state of the right arm with joint 1 at `q`."""
    state = JointState(
        name=[f"openarm_right_joint{i}" for i in range(1, 8)],
        position=[q, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6],
        velocity=[speed] + [0.0] * 6,
    )
    state.header.stamp = ns_to_stamp(t_ns)
    return state


def on_arm(ros, **params) -> Bench:
    """A detector on the wrist camera, which sees the same as the overhead one when joint 1 is at 0.5 rad."""
    state = arm(0, 0.5)
    q = dict(zip(state.name, state.position, strict=True))
    T_base_link7 = RobotDescription.load().link_pose("openarm_right_link7", q)
    return Bench(ros, camera=FakeCamera(ros, "wrist", "openarm_right_link7", T_base_link7), **params)


def frame_waits(bench: Bench) -> None:
    """Pump until a frame waits for joint states, and those that are published from now on arrive."""
    joints = bench.camera.joints
    bench.pump(lambda: bench.node.waiting_ns and joints.get_subscription_count(), "a frame waits for joint states")


@pytest.mark.requirement("B-14", "B-32", "B-61")
def test_a_camera_on_the_arm_waits_for_the_joints_at_the_stamp(ros) -> None:
    """The frame comes first, joint states 8 ms before and 12 ms after it later: the pose is interpolated.

    The newest joint state, with the arm elsewhere, is not used. The wait is long here, so that a busy machine passes.
    """
    bench = on_arm(ros, transform_wait=5.0)
    frame_waits(bench)
    t = bench.node.waiting_ns
    for offset, q in ((-8, 0.46), (12, 0.56), (400, 1.2)):
        bench.camera.joints.publish(arm(t + offset * MS, q, 5.0))
    ros.spin_until(lambda: bench.watch.got, what="the detection of the frame that waited")
    assert stamp_to_ns(bench.watch.got[0].header.stamp) == t
    (found,) = bench.watch.got[0].detections
    np.testing.assert_allclose(pose_to_matrix(found.bbox.center)[:3, 3], (0.30, -0.20, TABLE + 0.025), atol=0.0015)


@pytest.mark.parametrize(
    ("key", "value", "fault"),
    [
        ("camera", "rear", "cameras: overhead, wrist"),
        ("camera", "spectator", "no depth"),
        ("policy", "largest", "score"),
        ("max_rate", 0.0, "greater than 0"),
    ],
)
def test_wrong_parameters_are_named(ros, key, value, fault) -> None:
    """The valid choices are listed."""
    with pytest.raises(OpenArmError, match=fault):
        ros.start(DetectNode, **{key: value})
