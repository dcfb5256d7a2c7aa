# SPDX-License-Identifier: Apache-2.0
"""Judges a pick-and-place by ground truth that no node reads.

All poses are in the world frame (m, quaternions xyzw), velocities in m/s and rad/s, times in ns of simulated time.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from openarm_common import se3
from openarm_common.config import Config
from openarm_common.objects.resting import least_box_middles
from openarm_common.types import Array


class JudgeConfig(Config):
    """What counts as placed."""

    place_tolerance: float = Field(default=0.020, gt=0, description="m, footprint centre to target")
    lift: float = Field(default=0.05, gt=0, description="m, least rise of the centre during the run")
    tilt: float = Field(default=math.radians(10.0), gt=0, description="rad, between the upward axis before and after")
    height: float = Field(
        default=0.005, gt=0, description="m, change of the height of the centre: it is upright, and on the table"
    )
    moved: float = Field(default=0.001, gt=0, description="m, at rest: greatest motion of the centre in the rest time")
    turned: float = Field(default=0.01, gt=0, description="rad, at rest: greatest turn in the rest time")
    rest: float = Field(default=0.5, gt=0, description="s of simulated time at rest at the end")
    speed: float = Field(default=0.005, gt=0, description="m/s, at rest at one time")
    turn: float = Field(default=0.05, gt=0, description="rad/s, at rest at one time")
    fall: float = Field(default=0.02, gt=0, description="m, of free fall that is none yet; of objects of any shape")


RULES = JudgeConfig()
_GRAVITY = 9.81
#: Share of gravity from which on something falls: nothing that a hand carries is let down so fast.
_FREELY = 0.7


@dataclass(frozen=True)
class Sample:
    """One object at one time."""

    t_ns: int
    p_world: NDArray[np.float64]
    q_xyzw: NDArray[np.float64]
    linear: NDArray[np.float64]
    angular: NDArray[np.float64]


@dataclass(frozen=True)
class Verdict:
    """Result of one run by ground truth.

    Args:
        placed: Lifted, then upright and at rest within tolerance of the target.
        reasons: Faults, one sentence each; empty when placed.
        place_error: m, horizontal, footprint centre to target.
        rise: m, greatest rise of the centre.
        tilt: rad, change of the upward axis.
        false_success: The run claimed success and the object is not placed.
    """

    placed: bool
    reasons: tuple[str, ...]
    place_error: float
    rise: float
    tilt: float
    false_success: bool


def judge(
    track: Sequence[Sample],
    target_xy: tuple[float, float],
    *,
    claimed: bool,
    rules: JudgeConfig = RULES,
    corners: Array | None = None,
    higher: float = 0.0,
) -> Verdict:
    """Judge one object's track from before the grasp to after it.

    An object of any shape may rest on another side than before, since the request promises none, but not have fallen
    since it was lifted last: what an earlier attempt dropped, the last one has taken up. The centre of its footprint is
    the middle of the smallest rectangle about it; of those that are as small (about a pan, two that are 44 mm
    apart) the nearest to the target, since the request does not say which.

    Args:
        track: Samples in the order of time, the first from before anything moved.
        target_xy: Target of the footprint centre, m, world; NaN when no place was chosen.
        claimed: Whether the run reported success.
        rules: Tolerances.
        corners: (n, 3) of an object of any shape, in its frame, m; None: a plain shape.
        higher: Height of what it is to stand on over what it stood on, m.

    Raises:
        ValueError: The track is empty or not in the order of time.
    """
    if not track or any(later.t_ns < earlier.t_ns for earlier, later in itertools.pairwise(track)):
        raise ValueError(f"a track needs samples in the order of time, got {len(track)}")
    first, last = track[0], track[-1]
    off = _centres(last, corners) - np.asarray(target_xy)
    error = float(np.linalg.norm(off, axis=1).min())
    rise = rise_of(track)
    tilt = _tilt(first.q_xyzw, last.q_xyzw)
    moved, turned = _motion_at_end(track, rules)
    sink = float(last.p_world[2] - first.p_world[2]) - higher
    reasons: list[str] = []
    if rise < rules.lift:
        reasons.append(f"never lifted: it rose {1e3 * rise:.0f} mm, at least {1e3 * rules.lift:.0f} were expected")
    if math.isnan(error):
        reasons.append("no place was chosen for it")
    elif error > rules.place_tolerance:
        reasons.append(
            f"is {1e3 * error:.1f} mm from the target, at most {1e3 * rules.place_tolerance:.0f} are allowed"
        )
    if corners is not None:
        if (fell := fall_of(last_carry(track, rules))) > rules.fall:
            reasons.append(f"fell: {1e3 * fell:.0f} mm freely, at most {1e3 * rules.fall:.0f} are allowed")
    else:
        if tilt > rules.tilt:
            reasons.append(f"not upright: tilted by {math.degrees(tilt):.0f} degrees")
        if abs(sink) > rules.height:
            reasons.append(f"does not stand there as before: its centre is {1e3 * sink:+.0f} mm higher")
    if moved > rules.moved or turned > rules.turned:
        text = f"{1e3 * moved:.1f} mm and {math.degrees(turned):.1f} degrees in the last {rules.rest:g} s"
        reasons.append(f"not at rest: it moved {text}")
    placed = not reasons
    return Verdict(placed, tuple(reasons), error, rise, tilt, claimed and not placed)


def _centres(sample: Sample, corners: Array | None) -> Array:
    """Return the points (n, 2) that may be taken for the centre of the footprint of an object, world, m."""
    if corners is None:
        return sample.p_world[None, :2]
    T = se3.make(se3.matrix_from_quat_xyzw(sample.q_xyzw), sample.p_world)
    return least_box_middles(se3.apply(T, corners)[:, :2])


def rise_of(track: Sequence[Sample]) -> float:
    """Return by how much an object was higher at most than at first, m."""
    return float(max(sample.p_world[2] for sample in track) - track[0].p_world[2])


def fall_of(track: Sequence[Sample]) -> float:
    """Return from how high an object fell freely, by the speed that it reached downwards in doing so, m."""
    fastest = 0.0
    for before, after in itertools.pairwise(track):
        seconds = max((after.t_ns - before.t_ns) * 1e-9, 1e-9)
        faster = float(before.linear[2] - after.linear[2])
        if after.linear[2] < 0.0 and faster > _FREELY * _GRAVITY * seconds:
            fastest = max(fastest, -float(after.linear[2]))
    return fastest**2 / (2.0 * _GRAVITY)


def last_carry(track: Sequence[Sample], rules: JudgeConfig = RULES) -> Sequence[Sample]:
    """Return the samples from when an object rested last before it was lifted; all of them, when it was not."""
    begin, top = 0, -math.inf
    for k in range(len(track) - 1, -1, -1):
        sample, z = track[k], float(track[k].p_world[2])
        if top - z >= rules.lift and at_rest(sample, rules):
            begin = k
            break
        top = max(top, z)
    return track[begin:]


def rests(track: Sequence[Sample], rules: JudgeConfig = RULES) -> bool:
    """Return whether an object has stayed where it is at the end, for as long as it must.

    Motion is measured by the pose: in resting contact a solver may let a thing rock by hundredths of a millimetre, at
    speeds that say nothing.
    """
    if track[-1].t_ns - track[0].t_ns < rules.rest * 1e9:
        return False
    moved, turned = _motion_at_end(track, rules)
    return moved <= rules.moved and turned <= rules.turned


def _motion_at_end(track: Sequence[Sample], rules: JudgeConfig) -> tuple[float, float]:
    """Return how far from its last pose an object was in the rest time at the end: m and rad."""
    last = track[-1]
    end = list(itertools.takewhile(lambda sample: last.t_ns - sample.t_ns <= rules.rest * 1e9, reversed(track)))
    moved = max(float(np.linalg.norm(sample.p_world - last.p_world)) for sample in end)
    R_last = se3.matrix_from_quat_xyzw(last.q_xyzw)
    return moved, max(se3.angle_between(se3.matrix_from_quat_xyzw(sample.q_xyzw), R_last) for sample in end)


def at_rest(sample: Sample, rules: JudgeConfig = RULES) -> bool:
    """Return whether an object moves no more than in resting contact, by its speeds at one time."""
    return bool(np.linalg.norm(sample.linear) <= rules.speed and np.linalg.norm(sample.angular) <= rules.turn)


def _tilt(before_xyzw: NDArray[np.float64], after_xyzw: NDArray[np.float64]) -> float:
    """Return by how much the axis that pointed up has left the vertical, rad."""
    turn = se3.matrix_from_quat_xyzw(after_xyzw) @ se3.matrix_from_quat_xyzw(before_xyzw).T
    return math.acos(np.clip(turn[2, 2], -1.0, 1.0))
