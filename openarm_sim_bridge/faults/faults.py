# SPDX-License-Identifier: Apache-2.0
"""What can be made to go wrong on purpose: names, parameters and their checks.

Faults of cameras are worked in the process that draws (`camera_faults`), those of robot and world in the thread that
steps the world (`world_faults`). What is random about a fault comes from its seed alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import yaml
from pydantic import Field

from openarm_common.config import Config, validate
from openarm_common.errors import Code, OpenArmError

Side = Literal["left", "right", "both"]


class _OfCamera(Config):
    camera: str = Field(default="", description="name of a camera; empty: all")


class CameraDrop(_OfCamera):
    """Frames are not published."""

    share: float = Field(default=0.5, ge=0.0, le=1.0, description="of the frames")


class CameraDelay(_OfCamera):
    """Frames are published late, with their own stamps."""

    seconds: float = Field(default=0.2, ge=0.0, le=10.0, description="wall clock, s")


class CameraFreeze(_OfCamera):
    """The picture stands still while stamps go on."""


class StampOffset(_OfCamera):
    """Stamps of images and infos are off."""

    ms: float = Field(default=20.0, ge=-10_000.0, le=10_000.0, description="added to the stamps")


class IntrinsicsBias(_OfCamera):
    """CameraInfo tells wrong intrinsics."""

    focal: float = Field(default=0.02, gt=-0.9, le=1.0, description="error of fx and fy, as a share")
    cx: float = Field(default=0.0, ge=-500.0, le=500.0, description="error of cx, pixels")
    cy: float = Field(default=0.0, ge=-500.0, le=500.0, description="error of cy, pixels")


class MountKnocked(_OfCamera):
    """The camera was knocked: it stands elsewhere than told; direction and axis come from the seed."""

    mm: float = Field(default=10.0, ge=0.0, le=200.0, description="shift")
    deg: float = Field(default=1.0, ge=0.0, le=90.0, description="turn")


class DepthPatch(_OfCamera):
    """A rectangle of the depth image is wrong."""

    u: int = Field(default=280, ge=0, description="left edge, pixels")
    v: int = Field(default=200, ge=0, description="top edge, pixels")
    width: int = Field(default=80, ge=1, description="pixels")
    height: int = Field(default=80, ge=1, description="pixels")
    metres: float = Field(default=0.1, ge=-5.0, le=5.0, description="added to the depth")


class LightChanged(Config):
    """Lamps are dimmed or brightened."""

    scale: float = Field(default=0.4, ge=0.0, le=4.0, description="of all lights")


class JointStateGap(Config):
    """Joint states fall silent once a period, at a time within it that comes from the seed."""

    ms: float = Field(default=200.0, gt=0.0, le=10_000.0, description="length of a gap")
    every: float = Field(default=1.0, gt=0.0, le=60.0, description="period, s; no longer than a gap: silent for good")


class ObjectNudged(Config):
    """An object is pushed aside, once, upright and at rest; the direction comes from the seed."""

    object: str = Field(min_length=1, description="its name")
    mm: float = Field(default=20.0, ge=0.0, le=300.0, description="how far")


class FrictionLowered(Config):
    """Everything is slippery."""

    scale: float = Field(default=0.2, ge=0.0, le=1.0, description="of all friction")


class GripperStuck(Config):
    """A gripper takes no command."""

    side: Side = Field(default="both", description="which gripper")


class GripperWeak(Config):
    """A gripper presses with less force."""

    side: Side = Field(default="both", description="which gripper")
    share: float = Field(default=0.1, ge=0.0, le=1.0, description="of its force")


class JointSag(Config):
    """The arm's own weight is not compensated: it hangs below its targets."""

    side: Side = Field(default="both", description="which arm")
    share: float = Field(default=0.0, ge=0.0, le=1.0, description="of the weight that is still carried")


class JointLate(Config):
    """Targets take effect late."""

    side: Side = Field(default="both", description="which arm, with its gripper")
    ms: float = Field(default=100.0, ge=0.0, le=2_000.0, description="how late")


CAMERA_FAULTS: Mapping[str, type[Config]] = {
    "camera_drop": CameraDrop,
    "camera_delay": CameraDelay,
    "camera_freeze": CameraFreeze,
    "stamp_offset": StampOffset,
    "intrinsics_bias": IntrinsicsBias,
    "mount_knocked": MountKnocked,
    "depth_patch": DepthPatch,
    "light_changed": LightChanged,
}
WORLD_FAULTS: Mapping[str, type[Config]] = {
    "joint_state_gap": JointStateGap,
    "object_nudged": ObjectNudged,
    "friction_lowered": FrictionLowered,
    "gripper_stuck": GripperStuck,
    "gripper_weak": GripperWeak,
    "joint_sag": JointSag,
    "joint_late": JointLate,
}
FAULTS: Mapping[str, type[Config]] = {**CAMERA_FAULTS, **WORLD_FAULTS}


@dataclass(frozen=True)
class Fault:
    """A checked fault: its parameters are an instance of the model that `FAULTS` has for its name."""

    name: str
    parameters: Config
    seed: int = 0

    @property
    def of_camera(self) -> bool:
        """Whether the process that draws works it."""
        return self.name in CAMERA_FAULTS

    @property
    def side(self) -> str:
        """Of the robot; both where the fault has none."""
        return str(getattr(self.parameters, "side", "both"))

    def hits(self, side: str) -> bool:
        """Whether it concerns a side of the robot."""
        return self.side in ("both", side)

    def sees(self, camera: str) -> bool:
        """Whether it concerns a camera."""
        return getattr(self.parameters, "camera", "") in ("", camera)


def checked_fault(name: str, data: Mapping[str, Any], seed: int = 0) -> Fault:
    """Make a fault.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the faults there are, or the parameter that is wrong.
    """
    if name not in FAULTS:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"no fault {name!r}; faults: {', '.join(FAULTS)}")
    if seed < 0:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"seed is {seed}, expected 0 or more")
    model = FAULTS[name]
    try:
        return Fault(name, validate(model, dict(data), f"fault {name}"), seed)
    except OpenArmError as error:
        known = ", ".join(model.model_fields) or "none"
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{error.message}; parameters: {known}") from error


def parse_fault(name: str, text: str, seed: int = 0) -> Fault:
    """Make a fault from a YAML mapping of its parameters; empty is the defaults.

    Raises:
        OpenArmError: INVALID_ARGUMENT, as `checked_fault`, or when the text is no YAML mapping.
    """
    try:
        data: Any = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"parameters of {name!r} are not YAML: {error}") from error
    if data is not None and not isinstance(data, dict):
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"parameters of {name!r} are {text!r}, expected a YAML mapping such as {{key: 1.0}}"
        )
    parameters: dict[str, Any] = {} if data is None else data
    return checked_fault(name, parameters, seed)
