# SPDX-License-Identifier: Apache-2.0
"""The motion service: plans and executes motions of each arm, and of two arms at once, for whatever robot.

It owns arms, planning scene, held boxes and the map, and decides when an arm may move. The motion node serves it over
ROS; a campaign calls it in process.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from openarm_common.camera.cameras import CameraConfig, load_cameras
from openarm_common.camera.housings import with_housings
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.lift import LIFT
from openarm_common.robot.work import Table
from openarm_common.types import Array
from openarm_motion.collision.solids import Box, Solid, box_from
from openarm_motion.config import MotionConfig
from openarm_motion.constraints.asked import CartesianGoal, RegionGoal
from openarm_motion.constraints.cartesian import along
from openarm_motion.constraints.plans import reaching, to_region
from openarm_motion.planning import moves
from openarm_motion.planning.alternative import explained, explained_approach, near_joints, near_pose
from openarm_motion.planning.approach import ApproachPlan, plan_approach
from openarm_motion.planning.arm import Arm, StartState, kept
from openarm_motion.planning.dual_arm import DualArm, DualArmGoals, DualArmPlan, plan_any, plan_staggered, plan_together
from openarm_motion.planning.lift import LiftedArms
from openarm_motion.planning.moves import goal_configurations, named_posture, yielding
from openarm_motion.planning.planner import never
from openarm_motion.scene.held import HeldObjects
from openarm_motion.scene.map_view import FieldSource, MapState, MapView
from openarm_motion.scene.planning_scene import PlanningScene
from openarm_motion.service.claims import ArmClaims
from openarm_motion.service.context import Around, PlanningContext
from openarm_motion.service.coordination import DelayCoordination
from openarm_motion.service.faults import PlanFaults
from openarm_motion.service.lift import LiftMotions
from openarm_motion.service.requests import (
    ApproachAnswer,
    ArmGoal,
    ExecuteRequest,
    Goal,
    IkAnswer,
    JointGoal,
    MotionAnswer,
    MoveAnswer,
    MoveArmsAnswer,
    MoveArmsRequest,
    MoveRequest,
    NamedGoal,
    PlanApproachRequest,
    PoseGoal,
    SceneState,
    Strategy,
    YieldGoal,
)
from openarm_motion.service.robot import RobotInterface, RobotWatch
from openarm_motion.timing.trajectory import Motion, Trajectory

#: Called with a stage ("planning", "executing", ...) and its progress: 0 to 1, or the targets that were checked.
Report = Callable[[str, float], None]

#: Points of a trajectory in a preview.
_PREVIEW_POINTS = 50

_STRATEGIES: dict[Strategy, Callable[[DualArm, StartState, DualArmGoals, float], DualArmPlan]] = {
    "any": plan_any,
    "together": plan_together,
    "staggered": plan_staggered,
}


#: No joint is given.
EMPTY: Mapping[str, float] = MappingProxyType({})


def _with(now: StartState, state: Mapping[str, float], attempts: int = 1) -> StartState:
    return replace(now, state={**now.state, **state}, seeds=range(attempts))


def silent(stage: str, progress: float) -> None:
    """Discard a report."""


def table_box(table: Table) -> Box:
    """Return the table top of a scene as an obstacle."""
    x, y = table.centre
    return box_from("table", (x, y, table.top_z - 0.5 * table.thickness), table.extents)


def make_arms(
    config: MotionConfig,
    description: RobotDescription,
    fixed: Sequence[Box],
    cameras: Mapping[str, CameraConfig] | None = None,
) -> Mapping[str, Arm]:
    """Make the arms of a robot with its cameras mounted; those on a lift are of the height that it is at.

    Args:
        config: Parameters.
        description: The robot.
        fixed: Boxes that are always there (the table), base frame.
        cameras: Cameras by name, at their mounts; None: those of this process's robot, where the configuration says.
    """
    body = with_housings(description, (load_cameras() if cameras is None else cameras).values())
    names = config.arms or body.arm_names

    def make(robot: RobotDescription) -> dict[str, Arm]:
        return {name: Arm(name, robot, config, fixed, apart=kept(body, config)) for name in names}

    return make(body) if body.lift is None else LiftedArms(body, make)


class MotionService:
    """Plans and executes motions; one event loop, several requests at once.

    Args:
        robot: The robot and its clock.
        config: Parameters.
        arms: Arms from `make_arms`.
        field: Source of the map.
        frames: Names of the base frame.
    """

    def __init__(
        self,
        robot: RobotInterface,
        config: MotionConfig,
        arms: Mapping[str, Arm],
        field: FieldSource,
        frames: Sequence[str],
    ) -> None:
        self.robot, self.config, self._frames = robot, config, tuple(frames)
        self.arms = arms = arms if isinstance(arms, LiftedArms) else dict(arms)
        self.faults = PlanFaults(config.faults)
        #: No new motion is begun, and those under way hold.
        self.closing = False
        #: Called with each plan, by arm, before it is executed.
        self.on_plan: Callable[[Mapping[str, Sequence[Trajectory]]], None] = lambda plans: None
        #: Called when what a hand holds has changed.
        self.on_held: Callable[[], None] = lambda: None
        self.scene = PlanningScene(next(iter(arms.values())).static)
        self.memory = HeldObjects()
        self.coordination = DelayCoordination(robot, arms, self.memory, lambda: self.on_held())
        view = MapView(config.map, field, frames)
        self._context = PlanningContext(robot, arms, self.scene, self.memory, self.coordination, view, config)
        self.claims = ArmClaims()
        self._lift: LiftMotions | None = None
        if isinstance(arms, LiftedArms):
            lost = config.execution.stale_after
            self._lift = LiftMotions(robot, arms, self._context, self.memory, self.claims.holding, lost)

    # --- plans and motions
    async def plan_approach(
        self, request: PlanApproachRequest, cancelled: Callable[[], bool] = never, report: Report = silent
    ) -> ApproachAnswer:
        """Choose and plan one of several approaches of an arm.

        Args:
            request: Request.
            cancelled: Whether to stop.
            report: Called with the stage and the number of targets checked, also from a worker thread.
        """
        answer, begin = ApproachAnswer(), self.robot.now()
        try:
            (arm, start), stopped, wanted = self._at_start(request), self._stopped(cancelled), request.approach
            if not len(start):
                await self._context.fresh()
            estimates = (*wanted.obstacles, *request.ignore_regions)
            prepared = self._context.prepare(
                [arm], start, request.scale, stopped, estimates, [wanted.attached], request.scene_version
            )
            answer = replace(answer, scene_version=prepared.version)

            def work() -> ApproachPlan:
                self.faults.check(arm.name)
                now = prepared.complete()
                return explained_approach(lambda: plan_approach(arm, now, wanted, report), arm, now, wanted)

            plan = await self.robot.compute(work)
            delay = await self.coordination.start_delay(arm, plan.transfer, wanted.attached, stopped)
            self.on_plan({arm.name: plan.parts})
            self.memory.expect(arm.name, plan.transfer, wanted.attached, touches=wanted.blend)
            self.memory.expect(arm.name, plan.approach, wanted.attached, touches=True)
            self.memory.expect(arm.name, plan.retreat, plan.held_after)
            answer = replace(answer, message=f"planned{prepared.note}", start_delay=delay, plan=plan)
        except OpenArmError as error:
            answer = replace(answer, error=error, message=error.message)
        return replace(answer, planning_time=self.robot.now() - begin)

    async def move(
        self, request: MoveRequest, cancelled: Callable[[], bool] = never, report: Report = silent
    ) -> MoveAnswer:
        """Plan, and unless it is `plan_only` execute, a motion of one arm or the lift; arguments as `plan_approach`."""
        answer, begin, holding = MoveAnswer(), self.robot.now(), ""
        if request.arm == LIFT and self._lift is not None:
            goal = np.ravel(request.goal.q) if isinstance(request.goal, JointGoal) else np.zeros(0)
            return await self._lift.move(goal, request, self._stopped(cancelled), answer)
        try:
            arm, stopped = self._arm(request.arm), self._stopped(cancelled)
            with self.claims.holding(arm.name, wanted=not request.plan_only):
                report("planning", 0.0)
                held, holding = self.memory.on_request(arm.name, request.attached, request.hand_empty)
                around = moves.RequestBoxes(request.obstacles, held)
                await self._context.fresh()
                start = self._start([arm], request.state)
                prepared = self._context.prepare(
                    [arm], start, request.scale, stopped, request.obstacles, [held], request.scene_version
                )
                answer = replace(answer, scene_version=prepared.version)
                planner = self._planner(arm, request.goal, around)
                begun = lambda: _with(prepared.complete(), request.state, request.attempts)  # noqa: E731
                trajectory = await self.robot.compute(lambda: planner(begun()))
                message = f"planned, {trajectory.duration:.2f} s{prepared.note}{holding}"
                answer = replace(answer, trajectory=trajectory, planning_time=self.robot.now() - begin, message=message)
                self.on_plan({arm.name: (trajectory,)})
                if not request.plan_only:
                    self.scene.require(prepared.version)
                    self.coordination.hold(arm.name, held)
                    delay = await self._follow(arm, trajectory, stopped, report, request.max_start_delay)
                    answer = replace(answer, start_delay=delay, message=f"arrived{prepared.note}{holding}")
        except OpenArmError as error:
            return replace(answer, error=error, message=error.message + holding)
        return answer

    async def move_arms(
        self, request: MoveArmsRequest, cancelled: Callable[[], bool] = never, report: Report = silent
    ) -> MoveArmsAnswer:
        """Plan, and unless it is `plan_only` execute, a dual-arm motion; arguments as `plan_approach`."""
        answer = MoveArmsAnswer()
        try:
            arms, stopped = self._two_arms(request.arms), self._stopped(cancelled)
            with self.claims.holding(*(arm.name for arm in arms), wanted=not request.plan_only):
                report("planning", 0.0)
                begin = self.robot.now()
                held = [self.memory.on_request(t.arm, t.attached, t.hand_empty)[0] for t in request.targets]
                await self._context.fresh()
                start = self._start(arms, request.state)
                prepared = self._context.prepare(
                    arms, start, request.scale, stopped, request.obstacles, held, request.scene_version
                )
                answer = replace(answer, scene_version=prepared.version)
                both = DualArm(*arms)
                starts = both.parts(prepared.now.start)
                find = [self._goals(a, q, t) for a, q, t in zip(arms, starts, request.targets, strict=True)]
                limit = request.time_limit or self.config.planning.time_limit

                def work() -> DualArmPlan:
                    now = _with(prepared.complete(), request.state, request.attempts)
                    wanted = DualArmGoals((find[0](now), find[1](now)), request.obstacles, (held[0], held[1]))
                    return _STRATEGIES[request.strategy](both, now, wanted, limit)

                plan = await self.robot.compute(work)
                seconds = max(part.duration for part in plan.trajectories)
                apart = f"{plan.clearance * 1e3:.0f} mm apart"
                message = f"planned, {seconds:.2f} s, {apart}{prepared.note}"
                answer = replace(answer, plan=plan, planning_time=self.robot.now() - begin, message=message)
                plans = dict(zip((arm.name for arm in arms), plan.trajectories, strict=True))
                self.on_plan({name: (part,) for name, part in plans.items()})
                if not request.plan_only:
                    self.scene.require(prepared.version)
                    for arm, boxes in zip(arms, held, strict=True):
                        self.coordination.hold(arm.name, boxes)
                    await self.coordination.follow_together(
                        arms, plan.trajectories, stopped, lambda share: report("executing", share)
                    )
                    answer = replace(answer, message=f"arrived, {apart} on the way")
        except OpenArmError as error:
            return replace(answer, error=error, message=error.message)
        return answer

    async def execute(
        self, request: ExecuteRequest, cancelled: Callable[[], bool] = never, report: Report = silent
    ) -> MotionAnswer:
        """Execute a trajectory of one arm; arguments as `plan_approach`."""
        try:
            arm = self._arm(request.arm)
            self.scene.require(request.scene_version)
            with self.claims.holding(arm.name, wanted=True):
                await self._context.fresh()
                stopped = self._stopped(cancelled)
                delay = await self._follow(arm, request.motion, stopped, report, request.max_start_delay)
        except OpenArmError as error:
            return MotionAnswer(error, error.message)
        return MotionAnswer(message="arrived", start_delay=delay)

    async def execute_arms(
        self, motions: Mapping[str, Motion], cancelled: Callable[[], bool] = never, report: Report = silent
    ) -> MotionAnswer:
        """Execute trajectories of one arm, or of two at the same moment, by name; arguments as `plan_approach`."""
        if len(motions) == 1:
            return await self.execute(ExecuteRequest(*next(iter(motions.items()))), cancelled, report)
        try:
            arms, parts = self._two_arms(list(motions)), list(motions.values())
            progress = lambda share: report("executing", share)  # noqa: E731
            with self.claims.holding(*motions, wanted=True):
                await self._context.fresh()
                await self.coordination.check_together(arms, parts)
                await self.coordination.follow_together(arms, parts, self._stopped(cancelled), progress)
        except OpenArmError as error:
            return MotionAnswer(error, error.message)
        return MotionAnswer(message="arrived")

    async def hold(self, limit: float) -> None:
        """End all plans and motions; the arms hold where they are, within `limit` s."""
        self.closing = True
        followers = self.coordination.followers.values()
        await RobotWatch(self.robot).until(lambda: not any(f.active for f in followers), limit=limit)

    @property
    def moving(self) -> list[str]:
        """Names of the arms under way."""
        return [name for name, follower in self.coordination.followers.items() if follower.active is not None]

    def held_on_links(self) -> dict[str, tuple[str, tuple[Box, ...]]]:
        """Return what each hand holds: by arm, the tool link and the boxes in its frame."""
        return {name: (self.arms[name].kinematics.tool_link, boxes) for name, boxes in self.memory.held.items()}

    # --- questions
    async def surroundings(
        self, arm_name: str, state: Mapping[str, float] = EMPTY
    ) -> tuple[Arm, StartState, moves.RequestBoxes]:
        """Return an arm, where it is and what is around it, and what it holds, as a plan would have it now.

        Args:
            arm_name: Name of the arm.
            state: Positions of joints that are taken in place of the present ones.

        Raises:
            OpenArmError: as `PlanningContext.prepare`.
        """
        arm = self._arm(arm_name)
        held, _ = self.memory.on_request(arm.name, (), False)
        await self._context.fresh()
        prepared = self._context.prepare([arm], self._start([arm], state), 0.0, self._stopped(never), (), [held])
        now = _with(await self.robot.compute(prepared.complete), state)
        return arm, now, moves.RequestBoxes((), held)

    async def around_all(self, seen: object = None) -> Around | None:
        """Return what is around all arms; None where it is as when it was `Around.seen`. Raises as `surroundings`."""
        self._follow_lift()
        await self._context.fresh()
        return self._context.around_all(seen)

    def compute_ik(self, arm_name: str, pose: Array, seed: Sequence[float], *, position_only: bool) -> IkAnswer:
        """Solve the inverse kinematics of an arm's tool.

        Args:
            arm_name: Name of the arm.
            pose: (4, 4) base frame.
            seed: (n,) joints to stay near to; empty: the present ones.
            position_only: Position alone counts.

        Raises:
            OpenArmError: INVALID_ARGUMENT; LIMITS; NOT_READY, without seed and joint states.
        """
        arm = self._arm(arm_name)
        start = self._context.start(arm, seed, 0.0, never).start
        best = arm.inverse.nearest(pose, start, position_only=position_only)
        error = None
        if not best.success:
            error = moves.unreachable(arm, pose, position_only=position_only, margin=0.0, near=start)
        return IkAnswer(best, arm.kinematics.fk(best.q), error)

    def in_base(self, pose: Array, frame: str = "", state: Mapping[str, float] = EMPTY) -> Array:
        """Bring a pose (4, 4) in any known frame to the base frame; with joints in a state, or where they are.

        Raises:
            OpenArmError: NO_TRANSFORM, listing the frames there are.
        """
        if frame in ("", *self._frames):
            return pose
        states = self.robot.states
        if state:
            return states.pose(frame, state) @ pose
        stamp_ns = states.latest()[0] if self.robot.state_age() < float("inf") else 0
        return states.lookup(self._frames[-1], frame, stamp_ns) @ pose

    def scene_state(self) -> SceneState:
        """Return the planning scene, and whether plans use the map."""
        scene = self.scene
        try:
            seen = self._context.map_state()
        except OpenArmError as error:
            seen = MapState(None, why=error.message)
        return SceneState(scene.version, (*scene.fixed, *scene.solids), tuple(box.id for box in scene.fixed), seen)

    def apply_scene(self, *, clear: bool, remove: Sequence[str], add: Sequence[Solid], expected: int = 0) -> str:
        """Change the planning scene, all as asked or nothing; see `PlanningScene.apply`. Return it in a sentence."""
        self.scene.apply(clear=clear, remove=remove, add=add, expected=expected)
        names = ", ".join(solid.id for solid in self.scene.solids) or "nothing but what is fixed"
        return f"version {self.scene.version}: {names}"

    def fix(self, fixed: Sequence[Box]) -> None:
        """Plan with other boxes that are always there (the table), base frame, from the next request on."""
        for arm in self.arms.values():
            arm.static = tuple(fixed)
        self.scene.fix(fixed)

    def mount(self, arms: Mapping[str, Arm]) -> None:
        """Plan with these arms, from `make_arms`, in place of those of the same names, from the next request on."""
        for name, arm in arms.items():
            arm.static = self.arms[name].static
        self.arms.update(arms)

    def check_map(self) -> str:
        """Return how old the map is, or why it is not used.

        Raises:
            OpenArmError: NOT_READY or STALE_DATA, when it is required.
        """
        view = self._context.map_state()
        return view.why or f"version {view.version}, {view.age_s:.1f} s old"

    def tool_paths(self, plans: Mapping[str, Sequence[Trajectory]]) -> dict[str, Array]:
        """Return the paths (n, 3) of the tools on the trajectories of each arm, one after the other, base frame, m."""
        paths: dict[str, Array] = {}
        for name, parts in plans.items():
            q = np.concatenate([part.at(np.linspace(0.0, part.duration, _PREVIEW_POINTS))[0] for part in parts])
            paths[name] = self.arms[name].kinematics.fk_many(q)[:, :3, 3]
        return paths

    # --- parts of these
    def _start(self, arms: Sequence[Arm], state: Mapping[str, float]) -> Sequence[float]:
        """Joints of the arms where some are given in place of the present ones; empty for the present ones."""
        names = [name for arm in arms for name in arm.names]
        if not any(name in state for name in names):
            return ()
        present = self.robot.states.latest()[1]
        missing = [name for name in names if name not in state and name not in present]
        if missing:
            raise OpenArmError(Code.NOT_READY, f"neither the request nor /joint_states has {', '.join(missing)}")
        return [state[name] if name in state else present[name] for name in names]

    async def _follow(
        self, arm: Arm, motion: Motion, cancelled: Callable[[], bool], report: Report, max_delay: float
    ) -> float:
        progress = lambda share: report("executing", share)  # noqa: E731
        return await self.coordination.follow(arm, motion, cancelled, progress, max_delay)

    def _planner(self, arm: Arm, goal: Goal, around: moves.RequestBoxes) -> Callable[[StartState], Trajectory]:
        """The plan that a goal asks for; poses are looked up now, the rest is for `RobotInterface.compute`."""
        if isinstance(goal, JointGoal):
            return lambda now: explained(
                lambda: moves.to_joints(arm, now, goal.q, around), lambda: near_joints(arm, now, around, goal.q)
            )
        if isinstance(goal, NamedGoal):
            return lambda now: explained(
                lambda: moves.to_named(arm, now, goal.name, around),
                lambda: near_joints(arm, now, around, named_posture(arm, goal.name, now.start)),
            )
        if isinstance(goal, RegionGoal):
            return lambda now: to_region(arm, now, goal, around)
        if isinstance(goal, CartesianGoal):
            return lambda now: along(arm, now, goal, around)
        pose = self.in_base(goal.pose, goal.frame)
        if isinstance(goal, PoseGoal):
            free = goal.position_only
            return lambda now: explained(
                lambda: moves.to_pose(arm, now, pose, around, position_only=free),
                lambda: near_pose(arm, now, around, pose, position_only=free),
            )
        return lambda now: moves.to_pose_on_line(arm, now, pose, around)

    def _goals(self, arm: Arm, start: Array, target: ArmGoal) -> Callable[[StartState], Array]:
        """Configurations (k, n) that a goal of a dual-arm motion allows; as `_planner`."""
        goal = target.goal
        if isinstance(goal, JointGoal):
            q = arm.configuration(goal.q, f"goal of the {arm.name} arm", 1e-3)
            return lambda _: q[None]
        if isinstance(goal, NamedGoal):
            return lambda _: named_posture(arm, goal.name, start)[None]
        if isinstance(goal, YieldGoal):
            return lambda _: yielding(arm, start, goal.name)
        if isinstance(goal, RegionGoal):
            return lambda now: reaching(arm, now, start, goal)
        pose, free = self.in_base(goal.pose, goal.frame), goal.position_only
        return lambda now: goal_configurations(arm, now, start, pose, position_only=free)

    def _two_arms(self, names: Sequence[str]) -> tuple[Arm, Arm]:
        self._follow_lift()
        if len(names) != 2 or len(set(names)) != 2 or any(name not in self.arms for name in names):
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"targets are for {', '.join(repr(n) for n in names) or 'no arm'}; expected two different ones of"
                f" {', '.join(self.arms)}",
            )
        return self.arms[names[0]], self.arms[names[1]]

    def _follow_lift(self) -> None:
        """Plan from now on for the height that was measured last."""
        if isinstance(self.arms, LiftedArms) and self.robot.state_age() < float("inf"):
            self.arms.follow(self.robot.states.latest()[1])

    def _arm(self, name: str) -> Arm:
        self._follow_lift()
        if name not in self.arms:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"arm is {name!r}; arms: {', '.join(self.arms)}")
        return self.arms[name]

    def _at_start(self, request: PlanApproachRequest) -> tuple[Arm, Array]:
        """Return the arm and its start; where that begins with the lift's position, the arm as it is at that height."""
        arm, start = self._arm(request.arm), request.start
        if isinstance(self.arms, LiftedArms) and len(start) == arm.kinematics.n + 1:
            return self.arms.at(float(start[0]))[arm.name], start[1:]
        return arm, start

    def _stopped(self, cancelled: Callable[[], bool]) -> Callable[[], bool]:
        return lambda: self.closing or cancelled()
