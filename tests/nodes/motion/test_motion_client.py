# SPDX-License-Identifier: Apache-2.0
"""The motion node asked by `MotionClient`, from another thread."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from openarm_interfaces.msg import ArmTarget

from openarm_common import se3
from openarm_common.errors import Code
from openarm_motion.collision.solids import Sphere, box_from
from openarm_motion.ros.client import MotionClient
from tests.refusals import refused


def asked(bench, work: Callable[[MotionClient], Any]) -> Any:
    """What a program does with the client, while the graph spins here."""

    def run() -> Any:
        with MotionClient() as motion:
            return work(motion)

    with ThreadPoolExecutor(1) as worker:
        done = worker.submit(run)
        bench.ros.spin_until(done.done, what="the program")
        return done.result()


def test_a_program_plans_agrees_and_moves(bench) -> None:
    stages: list[tuple[str, float]] = []
    below = se3.make(bench.DOWN, (0.26, -0.24, 0.50))

    def work(motion: MotionClient) -> None:
        plan = motion.move_to_named("right", "official_home", scale=1.0, plan_only=True).raise_for_code()
        assert plan.scene_version == 1
        (trajectory,) = plan.trajectories
        assert trajectory.names == bench.description.arm_joints("right")
        assert trajectory.a.shape == trajectory.q.shape == (len(trajectory.t), 7)
        assert motion.execute("right", plan).raise_for_code().message == "arrived"
        q = motion.compute_ik("right", se3.make(bench.DOWN, (0.26, -0.24, 0.55)))
        motion.move_to_joints("right", q, scale=1.0, on_feedback=lambda *stage: stages.append(stage)).raise_for_code()
        motion.move_on_line("right", below, scale=1.0).raise_for_code()

    asked(bench, work)
    tip = bench.node.service.arms["right"].kinematics.fk(bench.q("right"))
    np.testing.assert_allclose(tip, below, atol=1e-3)
    assert stages[0][0] == "planning"
    assert stages[-1][0] == "executing"


def test_a_program_changes_the_scene_and_reads_why_there_is_no_plan(bench) -> None:
    tip = bench.node.service.arms["right"].kinematics.fk([0, 0, 0, 1.5708, 0, 0, 0])

    def work(motion: MotionClient) -> None:
        assert motion.apply_scene([Sphere("ball", se3.make(None, tip[:3, 3]), 0.05)]) == 2
        assert [o.id for o in motion.scene().objects] == ["table", "ball"]
        result = motion.move_to_named("right", "official_home")
        assert (result.success, result.code) == (False, Code.IN_COLLISION)
        assert result.failure is not None
        assert (result.failure.stage, result.failure.second) == ("goal", "ball")
        assert result.failure.has_alternative
        assert motion.move_to_joints("right", result.failure.alternative, scale=1.0).success
        refused("can't remove 'cup'", motion.apply_scene, remove=["cup"])
        assert motion.apply_scene(clear=True) == 3
        crate = box_from("crate", tip[:3, 3], (0.1, 0.1, 0.1))
        blocked = motion.move_to_pose("right", tip, obstacles=[crate])
        assert blocked.failure is not None
        assert blocked.failure.second == "crate"
        assert refused(None, motion.compute_ik, "left", np.eye(4)).code is Code.UNREACHABLE

    asked(bench, work)


@pytest.mark.long
def test_a_program_moves_both_arms(bench) -> None:
    targets = [ArmTarget(arm=arm, kind=ArmTarget.NAMED, named="official_home") for arm in ("left", "right")]
    result = asked(bench, lambda motion: motion.move_both(targets, scale=1.0))
    assert result.success, result.message
    assert [t.names[0] for t in result.trajectories] == ["openarm_left_joint1", "openarm_right_joint1"]
    np.testing.assert_allclose(bench.q("left")[3], 1.5708, atol=1e-3)
