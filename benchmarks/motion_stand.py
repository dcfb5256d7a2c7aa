# SPDX-License-Identifier: Apache-2.0
"""The simulated robot among boxes, moved by plans and judged by MuJoCo's contacts and distances. World frame, m, s."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.servos import ArmLoad
from openarm_common.scene.scene import load_scene
from openarm_control.arm import TrajectoryConfig, TrajectoryOutcome
from openarm_control.trajectory import Trajectory as Commanded
from openarm_motion.collision.solids import Box
from openarm_motion.timing.trajectory import Trajectory
from openarm_sim_bridge.robot import SimulatedRobot
from openarm_sim_bridge.world.hardware import HardwareConfig
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.stage import Stage

SIDES = RobotDescription.load().arm_names

#: Distances of the arms are looked for up to here, m.
FAR = 0.3


@dataclass
class Seen:
    """What the judge saw of one plan."""

    kind: str
    code: str = "OK"
    contacts: list[str] = field(default_factory=list)
    separation: float = FAR
    duration: float = 0.0
    planning: float = 0.0
    off: float = 0.0
    refused: int = 0


class Stand:
    """The simulated robot among boxes, and who moves it."""

    def __init__(self, description: RobotDescription, boxes: tuple[Box, ...], hardware: HardwareConfig) -> None:
        def add(spec: mujoco.MjSpec) -> None:
            for box in boxes:
                quaternion = np.roll(se3.quat_xyzw_from_matrix(box.T[:3, :3]), 1)
                spec.worldbody.add_geom(
                    name=box.id, type=mujoco.mjtGeom.mjGEOM_BOX, size=box.size / 2, pos=box.T[:3, 3], quat=quaternion
                )

        stage = Stage(description, {}, None, PhysicsConfig(), hardware)
        self._loads = {
            side: ArmLoad(description, description.arm_joints(side), description.tcp_link(side)) for side in SIDES
        }
        self.world = stage.world(load_scene("empty"), add)
        self._controller = SimulatedRobot.controllers(stage, self.world, TrajectoryConfig())
        self._geoms = [
            [
                g
                for g in range(self.world.model.ngeom)
                if self._body(g).startswith(f"openarm_{side}_") and self._solid(g)
            ]
            for side in ("left", "right")
        ]
        #: Arms that are on their way.
        self.busy: set[str] = set()
        self._contacts: set[str] = set()
        self._outcomes: list[TrajectoryOutcome] = []
        #: Pairs that touch before anything has moved, for example closed fingers.
        self._usual = set(self._touching())

    def state(self) -> dict[str, float]:
        """Joints by name."""
        return dict(zip(self.world.joint_names, self.world.read_joints().position.tolist(), strict=True))

    def run(self, parts: Mapping[str, Trajectory], seen: Seen, *, distances: bool) -> None:
        """Execute trajectories, one an arm, begun at the same moment."""
        for side, part in parts.items():
            self.start(side, part)
        while self.busy:
            self.tick(seen, distances=distances)
        self.close(seen)

    def start(self, side: str, part: Trajectory, wait: float = 0.0) -> None:
        """Let an arm begin a trajectory after a wait."""
        world = self.world
        follower = self._controller.arms[side]
        order = [world.joint_names.index(name) for name in follower.group.names]
        begin_ns = world.t_ns + round(wait * 1e9)
        command = follower.check(Commanded(part.names, part.t, part.q, part.v, part.a, start_ns=begin_ns))
        self.busy.add(side)

        def ended(outcome: TrajectoryOutcome) -> None:
            self.busy.discard(side)
            self._outcomes.append(outcome)

        follower.start(command, world.t_ns, world.read_joints().position[order], ended)

    def tick(self, seen: Seen, *, distances: bool) -> None:
        """Let one period of the controllers pass."""
        world = self.world
        world.set_targets(self._controller.update(world.read_joints(), world.period_ns))
        for _ in range(world.steps_per_tick):
            world.step(1)
            self._contacts |= set(self._touching()) - self._usual
        for side in self.busy:
            state = self._controller.arms[side].state
            if state is not None:
                seen.off = max(seen.off, self._loads[side].tool_offset(state.desired, state.desired - state.actual))
        if distances:
            seen.separation = min(seen.separation, self._separation(seen.separation))

    def close(self, seen: Seen) -> None:
        """Write down what there was since the last time."""
        seen.contacts = sorted(self._contacts)
        faults = [outcome.text for outcome in self._outcomes if outcome.result != 0]
        if faults:
            seen.code = f"EXECUTION_FAILED: {faults[0]}"
        self._contacts.clear()
        self._outcomes.clear()

    def _touching(self) -> Iterator[str]:
        data = self.world.data
        for contact in data.contact[: data.ncon]:
            if contact.dist < 0.0:
                yield " - ".join(sorted(self._name(int(g)) for g in (contact.geom1, contact.geom2)))

    def _separation(self, limit: float) -> float:
        model, data = self.world.model, self.world.data
        for a in self._geoms[0]:
            for b in self._geoms[1]:
                far = float(np.linalg.norm(data.geom_xpos[a] - data.geom_xpos[b]))
                if far - model.geom_rbound[a] - model.geom_rbound[b] < limit:
                    limit = min(limit, mujoco.mj_geomDistance(model, data, a, b, limit, None))
        return limit

    def _solid(self, geom: int) -> bool:
        return bool(self.world.model.geom_contype[geom] or self.world.model.geom_conaffinity[geom])

    def _body(self, geom: int) -> str:
        return self.world.model.body(int(self.world.model.geom_bodyid[geom])).name

    def _name(self, geom: int) -> str:
        body = self._body(geom)
        return self.world.model.geom(geom).name or "nameless" if body == "world" else body
