# SPDX-License-Identifier: Apache-2.0
"""Servos of a campaign's robot: each draw of a profile is identified once, by the suite itself, in this process."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from openarm_calibration.dynamics.excite import postures, waves
from openarm_calibration.dynamics.identify import Identified, ServoLog, identify
from openarm_common.errors import OpenArmError
from openarm_common.records import RecordStore
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.servo_store import StoredServos
from openarm_common.robot.servos import ArmLoad, ServoModel
from openarm_common.scene.scene import load_scene
from openarm_common.types import Array
from openarm_control.arm import TrajectoryConfig, TrajectoryOutcome
from openarm_control.trajectory import Trajectory
from openarm_evaluation.campaign.options import CampaignOptions
from openarm_evaluation.campaign.parameters import suite_config
from openarm_evaluation.campaign.robot import arms_behind
from openarm_evaluation.campaign.tasks.task import Task
from openarm_motion.planning import moves
from openarm_motion.planning.arm import Arm
from openarm_sim_bridge.robot import SimulatedRobot
from openarm_sim_bridge.world.hardware import HardwareConfig
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.stage import Stage

_POSTURES = 6


class DynamicsBench:
    """The simulated robot alone, moved to show its servos.

    Args:
        hardware: Hardware of the robot.
    """

    def __init__(self, hardware: HardwareConfig) -> None:
        self._description = RobotDescription.load()
        scene = load_scene("empty")
        self.stage = Stage(self._description, {}, None, PhysicsConfig(), hardware)
        self._arms = arms_behind((), scene.table)
        self._robot = SimulatedRobot.on(self.stage, scene, TrajectoryConfig())

    def identified(self) -> Mapping[str, Identified]:
        """Move both arms in turn and identify their servos, by side."""
        return {side: self._identified(side) for side in self._description.arm_names}

    def _identified(self, side: str) -> Identified:
        arm, description = self._arms[side], self._description
        load = ArmLoad(description, arm.names, description.tcp_link(side))
        collides = arm.scene(self._state(), ()).collides
        rng = np.random.default_rng(0)
        home, logs = np.array([self._state()[name] for name in arm.names]), list[ServoLog]()
        for posture in postures(*description.limits(arm.names, np.pi), load, lambda q: not collides(q), _POSTURES, rng):
            try:
                self._go(arm, posture)
            except OpenArmError:
                continue
            logs.append(self._play(arm, *waves(posture)))
        self._go(arm, home)
        return identify(logs, load)

    def _go(self, arm: Arm, q: Array) -> None:
        plan = moves.to_joints(arm, arm.start_state(self._state(), scale=1.0), q.tolist(), moves.RequestBoxes())
        self._follow(arm, Trajectory(plan.names, plan.t, plan.q, plan.v, plan.a))

    def _play(self, arm: Arm, t: Array, q: Array) -> ServoLog:
        return self._follow(arm, Trajectory(tuple(arm.names), t, q))

    def _follow(self, arm: Arm, trajectory: Trajectory) -> ServoLog:
        robot, follower, ends = self._robot, self._robot.controller.arms[arm.name], list[TrajectoryOutcome]()
        at = [robot.world.joint_names.index(name) for name in arm.names]
        loose = dict.fromkeys(arm.names, -1.0)
        points = Trajectory(
            trajectory.names, trajectory.t, trajectory.q, trajectory.v, trajectory.a, 0, loose, loose, goal_time_s=2.0
        )
        follower.start(follower.check(points), robot.world.t_ns, trajectory.q[0], ends.append)
        targets, positions = list[Array](), list[Array]()
        while not ends:
            robot.tick()
            targets.append(robot.targets[at])
            positions.append(robot.state.position[at])
        return ServoLog(robot.world.period_ns * 1e-9, np.array(targets), np.array(positions))

    def _state(self) -> dict[str, float]:
        world = self._robot.world
        return dict(zip(world.joint_names, world.read_joints().position.tolist(), strict=True))


def with_servos(task: Task, options: CampaignOptions, folder: Path) -> tuple[Task, Mapping[str, ServoModel] | None]:
    """The task with the robot of one of the dynamics seeds (each in turn), and its servos as identified, by side.

    Args:
        task: The task.
        options: Options of the campaign; None for the servos where they are not identified, or need not be.
        folder: Folder of identifications; those that it lacks are made.
    """
    seed = options.dynamics_seeds[task.seed % len(options.dynamics_seeds)]
    task = replace(task, dynamics_seed=seed)
    robot = RobotDescription.load()
    hardware = suite_config(options.graph_parameters()).bridge.hardware.of_seed(seed)
    if not options.identify or hardware.of(robot).gravity_compensation == 1.0:
        return task, None
    store, arms = RecordStore(folder / str(seed), StoredServos), robot.arm_names
    if any(store.find(arm) is None for arm in arms):
        for side, found in DynamicsBench(hardware).identified().items():
            store.save(found.record(side, seed))
    return task, {arm: store.load(arm).model() for arm in arms}
