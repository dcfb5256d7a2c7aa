# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate import BAG`: another robot, compressed images through a lens, poses by joint states or /tf."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from openarm_bringup.bags.bag import BagWriter
from openarm_bringup.bags.ros.listener import from_profile
from openarm_calibration.board.board import read_board
from openarm_calibration.foreign.pose_robot import joints_of_pose, robot_of_poses
from openarm_calibration.handeye.refine import mount_error
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL
from openarm_common.ros.convert import info_from_intrinsics, matrix_to_transform, ns_to_stamp
from openarm_common.ros.images import array_to_image
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_SENSOR
from tests.openarm_bringup.commands import answer_of, calibrate_fails
from tests.openarm_calibration import foreign_files as files
from tests.openarm_calibration import known_session

MS = 1_000_000
PLACES = 7
BOARD = "aprilgrid:5x4:30mm:0.3"
LENS = np.array([0.2, -0.1, 0.001, -0.0005, 0.02, 0.35, -0.05, 0.01])
TYPES = {
    "/eye/image/compressed": (CompressedImage, "sensor_msgs/msg/CompressedImage", QOS_SENSOR),
    "/eye/image_rect": (Image, "sensor_msgs/msg/Image", QOS_SENSOR),
    "/eye/camera_info": (CameraInfo, "sensor_msgs/msg/CameraInfo", QOS_SENSOR),
    "/joint_states": (JointState, "sensor_msgs/msg/JointState", QOS_COMMAND),
    "/tf": (TFMessage, "tf2_msgs/msg/TFMessage", QOS_COMMAND),
    "/tf_static": (TFMessage, "tf2_msgs/msg/TFMessage", QOS_LATCHED),
    "/robot_description": (String, "std_msgs/msg/String", QOS_LATCHED),
}


def record(path: Path, known: files.Truth, topics: tuple[str, ...], lens: np.ndarray | None) -> Path:
    """Write a bag of a robot `ur` that stands in places; between them nothing is recorded but one state in motion."""
    robot = robot_of_poses("ur_base", "ur_tool")
    info = info_from_intrinsics(files.K, "eye", 0)
    info.distortion_model, info.d = "rational_polynomial", LENS.tolist()  # also of images that are rectified
    t = 50_000 * MS
    with BagWriter(path, {}) as bag:
        for topic in topics:
            bag.add_topic(topic, TYPES[topic][1], from_profile(TYPES[topic][2]))

        def write(topic: str, message: object) -> None:
            if topic in topics:
                bag.write(topic, t, serialize_message(message))

        write("/robot_description", String(data=robot.urdf))
        mount = matrix_to_transform("flange", "ur_tool", se3.make(None, (0.0, 0.0, 0.1)), 0)
        write("/tf_static", TFMessage(transforms=[mount]))
        board = read_board(BOARD)
        for A, C in zip(known.A, known.C, strict=True):
            picture = known_session.photograph(board, C, files.K)
            picture = picture if lens is None else files.distorted(picture, lens)
            grey = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
            joints: Mapping[str, float] = joints_of_pose(A)
            for k in range(60):
                stamp = ns_to_stamp(t)
                state = JointState(name=list(joints), position=list(joints.values()))
                state.header.stamp = stamp
                write("/joint_states", state)
                other = JointState(name=["gripper"], position=[0.1])  # of a driver of its own
                other.header.stamp = stamp
                write("/joint_states", other)
                flange = A @ se3.make(None, (0.0, 0.0, -0.1))
                moving: TransformStamped = matrix_to_transform("ur_base", "flange", flange, t)
                write("/tf", TFMessage(transforms=[moving]))
                if k in (30, 40):
                    packed = CompressedImage(format="png", data=cv2.imencode(".png", grey)[1].tobytes())
                    packed.header.stamp = info.header.stamp = stamp
                    write("/eye/image/compressed", packed)
                    write("/eye/image_rect", array_to_image(grey, "mono8", "eye", t))
                    write("/eye/camera_info", info)
                t += 10 * MS
            t += 2_000 * MS
    return path


@pytest.fixture(scope="module")
def known() -> files.Truth:
    return files.truth("in_hand", PLACES, seed=2)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory, known: files.Truth) -> Path:
    topics = ("/eye/image/compressed", "/eye/camera_info", "/joint_states", "/robot_description")
    return record(tmp_path_factory.mktemp("foreign") / "bag", known, topics, LENS)


def off(data: dict, known: files.Truth) -> float:
    item = data["calibration"]
    link = se3.make(se3.matrix_from_quat_xyzw(item["quaternion_xyzw"]), item["position"])
    return mount_error(link @ T_LINK_OPTICAL, known.X)[0]


@pytest.mark.long
@pytest.mark.requirement("P-28", "A-44")
def test_a_bag_of_another_robot_with_a_lens_is_solved_and_its_session_too(capsys, bag, known, tmp_path: Path) -> None:
    """URDF of the bag, CompressedImage, rational_polynomial, joint states of two drivers."""
    session = tmp_path / "eye.npz"
    argv = ("--camera-kind", "eye_in_hand", "--tip", "ur_tool", "--board", BOARD, "--session", str(session))
    code, data = answer_of(capsys, "calibrate", "import", str(bag), *argv, "--store", str(tmp_path))
    assert code == 0, data["message"]
    assert [row["sample"] for row in data["stills"]] == [f"s{k + 1:03d}" for k in range(PLACES)]
    assert off(data, known) < 2e-4
    code, data = answer_of(capsys, "calibrate", "solve", str(session), "--store", str(tmp_path))
    assert code == 0, data["message"]
    assert off(data, known) < 2e-4


@pytest.mark.requirement("P-28", "A-44")
def test_a_bag_without_a_description_is_solved_by_tf(capsys, known, tmp_path: Path) -> None:
    """A rectified image, whose CameraInfo has the distortion of the lens; a chain of a moving and a static frame."""
    path = record(tmp_path / "bag", known, ("/eye/image_rect", "/eye/camera_info", "/tf", "/tf_static"), None)
    argv = ("--camera-kind", "eye_in_hand", "--base", "ur_base", "--tip", "ur_tool", "--board", BOARD)
    store = ("--store", str(tmp_path / "s"))
    code, data = answer_of(capsys, "calibrate", "import", str(path), *argv, "--joint-topic", "tf", *store)
    assert code == 0, data["message"]
    assert off(data, known) < 1e-4


TIP = ("--camera-kind", "eye_in_hand", "--tip", "ur_tool")


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ((), "give --camera-kind"),
        (("--camera-kind", "eye_in_hand"), "--tip is no link of the robot poses; links: ur_base"),
        ((*TIP, "--base", "x"), "--base is no link"),
        ((*TIP, "--image-topic", "/no"), "no messages of /no; topics of that kind: /eye/image/compressed"),
        ((*TIP, "--joint-topic", "/no"), "no messages of /no; topics of that kind: /joint_states"),
        ((*TIP, "--joint-topic", "tf"), "poses by /tf need --base and --tip"),
        ((*TIP, "--joint-topic", "tf", "--base", "ur_base"), "/tf does not lead from 'ur_tool' to 'ur_base'"),
        ((*TIP, "--urdf", "nowhere.urdf"), "nowhere.urdf does not exist"),
        ((*TIP, "--unit", "mm"), "--unit is no option for a bag"),
        ((*TIP, "--intrinsics", "1,2"), "WIDTH,HEIGHT,FX,FY,CX,CY"),
    ],
)
def test_wrong_calls_say_what_there_is(capsys, bag: Path, argv, words: str) -> None:
    calibrate_fails(capsys, 2, words, "import", str(bag), *argv)
