# SPDX-License-Identifier: Apache-2.0
"""Both arms planned as one, and on their way at once, kept apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_motion.collision.solids import box_from
from openarm_motion.planning import dual_arm as together
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.dual_arm import (
    DualArm,
    DualArmGoals,
    DualArmPlan,
    delayed,
    plan_staggered,
    plan_together,
    separation,
)
from openarm_motion.timing.validation import dense_times

DOWN = se3.rotation_from_z_y((0, 0, -1), (0, 1, 0))


@pytest.fixture(scope="module")
def both(arms: dict[str, Arm]) -> DualArm:
    return DualArm(arms["left"], arms["right"])


def hand_at(arm: Arm, home: dict[str, float], y: float, x: float = 0.30, z: float = 0.62) -> np.ndarray:
    """Configurations with the hand over the table, free with the other arm at home."""
    scene = arm.scene(home)
    found = [s.q for s in arm.inverse.solutions(se3.make(DOWN, (x, y, z)), 0.05) if not scene.collides(s.q)]
    return np.array(found[:6])


def starting(both: DualArm, state: dict[str, float]) -> StartState:
    return StartState(state, np.array([state[name] for name in both.names]), 0.5)


def apart_all_the_way(both: DualArm, state: dict[str, float], plan: DualArmPlan) -> float:
    """Least distance of the arms at looks 5 ms apart, from nothing but the trajectories."""
    whole = plan.whole
    scene = both.scene(state)
    states = whole.at(np.arange(0.0, whole.duration, 0.005))[0]
    return min(scene.separation(q) for q in states[::3])


def swapping(both: DualArm, home: dict[str, float]) -> tuple[dict[str, float], DualArmGoals]:
    """The left hand is over the middle, where the right one wants to go while the left one goes home."""
    left, right = both.arms
    inside = hand_at(left, home, 0.0)[0]
    state = {**home, **dict(zip(left.names, inside.tolist(), strict=True))}
    back = np.array([[home[name] for name in left.names]])
    return state, DualArmGoals((back, hand_at(right, home, 0.0)))


@pytest.mark.parametrize("how", [plan_together, plan_staggered])
@pytest.mark.requirement("N-12")
def test_arms_that_take_each_others_place_keep_20_mm_all_the_way(both, home, how) -> None:
    state, goals = swapping(both, home)
    plan: DualArmPlan = how(both, starting(both, state), goals, 10.0)
    seen = apart_all_the_way(both, state, plan)
    assert seen >= 0.020
    assert plan.clearance == pytest.approx(seen, abs=0.002)
    for arm, part, wanted in zip(both.arms, plan.trajectories, goals.goals, strict=True):
        assert part.names == arm.names
        np.testing.assert_allclose(part.q[0], [state[name] for name in arm.names], atol=1e-9)
        assert min(np.abs(part.q[-1] - q).max() for q in wanted) < 1e-9


@pytest.mark.requirement("N-12")
def test_the_arm_in_the_way_goes_first_and_the_other_waits_no_longer_than_it_must(
    both, home, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, goals = swapping(both, home)
    alone = together._alone

    def slow_left(arms, index, *args):
        way = alone(arms, index, *args)
        return replace(way, t=4 * way.t, v=way.v / 4, a=way.a / 16) if index == 0 else way

    monkeypatch.setattr(together, "_alone", slow_left)
    plan = plan_staggered(both, starting(both, state), goals, 10.0)
    assert plan.start_delays[0] == 0.0
    assert 0.0 < plan.start_delays[1] < plan.trajectories[0].duration
    late = plan.trajectories[1]
    np.testing.assert_array_equal(late.q[0], late.q[1])
    moving = replace(late, t=late.t[1:] - plan.start_delays[1], q=late.q[1:], v=late.v[1:], a=late.a[1:])
    scene = both.scene(state)
    sooner = delayed(moving, plan.start_delays[1] - 0.1)
    assert separation(scene, replace(plan, trajectories=(plan.trajectories[0], sooner)).whole) < 0.024
    assert separation(scene, plan.whole) >= 0.024
    assert apart_all_the_way(both, state, plan) >= 0.020


def test_a_goal_of_both_that_can_not_be_names_the_pair(both, home) -> None:
    left, right = (hand_at(arm, home, 0.0)[:1] for arm in both.arms)
    for how in (plan_together, plan_staggered):
        with pytest.raises(OpenArmError, match=r"openarm_(left|right)_\w+ would (hit|come within)") as caught:
            how(both, starting(both, home), DualArmGoals((left, right)), 2.0)
        assert caught.value.code == Code.IN_COLLISION


@pytest.mark.requirement("A-74")
def test_one_arm_fine_but_two_collide(both, home) -> None:
    left, right = (hand_at(arm, home, 0.0)[0] for arm in both.arms)
    scene = both.scene(home)
    start = starting(both, home).start
    assert scene.contacts(start) == []
    assert not scene.collides(np.concatenate([left, start[7:]]))
    assert not scene.collides(np.concatenate([start[:7], right]))
    together = np.concatenate([left, right])
    assert scene.collides(together)
    contact = scene.contacts(together)[0]
    assert {contact.first.split("_")[1], contact.second.split("_")[1]} == {"left", "right"}
    assert contact.required == pytest.approx(0.025)


def test_an_obstacle_of_the_second_arm_is_seen(both, home) -> None:
    start = starting(both, home).start
    hand = both.arms[1].kinematics.fk(start[7:])[:3, 3]
    scene = both.scene(home, [box_from("post", hand, (0.05, 0.05, 0.05))])
    assert scene.collides(start)
    assert "post" in {c.second for c in scene.contacts(start)}


def test_separation_is_that_of_every_look(both, home) -> None:
    state, goals = swapping(both, home)
    whole = plan_together(both, starting(both, state), goals, 10.0).whole
    scene = both.scene(state)
    every = min(scene.separation(q) for q in whole.at(dense_times(whole, scene.levers, 0.004))[0])
    assert separation(scene, whole) == pytest.approx(every, abs=1e-9)


def test_what_an_arm_holds_keeps_away_from_the_other_arm(both, home) -> None:
    long = box_from("tray", (0.0, 0.0, 0.06), (0.8, 0.8, 0.02))
    start = np.array([home[name] for name in both.names])
    bare = both.scene(home).separation(start)
    one, other = (both.scene(home, held=held).separation(start) for held in (((), [long]), ([long], ())))
    assert max(one, other) < bare - 0.05
    assert one == pytest.approx(other, abs=2e-3)  # the arms mirror each other
    # what both hold is looked at against each other
    assert both.scene(home, held=([long], [long])).separation(start) < min(one, other) - 0.05


def test_separation_is_the_least_of_all_pairs(both, home) -> None:
    rng = np.random.default_rng(8)
    scene, pair = both.scene(home), both.scene(home, separation=0.1)
    moving = [arm.robot.arm.moving for arm in both.arms]
    near = 0
    for _ in range(200):
        q = rng.uniform(both.lower, both.upper)
        contacts = [c for c in pair.contacts(q) if sum({c.first, c.second} & links != set() for links in moving) == 2]
        if contacts:
            near += 1
            assert scene.separation(q) == pytest.approx(min(c.distance for c in contacts), abs=1e-5)
        else:
            assert scene.separation(q) >= 0.1
    assert near > 8
