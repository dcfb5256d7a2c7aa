# SPDX-License-Identifier: Apache-2.0
"""Fault injection: names, parameters and their checks.

Faults of cameras are applied in the process that draws (`camera_faults`), those of robot and world in the thread that
steps the world (`world_faults`). All randomness of a fault comes from its seed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from pydantic import Field

from openarm_common.config import Config, parse_yaml, validate
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief

ParametersT = TypeVar("ParametersT", bound=Config)


class OfCamera(Config):
    """Concerns one camera, or all."""

    camera: str = Field(default="", description="name of a camera; empty: all")

    def hits(self, camera: str) -> bool:
        """Whether it concerns a camera."""
        return self.camera in ("", camera)


class OfSide(Config):
    """Concerns one arm and gripper, or all of them."""

    side: str = Field(default="both", description="which arm or gripper, or both")

    def hits(self, arm: str) -> bool:
        """Whether it concerns an arm of the robot."""
        return self.side in ("both", arm)


class CameraDrop(OfCamera):
    """Frames are not published."""

    share: float = Field(default=0.5, ge=0.0, le=1.0, description="of the frames")


class CameraDelay(OfCamera):
    """Frames are published late, with their own stamps."""

    seconds: float = Field(default=0.2, ge=0.0, le=10.0, description="wall clock, s")


class CameraFreeze(OfCamera):
    """The picture stays the same while stamps advance."""


class StampOffset(OfCamera):
    """Stamps of images and infos are off."""

    ms: float = Field(default=20.0, ge=-10_000.0, le=10_000.0, description="added to the stamps")


class IntrinsicsBias(OfCamera):
    """CameraInfo has wrong intrinsics."""

    focal: float = Field(default=0.02, gt=-0.9, le=1.0, description="error of fx and fy, as a share")
    cx: float = Field(default=0.0, ge=-500.0, le=500.0, description="error of cx, pixels")
    cy: float = Field(default=0.0, ge=-500.0, le=500.0, description="error of cy, pixels")


class MountKnocked(OfCamera):
    """The camera was knocked: its true pose is off the published one; direction and axis come from the seed."""

    mm: float = Field(default=10.0, ge=0.0, le=200.0, description="shift")
    deg: float = Field(default=1.0, ge=0.0, le=90.0, description="turn")


class DepthPatch(OfCamera):
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
    """Joint states are not published for a while once per period, at a time that comes from the seed."""

    ms: float = Field(default=200.0, gt=0.0, le=10_000.0, description="length of a gap")
    every: float = Field(default=1.0, gt=0.0, le=60.0, description="period, s; no longer than a gap: none is published")


class ObjectNudged(Config):
    """An object is displaced once, upright and without velocity; the direction comes from the seed."""

    object: str = Field(min_length=1, description="its name")
    mm: float = Field(default=20.0, ge=0.0, le=300.0, description="how far")


class FrictionLowered(Config):
    """All friction is lowered."""

    scale: float = Field(default=0.2, ge=0.0, le=1.0, description="of all friction")


class GripperStuck(OfSide):
    """A gripper takes no command."""


class GripperWeak(OfSide):
    """A gripper presses with less force."""

    share: float = Field(default=0.1, ge=0.0, le=1.0, description="of its force")


class JointSag(OfSide):
    """A part of an arm's weight is not carried, or more than is known where motors carry nothing: it sags."""

    share: float = Field(default=0.0, ge=0.0, le=1.0, description="the rest of the weight is added, unknown to all")


class JointLate(OfSide):
    """Targets take effect late."""

    ms: float = Field(default=100.0, ge=0.0, le=2_000.0, description="how late")


class MotorFault(Config):
    """A motor behind frames of its bus does not do as it should; see `openarm_common.motors.emulated.FAULTS`."""

    kind: str = Field(min_length=1, description="silent, error, hot, freeze, zero, loss, late, bus_off or power")
    joint: str = Field(default="", description="of the motor, where it is one")
    value: float = Field(default=0.0, description="status nibble, °C, rad, share or s")


def _by_name(*models: type[Config]) -> Mapping[str, type[Config]]:
    return {re.sub(r"(?<!^)(?=[A-Z])", "_", model.__name__).lower(): model for model in models}


CAMERA_FAULTS = _by_name(
    CameraDrop, CameraDelay, CameraFreeze, StampOffset, IntrinsicsBias, MountKnocked, DepthPatch, LightChanged
)
WORLD_FAULTS = _by_name(
    JointStateGap, ObjectNudged, FrictionLowered, GripperStuck, GripperWeak, JointSag, JointLate, MotorFault
)
#: Parameters of every fault by its name.
FAULTS: Mapping[str, type[Config]] = {**CAMERA_FAULTS, **WORLD_FAULTS}


@dataclass(frozen=True)
class Fault:
    """A checked fault: its parameters are an instance of the model that `FAULTS` has for its name."""

    name: str
    parameters: Config
    seed: int = 0

    @property
    def of_camera(self) -> bool:
        """Whether the process that draws applies it."""
        return self.name in CAMERA_FAULTS


def find(faults: Iterable[Fault], model: type[ParametersT]) -> ParametersT | None:
    """Return the parameters of the fault of a type; None when it is not among the faults."""
    return next((fault.parameters for fault in faults if isinstance(fault.parameters, model)), None)


def checked_fault(name: str, data: Mapping[str, Any], seed: int = 0) -> Fault:
    """Make a fault.

    Args:
        name: One of `FAULTS`.
        data: Its parameters; those left out are the defaults.
        seed: Seed of all randomness of the fault.

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

    Args:
        name: One of `FAULTS`.
        text: YAML.
        seed: Seed of all randomness of the fault.

    Raises:
        OpenArmError: INVALID_ARGUMENT, as `checked_fault`, or when the text is no YAML mapping.
    """
    data: Any = parse_yaml(text, f"parameters of {brief(name)}", Code.INVALID_ARGUMENT)
    if data is not None and not isinstance(data, dict):
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"parameters of {name!r} are {brief(text)}, expected a YAML mapping such as {{key: 1.0}}",
        )
    parameters: dict[str, Any] = {} if data is None else data
    return checked_fault(name, parameters, seed)
