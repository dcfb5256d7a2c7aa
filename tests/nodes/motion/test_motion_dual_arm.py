# SPDX-License-Identifier: Apache-2.0
"""The motion node's /motion/move_arms: both arms at once."""

from __future__ import annotations

import numpy as np
import pytest
from openarm_interfaces.action import MoveArms
from openarm_interfaces.msg import ArmTarget, CollisionBox

from openarm_common import se3
from openarm_common.ros.convert import matrix_to_pose, stamp_to_ns
from tests.nodes.motion.conftest import SLOWER


def over_the_middle(bench, arm: str, **kwargs) -> ArmTarget:
    pose = bench.stamped(se3.make(bench.DOWN, (0.30, 0.0, 0.62)))
    return ArmTarget(arm=arm, kind=ArmTarget.POSE, pose=pose, **kwargs)


def home(arm: str) -> ArmTarget:
    return ArmTarget(arm=arm, kind=ArmTarget.NAMED, named="home")


def both_goal(*targets: ArmTarget, **kwargs) -> MoveArms.Goal:
    return MoveArms.Goal(targets=list(targets), velocity_scale=1.0, **kwargs)


def watched(bench, goal: MoveArms.Goal) -> tuple[MoveArms.Result, float]:
    """Run a goal that must succeed; its result, and the least distance of the arms in the joint states meanwhile."""
    _, future = bench.start(bench.both_client, goal)
    gap = bench.separation(future)
    result = future.result().result
    assert result.success, result.message
    return result, gap


@pytest.mark.long
@pytest.mark.parametrize("strategy", [MoveArms.Goal.TOGETHER, MoveArms.Goal.STAGGERED])
@pytest.mark.requirement("N-12")
def test_arms_take_each_others_place_at_once(bench, strategy: int) -> None:
    watched(bench, both_goal(over_the_middle(bench, "left"), home("right"), strategy=strategy))
    result, gap = watched(bench, both_goal(over_the_middle(bench, "right"), home("left"), strategy=strategy))
    assert result.code == "OK"
    assert gap >= 0.020
    assert result.clearance >= 0.024
    assert [t.joint_names[0] for t in result.trajectories] == ["openarm_right_joint1", "openarm_left_joint1"]
    assert len(result.start_delays) == 2
    # both controllers are given the same start time
    assert len({stamp_to_ns(t.header.stamp) for t in result.trajectories}) == 1
    tip = bench.node.service.arms["right"].kinematics.fk(bench.q("right"))[:3, 3]
    np.testing.assert_allclose(tip, [0.30, 0.0, 0.62], atol=2e-3)


@pytest.mark.long
@pytest.mark.requirement("A-74")
def test_an_arm_in_the_way_yields_and_another_stays(bench) -> None:
    watched(bench, both_goal(over_the_middle(bench, "left"), home("right")))
    blocked = bench.run(
        bench.both_client, both_goal(over_the_middle(bench, "right"), stay(bench, "left"), plan_only=True)
    )
    assert blocked.code == "IN_COLLISION"
    assert {blocked.failure.first.split("_")[1], blocked.failure.second.split("_")[1]} == {"left", "right"}
    yielding = ArmTarget(arm="left", kind=ArmTarget.YIELD)
    _, gap = watched(bench, both_goal(over_the_middle(bench, "right"), yielding))
    assert gap >= 0.020
    state = bench.description.group_state("left_arm", "home")
    np.testing.assert_allclose(bench.q("left"), [state[n] for n in bench.description.arm_joints("left")], atol=2e-3)
    target = ArmTarget(arm="right", kind=ArmTarget.NAMED, named="official_home")
    before = bench.q("left")
    watched(bench, both_goal(target, yielding))
    np.testing.assert_allclose(bench.q("left"), before, atol=1e-6)


def stay(bench, arm: str) -> ArmTarget:
    return ArmTarget(arm=arm, kind=ArmTarget.JOINTS, joint_positions=bench.q(arm).tolist())


@pytest.mark.long
def test_when_one_arm_fails_the_other_holds(bench) -> None:
    targets = [ArmTarget(arm=arm, kind=ArmTarget.NAMED, named="official_home") for arm in ("left", "right")]
    goal = both_goal(*targets)
    goal.velocity_scale = 0.2
    bench.robot.fail_after = {"right": 0.5}
    bench.refused(bench.both_client, goal, "EXECUTION_FAILED")
    assert "left" in bench.robot.cancelled
    # and both are free again
    bench.robot.fail_after = {}
    assert bench.run(bench.move_client, bench.named("left", "home")).success


def test_cancel_holds_both(bench) -> None:
    goal = both_goal(*[ArmTarget(arm=arm, kind=ArmTarget.NAMED, named="official_home") for arm in ("left", "right")])
    goal.velocity_scale, bench.robot.speed = 0.1, SLOWER
    handle, future = bench.start(bench.both_client, goal)
    bench.ros.spin_until(lambda: len(bench.robot.active) == 2, what="both arms on their way")
    bench.refused(bench.move_client, bench.named("left"), "BUSY")
    bench.ros.result(handle.cancel_goal_async())
    answer = bench.ros.result(future)
    assert (answer.status, answer.result.code) == (5, "CANCELLED")
    assert sorted(bench.robot.cancelled) == ["left", "right"]


def test_bad_goals_say_why(bench) -> None:
    left, right = home("left"), home("right")
    box = CollisionBox(id="post", pose=matrix_to_pose(se3.make(None, (0.30, 0.0, 0.62))))
    box.size.x = box.size.y = box.size.z = 0.1
    far = ArmTarget(arm="left", kind=ArmTarget.POSE, pose=bench.stamped(se3.make(bench.DOWN, (0.9, 0.2, 0.6))))
    cases = [
        (both_goal(left), "INVALID_ARGUMENT", "targets are for 'left'; expected two different ones"),
        (both_goal(left, left), "INVALID_ARGUMENT", "expected two different ones of left, right"),
        (both_goal(left, right, strategy=7), "INVALID_ARGUMENT", "strategy is 7"),
        (both_goal(left, ArmTarget(arm="right", kind=9)), "INVALID_ARGUMENT", "kind is 9"),
        (both_goal(left, ArmTarget(arm="right", kind=3, named="yoga")), "INVALID_ARGUMENT", "no state 'yoga'"),
        (both_goal(left, right, expected_scene_version=5), "STALE_DATA", "expected 5"),
        (both_goal(far, right), "UNREACHABLE", "left arm can't reach"),
        (both_goal(over_the_middle(bench, "left"), right, obstacles=[box]), "IN_COLLISION", "post"),
    ]
    for goal, code, text in cases:
        bench.refused(bench.both_client, goal, code, text)
    assert not bench.robot.active
