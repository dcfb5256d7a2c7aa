# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate solve BAG`: recordings of an arm that stood in eight places, and what can be wrong with them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from openarm_bringup.bags.bag import BagWriter
from openarm_bringup.bags.ros.listener import from_profile
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.sampling.samples import load_session
from openarm_calibration.store.store import CalibrationStore
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL
from openarm_common.ros.convert import info_from_intrinsics, matrix_to_transform, ns_to_stamp
from openarm_common.ros.images import array_to_image
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_SENSOR
from tests.openarm_bringup.commands import answer_of, calibrate, calibrate_fails
from tests.openarm_calibration.known_session import BOARD, Known, make_session, photograph

MS = 1_000_000
PLACES = 8
PARAMETERS = "mujoco_bridge:\n  ros__parameters:\n    mount_seed: 1\n"
TOPICS = {
    "/wrist/color/image_raw": (Image, "sensor_msgs/msg/Image", QOS_SENSOR),
    "/wrist/color/camera_info": (CameraInfo, "sensor_msgs/msg/CameraInfo", QOS_SENSOR),
    "/joint_states": (JointState, "sensor_msgs/msg/JointState", QOS_COMMAND),
    "/tf_static": (TFMessage, "tf2_msgs/msg/TFMessage", QOS_LATCHED),
    "/robot_description": (String, "std_msgs/msg/String", QOS_LATCHED),
}


class Recorder:
    """Writes what a robot's topics would hold: joint states at 100 Hz, images at 10 Hz."""

    def __init__(self, bag: BagWriter, known: Known, *, without: str = "") -> None:
        self._bag, self._known, self._without = bag, known, without
        self.t = 100_000 * MS
        for topic, (_, name, qos) in TOPICS.items():
            if topic != without:
                bag.add_topic(topic, name, from_profile(qos))

    def write(self, topic: str, message: object) -> None:
        if topic != self._without:
            self._bag.write(topic, self.t, serialize_message(message))

    def stand(self, joints: Mapping[str, float], picture: np.ndarray, ms: int, *, states: bool = True) -> None:
        """Stand, seeing a picture."""
        self.move(joints, joints, picture, ms, states=states)

    def move(
        self,
        start: Mapping[str, float],
        end: Mapping[str, float],
        picture: np.ndarray,
        ms: int = 400,
        *,
        states: bool = True,
    ) -> None:
        """Move from joints to joints, seeing a picture."""
        optics = self._known.samples.head.optics
        for k in range(ms // 10):
            u = k / (ms / 10)
            joints = {name: (1 - u) * q + u * end[name] for name, q in start.items()}
            if states:
                message = JointState(name=list(joints), position=list(joints.values()))
                message.header.stamp = ns_to_stamp(self.t)
                self.write("/joint_states", message)
            if k % 10 == 5:
                frame = "wrist_color_optical_frame"
                self.write("/wrist/color/camera_info", info_from_intrinsics(optics, frame, self.t))
                self.write("/wrist/color/image_raw", array_to_image(picture, "mono8", frame, self.t))
            self.t += 10 * MS


def record(path: Path, known: Known, places: int, *, without: str = "") -> Path:
    """A bag of an arm that stands in places, then with nothing in view, then without joint states."""
    samples = known.samples.samples
    empty = np.full((480, 640), 130, np.uint8)
    with BagWriter(path, {"parameters": PARAMETERS}) as bag:
        recorder = Recorder(bag, known, without=without)
        recorder.write("/robot_description", String(data=known.description.urdf))
        mount = matrix_to_transform("openarm_right_link7", "wrist_link", np.eye(4), 0)
        recorder.write("/tf_static", TFMessage(transforms=[mount]))
        for k in range(places):
            picture = photograph(BOARD, samples[k].T_camera_board, known.samples.head.optics)
            recorder.stand(samples[k].joints, np.rint(picture).astype(np.uint8), 600)
            recorder.move(samples[k].joints, samples[(k + 1) % len(samples)].joints, empty)
        last = samples[places % len(samples)].joints
        recorder.stand(last, empty, 600)
        recorder.t += 2_000 * MS
        recorder.stand(last, empty, 300, states=False)
    return path


@pytest.fixture(scope="module")
def known() -> Known:
    return make_session("in_hand", PLACES, px=1e-9)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory, known: Known) -> Path:
    return record(tmp_path_factory.mktemp("bags") / "bag", known, PLACES)


@pytest.mark.long
@pytest.mark.requirement("P-28", "A-44")
def test_a_bag_is_solved_and_says_what_became_of_its_images(capsys, bag, known, tmp_path: Path) -> None:
    """One sample of each stand, to 0.05 mm of the true mount; what moved, was empty or had no joints is reported."""
    store, session = tmp_path / "store", tmp_path / "session.npz"
    argv = ("--store", str(store), "--session", str(session))
    code, data = answer_of(capsys, "calibrate", "solve", str(bag), "--save", *argv)
    assert code == 0, data["message"]
    stills = data["stills"]
    stands = [row for row in stills if row["code"] in ("OK", "NOTHING_DETECTED")]
    assert [row["sample"] for row in stands] == [f"s{k:03d}" for k in range(1, PLACES + 1)] + [""]
    assert "dark blobs seen" in stands[-1]["reason"]
    assert all("rad/s" in row["reason"] for row in stills if row["code"] == "MOVING")
    assert sum(row["code"] == "MOVING" for row in stills) == PLACES
    assert stills[-1]["code"] == "STALE_DATA"
    assert "ms away" in stills[-1]["reason"]
    assert sum(row["images"] for row in stills) == PLACES * 10 + 6 + 3
    stored = CalibrationStore(store).load("wrist")
    assert (stored.parent, stored.mount_seed, stored.samples) == ("openarm_right_link7", 1, PLACES)
    offset, angle = mount_error(stored.T_parent_link, known.X @ se3.inverse(T_LINK_OPTICAL))
    assert offset < 5e-5
    assert angle < math.radians(0.01)
    samples, digest = load_session(session, known.description)
    assert (len(samples), digest) == (PLACES, stored.session)
    code, out, _ = calibrate(capsys, "check", str(bag), "--store", str(store))
    assert code == 0
    assert "standstills of the robot" in out
    assert "images not used, MOVING, such as: the robot moves: openarm_right_joint" in out


@pytest.mark.parametrize(
    ("argv", "code", "words"),
    [
        (["--camera", "overhead"], 2, "no images of camera 'overhead'; cameras: wrist"),
        (["--camera", "../wrist"], 2, "no images of camera '../wrist'; cameras: wrist"),
        (["--board", "{kind: dots}"], 2, "boards: circles, symmetric_circles"),
        (["--board", "{rows: [}"], 2, "is not valid YAML"),
        (["--board", "dots"], 2, "expected keys and values"),
        (["--mount-seed", "-2"], 2, "expected 0 or more"),
        (["--session", "session.txt"], 2, "ends in .npz"),
        (["--algorithm", "tsay"], 2, "algorithms: REFINED"),
    ],
)
def test_wrong_calls_on_a_bag(capsys, bag, tmp_path, monkeypatch, argv: list[str], code: int, words: str) -> None:
    monkeypatch.chdir(tmp_path)
    calibrate_fails(capsys, code, words, "solve", str(bag), *argv)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("topic", ["/wrist/color/image_raw", "/wrist/color/camera_info", "/joint_states"])
def test_a_bag_that_lacks_a_topic_is_refused(capsys, known, tmp_path: Path, topic: str) -> None:
    bag = record(tmp_path / "bag", known, 1, without=topic)
    calibrate_fails(capsys, 2, topic.removeprefix("/wrist"), "solve", str(bag))


def test_options_of_a_bag_are_refused_for_a_session_file(capsys, known, tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    known.samples.save(path)
    options = ("--camera", "wrist", "--mount-seed", "1")
    calibrate_fails(capsys, 2, "--camera, --mount-seed: for a bag", "solve", str(path), *options)


def test_a_folder_that_is_no_bag_is_refused(capsys, tmp_path: Path) -> None:
    calibrate_fails(capsys, 2, "is not a bag", "solve", str(tmp_path))
