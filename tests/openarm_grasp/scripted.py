# SPDX-License-Identifier: Apache-2.0
"""A scripted robot at a table: objects, two hands, a clock of its own, and faults by name. No ROS, no sleeping."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Coroutine, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_work
from openarm_common.robot.zeros import HandReach
from openarm_grasp.config import GraspConfig
from openarm_grasp.context import GraspContext
from openarm_grasp.evidence.verdicts import Evidence
from openarm_grasp.perception.boxes import with_points
from openarm_grasp.perception.detections import Frame
from openarm_grasp.perception.sightings import standing_at
from openarm_grasp.planning.candidates import Box
from openarm_grasp.planning.options import NoWayError
from openarm_grasp.requests.request import GraspOutcome, GraspRequest
from openarm_grasp.requests.states import State
from openarm_grasp.requests.task import GraspSession, Status, Task
from openarm_grasp.robot.interface import PlanGrasp, Planned, PlanPlace
from openarm_grasp.robot.skills import Skills
from openarm_grasp.strategies.pick_and_place import pick_and_place
from openarm_grasp.strategies.registry import carry_out

#: How far either arm reaches over the middle, m.
OVER = 0.10
#: A camera over the table.
LENS, T_BASE_CAMERA = Intrinsics.from_fovy(640, 480, 60.0), se3.make(np.diag([1.0, -1.0, -1.0]), (0.35, 0.0, 1.2))


# --- what a robot was asked
@dataclass(frozen=True)
class Follow:
    arm: str
    trajectory: str
    what: str
    carrying: bool = False


HAND = RobotDescription.load().hand("right").parts


@dataclass(frozen=True)
class MoveLinear:
    arm: str
    what: str


@dataclass(frozen=True)
class GoHome:
    arms: tuple[str, ...]
    obstacles: tuple[Box, ...]


@dataclass(frozen=True)
class Grip:
    arm: str
    position: float
    what: str


@dataclass(frozen=True)
class Measure:
    arm: str
    expected: float
    planned: bool


@dataclass(frozen=True)
class Wait:
    duration: float


@dataclass(frozen=True)
class Observe:
    count: int
    near: bool


@dataclass(frozen=True)
class Reach:
    arms: tuple[str, ...]


Call = Follow | MoveLinear | GoHome | Grip | Measure | Wait | Observe | Reach | PlanGrasp | PlanPlace
Fault = Callable[[Call], OpenArmError | None]


class Path(str):
    """A trajectory: of two with the same name each is itself."""


def frame_of(*found: Detection, t_ns: int = 1) -> Frame:
    """What the camera over the table sees of boxes."""
    return with_points(Frame(t_ns, found), LENS, T_BASE_CAMERA, 0.4)


def standing(label: str, x: float, y: float, size: float = 0.05, z: float = 0.4) -> Detection:
    return Detection(label, 0.9, se3.make(p=(x, y, z + size / 2.0)), np.array([size, size, size]))


class World(Skills):
    """The skills of a robot, scripted; it keeps what it was asked and what was reported.

    Attributes:
        slips: Closes that get nothing.
        learned: What was learned of the hands.
        carried, effort: What the planner carries by arm; force of the fingers that hold nothing known, N.
        scene, q: Version of the planning scene, joints.
        near_off: How far off the camera on the hand sees objects, m.
        place_error: How far off its place an object comes to stand, m.
        lands: How an object that is put down comes to stand, of how it should.
        followed: Trajectories, in their order.
        lines: (3,) of pushes that were planned, m.
        far: The arms grasp nothing that is further away than this, m; a hand may push it from there.
        follows: Share of a push that the object follows.
    """

    def __init__(self, *objects: Detection, **config: object) -> None:
        self.objects = {d.label: d for d in objects}
        self.t_ns = 1_000_000_000
        self.gap = 0.0
        self.held: str | None = None
        self.carried: dict[str, Box] = {}
        self.effort = 0.0
        self.learned: HandReach | None = None
        self.faults: list[Fault] = []
        self.log: list[tuple[float, Call]] = []
        self.status: list[Status] = []
        self.slips = 0
        self.tcp_error = self.place_error = self.frame_age = 0.0
        self.far, self.follows, self.hands_come_behind, self.pushed = 1.0, 1.0, True, 0
        self.two_sided = False
        self.scene, self.q, self.near_off = 1, {"right_joint1": 0.0, "left_joint1": 0.0}, 0.0
        self.lands: Callable[[Detection], Detection] = lambda stands: stands
        self.followed: list[object] = []
        self.lines: list[np.ndarray] = []
        self.stopped: Code | None = None
        self.on_report: Callable[[Status], None] = lambda status: None
        self.plans: list[Planned | OpenArmError] = []
        self._config = GraspConfig.model_validate({"near": {"enabled": False}, **config})
        shoulders = {"left": (0.0, 0.15), "right": (0.0, -0.15)}
        looks = {"right": "wrist"} if self._config.near.enabled else {}
        self.session = GraspSession(GraspContext(self._config, robot_work().table, HAND, shoulders, looks))
        self.deadline_ns, self.velocity_scale = 0, 0.0
        self.robot = self  # type: ignore[assignment]
        self._target, self._turn, self._label, self._line = np.zeros(3), 0.0, "", np.zeros(3)
        self._object: Detection | None = None
        self._went, self._width = np.zeros(3), 0.0

    # --- running
    def grasp(self, label: str = "red", **kwargs: Any) -> GraspOutcome:
        """Pick and place with one arm."""
        request = GraspRequest(label, **kwargs)
        self.status = []
        return self._run(pick_and_place(self.task(request), request))

    def ends(self, code: Code, text: str = "", label: str = "red", **kwargs: Any) -> GraspOutcome:
        """Pick and place with one arm, which must end with a code and a text in the message."""
        outcome = self.grasp(label, **kwargs)
        assert outcome.code is code, outcome.message
        assert text in outcome.message, outcome.message
        return outcome

    def succeeds(self, label: str = "red", **kwargs: Any) -> GraspOutcome:
        """Pick and place with one arm, which must succeed."""
        return self.ends(Code.OK, label=label, **kwargs)

    def ask(self, label: str = "red", **kwargs: Any) -> GraspOutcome:
        """By whatever strategy."""
        return self._run(carry_out(self.task(GraspRequest(label, **kwargs))))

    def task(self, request: GraspRequest) -> Task:
        return Task(self.session, self, request, self._report)

    def _report(self, status: Status) -> None:
        self.status.append(status)
        self.on_report(status)

    def _run(self, work: Coroutine[Any, Any, GraspOutcome]) -> GraspOutcome:
        with pytest.raises(StopIteration) as end:
            work.send(None)
        assert self.state is State.IDLE
        return end.value.value

    @property
    def states(self) -> list[State]:
        return [status.state for status in self.status]

    @property
    def state(self) -> State:
        return self.status[-1].state if self.status else State.IDLE

    @property
    def attempt(self) -> int:
        return self.status[-1].attempt if self.status else 0

    @property
    def notes(self) -> list[str]:
        return [status.reason for status in self.status]

    # --- skills
    @property
    def now_ns(self) -> int:
        return self.t_ns

    @property
    def description(self) -> RobotDescription:
        return RobotDescription.load()

    def warn(self, text: str) -> None:
        pass

    def stop_observing(self) -> None:
        pass

    def expect_near(self, camera: str) -> None:
        pass

    def call(self, call: Call) -> None:
        if self.stopped is not None:
            raise OpenArmError(self.stopped, "stopped by injection")
        self.log.append((self.t_ns * 1e-9, call))
        for fault in self.faults:
            error = fault(call)
            if error is not None:
                raise error

    async def wait(self, duration: float) -> None:
        self.call(Wait(duration))
        self.pass_time(duration)

    async def observe(self, count: int, *, near: str = "") -> tuple[Frame, ...]:
        self.call(Observe(count, near))
        seen = self.frames(count)
        if not near:
            return seen
        T_off = se3.make(p=(self.near_off, 0.0, 0.0))
        shifted = (replace(d, T_base_object=T_off @ d.T_base_object) for d in seen[-1].detections)
        return (frame_of(*shifted, t_ns=seen[-1].t_ns),) * count

    async def towards_end(
        self,
        motion: Callable[[], Awaitable[None]],
        near_end: Callable[[], bool],
        work: Callable[[], Awaitable[None]],
    ) -> None:
        await motion()
        await work()

    async def together(self, parts: Sequence[Callable[[], Awaitable[None]]]) -> None:
        for part in parts:
            await part()

    async def plan(self, request: PlanGrasp | PlanPlace) -> Planned:
        if isinstance(request, PlanGrasp) and "/push/" in request.candidates[0].id:
            if not self.hands_come_behind:
                raise OpenArmError(Code.UNREACHABLE, f"{request.arm} arm: too far")
            self._line, self._label = request.candidates[0].retreat_offset, ""
            self.lines.append(self._line)
            return self._planned(0, "transfer", "behind", "push")
        self.call(request)
        if self.plans:
            answer = self.plans.pop(0)
            if isinstance(answer, OpenArmError):
                raise answer
            return answer
        if isinstance(request, PlanGrasp):
            self._reach(request.arm, request.candidates[0].T_base_tcp[:2, 3])
            self._label, self._width = request.target[0].id.removeprefix("target/"), request.candidates[0].width
            return self._planned(0, "transfer", "" if request.blend else "approach", "lift")
        within = [i for i, way in enumerate(request.targets) if self.reaches(request.arm, way.position)]
        if not within:
            self._reach(request.arm, request.targets[0].position)
        self._target, self._turn = request.targets[within[0]].position, request.targets[within[0]].yaw_offset
        return self._planned(within[0], "carry", "", "leave")

    def _planned(self, chosen: int, *names: str) -> Planned:
        transfer, approach, retreat = (Path(name) if name else None for name in names)
        return Planned(chosen, transfer, approach, retreat, start=dict(self.q), duration=3.0, scene_version=self.scene)

    def joints(self) -> dict[str, float]:
        return dict(self.q)

    async def scene_version(self) -> int:
        return self.scene

    async def until(self, done: Callable[[], bool], limit: float, what: str) -> None:
        self.call(Wait(0.0))
        assert done(), f"nobody ended {what}"

    def reaches(self, arm: str, p: np.ndarray) -> bool:
        """Each arm reaches all; of two that are `two_sided`, its own side and a strip of the other's."""
        y = float(p[1]) if arm == "left" else -float(p[1])
        return not self.two_sided or (y >= -OVER and float(p[0]) <= self.far)

    def _reach(self, arm: str, p: np.ndarray) -> None:
        if not self.reaches(arm, p):
            raise OpenArmError(Code.UNREACHABLE, f"{arm} arm: ({p[0]:.2f}, {p[1]:.2f}) is too far")

    async def reach(self, arms: Sequence[str], T_base_tcp: np.ndarray) -> dict[str, float]:
        self.call(Reach(tuple(arms)))
        return dict.fromkeys(arms, 0.2)

    async def follow(
        self,
        arm: str,
        trajectory: object,
        what: str,
        *,
        carrying: bool = False,
        line: object = None,
        check: object = None,
    ) -> None:
        self.call(Follow(arm, str(trajectory), what, carrying))
        self.followed.append(trajectory)
        self.pass_time(1.0)
        if trajectory == "lift" and self.held:
            self.lifted(self.held)
        self._went = self._line if trajectory == "push" else np.zeros(3)
        if trajectory == "push":
            self.push()

    def lifted(self, label: str) -> None:
        self.objects.pop(label)

    async def follow_and_grip(
        self, arm: str, trajectory: object, what: str, how: str, aperture: float | None = None
    ) -> None:
        await (self.open(arm, how, aperture) if how == "open" else self.close(arm, how))
        await self.follow(arm, trajectory, what)

    async def move_linear(self, arm: str, T_base_tcp: np.ndarray, what: str) -> None:
        self.call(MoveLinear(arm, what))
        self.pass_time(1.0)

    async def go_home(self, arms: Sequence[str], obstacles: Sequence[Box] = (), *, back_off_below: float = 0.0) -> None:
        self.call(GoHome(tuple(arms), tuple(obstacles)))
        self.pass_time(1.0)

    async def stuck(self) -> bool:
        return False

    def aperture(self, arm: str) -> float:
        return self.gap

    def is_closed(self, arm: str) -> bool:
        return Evidence(self.aperture(arm), 0.0, self.effort, 0.0, reach=self.learned).empty(self._config.held)

    def is_open(self, arm: str) -> bool:
        return self.gap >= 2.0 * (HAND.opening - self._config.hand.open_tolerance)

    async def open(self, arm: str, what: str, aperture: float | None = None, *, held: float = np.inf) -> None:
        await self._grip(arm, HAND.opening if aperture is None else 0.5 * aperture, what)

    async def close(self, arm: str, what: str, force: float = 0.0) -> None:
        await self._grip(arm, 0.0, what)

    async def _grip(self, arm: str, position: float, what: str) -> None:
        self.call(Grip(arm, position, what))
        self.pass_time(0.6)
        self.move_gripper(position)

    async def measure(
        self, arm: str, expected: float, T_base_tcp: np.ndarray | None = None, *, settle: float = 0.0
    ) -> Evidence:
        self.call(Measure(arm, expected, T_base_tcp is not None))
        error = self.tcp_error if T_base_tcp is not None else 0.0
        effort = self.effort if self.held is None else -30.0
        return Evidence(self.gap, expected, effort, 0.0, error, reach=self.learned)

    def held_box(self, arm: str) -> Box | None:
        return self.carried.get(arm)

    def T_base_tcp(self, arm: str) -> np.ndarray:
        return se3.make(p=np.array([0.26, 0.2, 0.6]) + self._went)

    # --- the world
    def move_gripper(self, position: float) -> None:
        if position > 0.0:
            if self.held and self._object:
                stands = standing_at(self._object, self._target[:2] + np.array([self.place_error, 0.0]), self._turn)
                self.objects[self.held] = self.lands(stands)
            self.held, self.gap = None, 2.0 * position
        elif self.slips or self._label not in self.objects:
            self.slips, self.gap = max(0, self.slips - 1), 0.0
        else:
            self.held, self._object = self._label, self.objects[self._label]
            self.gap = self._width

    def push(self) -> None:
        self.pushed += 1
        gap = self.session.context.config.push.gap
        way = self._line * (1.0 - gap / np.linalg.norm(self._line)) * self.follows
        self.objects["red"] = standing_at(self.objects["red"], self.objects["red"].p_base[:2] + way[:2])

    def frames(self, count: int) -> tuple[Frame, ...]:
        seen, found = frame_of(*(replace(d, id=name) for name, d in self.objects.items())), list[Frame]()
        for _ in range(count):
            self.pass_time(0.1)
            found.append(replace(seen, t_ns=self.t_ns - round(self.frame_age * 1e9)))
        return tuple(found)

    def pass_time(self, seconds: float) -> None:
        self.t_ns += round(seconds * 1e9)

    # --- faults
    def fail(self, chosen: Callable[[Call], bool], code: Code, times: int = 10**6) -> None:
        """Let calls end with a code, so many times."""
        left = [times]

        def fault(call: Call) -> OpenArmError | None:
            if left[0] > 0 and chosen(call):
                left[0] -= 1
                return OpenArmError(code, f"{type(call).__name__} failed by injection")
            return None

        self.faults.append(fault)

    @staticmethod
    def follows_path(trajectory: str) -> Callable[[Call], bool]:
        """Tells the call that follows a trajectory of that name."""
        return lambda call: isinstance(call, Follow) and call.trajectory == trajectory

    @staticmethod
    def grips(*, opening: bool) -> Callable[[Call], bool]:
        """Tells the call that opens or closes the hand."""
        return lambda call: isinstance(call, Grip) and (call.position > 0.0) == opening

    # --- what happened
    def done(self, kind: type) -> list[Any]:
        return [call for _, call in self.log if isinstance(call, kind)]

    def times(self, chosen: Callable[[Call], bool]) -> list[float]:
        return [t for t, call in self.log if chosen(call)]


def no_way(code: Code, message: str, refusals: dict[str, Any] | None = None) -> NoWayError:
    return NoWayError(code, message, refusals or {})
