# SPDX-License-Identifier: Apache-2.0
"""Which motor drives a joint: `hardware.yaml` in the folder of a robot.

Values by joint are those of one arm, from the shoulder; all arms have the same motors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Self

from pydantic import Field, model_validator

from openarm_common.config import Config, load_config
from openarm_common.errors import Code, OpenArmError
from openarm_common.motors.axis import Axis
from openarm_common.motors.frames import KD_MAX, KP_MAX, LAST_ID, motor_type
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import load_folder, robot_name

Id = Annotated[int, Field(ge=1, le=LAST_ID)]
Stiffness = Annotated[float, Field(ge=0.0, le=KP_MAX)]
Damping = Annotated[float, Field(ge=0.0, le=KD_MAX)]


class JointMotors(Config):
    """Motors of the joints of an arm.

    Attributes:
        types: Types of the motors.
        stiffness, damping: Gains kp and kd of their commands, N m/rad and N m s/rad.
        stop_damping: kd with which an arm stops softly when it can't be held.
        ids: Ids of frames to them, unless an arm has its own; of frames from them `reply_offset` is added.
        reply_offset: Added to the ids.
        directions: 1, or -1 where motor and joint turn against each other.
    """

    types: tuple[str, ...]
    stiffness: tuple[Stiffness, ...]
    damping: tuple[Damping, ...]
    stop_damping: tuple[Damping, ...]
    ids: tuple[Id, ...]
    reply_offset: int = Field(default=0x10, ge=0x10, le=0x70)
    directions: tuple[int, ...] = ()

    @model_validator(mode="after")
    def _as_many(self) -> Self:
        n = len(self.ids)
        for name in ("types", "stiffness", "damping", "stop_damping"):
            if len(getattr(self, name)) != n:
                raise ValueError(f"{name} has {len(getattr(self, name))} values, ids has {n}; expected as many")
        if self.directions and (len(self.directions) != n or not set(self.directions) <= {-1, 1}):
            raise ValueError(f"directions: expected {n} values, 1 or -1")
        for name in self.types:
            try:
                motor_type(name)
            except OpenArmError as error:
                raise ValueError(error.message) from error
        return self


class GripperMotor(Config):
    """Motor of the fingers, commanded by POS_FORCE, which limits its force.

    Attributes:
        type: Type of the motor.
        id: Id of frames to it.
        ratio: Motor position by position of the finger joint, rad by m or rad; of a hand whose `finger_sign` is 1.
        speed: Largest of the motor, rad/s.
        torque: Largest of the motor, N m.
    """

    type: str
    id: Id
    ratio: float = Field(description="rad by m or rad")
    speed: float = Field(gt=0.0, le=100.0)
    torque: float = Field(gt=0.0)


class ArmWiring(Config):
    """Where the motors of one arm are.

    Attributes:
        bus: Address; `openarm_common.motors.bus.open_bus`.
        offsets: Motor positions where the joints are at 0, rad; empty: 0.
        ids: Ids of frames to its motors, the gripper's last, where another arm is on the same bus; empty: those of
            `joints` and `gripper`.
    """

    bus: str = Field(min_length=1)
    offsets: tuple[float, ...] = ()
    ids: tuple[Id, ...] = ()


class Wiring(Config):
    """What `hardware.yaml` says.

    Attributes:
        joints: Motors of the joints of an arm.
        gripper: Motor of its fingers.
        arms: Their buses, by name.
        flexible: Whether frames are sent as CAN FD.
    """

    joints: JointMotors
    gripper: GripperMotor
    arms: Mapping[str, ArmWiring]
    flexible: bool = True


def load_wiring(robot: str | None = None) -> Wiring:
    """Read `hardware.yaml` of a robot; None is that of this process.

    Raises:
        OpenArmError: CONFIG_INVALID, naming what is missing or wrong.
    """
    folder, parts = load_folder(robot or robot_name())
    path = folder / parts.hardware
    if not path.is_file():
        text = f"{path}: missing; it says which motor drives which joint, so nothing can be sent to this robot's motors"
        raise OpenArmError(Code.CONFIG_INVALID, text)
    return load_config(path, Wiring)


def axes_of(wiring: Wiring, description: RobotDescription, buses: Mapping[str, str] | None = None) -> tuple[Axis, ...]:
    """Return the motors in the order of the controlled joints.

    Args:
        wiring: Wiring of the robot.
        description: The robot.
        buses: Addresses by arm, in place of those of the wiring; arms of one bus have that of the first of them.

    Raises:
        OpenArmError: CONFIG_INVALID, when wiring and description do not fit, or two motors of a bus have the same id.
    """
    if missing := [name for name in description.arm_names if name not in wiring.arms]:
        text = f"hardware.yaml has no arm {', '.join(missing)}; it has {', '.join(wiring.arms)}"
        raise OpenArmError(Code.CONFIG_INVALID, text)
    found, first = list[Axis](), dict[str, str]()
    for arm, parts in description.arms.items():
        place, joints = wiring.arms[arm], wiring.joints
        if len(joints.ids) != len(parts.joints) or len(place.offsets) not in (0, len(parts.joints)):
            n = len(parts.joints)
            text = f"hardware.yaml has {len(joints.ids)} motors, arm {arm} has {n} joints; expected as many"
            raise OpenArmError(Code.CONFIG_INVALID, text)
        ids = place.ids or (*joints.ids, wiring.gripper.id)
        if len(ids) != len(parts.joints) + 1:
            text = f"hardware.yaml: arms.{arm}.ids has {len(ids)} values, expected {len(parts.joints) + 1}:"
            raise OpenArmError(Code.CONFIG_INVALID, f"{text} one for each joint, and the gripper's")
        bus = (buses or {}).get(first.setdefault(place.bus, arm), place.bus)
        lower, upper = description.limits(parts.controlled)
        if endless := [name for name, end in zip(parts.controlled, upper, strict=True) if math.isinf(end)]:
            text = f"joint {endless[0]!r} turns without end, but the frames of its motor hold positions of a few turns"
            way = 'make it type="revolute" with limits in the URDF'
            raise OpenArmError(Code.CONFIG_INVALID, f"{text}; {way}")
        speed = [description.joint(name).velocity for name in parts.controlled]
        for i, joint in enumerate(parts.joints):
            found.append(
                Axis(
                    joint,
                    arm,
                    bus,
                    ids[i],
                    ids[i] + joints.reply_offset,
                    joints.types[i],
                    float(joints.directions[i]) if joints.directions else 1.0,
                    place.offsets[i] if place.offsets else 0.0,
                    float(lower[i]),
                    float(upper[i]),
                    float(speed[i]),
                    joints.stiffness[i],
                    joints.damping[i],
                    joints.stop_damping[i],
                    motor_type(joints.types[i]).tau_max,
                    grips=False,
                )
            )
        hand = wiring.gripper
        ratio = hand.ratio * description.hand(arm).sign
        found.append(
            Axis(
                parts.finger_joint,
                arm,
                bus,
                ids[-1],
                ids[-1] + joints.reply_offset,
                hand.type,
                ratio,
                0.0,
                float(lower[-1]),
                float(upper[-1]),
                hand.speed / abs(ratio),
                0.0,
                0.0,
                0.0,
                hand.torque,
                grips=True,
                unit="m" if description.joint(parts.finger_joint).type == "prismatic" else "rad",
            )
        )
    _check_ids(found)
    return tuple(found)


def _check_ids(axes: Sequence[Axis]) -> None:
    """Refuse frames of one bus that are of two motors, or to one and from another.

    Raises:
        OpenArmError: CONFIG_INVALID, naming both, and what to set.
    """
    taken = dict[tuple[str, int], str]()
    for axis in axes:
        for number, way in ((axis.id, "to"), (axis.reply_id, "from")):
            who = f"{way} {axis.joint} (motor {axis.id})"
            if (other := taken.setdefault((axis.bus, number), who)) != who:
                mine = [x for x in axes if x.arm == axis.arm]
                others = {n for x in axes if x.bus == axis.bus and x not in mine for n in (x.id, x.reply_id)}
                free = [i for i in range(1, LAST_ID + 1) if not {i, i + axis.reply_id - axis.id} & others]
                raise OpenArmError(
                    Code.CONFIG_INVALID,
                    f"frames {other} and {who} have the same id {number:#x} on {axis.bus}; in hardware.yaml give arm"
                    f" {axis.arm} a bus of its own, or other ids, as"
                    f" `arms.{axis.arm}.ids: {free[: len(mine)]}` (`openarm hardware set-id` sets them in the motors)",
                )
