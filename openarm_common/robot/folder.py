# SPDX-License-Identifier: Apache-2.0
"""A robot is a folder: `models/robots/NAME/robot.yaml` says which files describe it, and what its parts are called."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from openarm_common.config import Config, load_yaml, validate
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import models_dir

#: Names the robot of a process.
ROBOT = "OPENARM_ROBOT"
DEFAULT = "openarm_v1"


class ArmParts(Config):
    """One arm with its hand.

    Attributes:
        base: Link that the arm stands on.
        joints: Of the arm, from the shoulder.
        flange: Link that the last of them moves; it carries the hand, cameras and boards.
        hand: Link that the fingers move on.
        tcp: Link of the tool centre point: z out of the fingers, y the opening direction.
        finger_joint: That drives the fingers.
        fingers: Their links; the pad of each is its collision shape `{link}_pad_collision`.
    """

    base: str
    joints: tuple[str, ...] = Field(min_length=1)
    flange: str
    hand: str
    tcp: str
    finger_joint: str
    fingers: tuple[str, ...] = Field(min_length=1)

    @property
    def controlled(self) -> tuple[str, ...]:
        """Joints that are commanded: those of the arm, then the finger joint."""
        return (*self.joints, self.finger_joint)


class RobotFolder(Config):
    """What `robot.yaml` says; paths are relative to it.

    Attributes:
        xacro: Makes the URDF.
        srdf: Pairs of links that may touch, groups and postures.
        base: Base frame: x forward, y left, z up, on the floor.
        arms: By name; the group of each in the SRDF is `NAME_arm`.
        mirror: Signs that mirror the joint positions of one arm to the other; empty: arms are no mirror images.
    """

    xacro: str
    srdf: str
    base: str
    arms: Mapping[str, ArmParts] = Field(min_length=1)
    mirror: tuple[float, ...] = ()

    @model_validator(mode="after")
    def _signs(self) -> Self:
        for name, arm in self.arms.items():
            if self.mirror and len(self.mirror) != len(arm.joints):
                text = f"mirror has {len(self.mirror)} signs, arm {name} has {len(arm.joints)} joints"
                raise ValueError(text)
        return self


def robot_name() -> str:
    """Return the name of this process's robot: of the environment variable `OPENARM_ROBOT`."""
    return os.environ.get(ROBOT, "") or DEFAULT


def robot_names() -> tuple[str, ...]:
    """Return the robots there are."""
    return tuple(sorted(path.parent.name for path in (models_dir() / "robots").glob("*/robot.yaml")))


def arm_fault(arm: str, arms: Collection[str]) -> str:
    """Return what is wrong with the arm of a request; nothing with one of `arms`, "auto" and "" (the suite chooses)."""
    return "" if arm in ("auto", "", *arms) else f"arm {arm[:80]!r} does not exist; valid: auto, {', '.join(arms)}"


def known_arm(arm: str) -> str:
    """Return an arm of a request to this process's robot.

    Raises:
        ValueError: Listing the arms.
    """
    if text := arm_fault(arm, load_folder(robot_name())[1].arms):
        raise ValueError(text)
    return arm


def load_folder(name: str) -> tuple[Path, RobotFolder]:
    """Read `robot.yaml` of a robot; returns its folder, too.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the robots there are; CONFIG_INVALID, naming what is wrong.
    """
    if name not in robot_names():
        text = f"no robot {name[:80]!r}; robots: {', '.join(robot_names())}"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    path = models_dir() / "robots" / name / "robot.yaml"
    return path.parent, validate(RobotFolder, load_yaml(path), str(path))
