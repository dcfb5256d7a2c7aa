# SPDX-License-Identifier: Apache-2.0
"""Node `calibration` with a camera and a robot of the test: samples, refusals, solving, storing."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from openarm_interfaces.srv import (
    ComputeCalibration,
    GetSampleList,
    ListAlgorithms,
    RemoveSample,
    SampleFile,
    SaveCalibration,
    SetAlgorithm,
    TakeSample,
)
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image, JointState

from openarm_calibration.board import CircleGrid
from openarm_calibration.node import CalibrationNode
from openarm_calibration.refine import mount_error
from openarm_calibration.store import CalibrationStore
from openarm_calibration.synthetic_session import Known, make_session
from openarm_common import se3
from openarm_common.cameras import T_LINK_OPTICAL
from openarm_common.convert import array_to_image, info_from_intrinsics, ns_to_stamp
from openarm_common.node import QOS_COMMAND, QOS_SENSOR

MS = 1_000_000
BOARD = CircleGrid()


class Robot:
    """Joint states at 100 Hz and images at 20 Hz of a time of its own; poses of a session with a known mount."""

    def __init__(self, ros, camera: str, known: Known) -> None:
        self.known, self.camera = known, camera
        self.offset_ns = 0  # of the image stamps
        self.speed = 0.0  # of joint 1, rad/s
        self.images = True
        self.blank = False
        self._t = 10_000 * MS
        self._show = known.samples.samples[0]
        self._pixels = np.zeros((480, 640, 3), np.uint8)
        node = ros.node
        self._joints = node.create_publisher(JointState, "/joint_states", QOS_COMMAND)
        self._image = node.create_publisher(Image, f"/{camera}/color/image_raw", QOS_SENSOR)
        self._info = node.create_publisher(CameraInfo, f"/{camera}/color/camera_info", QOS_SENSOR)
        node.create_timer(0.01, self._tick)

    def pose(self, k: int) -> None:
        """Stand as in sample k, and let the camera see that."""
        self._show = self.known.samples.samples[k]
        optics = self.known.samples.head.optics
        scale, zoom, T = 4000.0, 3, self._show.T_camera_board
        w, h = BOARD.size
        to_board = np.array([[1 / scale, 0, 0.5 / scale - w / 2], [0, 1 / scale, 0.5 / scale - h / 2], [0, 0, 1]])
        K = optics.matrix
        K[:2] *= zoom
        K[:2, 2] += (zoom - 1) / 2
        H = K @ np.stack([T[:3, 0], T[:3, 1], T[:3, 3]], axis=1) @ to_board
        large = cv2.warpPerspective(BOARD.draw(scale), H, (640 * zoom, 480 * zoom), borderValue=130)
        grey = cv2.resize(large, (640, 480), interpolation=cv2.INTER_AREA)
        self._pixels = np.repeat(grey[:, :, None], 3, axis=2).astype(np.uint8)

    def _tick(self) -> None:
        self._t += 10 * MS
        message = JointState(name=list(self._show.joints), position=list(self._show.joints.values()))
        message.position[0] += self.speed * (self._t - 10_000 * MS) * 1e-9
        message.header.stamp = ns_to_stamp(self._t)
        self._joints.publish(message)
        if self.images and self._t % (50 * MS) == 0:
            frame = f"{self.camera}_color_optical_frame"
            t = self._t + self.offset_ns
            pixels = np.full_like(self._pixels, 128) if self.blank else self._pixels
            self._info.publish(info_from_intrinsics(self.known.samples.head.optics, frame, t))
            self._image.publish(array_to_image(pixels, "rgb8", frame, t))


class Verbs:
    """Calls of the services."""

    def __init__(self, ros) -> None:
        self._ros = ros

    def __call__(self, kind, name: str, **fields):
        client = self._ros.node.create_client(kind, f"/calibration/{name}")
        return self._ros.call(client, kind.Request(**fields), 30.0)


@pytest.fixture
def store(tmp_path: Path) -> CalibrationStore:
    return CalibrationStore(tmp_path / "store")


def start(ros, store: CalibrationStore, camera: str = "wrist", **more) -> None:
    given = {"camera": camera, "store": str(store.folder), "mount_seed": 1, "image_timeout": 0.5, "state_timeout": 0.5}
    ros.add(CalibrationNode(parameter_overrides=[Parameter(k, value=v) for k, v in {**given, **more}.items()]))


@pytest.mark.parametrize(("camera", "setup"), [("wrist", "in_hand"), ("overhead", "to_hand")])
def test_a33_a34_a45_from_images_to_a_stored_mount(ros, store, tmp_path: Path, camera: str, setup: str) -> None:
    """Ten samples by service, solved and stored: the true mount to 0.3 mm and 0.03°; saved and loaded the same."""
    known = make_session(setup, 10, px=1e-9)
    robot = Robot(ros, camera, known)
    start(ros, store, camera)
    call = Verbs(ros)
    assert "first sample" in call(GetSampleList, "get_sample_list").advice
    for k in range(10):
        robot.pose(k)
        taken = call(TakeSample, "take_sample")
        assert taken.success, taken.message
        assert len(taken.samples) == k + 1
    solved = call(ComputeCalibration, "compute_calibration")
    assert solved.success, solved.message
    assert solved.grade == "pass", solved.reasons
    assert solved.child == f"{camera}_link"
    assert json.loads(solved.report)["figures"]["samples"] == 10
    saved = call(SaveCalibration, "save_calibration")
    assert saved.success, saved.message
    stored = store.load(camera)
    offset, angle = mount_error(stored.T_parent_link, known.X @ se3.inverse(T_LINK_OPTICAL))
    assert offset < 0.3e-3
    assert angle < math.radians(0.03)
    assert stored.mount_seed == 1
    path = str(tmp_path / "session.npz")
    assert call(SampleFile, "save_samples", path=path).success
    assert call(RemoveSample, "remove_sample").samples == [f"s{k:03d}" for k in range(1, 10)]
    assert len(call(SampleFile, "load_samples", path=path).samples) == 10
    again = call(ComputeCalibration, "compute_calibration")
    assert again.mount == solved.mount
    assert again.success


def test_a44_a41_refusals_come_with_a_code_and_the_node_goes_on(ros, store) -> None:
    """Late stamps, a moving robot, no board, no image, too few samples, wrong names."""
    robot = Robot(ros, "wrist", make_session("in_hand", 3, px=1e-9))
    robot.pose(0)
    start(ros, store)
    call = Verbs(ros)
    assert call(SaveCalibration, "save_calibration").code == "NOT_READY"
    nothing = call(ComputeCalibration, "compute_calibration")
    assert (nothing.success, nothing.code) == (False, "DEGENERATE")
    assert "too few poses" in nothing.message
    robot.offset_ns = 1000 * MS
    late = call(TakeSample, "take_sample")
    assert late.code == "STALE_DATA", late.message
    robot.offset_ns, robot.speed = 0, 0.2
    moving = call(TakeSample, "take_sample")
    assert moving.code == "MOVING"
    assert "rad/s" in moving.message
    robot.speed, robot.blank = 0.0, True
    assert call(TakeSample, "take_sample").code == "NOTHING_DETECTED"
    robot.blank, robot.images = False, False
    none = call(TakeSample, "take_sample")
    assert none.code == "NOT_READY"
    assert "/wrist/color/image_raw" in none.message
    robot.images = True
    assert call(TakeSample, "take_sample").success
    assert "samples: s001" in call(RemoveSample, "remove_sample", sample="s7").message
    assert call(SetAlgorithm, "set_algorithm", algorithm="tsai").success
    assert "algorithms: REFINED, TSAI" in call(SetAlgorithm, "set_algorithm", algorithm="tsay").message
    assert call(ListAlgorithms, "list_algorithms").current == "TSAI"
    assert call(SampleFile, "load_samples", path="/nowhere.npz").code == "CONFIG_INVALID"
    assert call(SampleFile, "save_samples", path="").code == "INVALID_ARGUMENT"
    assert call(ComputeCalibration, "compute_calibration").code == "DEGENERATE"
