# SPDX-License-Identifier: Apache-2.0
"""An arm sets out while another is under way."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_motion.collision.solids import box_from
from openarm_motion.planning import moves
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.coordination import ActiveMotion, least_delay
from openarm_motion.planning.dual_arm import DualArm
from openarm_motion.planning.moves import RequestBoxes
from openarm_motion.timing.trajectory import Motion, Trajectory
from tests.refusals import refuses

DOWN = se3.rotation_from_z_y((0, 0, -1), (0, 1, 0))


def to_the_middle(arm: Arm, state: dict[str, float], y: float = 0.0) -> Trajectory:
    return moves.to_pose(arm, arm.start_state(state), se3.make(DOWN, (0.28, y, 0.60)), RequestBoxes())


def back(plan: Trajectory, slow: float = 3.0) -> Motion:
    t = slow * (plan.t[-1] - plan.t[::-1])
    return Motion(plan.names, t, plan.q[::-1], -plan.v[::-1] / slow, plan.a[::-1] / slow**2)


def standing(state: dict[str, float], arm: Arm, q: np.ndarray) -> dict[str, float]:
    return {**state, **dict(zip(arm.names, q.tolist(), strict=True))}


def nearest(arms: dict[str, Arm], state: dict[str, float], left: Motion, right: Motion, held=((), ())) -> float:
    """Least distance of the arms at looks 5 ms apart, from nothing but the motions."""
    both = DualArm(arms["left"], arms["right"])
    scene = both.scene(state, held=held)
    times = np.arange(0.0, max(left.t[-1], right.t[-1]) + 0.005, 0.005)
    return min(scene.separation(q) for q in np.hstack([left.states(times), right.states(times)]))


@pytest.fixture(scope="module")
def meeting(arms: dict[str, Arm], home: dict[str, float]) -> tuple[dict[str, float], Motion, Motion]:
    """The left arm stands over the middle and goes home slowly; the right one wants there."""
    left, right = arms["left"], arms["right"]
    there = to_the_middle(left, home)
    return standing(home, left, there.q[-1]), back(there), to_the_middle(right, home)


@pytest.mark.requirement("N-12")
def test_an_arm_rests_until_the_other_one_leaves_room(arms, meeting) -> None:
    state, left, right = meeting
    wait = least_delay(ActiveMotion(arms["right"], right), [ActiveMotion(arms["left"], left)], state)
    assert 0.2 < wait < left.t[-1]
    assert nearest(arms, state, left, right.later(wait)) >= 0.020
    assert nearest(arms, state, left, right.later(wait - 0.1)) < 0.024  # not longer than it must
    assert nearest(arms, state, left, right) < 0.020


@pytest.mark.requirement("N-12")
def test_what_has_passed_of_a_motion_under_way_counts(arms, meeting) -> None:
    state, left, right = meeting
    mine = ActiveMotion(arms["right"], right)
    whole = least_delay(mine, [ActiveMotion(arms["left"], left)], state)
    begun = left.later(-0.6)
    now = standing(state, arms["left"], begun.states(np.zeros(1))[0])
    assert least_delay(mine, [ActiveMotion(arms["left"], begun)], now) == pytest.approx(whole - 0.6, abs=0.11)


@pytest.mark.requirement("N-12")
def test_arms_that_do_not_meet_set_out_at_once(arms, home) -> None:
    left = to_the_middle(arms["left"], home, 0.25)
    right = to_the_middle(arms["right"], home, -0.25)
    assert least_delay(ActiveMotion(arms["right"], right), [ActiveMotion(arms["left"], left)], home) == 0.0
    assert nearest(arms, home, left, right) >= 0.020


@pytest.mark.requirement("A-74")
def test_an_arm_that_ends_in_the_way_is_no_matter_of_time(arms, home) -> None:
    left, right = (to_the_middle(arms[side], home) for side in ("left", "right"))
    with refuses(Code.IN_COLLISION, r"right arm after .*openarm_left_\w+.* no rest before it helps") as caught:
        least_delay(ActiveMotion(arms["right"], right), [ActiveMotion(arms["left"], left)], home)
    assert "longer" not in caught.value.message


def test_a_rest_that_is_too_long_is_refused(arms, meeting) -> None:
    state, left, right = meeting
    with pytest.raises(OpenArmError, match=r"within 0\.2 s; it would have to wait longer"):
        least_delay(ActiveMotion(arms["right"], right), [ActiveMotion(arms["left"], left)], state, longest=0.2)
    with refuses(Code.CANCELLED):
        least_delay(ActiveMotion(arms["right"], right), [ActiveMotion(arms["left"], left)], state, stopped=lambda: True)


@pytest.mark.requirement("N-12")
def test_two_held_objects_keep_apart_too(arms, home) -> None:
    """Hands that pass each other with room, but carry plates that would not."""
    left = to_the_middle(arms["left"], home, 0.20)
    right = to_the_middle(arms["right"], home, -0.20)
    least_delay(ActiveMotion(arms["right"], right), [ActiveMotion(arms["left"], left)], home)
    plate = box_from("plate", (0.0, 0.0, 0.20), (0.05, 0.44, 0.02))
    with pytest.raises(OpenArmError, match="plate"):
        least_delay(ActiveMotion(arms["right"], right, [plate]), [ActiveMotion(arms["left"], left, [plate])], home)


def test_motions_are_interpolated_as_controllers_do(arms, home) -> None:
    plan = to_the_middle(arms["left"], home, 0.25)
    whole = Motion(plan.names, plan.t, plan.q, plan.v, plan.a)
    times = np.linspace(-0.5, plan.duration + 0.5, 300)
    np.testing.assert_allclose(whole.states(times), plan.at(times)[0], atol=1e-12)
    cubic, linear = Motion(plan.names, plan.t, plan.q, plan.v), Motion(plan.names, plan.t, plan.q)
    for near, tolerance in ((cubic, 1e-4), (linear, 2e-3)):
        np.testing.assert_allclose(near.states(times), plan.at(times)[0], atol=tolerance)
    assert np.abs(linear.states(times) - cubic.states(times)).max() > 1e-5
    assert whole.later(0.3).joints_at(0.9) == pytest.approx(whole.joints_at(0.6))
    assert Motion(plan.names, plan.t[:1], plan.q[:1]).states(times).shape == (300, 7)
