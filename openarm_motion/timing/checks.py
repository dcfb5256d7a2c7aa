# SPDX-License-Identifier: Apache-2.0
"""Checks of a trajectory before it is sent to a controller: joints, numbers, limits, where it starts, the other arm.

s, rad, rad/s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.turns import nearest_turns
from openarm_motion.collision.exact import Clearance, CollisionContext, CollisionScene
from openarm_motion.timing.trajectory import Motion

if TYPE_CHECKING:
    from openarm_motion.planning.arm import Arm

#: What rounding (or another interpolation between the points) may add to a limit.
_SLACK = 1.02
_ROUNDING = 1e-3
#: Time between two checks of a pair of moving arms, s.
_PAIR_STEP = 0.04
#: Arms on their way keep this distance, m: less than plans keep, so that a plan is not refused for rounding.
_PAIR_CLEARANCE = 0.005


def check_trajectory(arm: Arm, motion: Motion, state: Mapping[str, float]) -> Motion:
    """Refuse a trajectory that the arm should not follow.

    Args:
        arm: The arm.
        motion: The trajectory, its columns in any order: all joints of the arm and no others.
        state: Present positions by joint name.

    Returns:
        The motion, columns in the arm's order, joints that turn without end in the turn that they are in.

    Raises:
        OpenArmError: INVALID_ARGUMENT or LIMITS, with the joint, the point and the value.
    """
    names, t, q, v, a = motion.names, motion.t, motion.q, motion.v, motion.a
    unknown = [name for name in names if name not in arm.names]
    missing = [name for name in arm.names if name not in names]
    if unknown or missing or len(names) != len(arm.names):
        fault = ", ".join(filter(None, [_list("unknown", unknown), _list("missing", missing)])) or "a joint named twice"
        raise _invalid(arm, f"{fault}; expected {', '.join(arm.names)}")
    if t.size == 0:
        raise _invalid(arm, "no points")
    for values, what in ((q, "position"), (v, "velocity"), (a, "acceleration")):
        if values is not None and not np.all(np.isfinite(values)):
            k, i = (int(x) for x in np.argwhere(~np.isfinite(values))[0])
            raise _invalid(arm, f"{what} of {names[i]} at point {k} is {values[k, i]}, expected a finite number")
    if not np.all(np.isfinite(t)) or t[0] < 0.0 or np.any(np.diff(t) <= 0.0):
        k = int(np.argmax(np.diff(t, prepend=-1.0) <= 0.0))
        raise _invalid(arm, f"time of point {k} is {t[k]:g} s, expected times that rise from 0 or later")
    order = [list(names).index(name) for name in arm.names]
    q = q[:, order]
    lower, upper = arm.kinematics.lower - _ROUNDING, arm.kinematics.upper + _ROUNDING
    outside = (q < lower) | (q > upper)
    if np.any(outside):
        k, i = (int(x) for x in np.argwhere(outside)[0])
        raise OpenArmError(
            Code.LIMITS,
            f"{arm.names[i]} at point {k} is {q[k, i]:.4f} rad, limits {arm.kinematics.lower[i]:.4f}"
            f" to {arm.kinematics.upper[i]:.4f}",
        )
    fastest = arm.limits(1.0).velocity * _SLACK
    speed = np.abs(v[:, order]) if v is not None else np.abs(np.diff(q, axis=0)) / np.diff(t)[:, None]
    if np.any(speed > fastest):
        k, i = (int(x) for x in np.argwhere(speed > fastest)[0])
        raise OpenArmError(
            Code.LIMITS,
            f"{arm.names[i]} at point {k} moves at {speed[k, i]:.2f} rad/s, limit {fastest[i] / _SLACK:.2f}",
        )
    now = np.array([state[name] for name in arm.names])
    q = q + (nearest_turns(q[0], now, arm.upper) - q[0])
    gap = np.abs(q[0] - now)
    i = int(np.argmax(gap))
    if gap[i] > arm.config.execution.start_tolerance:
        raise _invalid(
            arm,
            f"it starts with {arm.names[i]} at {q[0, i]:.3f} rad, the arm is at {now[i]:.3f}, expected within"
            f" {arm.config.execution.start_tolerance:g} rad; plan again from where the arm is",
        )
    return Motion(arm.names, t, q, None if v is None else v[:, order], None if a is None else a[:, order])


def check_against_others(
    arm: Arm, motion: Motion, state: Mapping[str, float], beside: Sequence[tuple[Arm, Motion]] = ()
) -> None:
    """Refuse a motion during which the arm would meet another arm, at rest or moving with it.

    Args:
        arm: The arm that is to move.
        motion: Its motion, beginning now.
        state: Present positions by joint name.
        beside: Other arms with their motions, which begin now, too; those that are left out are at rest.

    Raises:
        OpenArmError: IN_COLLISION, with the pair and the time.
    """
    keep = Clearance(arms=_PAIR_CLEARANCE)
    scene = CollisionScene(arm.robot, CollisionContext(state=state, clearance=keep, own=False))
    if scene.relax(motion.q[0], arm.config.planning.start_overlap) is not None:
        return  # it is in contact already: any way out is better than none, and the plan has checked it
    duration = max(motion.duration, *(other.duration for _, other in beside), 0.0)
    hint = "plan the arms together" if beside else "wait until the other arm is out of the way"
    for t in np.linspace(0.0, duration, max(2, int(np.ceil(duration / _PAIR_STEP)) + 1)):
        q = np.array([motion.joints_at(float(t))[name] for name in arm.names])
        for other, its in beside:
            scene.put_other(other.robot, its.states(np.array([t]))[0])
        if scene.collides(q):
            contact = scene.contacts(q)[0]
            raise OpenArmError(Code.IN_COLLISION, f"{arm.name} arm after {t:.1f} s: {contact}; {hint}")


def _invalid(arm: Arm, fault: str) -> OpenArmError:
    return OpenArmError(Code.INVALID_ARGUMENT, f"trajectory for the {arm.name} arm: {fault}")


def _list(what: str, names: list[str]) -> str:
    return f"{what} {', '.join(names)}" if names else ""
