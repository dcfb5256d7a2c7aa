# SPDX-License-Identifier: Apache-2.0
"""What must hold whatever goes wrong, judged from what was seen; world frame, m, simulated time."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from openarm_common.errors import Code
from openarm_evaluation.chaos.schedule import Fault
from openarm_evaluation.judging.judge import Sample, judge

#: Free fall from a greater height is a drop, m.
FALL_HEIGHT = 0.010
#: Rate of ground truth that shows a fall from 12 mm in every phase of its samples, Hz of simulated time.
TRUTH_HZ = 100.0
#: Joint speed of an arm that nobody moves, rad/s, over `_OVER_S`.
REST_SPEED = 0.05
#: Bounds, s of wall clock: of a request, of the notice of a server's death, of the graph's return.
REQUEST_S, DEATH_S, BACK_S = 180.0, 2.0, 15.0

#: How a pick may end though nothing goes wrong: by what stands on the table, or what a busy machine makes late.
NATURAL = frozenset(
    {
        Code.OK,
        Code.UNKNOWN_OBJECT,
        Code.NOTHING_DETECTED,
        Code.STALE_DATA,
        Code.UNREACHABLE,
        Code.IN_COLLISION,
        Code.NO_PLAN,
        Code.TOO_WIDE,
        Code.GRASP_MISSED,
        Code.GRASP_LOST,
        Code.HAND_COLLISION,
        Code.PLACE_FAILED,
    }
)
_OF_NODES = frozenset({Code.NOT_READY, Code.ROBOT_LOST, Code.NO_TRANSFORM, Code.EXECUTION_FAILED, Code.TIMEOUT})
#: How else it may end, by the kind of the fault; kinds that are not here must not be felt.
OF_KIND: Mapping[str, frozenset[Code]] = {
    "kill": _OF_NODES,
    "stop": _OF_NODES,
    "joints": _OF_NODES,
    "camera": frozenset({Code.NO_TRANSFORM}),
    "services": frozenset({Code.TIMEOUT}),
}

_G, _FALLING = 9.81, 0.7  # the share of g that only a fall reaches: arms accelerate less
_OVER_S = 0.1
#: Longest time between two samples that say how an object moved, s.
_GAP_S = 0.05


@dataclass(frozen=True)
class Violation:
    """Something that must not happen: which rule, and what was seen."""

    rule: str
    text: str


def since_reset(track: Sequence[Sample]) -> list[Sample]:
    """Return the samples since simulated time last began; that is when the simulation was restarted."""
    starts = [k for k in range(1, len(track)) if track[k].t_ns < track[k - 1].t_ns]
    return list(track[starts[-1] if starts else 0 :])


def fall_of(track: Sequence[Sample]) -> float:
    """Return the greatest height that an object fell freely, m; 0 for less than `FALL_HEIGHT`.

    The speed of an object in a fall grows as nothing else makes it grow, and shows how high it fell. After the last
    sample it may fall on for a whole period; half a period is added.
    """
    greatest = 0.0
    for first, second in itertools.pairwise(track):
        dt = (second.t_ns - first.t_ns) * 1e-9
        before, after = float(first.linear[2]), float(second.linear[2])
        if 0.0 < dt < _GAP_S and after < 0.0 and (after - before) / dt < -_FALLING * _G:
            speed = 0.5 * _G * dt - after
            greatest = max(greatest, speed * speed / (2.0 * _G))
    return greatest if greatest > FALL_HEIGHT else 0.0


def unasked_speed(
    joints: Sequence[tuple[int, Mapping[str, float]]], seen: int = 0, begin_ns: int = 0
) -> tuple[float, str]:
    """Return the greatest speed of an arm's joint and its name, rad/s, over windows of a tenth of a second.

    Args:
        joints: Simulated time and positions, as they came.
        seen: So many of them came before the answer: of a simulation that ended, their times may be later.
        begin_ns: Those of before do not count.
    """
    joints = [state for state in joints[seen:] if state[0] >= begin_ns]
    greatest, which, k = 0.0, "", 0
    for index, (t_ns, positions) in enumerate(joints):
        if joints[index - 1 if index else 0][0] > t_ns:  # the simulation was restarted
            return greatest, which
        while k < index and t_ns - joints[k + 1][0] >= _OVER_S * 1e9:
            k += 1
        dt = (t_ns - joints[k][0]) * 1e-9
        for name, position in positions.items():
            if dt >= _OVER_S and "finger" not in name and name in joints[k][1]:
                speed = abs(position - joints[k][1][name]) / dt
                greatest, which = max((greatest, which), (speed, name))
    return greatest, which


def falls(tracks: Mapping[str, Sequence[Sample]]) -> list[Violation]:
    """Return the objects that fell."""
    heights = {name: fall_of(track) for name, track in tracks.items()}
    return [
        Violation("no object falls", f"{name} fell {1e3 * height:.0f} mm freely")
        for name, height in heights.items()
        if height
    ]


def fits(code: Code, fault: Fault | None) -> list[Violation]:
    """Return what is wrong with the code of an answer after a fault; None: nothing had gone wrong before the answer."""
    if fault is not None and (fault.kind, fault.node) == ("kill", "grasp"):
        fitting = frozenset({Code.NOT_READY})  # nobody else could know
    else:
        fitting = NATURAL | OF_KIND.get(fault.kind if fault else "", frozenset())
    if code in fitting:
        return []
    return [Violation("a failure names its cause", f"{code} does not fit {fault or 'a pick without a fault'}")]


def claims(track: Sequence[Sample], success: bool, outcome: str, place: Sequence[float]) -> list[Violation]:
    """Return what an answer says that is not so.

    Args:
        track: Track of the object that was asked for, from before the request until it is at rest.
        success: Claim of the answer.
        outcome: Outcome of the answer, as `GraspResult.outcome`; "" when no answer came.
        place: Place in the answer.
    """
    found: list[Violation] = []
    if len(track) < 2 or since_reset(track) != list(track):
        return found  # the world is another one
    verdict = judge(track, (float(place[0]), float(place[1])), claimed=success)
    if verdict.false_success:
        found.append(Violation("no claim without truth", f"claimed success, but it {'; '.join(verdict.reasons)}"))
    moved = float(((track[-1].p_world - track[0].p_world) ** 2).sum() ** 0.5)
    if outcome == "REFUSED" and moved > 0.02:
        found.append(Violation("no claim without truth", f"claimed never to have touched it; it moved {moved:.3f} m"))
    return found
