# SPDX-License-Identifier: Apache-2.0
"""A whole grasp on the robot of a campaign, watched by ground truth tick by tick: lift, carry, put down, leave."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.scene import Scene, SceneObject
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task, endurance
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig
from openarm_grasp.strategies.pick_and_place import pick_and_place
from openarm_grasp.strategies.request import GraspOutcome, GraspRequest

BOX = SceneObject(name="blue_box", shape="box", size=(0.045, 0.06, 0.07), color="blue", position=(0.26, 0.22), yaw=0.4)


def trials(*objects: SceneObject) -> Trials:
    run = Trials(Task("nominal", 1, Scene(name="bench", objects=objects), ()), SimulatedSenses(), GraspConfig())
    run.robot.pass_time(0.3)
    return run


def ask(run: Trials, label: str, **kwargs) -> GraspOutcome:
    task = run.grasp_task(GraspRequest(label, **kwargs))
    return run.link.run(pick_and_place(task, task.request))


@dataclass
class Watched:
    """What was true at each tick."""

    outcome: GraspOutcome
    states: list[str] = field(default_factory=list[str])
    p_object: list[np.ndarray] = field(default_factory=list[np.ndarray])
    p_tcp: list[np.ndarray] = field(default_factory=list[np.ndarray])
    gap: list[float] = field(default_factory=list[float])

    def during(self, state: str) -> np.ndarray:
        return np.flatnonzero([s == state for s in self.states])


@pytest.fixture(scope="module")
def watched() -> Watched:
    run = trials(BOX)
    robot, seen = run.robot, Watched(GraspOutcome(Code.INTERNAL, "", ""))
    link, tick = robot.description.tcp_link("left"), robot.tick

    def watch() -> None:
        tick()
        q = dict(zip(robot.world.joint_names, robot.world.read_joints().position.tolist(), strict=True))
        seen.states.append(run.steps[-1].state if run.steps else "IDLE")
        seen.p_object.append(robot.world.objects()[0].T_world_object[:3, 3].copy())
        seen.p_tcp.append(robot.description.link_pose(link, q)[:3, 3])
        seen.gap.append(2.0 * q[robot.description.finger_joint("left")])

    robot.tick = watch  # type: ignore[method-assign]
    seen.outcome = ask(run, "blue")
    assert seen.outcome.success, seen.outcome.message
    return seen


@pytest.mark.requirement("P-07")
def test_the_object_rises_with_the_hand_and_slips_less_than_a_centimetre(watched: Watched) -> None:
    lift = watched.during("LIFT")
    obj, tcp = (np.array([track[i] for i in (lift[0], lift[-1])]) for track in (watched.p_object, watched.p_tcp))
    risen, hand = (obj[1] - obj[0])[2], (tcp[1] - tcp[0])[2]
    assert risen >= 0.03
    assert hand == pytest.approx(0.12, abs=0.01)
    assert np.linalg.norm((obj[1] - obj[0]) - (tcp[1] - tcp[0])) <= 0.01


@pytest.mark.requirement("P-10")
def test_the_hand_leaves_without_dragging_what_it_has_put_down(watched: Watched) -> None:
    place = watched.during("PLACE")
    gaps = np.array([watched.gap[i] for i in place])
    released = place[np.flatnonzero(gaps > gaps[0] + 0.004)[0]]
    dragged = np.linalg.norm(np.array(watched.p_object[-1]) - watched.p_object[released], axis=0)
    assert dragged <= 0.005
    x, y, _ = watched.outcome.place_position
    assert np.hypot(*(watched.p_object[-1][:2] - (x, y))) <= 0.02


@pytest.mark.requirement("B-19")
def test_what_is_out_of_reach_is_refused_before_anything_moves_and_says_how_far() -> None:
    outcome = ask(trials(BOX.model_copy(update={"position": (0.52, -0.39)})), "blue")
    assert outcome.code is Code.UNREACHABLE
    assert (outcome.kind, outcome.attempts) == ("REFUSED", 0)
    assert "mm of it" in outcome.message


@pytest.mark.requirement("N-20")
def test_a_gap_that_changes_on_the_way_is_a_slip_and_stops_the_carry() -> None:
    """The fingers creep together while the arm follows its path; 2 mm are let pass, 4 mm are not."""
    run = trials(BOX)
    assert ask(run, "blue", phase="pick").success
    hand, gap = run.skills._hands["left"], run.skills.aperture("left")

    def carry(creep: float) -> None:
        async def follow(arm, trajectory, what, guard) -> None:
            hand.gap = lambda: gap - creep  # type: ignore[method-assign]
            guard()

        hand.gap = lambda: gap  # type: ignore[method-assign]
        run.link.follow = follow  # type: ignore[method-assign]
        run.link.run(run.skills.follow("left", "carry", "carry", carrying=True))

    carry(0.002)
    with pytest.raises(OpenArmError, match="the object slips: the gap went from") as error:
        carry(0.004)
    assert error.value.code is Code.GRASP_LOST


@pytest.mark.requirement("A-78")
def test_the_endurance_task_asks_for_its_objects_again_and_again_in_one_world() -> None:
    """The command `openarm campaign --suite endurance` carries it out; here, that it is what it says."""
    task = endurance(7)
    assert len(task.labels) == 20
    assert len(task.scene.objects) == len(set(task.labels)) == 2
    assert not task.clear
