# SPDX-License-Identifier: Apache-2.0
"""One arm with all that planning needs: kinematics, collision shapes, limits, the table, a planner.

Everything that is planned goes through here; it holds no state between requests and may serve several threads.
"""

from __future__ import annotations

import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any, TypeAlias

import numpy as np

from openarm_common.collision.held_apart import held_apart
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.turns import nearest_turns, other_ways
from openarm_common.types import Array
from openarm_motion.collision.exact import Clearance, CollisionContext, CollisionScene, Contact
from openarm_motion.collision.fast import FastScene
from openarm_motion.collision.line_checks import LineChecks, spread
from openarm_motion.collision.occupancy import NOTHING, Environment
from openarm_motion.collision.robot import CollisionRobot
from openarm_motion.collision.solids import Box
from openarm_motion.config import MotionConfig
from openarm_motion.kinematics.chain import ArmKinematics
from openarm_motion.kinematics.inverse import InverseKinematics
from openarm_motion.kinematics.line import Line
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.planning.planner import PlannedPath, Planner, PlanQuery, make_planner, never
from openarm_motion.planning.search_kernels import duration
from openarm_motion.timing.blending import PolylineTiming
from openarm_motion.timing.trajectory import JointLimits, Trajectory, time_path
from openarm_motion.timing.validation import keeps_clear, validate_trajectory

_LOG = logging.getLogger(__name__)
#: A joint this far outside its limits is a wrong reading, not sag; rad.
_SAG = 0.05


#: How many times finer the steps of the searches are that follow one whose result failed the validation.
_FINENESS = (1.0, 4.0)
#: Goals to which the straight line is tried before a search, and where on it most of those that collide do so.
_DIRECT = 4
_SCOUTS = spread(16)

#: Least scale of velocities and accelerations: a motion takes minutes, and not more memory than there is.
_SLOWEST = 1e-3


@dataclass(frozen=True, eq=False)
class ValidatedPlan:
    """A path, and the same timed and validated."""

    path: PlannedPath
    trajectory: Trajectory


#: Velocity scale of a request, or that and the one of acceleration and jerk; 0 is the default.
Scale: TypeAlias = float | tuple[float, float]


@dataclass(frozen=True, eq=False)
class StartState:
    """What a request starts from.

    Attributes:
        state: Positions of the robot's joints by name, rad or m; both arms and fingers.
        start: (n,) where the arm starts; usually its part of `state`.
        scale: Scale of velocity, or of velocity and acceleration; 0 means the default.
        stopped: Whether the request was cancelled; asked often.
        environment: Bodies of the planning scene and the map.
        seeds: Added to that of the searches, one for each of them; the path that is followed soonest is taken.
    """

    state: Mapping[str, float]
    start: Array
    scale: Scale = 0.0
    stopped: Callable[[], bool] = never
    environment: Environment = NOTHING
    seeds: Sequence[int] = (0,)


class PlanningGroup(ABC):
    """Joints that are planned together: those of one arm, or of two as one.

    Attributes:
        title: Title in messages, for example "the left arm".
        config: Parameters.
        names: The joints.
        lower: (n,) joint limits, infinite for a joint that turns without end.
        upper: (n,) joint limits.
        direct: Whether straight joint lines are tried before the planner is asked.
    """

    title: str
    config: MotionConfig
    names: tuple[str, ...]
    lower: Array
    upper: Array
    direct: bool = True

    @abstractmethod
    def limits(self, scale: Scale) -> JointLimits:
        """Joint limits at the velocity scale of a request."""

    @abstractmethod
    def plan(
        self, scene: LineChecks, now: StartState, goals: Array, time_limit: float, fineness: float = 1.0
    ) -> PlannedPath:
        """Free path to one of several configurations (k, n), an earlier one preferred.

        Raises:
            OpenArmError: NO_PLAN, saying what is in the way where that is known; CANCELLED.
        """

    def query(
        self, scene: LineChecks, now: StartState, goals: Array, time_limit: float, fineness: float = 1.0
    ) -> PlanQuery:
        """What a planner is asked for a path to one of several goals (k, n); steps are `fineness` times finer."""
        search, limits = self.config.planning, self.limits(now.scale)
        step, travel = search.edge_step / fineness, search.edge_travel / fineness
        ends = np.vstack([now.start, goals])
        return PlanQuery(
            start=now.start,
            goals=goals,
            lower=np.where(np.isinf(self.lower), ends.min(axis=0) - np.pi, self.lower),
            upper=np.where(np.isinf(self.upper), ends.max(axis=0) + np.pi, self.upper),
            collides=scene.collides,
            edge_free=lambda a, b: scene.edge_free(a, b, step, travel),
            time_limit=time_limit,
            iterations=search.iterations,
            seed=search.seed + now.seeds[0],
            stopped=now.stopped,
            fast=None if scene.exact_only else cache(lambda: FastScene(scene.arms, scene.arms[0].distances)),
            resolution=(step, travel),
            limits=limits,
        )

    def plan_validated(
        self,
        scene: LineChecks,
        now: StartState,
        goals: Array,
        time_limit: float,
        validate: Callable[[Any, Trajectory], object] | None = None,
    ) -> ValidatedPlan:
        """Free path to one of several configurations, timed, and validated on the exact layer.

        Where the straight joint line to one of the first goals keeps the full clearance all the way, there is nothing
        to search. Where the validation finds what the search stepped over, the search is repeated with finer steps.
        What is no straight line is searched for once with each of the start's seeds, as far as time allows.
        Joints that turn without end go the short way, and the other way only where the search finds no path.

        Args:
            scene: Planning scene to keep clear of.
            now: State at the start.
            goals: (k, n) rad, joints that turn without end in any turn.
            time_limit: s.
            validate: Raises `PlanFailedError` for a trajectory in a scene; None is `validate_trajectory`.

        Raises:
            OpenArmError: as `plan`; IN_COLLISION, when the finest search did not help.
        """
        end = time.monotonic() + time_limit
        goals = nearest_turns(goals, now.start, self.upper)
        direct = self._direct(scene, now, goals) if self.direct else None
        if direct is not None and validate is None:
            return direct
        best = self._searched(scene, now, goals, end, validate, direct)
        for seed in now.seeds[1:]:
            if len(best.path.waypoints) == 2 or time.monotonic() > end or now.stopped():
                break
            with suppress(PlanFailedError):
                found = self._searched(scene, replace(now, seeds=(seed,)), goals, end, validate, None)
                best = min(best, found, key=lambda plan: plan.trajectory.duration)
        return best

    def _searched(
        self,
        scene: LineChecks,
        now: StartState,
        goals: Array,
        end: float,
        validate: Callable[[Any, Trajectory], object] | None,
        direct: ValidatedPlan | None,
    ) -> ValidatedPlan:
        """One plan: as `plan_validated`, with an end on the monotonic clock, s, and a straight line to try first."""
        fault, contact = "", None
        for fineness in _FINENESS:
            path = direct.path if direct else self._free_path(scene, now, goals, end, fineness)
            direct = None
            timing, left = self.timing(path, now.scale), True
            while left:
                trajectory = timing.trajectory()
                try:
                    (validate or validate_trajectory)(scene, trajectory)
                    return ValidatedPlan(path, trajectory)
                except PlanFailedError as error:
                    fault, contact, left = error.message, error.contact, timing.round_less(error.at)
        text = f"the plan of {self.title} failed the validation: {fault}"
        raise PlanFailedError(Code.IN_COLLISION, text, "certificate", contact)

    def straight(self, now: StartState, goal: Array) -> Trajectory:
        """The straight joint line from the start to a configuration (n,), timed and not checked."""
        return self.timing(PlannedPath(np.stack([now.start, goal]), 0, 0), now.scale).trajectory()

    def _free_path(self, scene: LineChecks, now: StartState, goals: Array, end: float, fineness: float) -> PlannedPath:
        """Free path to one of the goals (k, n), the short way or the other way of a joint that turns without end."""
        others, left = other_ways(goals, now.start, self.upper), max(end - time.monotonic(), 0.1)
        if not len(others):
            return self.plan(scene, now, goals, left, fineness)
        try:
            return self.plan(scene, now, goals, 0.5 * left, fineness)
        except OpenArmError as error:
            if error.code != Code.NO_PLAN:
                raise
        path = self.plan(scene, now, others, 0.5 * left, fineness)
        return replace(path, goal=path.goal % len(goals))

    def _direct(self, scene: LineChecks, now: StartState, goals: Array) -> ValidatedPlan | None:
        """The straight joint line to one of the first goals, where it is free all the way on the exact layer."""
        for i, goal in enumerate(goals[:_DIRECT]):
            if now.stopped():
                return None
            if any(scene.collides(now.start + u * (goal - now.start)) for u in _SCOUTS):
                continue
            path = PlannedPath(np.stack([now.start, goal]), i, i + 1)
            trajectory = self.timing(path, now.scale).trajectory()
            if keeps_clear(scene, trajectory):
                return ValidatedPlan(path, trajectory)
        return None

    def timing(self, path: PlannedPath, scale: Scale) -> PolylineTiming:
        """Timings of a free path."""
        search = self.config.planning
        return PolylineTiming(search.timing, self.names, path.waypoints, self.limits(scale), search.period)


class Arm(PlanningGroup):
    """One arm.

    Args:
        name: Name in messages, for example "left".
        description: The robot.
        config: Parameters.
        static: Boxes that are always there (the table), base frame; held objects may rest on them.
        planner: Finds free paths.
        apart: See `CollisionRobot`; None: it is found here, in some 0.3 s.

    Raises:
        OpenArmError: CONFIG_INVALID, when the limits are not for this arm's number of joints.
    """

    def __init__(
        self,
        name: str,
        description: RobotDescription,
        config: MotionConfig,
        static: Sequence[Box] = (),
        planner: Planner | None = None,
        apart: Mapping[frozenset[str], float] | None = None,
    ) -> None:
        self.name, self.title = name, f"the {name} arm"
        self.config = config
        self.description = description
        self._hand = description.hands.get(name)
        #: Distance of the pads of an open hand from its middle, m; None without a hand.
        self.opened = self._hand.parts.opening if self._hand else None
        self.kinematics = ArmKinematics(description, config.tool_link.format(arm=name) or description.tcp_link(name))
        self.names, self.lower, self.upper = self.kinematics.names, self.kinematics.lower, self.kinematics.upper
        self.inverse = InverseKinematics(self.kinematics, config.planning.swivels)
        self.robot = CollisionRobot(description, self.kinematics, kept(description, config) if apart is None else apart)
        self.static: tuple[Box, ...] = tuple(static)
        self._planner: Planner = planner or make_planner(config.planning.planner)
        self.direct = planner is None and config.planning.planner == "fast"  # another one is asked for every path
        limits = config.limits.of(description.motion, name, self.names)
        fastest = [description.joint(joint).velocity or np.inf for joint in self.names]  # controllers refuse more
        self._limits = limits._replace(velocity=np.minimum(limits.velocity, fastest))

    def start_state(
        self,
        state: Mapping[str, float],
        start: Sequence[float] | Array = (),
        scale: Scale = 0.0,
        stopped: Callable[[], bool] = never,
        environment: Environment = NOTHING,
    ) -> StartState:
        """Check and complete what a request starts from; an empty `start` is the present configuration.

        Raises:
            OpenArmError: NOT_READY, when the state lacks a joint of the arm; INVALID_ARGUMENT, for a start that is not
                finite or of another size; LIMITS, for one outside the limits.
        """
        missing = [name for name in self.names if name not in state]
        if missing and len(start) == 0:
            raise OpenArmError(Code.NOT_READY, f"/joint_states lacks {', '.join(missing)}")
        q = self.configuration(start if len(start) else [state[name] for name in self.names], "start", _SAG)
        self.scale(scale)
        return StartState(dict(state), q, scale, stopped, environment)

    def configuration(self, values: Sequence[float] | Array, what: str, tolerance: float = 1e-4) -> Array:
        """Check joint positions and move them into the limits where they are out by no more than `tolerance`.

        Raises:
            OpenArmError: INVALID_ARGUMENT or LIMITS, naming the joint, its value and its limits.
        """
        q = np.array(values, dtype=np.float64)
        if q.shape != (self.kinematics.n,):
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"{what} has {q.size} joint positions, expected {self.kinematics.n}: {', '.join(self.names)}",
            )
        if not np.all(np.isfinite(q)):
            i = int(np.argmin(np.isfinite(q)))
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{what}: {self.names[i]} is {q[i]}, expected a finite number")
        outside = self.kinematics.outside(q, -tolerance)
        if outside:
            raise OpenArmError(Code.LIMITS, f"{what}: {self.kinematics.outside(q)}")
        return np.clip(q, self.kinematics.lower, self.kinematics.upper)

    def scale(self, requested: Scale, what: str = "velocity_scale") -> float:
        """Velocity scale of a request, whose field has the name `what`; 0 is the default.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when it is neither 0 nor from `_SLOWEST` to 1.
        """
        if isinstance(requested, tuple):
            requested = requested[0]
        if requested == 0.0:
            return self.config.limits.default_scale
        if not _SLOWEST <= requested <= 1.0:
            text = f"{what} is {requested}, expected {_SLOWEST:g} to 1 (or 0 for the default)"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        return requested

    def limits(self, scale: Scale) -> JointLimits:
        """Joint limits at the velocity scale of a request."""
        return self._limits.scaled(self.scale(scale), self.scale(scale[1]) if isinstance(scale, tuple) else None)

    def scene(
        self,
        state: Mapping[str, float],
        boxes: Sequence[Box] = (),
        held: Sequence[Box] = (),
        touchable: frozenset[str] = frozenset(),
        *,
        straight: bool = False,
        gripper: float | None = None,
        environment: Environment = NOTHING,
        carried: Sequence[tuple[int, Box]] = (),
        arms: float | None = None,
        clearance: Clearance | None = None,
    ) -> CollisionScene:
        """Surroundings of the arm with the table in them.

        Args:
            state: The robot's joints; the other arm and the fingers are taken from here.
            boxes: Obstacles, base frame.
            held: Boxes held by this arm, tool frame.
            touchable: Ids of boxes that the fingers may touch.
            straight: Clearance of straight parts instead of free paths.
            gripper: Distance of the finger pads from the middle instead of the present one, m.
            environment: Bodies of the planning scene, as certain as the table, the map, and the distance of the arms.
            carried: Boxes that go with the other arm, see `CollisionContext`.
            arms: Distance that the arms keep from each other instead of that of clearance and environment, m.
            clearance: Instead of that of free paths.
        """
        if clearance is None:
            clearance = self.config.straight if straight else self.config.clearance
        apart = max(clearance.arms, environment.arm_clearance) if arms is None else arms
        certain = (*self.static, *environment.solids)
        fixed = frozenset(body.id for body in certain)
        return CollisionScene(
            self.robot,
            CollisionContext(
                state=self.with_gripper(state, gripper),
                boxes=[*certain, *boxes],
                held=held,
                carried=carried,
                touchable=touchable,
                supports=fixed | touchable,
                fixed=fixed,
                clearance=clearance.model_copy(update={"arms": apart}),
                map=environment.map,
                allowed=environment.allowed,
            ),
        )

    def with_gripper(self, state: Mapping[str, float], finger: float | None) -> Mapping[str, float]:
        """The state with the finger pads at another distance from the middle of the hand, m; None: where they are."""
        if self._hand is None or finger is None:
            return state
        return {**state, self._hand.joint: self._hand.position(finger)}

    def relax(self, scene: CollisionScene, start: Array) -> None:
        """Let the arm leave its start: where it overlaps an estimated box, the box is wrong, not the arm.

        Args:
            scene: Planning scene at the start.
            start: (n,) rad.

        Raises:
            OpenArmError: IN_COLLISION, when it is stuck deeper than an error of measurement explains.
        """
        planning = self.config.planning
        contact = scene.relax(start, planning.start_overlap, planning.estimate_overlap)
        if contact is not None:
            text = f"the {self.name} arm starts in collision: {contact}; free it by hand or correct the obstacle"
            raise PlanFailedError(Code.IN_COLLISION, text, "start", contact)

    def plan(
        self, scene: LineChecks, now: StartState, goals: Array, time_limit: float, fineness: float = 1.0
    ) -> PlannedPath:
        """Free path to one of several configurations (k, n), an earlier one preferred.

        Raises:
            OpenArmError: NO_PLAN, saying what is in the way of the straight joint line; CANCELLED.
        """
        search = self.config.planning
        query = self.query(scene, now, goals, time_limit, fineness)
        try:
            return self._planner.plan(query)
        except OpenArmError as error:
            if error.code != Code.NO_PLAN:
                raise
            hit = scene.first_hit(now.start, goals[0], search.edge_step, search.edge_travel)
            contact = None if hit is None else next(iter(scene.contacts(hit)), None)
            blocked = "" if contact is None else f"; on the direct way {contact}"
            raise PlanFailedError(Code.NO_PLAN, error.message + blocked, "search", contact) from error

    def timing_into(self, path: PlannedPath, line: Array, way: Array, scale: Scale) -> PolylineTiming:
        """Timings of a free path that goes on along a line; their last column is the way of the tool on the line.

        Args:
            path: Free path to the beginning of the line.
            line: (k, n) configurations on it, rad.
            way: (k,) of the tool from its beginning to them, m.
            scale: Velocity scale of the request.
        """
        search, limits = self.config.planning, self.limits(scale)
        points = np.vstack([path.waypoints, line])
        gone = np.append(np.zeros(len(path.waypoints)), way)
        speed = self.config.limits.straight_speed * self.scale(scale)
        most = JointLimits(*(np.append(row, x) for row, x in zip(limits, (speed, np.inf, np.inf), strict=True)))
        return PolylineTiming(search.timing, (*self.names, "way"), np.column_stack([points, gone]), most, search.period)

    def time_line(self, line: Line, scale: Scale) -> Trajectory:
        """Timed straight line."""
        speed = self.config.limits.straight_speed * self.scale(scale)
        return time_path(self.names, line.q, line.s, self.limits(scale), speed, self.config.planning.period)


def kept(description: RobotDescription, config: MotionConfig) -> Mapping[frozenset[str], float]:
    """Links that the design of a robot holds nearer to each other than the clearance asks, with their distance, m."""
    return _kept(description, max(config.clearance.own, config.straight.own))


@lru_cache(maxsize=4)
def _kept(description: RobotDescription, asked: float) -> Mapping[frozenset[str], float]:
    found = held_apart(description, asked)
    for links, distance in found.items():
        text = "%s are %.1f mm apart by design: clearance.own, %.1f mm, is not asked of them"
        _LOG.info(text, " and ".join(sorted(links)), distance * 1e3, asked * 1e3)
    return found


def segment_time(a: Array, b: Array, limits: JointLimits) -> float:
    """Duration of a straight joint segment from rest to rest, s."""
    return 0.0 if float(np.abs(b - a).max()) < 1e-9 else duration(a, b, np.stack(limits))


def first_contact(scene: CollisionScene, q: Array) -> Contact | None:
    """The worst pair that is too near at a configuration, or None."""
    return scene.contacts(q)[0] if scene.collides(q) else None
