# SPDX-License-Identifier: Apache-2.0
"""P-20, R-25: a plan is shown, confirmed through /grasp/confirm, and executed as it was shown."""

from __future__ import annotations

import pytest
from openarm_interfaces.msg import GraspStatus
from openarm_interfaces.srv import Grasp

from openarm_common.errors import Code
from openarm_grasp.ros.client import GraspClient, GraspResult

pytestmark = [pytest.mark.requirement("P-20", "R-25"), pytest.mark.long]

PARTS = ["transfer", "approach", "lift", "carry", "leave"]


def waiting(bench, *before: str) -> GraspStatus:
    """The status with a plan that waits, of none of these ids."""

    def newest() -> GraspStatus | None:
        status = bench.status[-1]
        return status if status.plan_id and status.plan_id not in before else None

    bench.until(newest, what="a plan waits")
    return bench.status[-1]


def paths(bench) -> dict[str, list[tuple[float, float, float]]]:
    """What is shown of the plan that waits, by part."""

    def lines():
        markers = bench.markers[-1].markers if bench.markers else []
        return {m.ns.removeprefix("plan/"): m for m in markers if m.ns.startswith("plan/")}

    bench.until(lines, what="the paths of the plan")
    return {name: [(p.x, p.y, p.z) for p in marker.points] for name, marker in lines().items()}


def path_of(bench, trajectory) -> list[tuple[float, float, float]]:
    robot = bench.world.robot
    arm = "left" if "left" in trajectory.joint_names[0] else "right"
    poses = (
        robot.link_pose(robot.tcp_link(arm), dict(zip(trajectory.joint_names, p.positions, strict=True)))
        for p in trajectory.points
    )
    return [tuple(T[:3, 3].tolist()) for T in poses]


def test_what_is_executed_is_what_was_shown_last_and_others_are_served_meanwhile(bench):
    answered = bench.service.call_async(Grasp.Request(label="red", confirm=True))
    overtaken = waiting(bench).plan_id
    bench.world.scene += 1
    assert bench.answer(overtaken, accept=True).success
    status = waiting(bench, overtaken)
    assert any("the planning scene has changed from version 1 to 2" in one.reason for one in bench.status)
    shown = paths(bench)
    assert list(shown) == PARTS
    assert (status.state, status.label, status.arm) == ("PLAN", "red", "right")
    assert "12.0 s of motion" in status.reason
    assert bench.ask("blue").code == "BUSY"
    refused = bench.answer("x", accept=True)
    assert (refused.success, refused.code) == (False, "INVALID_ARGUMENT")
    assert status.plan_id in refused.message
    assert set(bench.world.log) == {"plan right"}
    planned = len(bench.world.log)
    accepted = bench.answer(status.plan_id, accept=True)
    assert accepted.success, accepted.message
    answer = bench.ros.result(answered, 60.0)
    assert answer.success, answer.message
    # bit for bit: the paths of what the arm was given
    assert [path_of(bench, one) for one in bench.world.executed] == list(shown.values())
    assert bench.world.log.count("plan right") == planned
    bench.until(lambda: not any(m.ns.startswith("plan/") for m in bench.markers[-1].markers), what="it is taken down")
    late = bench.answer(status.plan_id, accept=True)
    assert (late.success, late.code) == (False, "NOT_READY")


def test_the_client_asks_its_caller(bench):
    asked: list[GraspStatus] = []

    def work(grasp: GraspClient) -> list[GraspResult]:
        rejected = grasp.pick("red", confirm=lambda plan: bool(asked.append(plan)))
        return [rejected, grasp.pick("blue", confirm=lambda plan: asked.append(plan) is None)]

    rejected, placed = bench.program(work)
    assert (rejected.code, rejected.attempts) == (Code.CANCELLED, 0)
    assert placed.success, placed.message
    assert [(plan.label, plan.arm) for plan in asked] == [("red", "right"), ("blue", "left")]
