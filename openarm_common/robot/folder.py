# SPDX-License-Identifier: Apache-2.0
"""A robot is a folder: `models/robots/NAME/robot.yaml` says which files describe it, and what its parts are called."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping
from functools import cache, wraps
from pathlib import Path
from typing import Literal, ParamSpec, Self, TypeVar

from pydantic import Field, model_validator

from openarm_common.config import Config, load_config
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import is_file, models_dir
from openarm_common.robot.hand import HandParts
from openarm_common.robot.lift import LiftParts
from openarm_common.robot.motors import JointMotion, Motors
from openarm_common.robot.work import Work
from openarm_common.robot.zeros import zeros_path

P = ParamSpec("P")
R = TypeVar("R")

#: Names the robot of a process: a folder of `models/robots`, or the path of one elsewhere.
ROBOT = "OPENARM_ROBOT"
DEFAULT = "openarm_v1"


class ArmParts(Config):
    """One arm with its hand.

    Attributes:
        base: Link that the arm stands on.
        joints: Joints of the arm, from the shoulder.
        flange: Link that the last of them moves; it carries the hand, cameras and boards.
        hand: Link that the fingers move on.
        tcp: Link of the tool centre point: z out of the fingers, y the opening direction.
        finger_joint: Joint that drives the fingers; "": the arm has no hand, and is planned for alone.
        finger_sign: Sign of its positions, against those of the robot's hand.
        fingers: Their links; the pad of each is its collision shape `{link}_pad_collision`.
    """

    base: str
    joints: tuple[str, ...] = Field(min_length=1)
    flange: str
    hand: str
    tcp: str
    finger_joint: str = ""
    finger_sign: Literal[-1, 1] = 1
    fingers: tuple[str, ...] = ()

    @property
    def controlled(self) -> tuple[str, ...]:
        """Joints that are commanded: those of the arm, then the finger joint."""
        return (*self.joints, self.finger_joint) if self.finger_joint else self.joints

    @model_validator(mode="after")
    def _whole_hand(self) -> Self:
        if bool(self.finger_joint) != bool(self.fingers):
            raise ValueError("expected finger_joint and fingers, or neither of them")
        return self


class RobotFolder(Config):
    """What `robot.yaml` says; paths are relative to it.

    Attributes:
        xacro: Makes the URDF; this or `urdf`.
        urdf: The URDF as it is.
        srdf: Pairs of links that may touch, groups and postures.
        cameras: YAML of the cameras; "": it has none.
        base: Base frame: x forward, y left, z up, on the floor.
        hand: Abilities of the fingers of each arm; None: nothing is known of them.
        motion: Limits that plans keep for the joints of an arm; None: parameters of the motion node say them.
        motors: Motors of each arm; None: it is not simulated.
        hardware: YAML of the motors on CAN, where the robot is one that has them; it may be another robot's.
        arms: Arms by name; the group of each in the SRDF is `NAME_arm`.
        lift: Lift that carries all arms; None: they stand on the base.
        mirror: Signs that mirror the joint positions of one arm to the other; empty: arms are no mirror images.
        work: Workplace; None: it has no table, and no scenes.
    """

    xacro: str = ""
    urdf: str = ""
    srdf: str
    cameras: str = ""
    base: str
    hand: HandParts | None = None
    motion: JointMotion | None = None
    motors: Motors | None = None
    hardware: str = "hardware.yaml"
    arms: Mapping[str, ArmParts] = Field(min_length=1)
    lift: LiftParts | None = None
    mirror: tuple[float, ...] = ()
    work: Work | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if bool(self.xacro) == bool(self.urdf):
            text = f"expected one of xacro and urdf, got {'both' if self.xacro else 'neither'}"
            raise ValueError(text)
        return self

    @model_validator(mode="after")
    def _signs(self) -> Self:
        for name, arm in self.arms.items():
            if self.mirror and len(self.mirror) != len(arm.joints):
                text = f"mirror has {len(self.mirror)} signs, arm {name} has {len(arm.joints)} joints"
                raise ValueError(text)
            for part in ("motion", "motors"):
                rows = getattr(self, part).rows() if getattr(self, part) else ()
                for row, numbers in rows:
                    if len(numbers) != len(arm.joints):
                        text = f"{part}.{row} has {len(numbers)} numbers, arm {name} has {len(arm.joints)} joints"
                        raise ValueError(text)
        return self


def robot_source() -> str:
    """Return what names this process's robot: its name, or the path of a folder elsewhere."""
    return os.environ.get(ROBOT, "") or DEFAULT


def robot_name() -> str:
    """Return the name of this process's robot: of the folder that the environment variable `OPENARM_ROBOT` names."""
    return robot_folder().name


def robot_folder(name: str = "") -> Path:
    """Return the folder of a robot of `models/robots`, or that of this process's robot, which may be elsewhere."""
    folders, mine = models_dir() / "robots", robot_source()
    return folders / (mine if name in ("", Path(mine).name) else name)  # a path that is absolute stays one


def choose_robot(name: str | None) -> None:
    """Let the robot of this process, and of those that it starts, be another one; None leaves it.

    Args:
        name: Name of a folder of `models/robots`, or the path of a robot's folder elsewhere.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the robots there are.
    """
    if name is None:
        return
    elsewhere = Path(name).expanduser()
    if name not in robot_names() and is_file(elsewhere / "robot.yaml"):
        os.environ[ROBOT] = str(elsewhere.resolve())
    else:
        _check_name(name)
        os.environ[ROBOT] = name


def other_robot(name: str) -> str:
    """Return why what is of a robot is not for this process; empty when it is."""
    mine = robot_name()
    if name == mine:
        return ""
    return f"is of robot {name[:80]!r}, expected {mine!r}; take one of this robot, or name the other by {ROBOT}"


def per_robot(function: Callable[P, R]) -> Callable[P, R]:
    """Cache a function by its arguments, which can be hashed, by this process's robot and the zeros of its joints."""

    @cache
    def made(folder: Path, zeros: str, *args: P.args, **kwargs: P.kwargs) -> R:
        return function(*args, **kwargs)

    @wraps(function)
    def of_this_robot(*args: P.args, **kwargs: P.kwargs) -> R:
        return made(robot_folder(), zeros_path(), *args, **kwargs)

    return of_this_robot


def robot_names() -> tuple[str, ...]:
    """Return the robots there are."""
    return tuple(sorted(path.parent.name for path in (models_dir() / "robots").glob("*/robot.yaml")))


def _check_name(name: str) -> None:
    if name not in robot_names():
        text = f"no robot {name[:80]!r}; robots: {', '.join(robot_names())}, or the path of a folder with a robot.yaml"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)


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
    folder = robot_folder(name)
    if name != robot_name() or not is_file(folder / "robot.yaml"):
        _check_name(name)
    return folder, read_folder(folder)


def read_folder(folder: Path) -> RobotFolder:
    """Read `robot.yaml` of a folder, wherever it is.

    Raises:
        OpenArmError: CONFIG_INVALID, naming what is wrong.
    """
    return load_config(folder / "robot.yaml", RobotFolder)


@per_robot
def robot_hand() -> HandParts:
    """Return the hand of this process's robot.

    Raises:
        OpenArmError: Same as `load_folder`; CONFIG_INVALID, when its `robot.yaml` does not say it.
    """
    folder, robot = load_folder(robot_name())
    return _said(robot.hand, f"{folder / 'robot.yaml'}:hand: missing; it says what the fingers are and can do")


@per_robot
def robot_work() -> Work:
    """Return where this process's robot works.

    Raises:
        OpenArmError: Same as `load_folder`; CONFIG_INVALID, when its `robot.yaml` does not say it.
    """
    folder, robot = load_folder(robot_name())
    where = "where the table and the objects before the robot are"
    return _said(robot.work, f"{folder / 'robot.yaml'}:work: missing; it says {where}")


def _said(part: R | None, text: str) -> R:
    if part is None:
        raise OpenArmError(Code.CONFIG_INVALID, text)
    return part
