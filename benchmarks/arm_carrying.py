# SPDX-License-Identifier: Apache-2.0
"""How far the arms are from where they should be, at rest and moving, and what each part of carrying them does to it.

    python -m benchmarks.arm_carrying [--motions 40] [--robots 3] [--only TEXT] [--json PATH]

Random planned motions of both arms through the bridge's own controllers, in process. Errors are those of the tool
centre point, by the simulator's ground truth: against the reference by the joint zeros of the robot (what carrying can
do), at rest 0.3 s after the end of a motion.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from openarm_common.draws import until
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.servos import ServoModel
from openarm_common.scene.scene import load_scene
from openarm_common.types import Array
from openarm_control.arm import TrajectoryConfig, TrajectoryOutcome
from openarm_control.carrier import CarrierConfig
from openarm_control.controller import RobotController
from openarm_control.trajectory import Trajectory as Followed
from openarm_evaluation.campaign.dynamics import DynamicsBench
from openarm_evaluation.campaign.robot import arms_behind
from openarm_motion.planning import moves
from openarm_motion.planning.arm import Arm
from openarm_motion.timing.trajectory import Trajectory
from openarm_sim_bridge.robot import SimulatedRobot
from openarm_sim_bridge.world.hardware import IDEAL, HardwareConfig
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.stage import Stage

SIDES = RobotDescription.load().arm_names

_REST_NS = 300_000_000
_OFF = CarrierConfig(weight=False, lag=False, correction=0.0, settle=False)
PARTS = {
    "none": _OFF,
    "weight": _OFF.model_copy(update={"weight": True}),
    "+ lag": _OFF.model_copy(update={"weight": True, "lag": True}),
    "+ correction": CarrierConfig(settle=False),
    "+ settling": CarrierConfig(),
    "+ identified": CarrierConfig(),
}
ROBOTS: dict[str, HardwareConfig] = {
    "ideal": IDEAL,
    "openarm": HardwareConfig(),
    "openarm, 26 ms": HardwareConfig(latency=(0.026, 0.026)),
    "openarm, gains 30 %": HardwareConfig(gain_error=0.3, mass_error=0.1),
}


@dataclass
class Errors:
    """What was seen, m and rad."""

    static: list[float] = field(default_factory=list[float])
    moving: list[float] = field(default_factory=list[float])
    joint: list[float] = field(default_factory=list[float])
    overtime: list[float] = field(default_factory=list[float])
    failed: int = 0

    def row(self) -> str:
        """Figures of a table."""
        texts = [
            "/".join(f"{1e3 * value:.1f}" for value in np.quantile(values, (0.5, 0.95, 1.0)))
            for values in (self.static, self.moving, self.joint)
        ]
        return f"{texts[0]:>18} {texts[1]:>18} {texts[2]:>18} {np.mean(self.overtime):8.2f} {self.failed:6d}"


def motions(arms: Mapping[str, Arm], home: Mapping[str, float], top_z: float, n: int) -> list[tuple[str, Trajectory]]:
    """Plan random motions of both arms in turn."""
    rng, state, found = np.random.default_rng(5), dict(home), list[tuple[str, Trajectory]]()
    for _ in until(lambda: len(found) >= n, "random motions", "move the table", 100 * n):
        side = SIDES[len(found) % 2]
        arm, sign = arms[side], 1.0 if side == "left" else -1.0
        tilt, heading, yaw = rng.uniform(0.0, 0.7), *rng.uniform(-np.pi, np.pi, 2)
        z = np.array([np.sin(tilt) * np.cos(heading), np.sin(tilt) * np.sin(heading), -np.cos(tilt)])
        y = np.cross(z, (np.cos(yaw), np.sin(yaw), 0.0))
        y /= np.linalg.norm(y)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
        pose[:3, 3] = rng.uniform(0.15, 0.42), sign * rng.uniform(0.03, 0.42), top_z + rng.uniform(0.05, 0.35)
        try:
            plan = moves.to_pose(
                arm, arm.start_state(state, scale=float(rng.choice([0.3, 0.5, 1.0]))), pose, moves.RequestBoxes()
            )
        except OpenArmError:
            continue
        found.append((side, plan))
        state |= dict(zip(plan.names, plan.q[-1].tolist(), strict=True))
    return found


def play(
    robot: SimulatedRobot[RobotController],
    arms: Mapping[str, Arm],
    side: str,
    plan: Trajectory,
    zero: Array,
    out: Errors,
) -> None:
    """Carry out a motion and note the errors."""
    world, follower, ends = robot.world, robot.controller.arms[side], list[TrajectoryOutcome]()
    at = [world.joint_names.index(name) for name in follower.group.names]
    loose = dict.fromkeys(follower.group.names, -1.0)
    points = Followed(plan.names, plan.t, plan.q, plan.v, plan.a, path_tolerance=loose, goal_tolerance=loose)
    state = world.read_joints()
    follower.start(follower.check(points), state.t_ns, plan.q[0], ends.append)
    begun = state.t_ns
    qpos = [int(world.model.joint(name).qposadr[0]) for name in follower.group.names]
    fk = arms[side].kinematics.fk

    def off(reference: Array, q: Array) -> tuple[float, float]:
        tool = float(np.linalg.norm(fk(reference)[:3, 3] - fk(q)[:3, 3]))
        return tool, float(np.max(np.abs(reference - q)))

    peak = np.zeros(2)
    while not ends:
        q = world.data.qpos[qpos] + zero[at]
        robot.tick()
        if follower.state is not None and world.t_ns - begun <= plan.duration * 1e9:
            peak = np.maximum(peak, off(follower.state.desired, q))
    out.failed += ends[0].result != 0
    out.overtime.append((world.t_ns - begun) * 1e-9 - plan.duration)
    until = world.t_ns + _REST_NS
    while world.t_ns < until:
        robot.tick()
    out.moving.append(float(peak[0]))
    out.joint.append(float(peak[1]))
    out.static.append(off(plan.q[-1], world.data.qpos[qpos] + zero[at])[0])


def identified(hardware: HardwareConfig) -> dict[str, ServoModel]:
    """Return the servos as the suite identifies them."""
    return {side: found.servos for side, found in DynamicsBench(hardware).identified().items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--motions", type=int, default=40)
    parser.add_argument("--robots", type=int, default=3, help="draws of each profile")
    parser.add_argument("--only", default="", help="rows whose name has this")
    options = parser.parse_args()
    description, scene = RobotDescription.load(), load_scene("empty")
    arms = arms_behind((), scene.table)
    plans = motions(arms, Stage(description, {}, None, PhysicsConfig()).home, scene.table.top_z, options.motions)
    print("p50/p95/worst of motions: mm at the tool at rest, its peak moving, mrad a joint; s overtime; failed")
    for name, hardware in ROBOTS.items():
        for part, carrier in PARTS.items():
            if options.only not in f"{name}: {part}":
                continue
            errors = Errors()
            for seed in range(1, 1 + (1 if name == "ideal" else options.robots)):
                drawn = hardware.model_copy(update={"dynamics_seed": seed, "zero_seed": seed})
                stage = Stage(description, {}, None, PhysicsConfig(), drawn)
                known = identified(drawn) if part == "+ identified" and name != "ideal" else None
                robot = SimulatedRobot.on(stage, scene, TrajectoryConfig(carrier=carrier), servos=known)
                for _ in range(50):
                    robot.tick()
                for side, plan in plans:
                    play(robot, arms, side, plan, stage.encoders.zero, errors)
            print(f"{name + ': ' + part:34}{errors.row()}", flush=True)


if __name__ == "__main__":
    main()
