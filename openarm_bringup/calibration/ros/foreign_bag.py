# SPDX-License-Identifier: Apache-2.0
"""Calibration samples of a bag of another robot: any topics, compressed images, distortion, its URDF or /tf alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple
from functools import partial

import numpy as np

from openarm_bringup.bags.bag import Bag
from openarm_bringup.bags.ros.messages import contents, message_of, messages_of
from openarm_bringup.calibration.foreign_options import Foreign, lens_given
from openarm_bringup.calibration.ros.samples import stamp_of
from openarm_calibration.board.board import Board
from openarm_calibration.board.detect import detect_undistorted
from openarm_calibration.foreign.pose_robot import joints_of_pose, robot_of_poses
from openarm_calibration.foreign.pose_source import kind_of
from openarm_calibration.sampling.gate import GateConfig
from openarm_calibration.sampling.samples import SampleSet, SessionHead
from openarm_calibration.sampling.stills import Picker, State, Stretch, stretches
from openarm_common import se3
from openarm_common.camera.lens import Lens
from openarm_common.config import read_text, validate
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import stamp_to_ns, transform_to_matrix
from openarm_common.ros.images import grey_image, is_rectified, lens_from_info
from openarm_common.types import Array

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO, _JOINTS, _TF = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/JointState", "tf2_msgs/msg/TFMessage"
#: Transforms of a chain are of one moment when they are this near to each other, ns.
_SAME_NS = 50_000_000


def samples_of_foreign(bag: Bag, board: Board, given: Foreign) -> tuple[SampleSet, list[Stretch]]:
    """Take a sample of each posture in which the robot rests.

    Args:
        bag: Open.
        board: Board to detect.
        given: Options of the command line.

    Returns:
        The samples, and what became of all images.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when a topic, a link or an option is missing, with those that there are.
    """
    setup = kind_of(given.camera_kind or "", "a bag")
    images = _topic(bag, "image_topic", given.image_topic, (_IMAGE, _COMPRESSED), without="depth")
    with contents(bag):
        lens = _lens(bag, images, given)
        robot, states = _of_tf(bag, given) if given.joint_topic == "tf" else _of_joints(bag, given)
    base = given.base or robot.root
    head = {
        "camera": given.camera, "setup": setup, "parent": given.tip if setup == "in_hand" else base,
        "carrier": given.tip, "base": base, "intrinsics": astuple(lens.intrinsics), "board": board.model_dump(),
    }  # fmt: skip
    samples = SampleSet(validate(SessionHead, head, "import", Code.INVALID_ARGUMENT), robot, foreign=True)
    names = samples.joint_names
    whole = [(t, joints) for t, joints in states if all(name in joints for name in names)]
    if not whole:
        seen = sorted({name for _, joints in states[:100] for name in joints})
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"no joint states of {bag.path} have all of {', '.join(names) or 'the moving joints'} between {base!r} and"
            f" {given.tip!r}; joints: {', '.join(seen) or 'none'}",
        )
    with contents(bag):
        stamps = [stamp_of(record.data) for record in bag.records([images])]
    found = stretches(stamps, whole, names, robot, GateConfig())
    picker = Picker(samples, found, partial(detect_undistorted, board, lens=lens))
    for record in bag.records([images]):
        t_ns = stamp_of(record.data)
        if picker.wants(t_ns):
            message = message_of(bag, record)
            try:
                pixels = grey_image(message)
            except OpenArmError as error:
                picker.refuse(t_ns, error)
            else:
                picker.offer(t_ns, pixels, lens.intrinsics)
    return samples, found


def _topic(bag: Bag, option: str, name: str, kinds: Sequence[str], without: str = "") -> str:
    """Return the topic of an option, or the only one of its types."""
    there = sorted(t for t, (kind, _) in bag.topics.items() if kind in kinds and bag.counts.get(t))
    wanted = [t for t in there if not without or without not in t]
    if name:
        if name not in there:
            listed = ", ".join(there) or "none"
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"{bag.path} has no messages of {name}; topics of that kind: {listed}"
            )
        return name
    if len(wanted) != 1:
        expected = f"give one by --{option.replace('_', '-')}" if wanted else f"expected one of {' or '.join(kinds)}"
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{bag.path} has {len(wanted)} topics for that: {', '.join(wanted) or 'none'}; {expected}",
        )
    return wanted[0]


def _lens(bag: Bag, images: str, given: Foreign) -> Lens:
    """Return the lens by CameraInfo next to the images, or by the options."""
    if given.intrinsics:
        return lens_given(given.intrinsics)
    parts = images.split("/")
    near = [f"{'/'.join(parts[:k])}/camera_info" for k in range(len(parts) - 1, 0, -1)]
    name = given.info_topic or next((t for t in near if bag.counts.get(t)), "")
    topic = _topic(bag, "info_topic", name, (_INFO,))
    info = messages_of(bag, (topic,))[topic][-1]
    return lens_from_info(info, rectified=is_rectified(images))


def _of_joints(bag: Bag, given: Foreign) -> tuple[RobotDescription, list[State]]:
    """Return the robot, and its joint states in the order of their stamps."""
    if given.urdf is not None:
        urdf = read_text(given.urdf, Code.INVALID_ARGUMENT)
    else:
        texts = messages_of(bag, ("/robot_description",))["/robot_description"]
        if not texts:
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"{bag.path} has no /robot_description; give its URDF by --urdf, or take poses by --joint-topic tf",
            )
        urdf = texts[-1].data
    robot = RobotDescription.from_urdf(urdf)
    if given.tip not in robot.links or (given.base and given.base not in robot.links):
        what = "--tip" if given.tip not in robot.links else "--base"
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"{what} is no link of the robot {robot.name}; links: {', '.join(robot.links)}"
        )
    name = given.joint_topic or ("/joint_states" if bag.counts.get("/joint_states") else "")
    topic = _topic(bag, "joint_topic", name, (_JOINTS,))
    states = [
        (stamp_to_ns(message.header.stamp), dict(zip(message.name, message.position, strict=False)))
        for message in messages_of(bag, (topic,))[topic]
    ]
    return robot, sorted(states, key=lambda state: state[0])


def _of_tf(bag: Bag, given: Foreign) -> tuple[RobotDescription, list[State]]:
    """Return a robot of poses, and the pose of the tip in the base as its joint states, by /tf and /tf_static."""
    if not (given.base and given.tip):
        raise OpenArmError(Code.INVALID_ARGUMENT, "poses by /tf need --base and --tip: frames of the robot")
    found = messages_of(bag, ("/tf", "/tf_static"))
    parents: dict[str, str] = {}
    poses: dict[str, list[tuple[int, Array]]] = {}
    for message in (*found["/tf_static"], *found["/tf"]):
        for one in message.transforms:
            child = one.child_frame_id.lstrip("/")
            parents[child] = one.header.frame_id.lstrip("/")
            poses.setdefault(child, []).append((stamp_to_ns(one.header.stamp), transform_to_matrix(one.transform)))
    chain, frame = list[str](), given.tip
    while frame != given.base:
        if frame not in parents or frame in chain:
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"/tf does not lead from {given.tip!r} to {given.base!r}; frames: {', '.join(sorted(parents))}",
            )
        chain.append(frame)
        frame = parents[frame]
    static = {one.child_frame_id.lstrip("/") for message in found["/tf_static"] for one in message.transforms}
    moving = [name for name in chain if name not in static]
    if not moving:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"nothing moves between {given.base!r} and {given.tip!r} in /tf")
    return robot_of_poses(given.base, given.tip), _along(chain, moving, poses)


def _along(chain: list[str], moving: list[str], poses: Mapping[str, list[tuple[int, Array]]]) -> list[State]:
    """Return the joints that stand for the pose of a chain, at the stamps of its first moving frame."""
    ordered = {name: sorted(poses[name], key=lambda pair: pair[0]) for name in chain}
    times = {name: np.array([t for t, _ in pairs]) for name, pairs in ordered.items()}
    stamps, rows = list[int](), list[list[float]]()
    keys: list[str] = []
    for t in times[moving[0]].tolist():
        T = np.eye(4)
        for name in chain:
            k = int(np.argmin(np.abs(times[name] - t))) if name in moving else -1
            if k >= 0 and abs(int(times[name][k]) - t) > _SAME_NS:
                break
            T = ordered[name][k][1] @ T
        else:
            if se3.is_pose(T):
                joints = joints_of_pose(T)
                keys = list(joints)
                stamps.append(int(t))
                rows.append(list(joints.values()))
    if not rows:
        return []
    values = np.array(rows)
    values[:, 3:] = np.unwrap(values[:, 3:], axis=0)
    return [(t, dict(zip(keys, row, strict=True))) for t, row in zip(stamps, values.tolist(), strict=True)]
