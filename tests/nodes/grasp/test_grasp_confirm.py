# SPDX-License-Identifier: Apache-2.0
"""P-20, R-25: a plan is shown, confirmed through /grasp/confirm, and executed as it was shown."""

from __future__ import annotations

import pytest
from openarm_interfaces.action import Pick
from openarm_interfaces.msg import GraspStatus
from openarm_interfaces.srv import Grasp

from openarm_common.errors import Code
from openarm_grasp.ros.client import GraspClient, GraspResult

pytestmark = pytest.mark.requirement("P-20", "R-25")

PARTS = ["transfer", "approach", "lift", "carry", "put down", "leave"]


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


def test_what_is_executed_is_what_was_shown_and_others_are_served_meanwhile(bench):
    answered = bench.service.call_async(Grasp.Request(label="red", confirm=True))
    status = waiting(bench)
    shown = paths(bench)
    assert list(shown) == PARTS
    assert (status.state, status.label, status.arm) == ("PLAN", "red", "right")
    assert "12.0 s of motion" in status.reason
    assert bench.ask("blue").code == "BUSY"
    refused = bench.answer("x", accept=True)
    assert (refused.success, refused.code) == (False, "INVALID_ARGUMENT")
    assert status.plan_id in refused.message
    assert bench.world.log == ["plan right", "plan right"]
    accepted = bench.answer(status.plan_id, accept=True)
    assert accepted.success, accepted.message
    answer = bench.ros.result(answered, 60.0)
    assert answer.success, answer.message
    # bit for bit: the paths of what the arm was given
    assert [path_of(bench, one) for one in bench.world.executed] == list(shown.values())
    assert bench.world.log.count("plan right") == 2
    bench.until(lambda: not any(m.ns.startswith("plan/") for m in bench.markers[-1].markers), what="it is taken down")
    late = bench.answer(status.plan_id, accept=True)
    assert (late.success, late.code) == (False, "NOT_READY")


def test_a_plan_that_is_rejected_cancelled_or_out_of_time_moves_nothing(bench):
    rejected = bench.service.call_async(Grasp.Request(label="red", confirm=True))
    first = waiting(bench)
    assert bench.answer(first.plan_id, accept=False).success
    assert bench.ros.result(rejected).code == "CANCELLED"
    late = bench.service.call_async(Grasp.Request(label="red", confirm=True, timeout=5.0))
    assert bench.ros.result(late).code == "TIMEOUT"
    handle, result = bench.ros.send_goal(bench.action, Pick.Goal(label="red", confirm=True))
    waiting(bench, *{status.plan_id for status in bench.status if status.plan_id})
    bench.ros.result(handle.cancel_goal_async())
    assert bench.ros.result(result).result.code == "CANCELLED"
    assert set(bench.world.log) == {"plan right"}


def test_a_plan_that_does_not_hold_any_more_is_replaced_by_one_that_is_asked_about(bench):
    answered = bench.service.call_async(Grasp.Request(label="red", confirm=True))
    first = waiting(bench)
    bench.world.objects["red"][0] += 0.03
    assert bench.answer(first.plan_id, accept=True).success
    second = waiting(bench, first.plan_id)
    bench.world.scene += 1
    assert bench.answer(second.plan_id, accept=True).success
    third = waiting(bench, first.plan_id, second.plan_id)
    assert set(bench.world.log) == {"plan right"}
    shown = paths(bench)
    assert bench.answer(third.plan_id, accept=True).success
    assert bench.ros.result(answered, 60.0).success
    assert [path_of(bench, one) for one in bench.world.executed] == list(shown.values())
    reasons = "; ".join(status.reason for status in bench.status)
    assert "'red' is not seen any more where it stood (the nearest is 30 mm away)" in reasons
    assert "the planning scene has changed from version 1 to 2" in reasons


def test_the_client_asks_its_caller(bench):
    asked: list[GraspStatus] = []

    def work(grasp: GraspClient) -> list[GraspResult]:
        rejected = grasp.pick("red", confirm=lambda plan: bool(asked.append(plan)))
        return [rejected, grasp.pick("blue", confirm=lambda plan: asked.append(plan) is None)]

    rejected, placed = bench.program(work)
    assert (rejected.code, rejected.attempts) == (Code.CANCELLED, 0)
    assert placed.success, placed.message
    assert [(plan.label, plan.arm) for plan in asked] == [("red", "right"), ("blue", "left")]
