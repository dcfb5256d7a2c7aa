# SPDX-License-Identifier: Apache-2.0
"""Calibration samples of a bag: images, camera_info, joint states, robot and frames as they were recorded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from openarm_bringup.bags.bag import Bag
from openarm_bringup.bags.ros.messages import contents, message_of, messages_of
from openarm_bringup.supervision.environment import name_of_zeros
from openarm_calibration.board.board import Board
from openarm_calibration.board.detect import detect_undistorted
from openarm_calibration.sampling.gate import GateConfig
from openarm_calibration.sampling.samples import SampleSet, head_of
from openarm_calibration.sampling.stills import Picker, Stretch, stretches
from openarm_common.camera.cameras import CameraConfig, load_cameras
from openarm_common.camera.lens import Lens
from openarm_common.config import parse_yaml
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.images import grey_image, lens_from_info

#: Ends of the topics of images: as they are, or compressed.
_IMAGES = ("/color/image_raw", "/color/image_raw/compressed")
_INFOS = "/color/camera_info"


@dataclass
class _Small:
    """All of a bag but its images."""

    robot: RobotDescription
    parents: dict[str, str]
    states: list[tuple[int, Mapping[str, float]]]
    lenses: dict[int, Lens]


def samples_of(
    bag: Bag, camera: str, board: Board, carrier: str, mount_seed: int | None
) -> tuple[SampleSet, list[Stretch]]:
    """Take a sample of each posture in which the robot rests.

    Args:
        bag: Open.
        camera: Camera whose images are used; empty: the only one.
        board: Board to detect.
        carrier: Link that holds the board when the camera is fixed; empty is the node's parameter.
        mount_seed: Seed of simulated mounts; None is what the bag says of itself.

    Returns:
        The samples, and what became of all images.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the bag lacks a topic or the camera; BAD_IMAGE, for a camera that is not
            calibrated; NO_TRANSFORM, when nothing says which link carries the camera.
    """
    camera = _camera(bag, camera)
    with contents(bag):
        small = _small(bag, camera)
    lens = next(iter(small.lenses.values()))
    configured = load_cameras()
    own = RobotDescription.load()
    base = own.base if own.base in small.robot.links else small.robot.root
    parent = _parent(small, camera, base, configured)
    simulated = camera not in configured or configured[camera].mount_error
    seed = mount_seed if mount_seed is not None else _seed(bag)
    head = head_of(
        camera, parent, small.robot, lens.intrinsics, board, carrier,
        base=base, mount_seed=seed if simulated else None, zeros_of=name_of_zeros(_bridge(bag)),
    )  # fmt: skip
    # a session file of a robot that this suite does not have keeps its description
    link = head.parent if head.setup == "in_hand" else head.carrier
    ours = link in own.links and all(joint.name in own.joints for joint in small.robot.chain(link))
    samples = SampleSet(head, own.described if ours else small.robot, foreign=not ours)
    images = next(topic for end in _IMAGES if bag.counts.get(topic := f"/{camera}{end}"))
    # The first bytes of a message are its stamp; the pixels are read in a second pass, where they are needed.
    with contents(bag):
        stamps = [stamp_of(record.data) for record in bag.records([images])]
    found = stretches(stamps, small.states, samples.joint_names, small.robot, GateConfig())
    picker = Picker(samples, found, partial(detect_undistorted, board, lens=lens))
    for record in bag.records([images]):
        t_ns = stamp_of(record.data)
        if picker.wants(t_ns):
            picker.offer(t_ns, grey_image(message_of(bag, record)), small.lenses.get(t_ns, lens).intrinsics)
    return samples, found


def _camera(bag: Bag, name: str) -> str:
    """Return the camera whose images are used."""
    counted = [topic for topic, count in bag.counts.items() if count]
    there = sorted({topic[1 : -len(end)] for topic in counted for end in _IMAGES if topic.endswith(end)})
    if name and name not in there:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"{bag.path} has no images of camera {name!r}; cameras: {', '.join(there) or 'none'}"
        )
    if not name and len(there) != 1:
        expected = "give one by --camera" if there else f"expected a topic /NAME{_IMAGES[0]}, or that with /compressed"
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{bag.path} has images of {len(there)} cameras: {', '.join(there) or 'none'}; {expected}",
        )
    camera = name or there[0]
    needed = (f"/{camera}{_INFOS}", "/joint_states")
    missing = [topic for topic in needed if not bag.counts.get(topic)]
    if missing:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{bag.path} has no {' and no '.join(missing)}; `openarm record --profile camera` records what is needed",
        )
    return camera


def _small(bag: Bag, camera: str) -> _Small:
    info = f"/{camera}{_INFOS}"
    found = messages_of(bag, (info, "/joint_states", "/tf_static", "/robot_description"))
    states = [
        (stamp_to_ns(message.header.stamp), dict(zip(message.name, message.position, strict=False)))
        for message in found["/joint_states"]
    ]
    urdf = found["/robot_description"][-1].data if found["/robot_description"] else ""
    return _Small(
        # what the bag says of the robot holds, also where this suite knows the robot otherwise
        robot=RobotDescription.from_urdf(urdf) if urdf else RobotDescription.load(),
        parents={e.child_frame_id: e.header.frame_id for message in found["/tf_static"] for e in message.transforms},
        states=sorted(states, key=lambda state: state[0]),
        lenses={stamp_to_ns(message.header.stamp): lens_from_info(message) for message in found[info]},
    )


def _parent(small: _Small, camera: str, base: str, configured: Mapping[str, CameraConfig]) -> str:
    """Link that carries a camera: by /tf_static of the bag, or by the configuration where that is silent of it."""
    links, frame = small.robot.links, f"{camera}_link"
    if frame not in small.parents and camera in configured:
        frame = configured[camera].parent
    above = _ancestors(small.parents, base)
    for ancestor in (frame, *_ancestors(small.parents, frame)):
        if ancestor in links:
            return ancestor
        if ancestor in above:  # such as `world`: the camera is fixed relative to the robot
            return base
    raise OpenArmError(
        Code.NO_TRANSFORM,
        f"nothing says which link carries {camera!r}: /tf_static of the bag does not tie '{camera}_link' to a link of"
        f" its robot; links: {', '.join(links)}",
    )


def _ancestors(parents: Mapping[str, str], frame: str) -> list[str]:
    """Frames above one, the nearest first."""
    out: list[str] = []
    while frame in parents and parents[frame] not in out:
        frame = parents[frame]
        out.append(frame)
    return out


def _bridge(bag: Bag) -> dict[str, Any] | None:
    """Return the parameters of the simulation that a bag was recorded from; None: it is of none, or says nothing."""
    try:
        nodes: Any = parse_yaml(bag.custom.get("parameters", ""), "parameters")
        return dict(nodes["mujoco_bridge"]["ros__parameters"])
    except (OpenArmError, KeyError, TypeError):
        return None


def _seed(bag: Bag) -> int | None:
    """Mount seed of the simulation that a bag was recorded from."""
    seed = (_bridge(bag) or {}).get("mount_seed")
    return seed if isinstance(seed, int) and seed >= 0 else None


def stamp_of(data: bytes) -> int:
    """Stamp of a serialized message that begins with a header, ns."""
    order = "little" if data[1] & 1 else "big"
    seconds, nanoseconds = (int.from_bytes(data[k : k + 4], order, signed=k == 4) for k in (4, 8))
    return seconds * 10**9 + nanoseconds
