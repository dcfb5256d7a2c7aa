# SPDX-License-Identifier: Apache-2.0
"""A recording answers the same question, also where rounding has let one way more or less through."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence.verdicts import Verdict
from openarm_grasp.planning.options import NoWayError
from openarm_grasp.robot.interface import PlanGrasp, Planned
from tests.openarm_grasp.recorded import RecordedRobot, _asked
from tests.openarm_grasp.tape import Call, Tape

#: Places of the ways that were offered, m.
PLACES = tuple(0.01 * k for k in range(20))


def request(places: tuple[float, ...], shift: float = 0.0) -> PlanGrasp:
    offset, ways = np.array([0.0, 0.0, 0.1]), []
    for rank, x in enumerate(places):
        T = se3.make(np.eye(3), (x + shift, 0.0, 0.0))
        ways.append(SimpleNamespace(id=f"way{rank}", T_base_tcp=T, approach_offset=offset, retreat_offset=offset))
    box: Any = SimpleNamespace(id="box", T_frame_box=np.eye(4), size=(0.1, 0.1, 0.1))
    offered: Any = tuple(ways)
    return PlanGrasp("left", offered, (box,), (), ())


def robot(answer: Planned | None, error: Any = None) -> RecordedRobot:
    words, poses = _asked(request(PLACES))
    call = Call(["plan", *words], poses)
    call.answer, call.error, call.end = answer, error, 0
    tape = Tape(("joint",), ())
    tape.clock_ns, tape.state_ns, tape.q, tape.calls = [0], [0], [np.zeros(1)], [call]
    return RecordedRobot(tape, GraspConfig())


FAR = Verdict(Code.UNREACHABLE, "too far")
PLAN: Any = Planned(7, "a", "b", "c", {"way3": FAR, "way9": FAR}, tuple(0.1 * k for k in range(20)))  # type: ignore[arg-type]


def test_the_same_question_has_the_same_answer() -> None:
    assert asyncio.run(robot(PLAN).plan(request(PLACES))) == PLAN


@pytest.mark.parametrize(
    ("places", "chosen", "refused", "margins"),
    [
        (PLACES[:3] + PLACES[4:], 6, {"way8"}, (0.2, 0.4)),
        ((*PLACES[:3], 0.5, *PLACES[3:]), 8, {"way4", "way10"}, (0.2, np.nan)),
    ],
    ids=["a way less", "a way more"],
)
def test_ways_are_known_by_their_poses(
    places: tuple[float, ...], chosen: int, refused: set[str], margins: tuple[float, float]
) -> None:
    plan = asyncio.run(robot(PLAN).plan(request(places, 5e-5)))
    assert plan.chosen == chosen
    assert set(plan.refusals) == refused
    assert len(plan.limit_margins) == len(places)
    np.testing.assert_allclose(plan.limit_margins[2:4], margins)
    with pytest.raises(NoWayError) as caught:
        asyncio.run(robot(None, (Code.UNREACHABLE.value, "too far", {"way3": FAR, "way9": FAR})).plan(request(places)))
    assert set(caught.value.refusals) == refused


@pytest.mark.parametrize(
    ("places", "shift"),
    [(PLACES[:7] + PLACES[8:], 0.0), (PLACES[:17], 0.0), (PLACES, 2e-4)],
    ids=["without the chosen", "too few", "elsewhere"],
)
def test_another_question_has_no_answer(places: tuple[float, ...], shift: float) -> None:
    with pytest.raises(pytest.fail.Exception, match="asked for other ways"):
        asyncio.run(robot(PLAN).plan(request(places, shift)))
