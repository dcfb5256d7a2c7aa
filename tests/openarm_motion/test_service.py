# SPDX-License-Identifier: Apache-2.0
"""The motion service on a robot that is a few lines of Python: no ROS, no physics, one tick of 10 ms a pause."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.camera.housings import mounted
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_control.trajectory import JointSpline
from openarm_motion.collision.exact import CollisionScene
from openarm_motion.collision.solids import Sphere
from openarm_motion.config import MotionConfig
from openarm_motion.planning.approach import ApproachRequest, Target
from openarm_motion.planning.arm import Arm
from openarm_motion.service.motion_service import MotionService, make_arms
from openarm_motion.service.requests import (
    ArmGoal,
    ExecuteRequest,
    JointGoal,
    LineGoal,
    MoveArmsRequest,
    MoveRequest,
    NamedGoal,
    PlanApproachRequest,
    PoseGoal,
)
from openarm_motion.service.robot import GoalOutcome
from openarm_motion.timing.trajectory import Motion

TICK_NS = 10_000_000


class Goal:
    def __init__(self, robot: Robot, motion: Motion, begin_ns: int) -> None:
        self.robot, self.motion, self.begin_ns = robot, motion, begin_ns
        self.outcome: GoalOutcome | None = None

    @property
    def accepted(self) -> bool | None:
        return True if self.robot.t_ns >= self.begin_ns else None

    @property
    def since_ns(self) -> int:
        return self.begin_ns if self.robot.tells and self.robot.t_ns > self.begin_ns + 3 * TICK_NS else 0

    def cancel(self) -> None:
        self.outcome = self.outcome or GoalOutcome(False, "cancelled")


class Controller:
    """Follows exactly, but for joints that are stuck."""

    def __init__(self, robot: Robot, name: str) -> None:
        self.robot, self.name = robot, name
        self.goals: list[Goal] = []
        self.touches: list[bool] = []
        self.there = True
        self.fastest = math.inf

    def ready(self) -> bool:
        return self.there

    def start(self, motion: Motion, begin_ns: int, *, touches: bool) -> Goal:
        self.touches.append(touches)
        self.goals.append(Goal(self.robot, motion, begin_ns or self.robot.t_ns + self.robot.latency_ns))
        return self.goals[-1]

    def tick(self) -> None:
        for goal in self.goals:
            if goal.outcome is not None:
                continue
            elapsed = (self.robot.t_ns - goal.begin_ns) * 1e-9
            moved = goal.motion.joints_at(max(elapsed, 0.0))
            self.robot.state.update({name: x for name, x in moved.items() if name not in self.robot.stuck})
            if elapsed >= goal.motion.duration:
                goal.outcome = GoalOutcome(True)


class Robot:
    """Implements `openarm_motion.service.robot.RobotInterface`."""

    def __init__(self, description, home) -> None:
        self.states, self.state = RobotStateBuffer(description), dict(home)
        self.t_ns = self.heard_ns = 10**9
        self.silent, self.stuck = False, set[str]()
        #: Joints whose encoders know one turn.
        self.wraps = set[str]()
        #: Until a controller accepts and begins; whether it then says when it began.
        self.latency_ns, self.tells = 0, True
        self.controllers = {arm: Controller(self, arm) for arm in ("left", "right")}
        self.tick()

    def tick(self) -> None:
        self.t_ns += TICK_NS
        for controller in self.controllers.values():
            controller.tick()
        if not self.silent:
            self.heard_ns = self.t_ns
            read = {name: math.remainder(q, math.tau) if name in self.wraps else q for name, q in self.state.items()}
            self.states.add_joint_state(self.t_ns, list(read), list(read.values()))

    def state_age(self) -> float:
        return (self.t_ns - self.heard_ns) * 1e-9

    def now(self) -> float:
        return self.t_ns * 1e-9

    def controller(self, arm: str) -> Controller:
        return self.controllers[arm]

    async def pause(self) -> None:
        class Turn:
            def __await__(self):
                yield

        await Turn()

    async def compute(self, work, nominal: float = 0.1):
        await self.pause()
        return work()

    async def together(self, parts) -> None:
        left = [part().__await__() for part in parts]
        while left:
            for work in list(left):
                try:
                    next(work)
                except StopIteration:
                    left.remove(work)
            await self.pause()


class NoMap:
    def latest(self):
        raise OpenArmError(Code.NOT_READY, "no map")

    def intact(self, field) -> bool:
        return False


class Bench:
    def __init__(self, arms, description, home) -> None:
        self.robot = Robot(description, home)
        self.service = MotionService(self.robot, MotionConfig(), arms, NoMap(), (description.root,))

    def run(self, *works, each: Callable[[], None] = lambda: None):
        """Carry out coroutines at the same time; their answers in order."""
        answers: list = [None] * len(works)

        def part(k: int):
            async def one() -> None:
                answers[k] = await works[k]

            return one

        all_of_them = self.robot.together([part(k) for k in range(len(works))])
        for _ in range(6000):
            try:
                all_of_them.send(None)
            except StopIteration:
                return answers
            self.robot.tick()
            each()
        return pytest.fail("it did not end within a minute of the robot's time")

    def move(self, arm: str = "right", posture: str = "official_home", **options):
        return self.service.move(MoveRequest(arm, NamedGoal(posture), scale=1.0, **options))


@pytest.fixture
def bench(arms, description, home) -> Bench:
    return Bench(arms, description, home)


def test_a_move_is_planned_executed_and_its_arrival_verified(bench) -> None:
    stages: list[str] = []
    request = MoveRequest("right", NamedGoal("official_home"), scale=1.0)
    (answer,) = bench.run(bench.service.move(request, report=lambda stage, _: stages.append(stage)))
    assert (answer.code, answer.message) == (Code.OK, "arrived")
    assert answer.trajectory.duration > 0.5
    assert stages[0] == "planning"
    assert stages[-1] == "executing"
    np.testing.assert_allclose(
        [bench.robot.state[n] for n in bench.service.arms["right"].names], answer.trajectory.q[-1], atol=1e-9
    )


@pytest.mark.parametrize("wraps", [False, True])
def test_a_wrist_that_turns_without_end_goes_the_short_way_from_any_turn(description, home, table, wraps) -> None:
    name = description.arm_joints("right")[6]
    endless = replace(description.joint(name), type="continuous", lower=-math.inf, upper=math.inf)
    robot = description._with_joints(endless)
    arm = Arm("right", robot, MotionConfig(), [table])
    bench = Bench({"right": arm}, robot, home)
    bench.robot.wraps = {name} if wraps else set()

    def goes(q7: float, *, given: float | None = None) -> float:
        """Position of the wrist after a motion to `q7`; one that is given is of the turn `given`."""
        start = bench.robot.state[name]
        goal = np.array([*(home[joint] for joint in arm.names[:6]), q7])
        request = MoveRequest("right", JointGoal(goal), scale=1.0, plan_only=given is not None)
        (answer,) = bench.run(bench.service.move(request))
        assert answer.code is Code.OK, answer.message
        if given is not None:
            motion = replace(answer.trajectory, q=answer.trajectory.q + given * math.tau * (np.arange(7) == 6))
            (answer,) = bench.run(bench.service.execute(ExecuteRequest("right", motion)))
            assert answer.code is Code.OK, answer.message
        sent = bench.robot.controllers["right"].goals[-1].motion.q[:, 6]
        assert sent[0] == pytest.approx(start, abs=1e-6)
        assert np.abs(np.diff(sent)).max() < 0.2
        return bench.robot.state[name]

    ends = [goes(q7) for q7 in (3.1, -3.1, 13.0 - 2.0 * math.tau, 3.0, -1.0, 1.5)]
    np.testing.assert_allclose(ends, np.unwrap([3.1, -3.1, 13.0 - 2.0 * math.tau, 3.0, -1.0, 1.5]), atol=1e-6)
    assert goes(-2.0, given=3.0) == pytest.approx(math.tau - 2.0 + (ends[-1] - 1.5), abs=1e-6)
    pose = arm.kinematics.fk([bench.robot.state[joint] for joint in arm.names])
    solved = bench.service.compute_ik("right", pose, (), position_only=False).nearest
    assert solved.success
    assert abs(solved.q[6] - bench.robot.state[name]) < 0.1


def test_plans_keep_the_speed_that_the_controller_of_an_arm_follows_now(bench) -> None:
    """An arm whose motor lost a turn; a motion of both keeps it, too, and a request that is slower anyway."""

    def fastest(*trajectories) -> float:
        return max(float(np.abs(one.v).max()) for one in trajectories)

    right = bench.robot.controllers["right"]
    right.fastest = 0.3
    (slow,) = bench.run(bench.move(plan_only=True))
    assert 0.15 < fastest(slow.trajectory) <= 0.3 * 1.001
    (other,) = bench.run(bench.move("left", plan_only=True))
    assert fastest(other.trajectory) > 1.0
    targets = (ArmGoal("left", NamedGoal("official_home")), ArmGoal("right", NamedGoal("official_home")))
    (both,) = bench.run(bench.service.move_arms(MoveArmsRequest(targets, scale=1.0, plan_only=True)))
    assert fastest(*both.plan.trajectories) <= 0.3 * 1.001
    (slower,) = bench.run(
        bench.service.move(MoveRequest("right", NamedGoal("official_home"), scale=0.02, plan_only=True))
    )
    assert fastest(slower.trajectory) < 0.07
    right.fastest = math.inf
    (again,) = bench.run(bench.move(plan_only=True))
    assert again.trajectory.duration < 0.5 * slow.trajectory.duration


def test_plan_only_sends_nothing_and_the_plan_is_executed_later(bench) -> None:
    (plan,) = bench.run(bench.move(plan_only=True))
    assert bench.robot.controllers["right"].goals == []
    motion = plan.trajectory
    (answer,) = bench.run(bench.service.execute(ExecuteRequest("right", motion, scene_version=plan.scene_version)))
    assert answer.code is Code.OK


def test_a_camera_is_where_it_is_mounted(bench, table) -> None:
    """A ball 3 cm from the nominal housing is in the way of one whose mount was calibrated to be there."""
    plain, cameras = RobotDescription.load(), load_cameras()
    T = cameras["wrist"].T_parent_link @ se3.make(None, (-0.03, 0.03, 0.03))
    parent = plain.link_pose(cameras["wrist"].parent, bench.robot.state)
    ball = Sphere("ball", parent @ T @ cameras["wrist"].T_link_housing, 0.004)
    bench.service.apply_scene(clear=False, remove=(), add=[ball])
    (before,) = bench.run(bench.move(plan_only=True))
    assert before.code is Code.OK
    bench.service.mount(make_arms(MotionConfig(), plain, (), mounted(cameras, {"wrist": T})))
    (after,) = bench.run(bench.move(plan_only=True))
    assert after.code is Code.IN_COLLISION
    assert f"{cameras['wrist'].parent} would hit ball" in after.message
    assert bench.service.arms["right"].static == (table,)


def test_a_plan_of_another_scene_is_not_executed(bench) -> None:
    (plan,) = bench.run(bench.move(plan_only=True))
    bench.service.apply_scene(clear=False, remove=(), add=[Sphere("ball", se3.make(None, (0.3, 0.0, 0.9)), 0.05)])
    motion = plan.trajectory
    (answer,) = bench.run(bench.service.execute(ExecuteRequest("right", motion, scene_version=plan.scene_version)))
    assert answer.code is Code.STALE_DATA
    assert bench.robot.controllers["right"].goals == []


def test_an_arm_takes_one_motion_at_a_time_and_two_arms_move_at_once(bench) -> None:
    first, second, other = bench.run(bench.move(), bench.move(posture="home"), bench.move("left"))
    assert (first.code, second.code, other.code) == (Code.OK, Code.BUSY, Code.OK)
    assert "the right arm is moving already" in second.message


def test_a_cancelled_motion_holds(bench) -> None:
    stopped = lambda: bench.robot.t_ns > 1_600_000_000  # noqa: E731
    (answer,) = bench.run(bench.service.move(MoveRequest("right", NamedGoal("official_home"), scale=0.1), stopped))
    assert answer.code is Code.CANCELLED
    assert "the right arm holds where it is" in answer.message
    assert bench.robot.controllers["right"].goals[0].outcome == GoalOutcome(False, "cancelled")
    assert bench.service.moving == []


def test_a_controller_that_says_success_is_not_evidence(bench) -> None:
    bench.robot.stuck = {"openarm_right_joint2"}
    (answer,) = bench.run(bench.move())
    assert answer.code is Code.EXECUTION_FAILED
    assert "openarm_right_joint2 ended" in answer.message


@pytest.mark.parametrize(
    ("lose", "text"),
    [
        (lambda robot: setattr(robot, "silent", True), "no /joint_states"),
        (lambda robot: setattr(robot.controllers["right"], "there", False), "controller right is gone"),
    ],
)
def test_a_robot_that_vanishes_ends_a_motion(bench, lose, text) -> None:
    def each() -> None:
        if bench.robot.t_ns > 1_500_000_000:
            lose(bench.robot)

    (answer,) = bench.run(bench.service.move(MoveRequest("right", NamedGoal("official_home"), scale=0.1)), each=each)
    assert answer.code is Code.ROBOT_LOST
    assert text in answer.message
    assert bench.robot.controllers["right"].goals[0].outcome is not None  # it was withdrawn
    assert bench.robot.now() < 4.0


@pytest.mark.requirement("N-12")
@pytest.mark.parametrize("tells", [True, False])
def test_the_rest_before_a_start_is_searched_when_the_start_of_the_other_arm_is_known(bench, tells: bool) -> None:
    plans = bench.run(bench.move("left", plan_only=True), bench.move(plan_only=True))
    bench.robot.latency_ns, bench.robot.tells = 20 * TICK_NS, tells
    known: list[tuple[int, int]] = []
    both = (ExecuteRequest(arm, plan.trajectory, 5.0) for arm, plan in zip(("left", "right"), plans, strict=True))

    def each() -> None:
        left, right = (bench.robot.controllers[arm].goals for arm in ("left", "right"))
        active = bench.service.coordination.followers["left"].active
        if right and not known:
            assert active is not None
            known.append((active.since_ns - left[0].begin_ns, bench.robot.t_ns - left[0].begin_ns))

    answers = bench.run(*(bench.service.execute(request) for request in both), each=each)
    assert [answer.code for answer in answers] == [Code.OK, Code.OK]
    ((error_ns, after_ns),) = known
    assert abs(error_ns) <= (0 if tells else 2 * TICK_NS)
    assert after_ns >= (3 * TICK_NS if tells else 200_000_000)


def test_a_dual_arm_motion_moves_both_arms_from_the_same_moment(bench) -> None:
    targets = tuple(ArmGoal(arm, NamedGoal("official_home")) for arm in ("left", "right"))
    (answer,) = bench.run(bench.service.move_arms(MoveArmsRequest(targets, scale=1.0)))
    assert answer.code is Code.OK, answer.message
    left, right = (controller.goals[0] for controller in bench.robot.controllers.values())
    assert left.begin_ns == right.begin_ns > 0
    assert answer.plan is not None
    assert answer.plan.clearance >= 0.02


@pytest.mark.requirement("A-67")
@pytest.mark.parametrize("timing", ["blended", "stops", "quintic"])
def test_what_a_controller_executes_begins_and_ends_with_zero_velocity_and_acceleration(
    bench, arms, description, table, home, timing: str
) -> None:
    """By positions alone: from rest with a limited jerk a joint moves at most jerk t³/6 in a time t, else more."""
    if timing != MotionConfig().planning.timing:
        config = MotionConfig.model_validate({"planning": {"timing": timing}})
        bench = Bench({side: Arm(side, description, config, [table]) for side in arms}, description, home)
    service, robot = bench.service, bench.robot
    down = se3.rotation_from_z_y((0.0, 0.0, -1.0), (0.0, 1.0, 0.0))
    way = Target("spot", se3.make(down, (0.3, -0.2, 0.5)), np.array([0, 0, 0.08]), np.array([0, 0, 0.1]), 0.0)
    (planned,) = bench.run(service.plan_approach(PlanApproachRequest("right", ApproachRequest((way,)))))
    assert planned.plan is not None, planned.message
    for part in planned.plan.parts:
        (answer,) = bench.run(service.execute(ExecuteRequest("right", part)))
        assert answer.code is Code.OK, answer.message
    on_line = LineGoal(se3.make(down, (0.33, -0.22, 0.55)))
    both = tuple(ArmGoal(arm, NamedGoal("official_home")) for arm in arms)
    for request in (
        service.move(MoveRequest("right", on_line)),
        bench.move(),
        service.move_arms(MoveArmsRequest(both)),
    ):
        (answer,) = bench.run(request)
        assert answer.code is Code.OK, answer.message
    assert robot.controllers["right"].touches[:4] == [False, True, False, True], "the approach, and what is no plan's"
    executed = [(side, goal.motion) for side in arms for goal in robot.controllers[side].goals]
    assert len(executed) >= 7
    for side, motion in executed:
        spline = JointSpline(motion.t, motion.q, motion.v, motion.a)
        first, last = spline.sample(float(motion.t[0]))[0], spline.sample(spline.end_s)[0]
        jerk = arms[side].limits(1.0).jerk
        for h in (0.001, 0.002, 0.005, 0.01):
            for moved in (spline.sample(float(motion.t[0]) + h)[0] - first, last - spline.sample(spline.end_s - h)[0]):
                assert np.all(np.abs(moved) <= 1.1 * jerk * h**3 / 6.0 + 1e-12), (side, h, moved)


def test_an_unreachable_pose_carries_the_nearest_alternative(bench) -> None:
    pose = se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.9, -0.2, 0.6))
    (answer,) = bench.run(bench.service.move(MoveRequest("right", PoseGoal(pose), scale=1.0, plan_only=True)))
    assert answer.code is Code.UNREACHABLE
    ik = bench.service.compute_ik("right", pose, (), position_only=False)
    assert ik.error is not None
    assert ik.nearest.position_error > 0.05


def test_a_failed_request_keeps_no_scene_alive(bench) -> None:
    """Exceptions that are kept with their frames would, until a full garbage collection."""
    service = bench.service
    q = np.array([bench.robot.state[name] for name in service.arms["right"].names])
    T = service.arms["right"].kinematics.fk(q)
    far, aside = T.copy(), T.copy()
    far[0, 3] += 0.9
    aside[2, 3] -= 0.8
    aside[0, 3] += 0.2
    lines = (np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.0, 0.05]))
    ways = tuple(Target(f"w{k}", pose, *lines, 1.0) for k, pose in enumerate((far, aside)))
    gc.collect()
    gc.disable()
    try:
        before = sum(isinstance(one, CollisionScene) for one in gc.get_objects())
        for request in (PoseGoal(far), LineGoal(far), PoseGoal(aside), LineGoal(aside)):
            (answer,) = bench.run(service.move(MoveRequest("right", request, plan_only=True)))
            assert answer.code is not Code.OK
        (answer,) = bench.run(service.plan_approach(PlanApproachRequest("right", ApproachRequest(ways))))
        assert answer.code is not Code.OK
        del answer
        assert sum(isinstance(one, CollisionScene) for one in gc.get_objects()) == before
    finally:
        gc.enable()
