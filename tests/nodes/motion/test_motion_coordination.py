# SPDX-License-Identifier: Apache-2.0
"""Two arms that are asked one by one and move at the same time; what a hand holds from one request to the next."""

from __future__ import annotations

import numpy as np
import pytest
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, MoveArms, PlanApproach
from openarm_interfaces.msg import ApproachTarget, ArmTarget, CollisionBox

from openarm_common import se3
from openarm_common.ros.convert import matrix_to_pose
from tests.nodes.motion.conftest import FASTER, SLOWER, slower

MIDDLE = (0.28, 0.0, 0.60)


def to(bench, arm: str, p: tuple[float, float, float], **kwargs) -> MoveArm.Goal:
    pose = bench.stamped(se3.make(bench.DOWN, p))
    return MoveArm.Goal(arm=arm, kind=MoveArm.Goal.POSE, pose=pose, **{"velocity_scale": 1.0, **kwargs})


def execute(arm: str, trajectory, max_start_delay: float = 30.0) -> ExecuteTrajectory.Goal:
    return ExecuteTrajectory.Goal(arm=arm, trajectory=trajectory, max_start_delay=max_start_delay)


def leaving(bench) -> tuple[object, object]:
    """The left arm is over the middle; how it goes home, slowly, and how the right one goes there, quickly.

    From then on the robot's time goes so slowly that a busy machine has planned or cancelled before the way is free.
    """
    right = bench.done(bench.move_client, to(bench, "right", MIDDLE, plan_only=True))
    bench.done(bench.move_client, to(bench, "left", MIDDLE))
    left = bench.run(bench.move_client, bench.named("left", "home", plan_only=True))
    bench.robot.speed = SLOWER
    return slower(left.trajectory, 5), right.trajectory


@pytest.mark.long
@pytest.mark.requirement("N-12")
def test_an_arm_rests_until_the_one_under_way_leaves_room(bench) -> None:
    slow, quick = leaving(bench)
    bench.refused(bench.execute_client, execute("right", quick, 0.0), "IN_COLLISION")
    _, left = bench.start(bench.execute_client, execute("left", slow))
    _, right = bench.start(bench.execute_client, execute("right", quick))
    bench.under_way("right")
    bench.robot.speed = FASTER
    gap = bench.separation(left, right)
    first, second = left.result().result, right.result().result
    assert first.success, first.message
    assert second.success, second.message
    assert first.start_delay == 0.0
    assert 0.1 < second.start_delay < slow.points[-1].time_from_start.sec + 1.0
    assert gap >= 0.020
    tip = bench.node.service.arms["right"].kinematics.fk(bench.q("right"))[:3, 3]
    np.testing.assert_allclose(tip, MIDDLE, atol=2e-3)


@pytest.mark.requirement("N-12")
def test_an_arm_began_when_its_controller_says_and_holds_after_a_cancel(bench) -> None:
    handle, left = bench.begin("left", bench.slow_plan("left"))
    follower = bench.node.service.coordination.followers["left"]
    bench.ros.spin_until(lambda: follower.active is not None and follower.active.certain, what="the start is known")
    assert follower.active.since_ns == bench.robot.active["left"][0]
    handle.cancel_goal_async()
    answer = bench.ros.result(left)
    assert answer.status == 5  # canceled
    assert (answer.result.success, answer.result.code) == (False, "CANCELLED")
    assert "holds" in answer.result.message
    assert bench.robot.cancelled == ["left"]


@pytest.mark.requirement("N-12")
def test_hands_are_kept_apart_as_if_they_were_open(bench) -> None:
    """The closed hands would stand 41 mm apart; one that opens there would come within 11 mm of the other."""
    bench.done(bench.move_client, to(bench, "left", (0.28, 0.08, 0.60)))
    there = bench.done(bench.move_client, to(bench, "right", (0.28, -0.08, 0.68), plan_only=True))
    bench.refused(bench.execute_client, execute("right", there.trajectory), "IN_COLLISION", "finger")


@pytest.mark.requirement("N-12")
def test_an_arm_holds_when_the_other_stops_in_its_way(bench) -> None:
    slow, quick = leaving(bench)
    handle, left = bench.start(bench.execute_client, execute("left", slow))
    _, right = bench.start(bench.execute_client, execute("right", quick))
    bench.under_way("right")
    handle.cancel_goal_async()
    gap = bench.separation(left, right)
    assert left.result().result.code == "CANCELLED"
    result = right.result().result
    assert result.code == "IN_COLLISION"
    assert "the left arm stopped on its way, and the right arm holds before it: right arm after" in result.message
    assert gap >= 0.020


def approach(arm: str, y: float) -> PlanApproach.Goal:
    targets: list[ApproachTarget] = []
    for yaw in np.arange(4) * np.pi / 2:
        rotation = se3.rotation_from_z_y((0, 0, -1), (np.cos(yaw), np.sin(yaw), 0.0))
        target = ApproachTarget(id=f"{yaw:.1f}", pose=matrix_to_pose(se3.make(rotation, (0.27, y, 0.425))), score=1.0)
        target.approach_offset.z, target.retreat_offset.z = 0.08, 0.12
        targets.append(target)
    cube = CollisionBox(id="cube", pose=matrix_to_pose(se3.make(None, (0.27, y, 0.425))))
    cube.size.x = cube.size.y = cube.size.z = 0.05
    return PlanApproach.Goal(
        arm=arm, targets=targets, obstacles=[cube], touchable=["cube"], attached_after_approach=True, velocity_scale=1.0
    )


@pytest.mark.long
@pytest.mark.requirement("A-68")
def test_an_approach_is_planned_around_where_the_other_arm_will_end(bench) -> None:
    slow, _ = leaving(bench)
    blocked = bench.run(bench.plan_client, approach("right", -0.02))
    assert (blocked.success, blocked.failure.stage) == (False, "goal"), blocked.message
    assert "openarm_left_" in blocked.failure.second
    _, left = bench.start(bench.execute_client, execute("left", slow))
    bench.under_way("left")
    plan = bench.done(bench.plan_client, approach("right", -0.02))
    assert 0.0 < plan.start_delay < slow.points[-1].time_from_start.sec + 1.0
    assert not left.done()
    _, right = bench.start(bench.execute_client, execute("right", plan.transfer))
    bench.under_way("right")
    bench.robot.speed = FASTER
    assert bench.separation(left, right) >= 0.020
    assert right.result().result.success, right.result().result.message


# --- what is held


@pytest.mark.long
@pytest.mark.requirement("P-04")
def test_what_is_held_stays_so_until_a_request_says_otherwise(bench) -> None:
    plan = bench.run(bench.plan_client, approach("right", -0.24))
    for part in (plan.transfer, plan.approach, plan.retreat):
        bench.done(bench.execute_client, ExecuteTrajectory.Goal(arm="right", trajectory=part))
    bench.ros.spin_until(lambda: bench.held() == ["right/cube"], what="the cube to be shown as held")
    shelf = CollisionBox(id="shelf", pose=matrix_to_pose(se3.make(None, (0.27, -0.24, 0.465))))
    shelf.size.x, shelf.size.y, shelf.size.z = 0.30, 0.30, 0.01
    goal = to(bench, "right", (0.27, -0.24, 0.500), obstacles=[shelf], plan_only=True)
    refused = bench.run(bench.move_client, goal)
    assert refused.code == "IN_COLLISION", refused.message
    assert (refused.failure.first, refused.failure.second) == ("held cube", "shelf")
    assert "with cube in the hand as before (hand_empty: true if it holds nothing any more)" in refused.message
    assert bench.held() == ["right/cube"]

    assert "with cube in the hand" in bench.done(bench.move_client, to(bench, "right", (0.27, -0.20, 0.56))).message
    assert bench.held() == ["right/cube"]

    goal.hand_empty = True
    assert bench.run(bench.move_client, goal).success
    assert bench.held() == ["right/cube"]  # a plan alone forgets nothing
    both = bench.named("right", "home", hand_empty=True)
    both.attached = [CollisionBox(id="cup", pose=matrix_to_pose(np.eye(4)), size=shelf.size)]
    bench.refused(bench.move_client, both, "INVALID_ARGUMENT", "attached names cup, and hand_empty is true")

    targets = [ArmTarget(arm=side, kind=ArmTarget.NAMED, named="home") for side in ("left", "right")]
    assert bench.run(bench.both_client, MoveArms.Goal(targets=targets, velocity_scale=1.0)).success
    assert bench.held() == ["right/cube"]
    targets[1].hand_empty = True
    assert bench.run(bench.both_client, MoveArms.Goal(targets=targets, velocity_scale=1.0)).success
    bench.ros.spin_until(lambda: bench.held() == [], what="an empty hand")
