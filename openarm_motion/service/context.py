# SPDX-License-Identifier: Apache-2.0
"""What a plan starts from: joints, planning scene, map, and what the hands hold."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from openarm_common.types import Array
from openarm_motion.collision.occupancy import Environment, carried
from openarm_motion.collision.solids import Box
from openarm_motion.config import MotionConfig
from openarm_motion.planning.arm import Arm, Scale, StartState
from openarm_motion.planning.planner import never
from openarm_motion.scene.held import HeldObjects
from openarm_motion.scene.map_view import MapState, MapView, unexplained
from openarm_motion.scene.planning_scene import PlanningScene
from openarm_motion.service.robot import RobotInterface, RobotWatch, stale

if TYPE_CHECKING:
    from openarm_motion.service.coordination import DelayCoordination

#: Next to an arm under way plans keep this distance from where it will end, m: more than what is then proven.
_NEXT_TO = 0.035
#: Hands, and what they hold, are no further from the tool, m.
_BEYOND = 0.5
#: Other joints that move less than this are where they were, rad or m.
_STILL = 2e-3


@dataclass(frozen=True, eq=False)
class Prepared:
    """A start without the map yet, the scene's version, and what the answer says of the map.

    `complete` adds the map; it takes some ms and is for `RobotInterface.compute`.
    """

    now: StartState
    version: int
    note: str
    complete: Callable[[], StartState]


@dataclass(frozen=True, eq=False)
class Around:
    """What is around all arms.

    Attributes:
        prepared: Contexts prepared for a plan of all of them.
        held: Boxes that each holds, tool frame.
        seen: Equal as long as it is the same.
    """

    prepared: Prepared
    held: tuple[Sequence[Box], ...]
    seen: object


class PlanningContext:
    """Collects what plans start from.

    Args:
        robot: The robot.
        arms: Arms by name.
        scene: Bodies to keep clear of.
        held: Boxes that the hands hold.
        coordination: Coordination of the arms under way.
        map_view: The map.
        config: Parameters.
    """

    def __init__(
        self,
        robot: RobotInterface,
        arms: Mapping[str, Arm],
        scene: PlanningScene,
        held: HeldObjects,
        coordination: DelayCoordination,
        map_view: MapView,
        config: MotionConfig,
    ) -> None:
        self._robot, self._arms, self._scene, self._held = robot, arms, scene, held
        self._coordination, self._map, self._config = coordination, map_view, config

    def map_state(self) -> MapState:
        """Return the map as it is now; what is required and missing is an error, see `MapView.read`."""
        return self._map.read(round(self._robot.now() * 1e9))

    def prepare(
        self,
        arms: Sequence[Arm],
        start: Sequence[float] | Array,
        scale: Scale,
        stopped: Callable[[], bool],
        estimates: Sequence[Box] = (),
        attached: Sequence[Sequence[Box]] = (),
        expected: int = 0,
    ) -> Prepared:
        """Take the robot as it is now; a given start is enough where the joint states are missing.

        Other arms under way are taken to be where they will end.

        Args:
            arms: The arms that are asked; the start is that of all of them, one after the other.
            start: Joints, or empty for the present ones.
            scale: Velocity scale.
            stopped: Whether the request was cancelled.
            estimates: Boxes of the request: what the map shows of them is theirs.
            attached: Boxes that each arm holds, tool frame.
            expected: Version that the scene must have; 0 is any.

        Raises:
            OpenArmError: from `Arm.start_state`, `PlanningScene.require` and `MapView.read`; NOT_READY without joints.
        """
        self._scene.require(expected)
        starts = np.split(np.asarray(start), np.cumsum([arm.kinematics.n for arm in arms])[:-1])
        slow = self._slowed(arms, scale)
        parts = [self.start(arm, part, slow, stopped) for arm, part in zip(arms, starts, strict=True)]
        now = replace(parts[0], start=np.concatenate([part.start for part in parts]))
        uncertain = list(estimates)
        for arm, part, boxes in zip(arms, parts, attached, strict=True):
            uncertain += carried(boxes, arm.kinematics.fk(part.start))
        ends = self._coordination.ends(arms)
        later = {**now.state, **ends}
        solids = (*self._scene.solids, *self._others_hold(arms, later))
        view, config, clearance = self.map_state(), self._config.map, _NEXT_TO if ends else 0.0
        octree = self._scene.octree

        def complete() -> StartState:
            occupied = view.occupied if octree is None else octree.beside(view.occupied, *self._reach())
            if occupied is not None:
                certain, robot = (*self._scene.fixed, *solids), arms[0].description  # with what is mounted on it
                occupied = unexplained(occupied, config, robot, now.state, certain, uncertain)
            return replace(now, state=later, environment=Environment(solids, occupied, clearance, self._scene.allowed))

        # a graph without a map is as it should be; one with an old map is not
        note = f" without the map: {view.why}" if view.why and view.version else ""
        return Prepared(now, self._scene.version, note, complete)

    def around_all(self, seen: object) -> Around | None:
        """Return what is around all arms; None where it is as when it was `seen`. Raises as `prepare`."""
        arms = list(self._arms.values())
        held = tuple(self._held.held.get(arm.name, ()) for arm in arms)
        joints = {name for arm in arms for name in arm.names}
        state = self._robot.states.latest()[1]
        others = tuple(round(q / _STILL) for name, q in sorted(state.items()) if name not in joints)
        now = (self._scene.version, self.map_state().version, held, others, arms)
        if now == seen:
            return None
        return Around(self.prepare(arms, (), 0.0, never, (), held), held, now)

    def start(self, arm: Arm, start: Sequence[float] | Array, scale: Scale, stopped: Callable[[], bool]) -> StartState:
        """Take the joints alone, without scene and map; arguments as `prepare`."""
        state: dict[str, float] = {}
        age = self._robot.state_age()
        if age <= self._config.execution.stale_after:
            state = self._robot.states.latest()[1]
        elif len(start) == 0:
            raise stale(age)
        return arm.start_state(state, start, scale, stopped)

    async def fresh(self) -> None:
        """Wait a moment for a fresh joint state; see `RobotWatch.fresh`."""
        if self._robot.state_age() > self._config.execution.stale_after:
            await RobotWatch(self._robot).fresh()

    def _slowed(self, arms: Sequence[Arm], scale: Scale) -> Scale:
        """Velocity scale with which no joint is faster than a controller of the arms follows now."""
        share = min(self._robot.controller(arm.name).fastest / arm.limits(1.0).velocity.max() for arm in arms)
        scales = scale if isinstance(scale, tuple) else (scale, scale)
        return scale if share >= 1.0 else (min(arms[0].scale(scales[0]), share), scales[1])

    def _reach(self) -> tuple[Array, Array]:
        """Two corners (3,) of a box about all that the arms, and what they hold, can meet; base frame, m."""
        shoulders = np.array([arm.kinematics.placements[0, :3, 3] for arm in self._arms.values()])
        reach = np.array([[arm.kinematics.reach + _BEYOND] for arm in self._arms.values()])
        return (shoulders - reach).min(axis=0), (shoulders + reach).max(axis=0)

    def _others_hold(self, arms: Sequence[Arm], state: Mapping[str, float]) -> list[Box]:
        """What the other arms hold, where they hold it in a state."""
        boxes, asked = list[Box](), {arm.name for arm in arms}
        for name, held in self._held.held.items():
            other = self._arms[name]
            if name in asked or any(joint not in state for joint in other.names):
                continue
            T = other.kinematics.fk(np.array([state[joint] for joint in other.names]))
            boxes += [replace(box, id=f"{box.id} in the {name} hand") for box in carried(held, T)]
        return boxes
