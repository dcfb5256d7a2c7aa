# SPDX-License-Identifier: Apache-2.0
"""Samples of one camera and board, and the session file that keeps them.

A session is one NPZ file without pickles: the head (camera, board, what carries what) as JSON, and of each sample the
marks, the joint states with both stamps, and the image. It can be solved again without robot or ROS. Robot poses are
recomputed from the joints by the description that reads it, or, for a robot that is not of this suite, by its own that
the file keeps.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path
from typing import IO, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from openarm_calibration.board.board import Board, parse_board
from openarm_calibration.board.detect import BoardDetection, guess_pose
from openarm_calibration.foreign.pose_robot import are_of_pose
from openarm_calibration.handeye.kinematics import ArmPosture, Kinematics
from openarm_calibration.handeye.problem import BoardView, Problem, assemble
from openarm_calibration.handeye.transforms import difference
from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.config import Config, validate
from openarm_common.errors import Code, OpenArmError, said
from openarm_common.resources import write_whole
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.zeros import REAL, zeros_of
from openarm_common.types import Array

#: Half the step of the derivative of the robot's pose by time, s.
_RATE_STEP_NS = 10_000_000
#: Of session files.
SESSION_SUFFIXES = (".npz",)


class SessionHead(Config):
    """What a session is about."""

    camera: str = Field(min_length=1, pattern=r"^[a-z][a-z0-9_]*$", description="name of the camera")
    setup: Literal["in_hand", "to_hand"] = Field(description="whether the arm carries the camera or the board")
    parent: str = Field(min_length=1, description="link that carries the camera")
    carrier: str = Field(min_length=1, description="link that moves: the camera's parent, or what carries the board")
    base: str = Field(default="", description="base frame; empty: the root of the robot")
    intrinsics: tuple[int, int, float, float, float, float] = Field(description="width, height, fx, fy, cx, cy")
    board: dict[str, Any] = Field(description="keys of the board")
    mount_seed: int | None = Field(default=None, description="of the simulated mounts")
    created: str = Field(default="", description="when, as ISO 8601")
    robot: str = Field(default="", description="name of the robot; empty in sessions of older versions")
    zeros_of: str = Field(default=REAL, description="robot whose joint zeros count: zeros, or a simulated one's")

    @field_validator("intrinsics")
    @classmethod
    def _of_a_camera(
        cls, value: tuple[int, int, float, float, float, float]
    ) -> tuple[int, int, float, float, float, float]:
        if fault := Intrinsics(*value).fault():
            raise ValueError(fault)
        return value

    @property
    def optics(self) -> Intrinsics:
        """Intrinsics of the camera."""
        return Intrinsics(*self.intrinsics)


@dataclass(frozen=True, eq=False)
class Sample:
    """One image of the board with the robot at its stamp.

    Args:
        name: Unique in the session.
        t_image_ns: Stamp of the image.
        t_joints_ns: Stamp of the nearest joint state.
        joints: Positions at the stamp of the image, rad or m.
        speed: Speed of the fastest joint, rad/s.
        detection: Marks of the board.
        T_camera_board: (4, 4) by the marks alone.
        png: The image; may be empty.
        track: Joint states around the image.
    """

    name: str
    t_image_ns: int
    t_joints_ns: int
    joints: Mapping[str, float]
    speed: float
    detection: BoardDetection
    T_camera_board: Array
    png: bytes = b""
    track: tuple[tuple[int, Mapping[str, float]], ...] = field(default=())


class SampleSet:
    """The samples of one session.

    Args:
        head: Subject of the session.
        description: The robot; its forward kinematics turn joints into poses.
        foreign: Whether the session file keeps the description, since no other reader has it.
    """

    def __init__(self, head: SessionHead, description: RobotDescription, *, foreign: bool = False) -> None:
        head = head.model_copy(update={"base": head.base or description.root})
        for what, link in (("parent", head.parent), ("carrier", head.carrier), ("base", head.base)):
            if link not in description.links:
                links = ", ".join(description.links)
                raise OpenArmError(Code.CONFIG_INVALID, f"session:{what}: no link {link!r}; links: {links}")
        self.head = head
        self.board = parse_board(head.board, "session:board")
        self._description, self._foreign = description, foreign
        self._samples: list[Sample] = []
        self._taken = 0

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self._samples)

    @property
    def samples(self) -> tuple[Sample, ...]:
        """In the order they were taken."""
        return tuple(self._samples)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joints that move the camera against the board."""
        link = self.head.parent if self.head.setup == "in_hand" else self.head.carrier
        return tuple(joint.name for joint in self._description.chain(link) if joint.type != "fixed")

    def copy(self) -> SampleSet:
        """Return a set with the same samples."""
        return self._of(self._description)

    @property
    def description(self) -> RobotDescription:
        """The robot."""
        return self._description

    @property
    def foreign(self) -> bool:
        """Whether the robot is one that the session describes itself."""
        return self._foreign

    def with_zeros(self, offsets: Mapping[str, float]) -> SampleSet:
        """Return the same samples of a robot with these zeros of its joints, instead of those that it has, rad."""
        mine = {name: offset for name, offset in offsets.items() if name in self._description.joints}
        return self._of(self._description.described.with_zeros(mine))

    def _of(self, description: RobotDescription) -> SampleSet:
        out = SampleSet(self.head, description, foreign=self._foreign)
        for sample in self._samples:
            out.add(sample)
        return out

    def take(
        self, t_image_ns: int, matched: Any, detection: BoardDetection, image: NDArray[np.uint8] | None = None
    ) -> Sample:
        """Make a sample and add it.

        Args:
            t_image_ns: Stamp of the image.
            matched: `gate.Matched`.
            detection: Detection of the board in the image.
            image: Image to keep, (h, w) grey.

        Raises:
            OpenArmError: NOTHING_DETECTED, when the marks have no pose.
        """
        T, _ = guess_pose(self.board.points[detection.ids], detection.pixels, self.board.radius, self.head.optics)
        png = b"" if image is None else cv2.imencode(".png", image)[1].tobytes()
        self._taken += 1
        sample = Sample(
            f"s{self._taken:03d}", t_image_ns, matched.t_joints_ns, dict(matched.joints), matched.speed, detection, T,
            png, matched.track,
        )  # fmt: skip
        self._samples.append(sample)
        return sample

    def add(self, sample: Sample) -> None:
        """Add a sample; its name must be new.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when it is taken.
        """
        if any(sample.name == other.name for other in self._samples):
            raise OpenArmError(Code.INVALID_ARGUMENT, f"there is a sample {sample.name!r} already")
        self._samples.append(sample)
        self._taken = max(self._taken, len(self._samples))

    def remove(self, name: str) -> Sample:
        """Remove a sample by its name; an empty name is the last.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing the names.
        """
        for k, sample in enumerate(self._samples):
            if sample.name == name or (not name and k == len(self._samples) - 1):
                return self._samples.pop(k)
        names = ", ".join(s.name for s in self._samples) or "none"
        raise OpenArmError(Code.INVALID_ARGUMENT, f"no sample {name!r}; samples: {names}")

    def pose(self, joints: Mapping[str, float]) -> Array:
        """Return A (4, 4): T_base_parent when the arm carries the camera, else T_parent_carrier."""
        link = self._description.link_pose
        if self.head.setup == "in_hand":
            return se3.inverse(link(self.head.base, joints)) @ link(self.head.parent, joints)
        return se3.inverse(link(self.head.parent, joints)) @ link(self.head.carrier, joints)

    def kinematics(self, parameters: tuple[str, ...]) -> Kinematics:
        """Return what turns joint positions into A, with these parameters (see `Kinematics`)."""
        head = self.head
        base, tip = (head.base, head.parent) if head.setup == "in_hand" else (head.parent, head.carrier)
        return Kinematics(self._description, base, tip, parameters)

    def pose_at(self, sample: Sample, t_ns: int) -> Array:
        """Return A (4, 4) at a stamp near a sample's, by its track; at the sample's own joints without one."""
        times = [t for t, _ in sample.track]
        if len(times) < 2 or not times[0] <= t_ns <= times[-1]:
            return self.pose(sample.joints)
        names = list(sample.joints)
        values = np.array([[state[name] for name in names] for _, state in sample.track])
        at = [float(np.interp(t_ns, times, column)) for column in values.T]
        return self.pose(dict(zip(names, at, strict=True)))

    def problem(self, delay_s: float = 0.0) -> Problem:
        """Return the hand-eye problem of all samples, whose images are assumed to be `delay_s` old at their stamps.

        Raises:
            OpenArmError: DEGENERATE, without samples.
        """
        if not self._samples:
            raise OpenArmError(Code.DEGENERATE, "too few poses: no samples; take at least 3, better 10 to 15")
        views: list[BoardView] = []
        kinematics = None if are_of_pose(self.joint_names) else self.kinematics(self.joint_names)
        for k, sample in enumerate(self._samples):
            t_ns = sample.t_image_ns - round(delay_s * 1e9)
            early, late = (self.pose_at(sample, t_ns + step) for step in (-_RATE_STEP_NS, _RATE_STEP_NS))
            A = self.pose_at(sample, t_ns) if delay_s else self.pose(sample.joints)
            rate = difference(early, late) / (2e-9 * _RATE_STEP_NS)
            points = self.board.points[sample.detection.ids]
            view = BoardView(points, sample.detection.pixels, A, self.head.setup, self.board.radius, pose=k, rate=rate)
            arm = None if kinematics is None else ArmPosture(kinematics, sample.joints)
            views.append(replace(view, name=sample.name, arm=arm))
        return assemble(views, [self.head.optics], [sample.T_camera_board for sample in self._samples])

    # --- session file
    def _text(self) -> str:
        """Return all but marks and images, as JSON."""
        listed = [
            {
                "name": sample.name, "t_image_ns": sample.t_image_ns, "t_joints_ns": sample.t_joints_ns,
                "joints": dict(sample.joints), "speed": sample.speed, "residual": sample.detection.residual,
                "track": [[t, dict(state)] for t, state in sample.track],
            }
            for sample in self._samples
        ]  # fmt: skip
        robot = {"urdf": self._description.urdf} if self._foreign else {}
        return json.dumps({"format": 1, "head": self.head.model_dump(mode="json"), "samples": listed, **robot})

    def digest(self) -> str:
        """Return the hash of the session as it is now, as `save` returns it."""
        return hashlib.sha256(self._text().encode()).hexdigest()

    def save(self, path: Path) -> str:
        """Write the session and return its hash.

        Raises:
            OpenArmError: ENVIRONMENT, when it can't be written; INVALID_ARGUMENT, for a name that is not .npz.
        """
        if path.suffix not in SESSION_SUFFIXES:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"session file {path}: expected a name that ends in .npz")
        text = self._text()
        arrays: dict[str, NDArray[Any]] = {}
        for k, sample in enumerate(self._samples):
            arrays[f"ids_{k}"] = sample.detection.ids
            arrays[f"pixels_{k}"] = sample.detection.pixels
            arrays[f"pose_{k}"] = sample.T_camera_board
            arrays[f"png_{k}"] = np.frombuffer(sample.png, dtype=np.uint8)
        arrays["head"] = np.frombuffer(text.encode(), dtype=np.uint8)
        stream = io.BytesIO()
        np.savez_compressed(stream, **arrays)  # pyright: ignore[reportArgumentType]
        write_whole(path, stream.getvalue())
        return hashlib.sha256(text.encode()).hexdigest()


def head_of(
    camera: str, parent: str, description: RobotDescription, optics: Intrinsics, board: Board, carrier: str, **more: Any
) -> SessionHead:
    """Describe a session: a camera on a link that moves is in the hand; for another one an arm carries the board.

    Args:
        camera: Name of the camera.
        parent: Link that carries it.
        description: The robot.
        optics: Intrinsics.
        board: Board to detect.
        carrier: Link that holds the board of a camera that does not move; "": the flange of the robot's last arm.
        more: Other fields.
    """
    moves = any(joint.type != "fixed" for joint in description.chain(parent))
    if not carrier:
        *_, last = RobotDescription.load().arms.values()  # that of a bag names no arms
        carrier = last.flange
    more.setdefault("zeros_of", zeros_of())
    return SessionHead(
        camera=camera, setup="in_hand" if moves else "to_hand", parent=parent, carrier=parent if moves else carrier,
        intrinsics=astuple(optics), board=board.model_dump(), robot=description.name, **more,
    )  # fmt: skip


# --- reading a session file
#: What is kept of each sample in addition to the JSON.
_ARRAYS = ("ids", "pixels", "pose", "png")


def load_session(path: Path, description: RobotDescription) -> tuple[SampleSet, str]:
    """Read a session file; returns the samples and the hash.

    Args:
        path: Path of the session.
        description: Description of the robot, unless the session keeps one of its own.

    Raises:
        OpenArmError: CONFIG_INVALID, when it is missing, damaged, no session, or of another robot.
    """
    try:
        _require_archive(path)
        with np.load(path, allow_pickle=False) as data:
            text = bytes(data["head"]).decode()
            document = json.loads(text)
            head = validate(SessionHead, document["head"], f"{path}:head")
            if urdf := document.get("urdf"):
                description = RobotDescription.from_urdf(str(urdf))
            out = SampleSet(head, description, foreign=bool(urdf))
            for k, entry in enumerate(document["samples"]):
                out.add(_sample(entry, {name: data[f"{name}_{k}"] for name in _ARRAYS}, out))
    except _DAMAGED as error:
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{path} is no session file, or damaged: {type(error).__name__}: {said(error)}"
        ) from error
    return out, hashlib.sha256(text.encode()).hexdigest()


#: What reading an altered archive of JSON and arrays ends in; RuntimeError: encrypted, or nested too deeply;
#: TokenError: a header of numpy, which is text of Python.
_DAMAGED = (
    AttributeError, EOFError, LookupError, OSError, OverflowError, RuntimeError, TypeError, ValueError, struct.error,
    tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
#: Largest array, and the sum of all, unpacked, bytes.
_MAX_ARRAY, _MAX_SESSION = 64 * 2**20, 512 * 2**20


def _require_archive(path: Path) -> None:
    """Refuse what is no archive of arrays, or would fill the memory, before anything of it is unpacked.

    Raises:
        OpenArmError: CONFIG_INVALID.
    """
    try:
        with path.open("rb") as file:
            begin = file.read(2)
    except FileNotFoundError as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"session file {path} does not exist") from error
    except OSError as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"can't read session file {path}: {error.strerror}") from error
    if begin != b"PK":
        what = "is empty" if not begin else "is no session file: expected an .npz archive of samples"
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} {what}")
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        largest, total = max((m.file_size for m in members), default=0), sum(m.file_size for m in members)
        if largest > _MAX_ARRAY or total > _MAX_SESSION:
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"{path} unpacks to {total / 2**20:.0f} MiB, its largest array to {largest / 2**20:.0f} MiB; expected"
                f" at most {_MAX_SESSION // 2**20} and {_MAX_ARRAY // 2**20} MiB",
            )
        for member in members:
            with archive.open(member) as file:
                _require_array(file, member)


def _require_array(file: IO[bytes], member: zipfile.ZipInfo) -> None:
    """Refuse an array whose header says more than its data.

    Raises:
        ValueError: When there is no header, or it does not fit.
    """
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize > member.file_size:
        raise ValueError(f"{member.filename}: {dtype} of shape {shape} in {member.file_size} bytes")


def _sample(entry: dict[str, Any], arrays: Mapping[str, NDArray[Any]], samples: SampleSet) -> Sample:
    """Read a sample of a session file.

    Raises:
        KeyError, TypeError, ValueError: When something is missing or has no sense.
        OpenArmError: CONFIG_INVALID, when its joints are those of another robot.
    """
    name = str(entry["name"])
    if arrays["ids"].dtype.kind not in "iu":
        raise ValueError(f"sample {name} has ids of type {arrays['ids'].dtype}, expected integers")
    if any(arrays[key].dtype.kind not in "iuf" for key in ("pixels", "pose")):
        raise ValueError(f"sample {name} has pixels or a pose that are no numbers")
    ids, pixels = arrays["ids"].astype(np.int64), arrays["pixels"].astype(np.float64)
    pose = arrays["pose"].astype(np.float64)
    if pixels.shape != (len(ids), 2) or not np.isfinite(pixels).all() or len(ids) < 4:
        raise ValueError(f"sample {name} has {len(ids)} ids and pixels {pixels.shape}; expected 4 or more, all finite")
    if len(np.unique(ids)) != len(ids) or ids.min() < 0 or ids.max() >= len(samples.board.points):
        raise ValueError(f"sample {name} has marks that its board does not have, or twice")
    if pose.shape != (4, 4) or not se3.is_pose(pose):
        raise ValueError(f"sample {name} has a pose {pose.shape} that is none")
    joints = _joints(entry["joints"])
    missing = [joint for joint in samples.joint_names if joint not in joints]
    if missing:
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"sample {name} is of another robot: it lacks {', '.join(missing)}; it has"
            f" {', '.join(joints) or 'no joints'}",
        )
    track = tuple((int(t), _joints(state)) for t, state in entry["track"])
    if any(state.keys() != joints.keys() for _, state in track):
        raise ValueError(f"sample {name} has a track of other joints")
    return Sample(
        name, int(entry["t_image_ns"]), int(entry["t_joints_ns"]), joints, float(entry["speed"]),
        BoardDetection(ids, pixels, float(entry["residual"])), pose, arrays["png"].tobytes(), track,
    )  # fmt: skip


def _joints(state: Mapping[str, Any]) -> dict[str, float]:
    joints = {str(name): float(value) for name, value in state.items()}
    if not all(math.isfinite(value) for value in joints.values()):
        raise ValueError("a joint position is not finite")
    return joints
