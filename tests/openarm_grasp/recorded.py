# SPDX-License-Identifier: Apache-2.0
"""Requests of the grasp on a robot that is simulated, or on what one answered when it was recorded.

A recording has each answer of the robot's interface in its order, and the joint states at every tick. The strategies
run on it as on the robot: they must ask for the same, and find out the same, in a hundredth of the time. What is asked
otherwise than before fails the test; `openarm test --record PATH` simulates again and writes new recordings.
"""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.camera.housings import mounted
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.robot.self_filter import SelfFilter, SelfFilterConfig
from openarm_common.scene.scene import Scene
from openarm_evaluation.campaign.in_process_robot import InProcessRobot
from openarm_evaluation.campaign.robot import SimulatedSenses, together, turn
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_evaluation.judging.trial import Step
from openarm_grasp.config import GraspConfig
from openarm_grasp.context import GraspContext
from openarm_grasp.evidence.verdicts import Verdict
from openarm_grasp.perception.boxes import with_points
from openarm_grasp.perception.detections import Frame
from openarm_grasp.planning.candidates import Box
from openarm_grasp.planning.options import NoWayError
from openarm_grasp.requests.request import GraspOutcome, GraspRequest
from openarm_grasp.requests.task import GraspSession, Status
from openarm_grasp.requests.task import Task as GraspTask
from openarm_grasp.robot.interface import PlanGrasp, Planned, PlanPlace, check_deadline
from openarm_grasp.robot.skills import Skills
from openarm_grasp.strategies.registry import carry_out
from tests.openarm_grasp.tape import Call, Tape, packed, unpacked

#: What is asked for may differ by this from what was recorded, m and rad: rounding of another machine.
_SAME = 1e-4
#: So many of the ways that were offered must be offered again; of those at the edge of a limit, rounding decides.
_MOST = 0.9


def _with_points(robot: Any, seen: Sequence[Frame], camera: str) -> tuple[Frame, ...]:
    """Frames that have no points with those of their boxes."""
    made, mounted = list(seen), load_cameras()[camera]
    robot_filter = SelfFilter(robot.description, SelfFilterConfig())
    for k, frame in enumerate(made):
        if frame.cloud is None:
            T = robot.states.lookup(robot.description.root, mounted.parent, frame.t_ns) @ mounted.T_parent_optical
            shapes = robot_filter.shapes(robot.states.latest()[1])
            outline = robot_filter.outline(mounted.intrinsics, T, shapes)
            made[k] = with_points(frame, mounted.intrinsics, T, 0.4, outline)
    return tuple(made)


def _asked(request: PlanGrasp | PlanPlace) -> tuple[list[Any], np.ndarray]:
    """What is compared of a plan: ids by word, poses by number."""
    ways = request.candidates if isinstance(request, PlanGrasp) else request.targets
    own = request.target if isinstance(request, PlanGrasp) else request.held
    boxes = (*request.obstacles, *own, *request.ignore_regions)
    words = [type(request).__name__, request.arm, [way.id for way in ways], [box.id for box in boxes]]
    numbers = [way.T_base_tcp[:3].ravel() for way in ways]
    numbers += [part for way in ways for part in (way.approach_offset, way.retreat_offset)]
    numbers += [part for box in boxes for part in (box.T_frame_box[:3].ravel(), np.asarray(box.size))]
    return words, np.concatenate([*numbers, np.zeros(0)])


def _ways(count: int, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of so many ways (count, 18) in what `_asked` returns, and those of the boxes."""
    T, offsets, boxes = np.split(poses, (12 * count, 18 * count))
    return np.hstack([T.reshape(count, 12), offsets.reshape(count, 6)]), boxes


class SimulatedRobot(InProcessRobot):
    """The robot of a campaign, which notes what it answers.

    Args:
        trials: Whose robot.
        config: Parameters of the grasp.
        clouds: Whether frames have points.
    """

    def __init__(self, trials: Trials, config: GraspConfig, *, clouds: bool) -> None:
        super().__init__(trials.robot, config)
        self._clouds = clouds
        self.tape = Tape(tuple(self.robot.world.joint_names), tuple(item.name for item in self.robot.scene.objects))
        self._stopped = False
        tick = self.robot.tick

        def noted() -> None:
            tick()
            self._note()

        self.robot.tick = noted  # type: ignore[method-assign]
        self._note()

    def _note(self) -> None:
        self.tape.clock_ns.append(self.robot.t_ns)
        self.tape.state_ns.append(self.now_ns)
        self.tape.q.append(self.robot.trace[-1][1])
        poses = [readout.T_world_object for readout in self.robot.world.objects()]
        self.tape.truth.append(np.array([[*T[:3, 3], *se3.quat_xyzw_from_matrix(T[:3, :3])] for T in poses]))

    def check(self) -> None:
        try:
            super().check()
        except OpenArmError:
            self._stopped = True
            raise

    @property
    def now_tick(self) -> int:
        """Number of ticks so far."""
        return len(self.tape.q) - 1

    def _begin(self, *what: Any, poses: Sequence[Any] | np.ndarray = ()) -> Call:
        self.tape.calls.append(Call(list(what), np.asarray(poses, np.float64).ravel()))
        return self.tape.calls[-1]

    def _end(self, call: Call, answer: Any) -> Any:
        call.answer, call.end = answer, self.now_tick
        return answer

    async def _ask(self, call: Call, work: Awaitable[Any]) -> Any:
        self._stopped = False
        try:
            return self._end(call, await work)
        except OpenArmError as error:
            self._end(call, None)
            if not self._stopped:  # else it is what the strategy found out
                call.error = (error.code.value, error.message, getattr(error, "refusals", None))
            raise

    def effort(self, joint: str) -> float:
        return self._end(self._begin("effort", joint), super().effort(joint))

    def pads(self, arm: str) -> tuple[float, ...]:
        return self._end(self._begin("pads", arm), super().pads(arm))

    def held_box(self, arm: str) -> Box | None:
        return self._end(self._begin("held_box", arm), super().held_box(arm))

    async def observe(self, count: int, *, near: str = "") -> tuple[Frame, ...]:
        call = self._begin("observe", count, near)
        seen = await self._ask(call, super().observe(count, near=near))
        if not self._clouds:
            seen = tuple(replace(frame, cloud=None) for frame in seen)
        arrays: list[np.ndarray] = []  # the strategy gets what will be read
        kept = packed(seen, arrays)
        kept = self._end(call, unpacked(kept, {f"array{k}": array for k, array in enumerate(arrays)}))
        return _with_points(self, kept, near or self._config.camera)

    async def plan(self, request: PlanGrasp | PlanPlace) -> Planned:
        words, poses = _asked(request)
        call = self._begin("plan", *words, poses=poses)
        plan = await self._ask(call, super().plan(request))
        parts = {part: f"{part} {len(self.tape.calls)}" for part in ("transfer", "approach", "retreat")}
        call.answer = replace(plan, **parts)
        return plan

    async def scene_version(self) -> int:
        return await self._ask(self._begin("scene_version"), super().scene_version())

    async def reach(self, arm: str, T_base_tcp: Any) -> Mapping[str, float]:
        return await self._ask(self._begin("reach", arm, poses=T_base_tcp), super().reach(arm, T_base_tcp))

    async def follow(self, arm: str, trajectory: object, what: str, guard: Callable[[], None] | None = None) -> None:
        def watched() -> None:
            try:
                if guard is not None:
                    guard()
            except OpenArmError:
                self._stopped = True
                raise

        call = self._begin("follow", arm, what)
        await self._ask(call, super().follow(arm, trajectory, what, watched))

    async def move(
        self, arm: str, to: Any, what: str, obstacles: Sequence[Box] = (), *, plan_only: bool = False
    ) -> None:
        call = self._begin(*_moved(arm, to, what, plan_only), poses=() if isinstance(to, str) else to)
        await self._ask(call, super().move(arm, to, what, obstacles, plan_only=plan_only))

    async def grip(self, arm: str, joint: str, position: float, what: str, effort: float = 0.0) -> bool:
        call = self._begin("grip", arm, joint, what, poses=(position, effort))
        return await self._ask(call, super().grip(arm, joint, position, what, effort))


def _moved(arm: str, to: Any, what: str, plan_only: bool) -> list[Any]:
    return ["move", arm, to if isinstance(to, str) else "", what, plan_only]


class RecordedRobot:
    """A robot that answers as it did when it was recorded; implements `openarm_grasp.robot.interface.RobotInterface`.

    Args:
        tape: What it answered.
        config: Parameters of the grasp.
    """

    def __init__(self, tape: Tape, config: GraspConfig) -> None:
        self.tape, self._config = tape, config
        self.description = RobotDescription.load()
        self.states = RobotStateBuffer(self.description)
        self.deadline_ns, self.velocity_scale, self.cancelled = 0, 0.0, ""
        self.watch: Callable[[], None] = lambda: None
        self._tick, self._calls = -1, 0
        self.together = together
        self.tick()

    def tick(self) -> None:
        """Let one control tick pass."""
        self._tick += 1
        if self._tick == len(self.tape.q):
            pytest.fail("the recording ends here, the grasp goes on; record again (openarm test --record PATH)")
        if self.tape.state_ns[self._tick] == self.tape.clock_ns[self._tick]:
            self.states.add_joint_state(self.t_ns, self.tape.joints, self.tape.q[self._tick].tolist())

    @property
    def now_tick(self) -> int:
        """Number of ticks so far."""
        return self._tick

    @property
    def t_ns(self) -> int:
        """Time of the simulation that was recorded."""
        return self.tape.clock_ns[self._tick]

    def run(self, work: Any) -> Any:
        """Carry out a coroutine of this robot, one tick a turn."""
        while True:
            try:
                work.send(None)
            except StopIteration as end:
                return end.value
            self.tick()

    def _next(self, *what: Any, poses: Sequence[Any] | np.ndarray = ()) -> Call:
        """The next answer, which must be that to the same question."""
        call = self._take(*what)
        self._compare(what, call.what, np.asarray(poses, np.float64).ravel(), call.poses)
        return call

    def _take(self, *what: Any) -> Call:
        if self._calls == len(self.tape.calls):
            pytest.fail(f"the recording has no more answers; asked: {list(what)}")
        self._calls += 1
        return self.tape.calls[self._calls - 1]

    def _compare(self, words: Sequence[Any], recorded: Sequence[Any], asked: np.ndarray, poses: np.ndarray) -> None:
        if json.loads(json.dumps(words)) != recorded:
            pytest.fail(f"asked: {list(words)}; when it was recorded: {recorded}")
        if asked.shape != poses.shape or np.abs(asked - poses).max(initial=0.0) > _SAME:
            pytest.fail(f"asked with other poses or sizes than when it was recorded: {list(words)}")

    async def _answer(self, call: Call, guard: Callable[[], None] | None = None) -> Any:
        faults: list[OpenArmError] = []
        while True:
            try:
                if not faults:
                    self.check()
                    if guard is not None:
                        guard()
            except OpenArmError as error:
                faults.append(error)
            if self._tick >= call.end:
                break
            await turn()
        if faults:
            raise faults[0]
        if call.error is None:
            return call.answer
        code, message, refusals = call.error
        raise OpenArmError(Code(code), message) if refusals is None else NoWayError(Code(code), message, refusals)

    @property
    def now_ns(self) -> int:
        return self.states.latest()[0]

    def effort(self, joint: str) -> float:
        return self._next("effort", joint).answer

    def pads(self, arm: str) -> tuple[float, ...]:
        return self._next("pads", arm).answer

    def held_box(self, arm: str) -> Box | None:
        return self._next("held_box", arm).answer

    def check(self) -> None:
        self.watch()
        if self.cancelled:
            raise OpenArmError(Code.CANCELLED, self.cancelled)
        check_deadline(self.now_ns, self.deadline_ns)
        silent_s = (self.t_ns - self.now_ns) * 1e-9
        if silent_s > self._config.limits.joint_state_timeout:
            raise OpenArmError(Code.ROBOT_LOST, f"joint states have been silent for {silent_s:.1f} s")

    def warn(self, text: str) -> None:
        """Nothing to warn."""

    def expect_near(self, camera: str) -> None:
        """Nothing to wake."""

    def stop_observing(self) -> None:
        """Nothing observes."""

    async def until(
        self, done: Callable[[], bool], limit: float, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        deadline_ns = self.t_ns + limit * 1e9
        while not done():
            self.check()
            if guard is not None:
                guard()
            if self.t_ns > deadline_ns:
                raise OpenArmError(Code.TIMEOUT, f"{what}: not done within {limit:g} s")
            await turn()

    async def observe(self, count: int, *, near: str = "") -> tuple[Frame, ...]:
        seen = await self._answer(self._next("observe", count, near))
        return _with_points(self, seen, near or self._config.camera)

    async def plan(self, request: PlanGrasp | PlanPlace) -> Planned:
        words, poses = _asked(request)
        call = self._take("plan", *words)
        if call.what[0] != "plan":
            pytest.fail(f"asked for a plan; when it was recorded: {call.what}")
        ids, before = words.pop(2), [*call.what[1:3], *call.what[4:]]
        ids_before: list[str] = call.what[3]
        (ways, boxes), (ways_before, boxes_before) = _ways(len(ids), poses), _ways(len(ids_before), call.poses)
        self._compare(words, before, boxes, boxes_before)
        # Where rounding lets a way more or less through, the ranks of others differ, and with them their ids.
        apart = np.abs(ways_before[:, None] - ways[None]).max(axis=2, initial=0.0)
        now = {k: int(row.argmin()) for k, row in enumerate(apart) if row.min(initial=np.inf) <= _SAME}
        chosen = call.answer.chosen if call.error is None else None
        if len(now) < _MOST * max(len(ids), len(ids_before)) or (chosen is not None and chosen not in now):
            pytest.fail(f"asked for other ways, {len(now)} of them as recorded: {ids}; recorded: {ids_before}")
        names = {ids_before[k]: ids[i] for k, i in now.items()}
        try:
            plan: Planned = await self._answer(call)
        except NoWayError as error:
            raise NoWayError(error.code, error.message, _renamed(error.refusals, names)) from None
        margins = {i: plan.limit_margins[k] for k, i in now.items()} if plan.limit_margins else {}
        return replace(
            plan,
            chosen=now[plan.chosen],
            refusals=_renamed(plan.refusals, names),
            limit_margins=tuple(margins.get(i, np.nan) for i in range(len(ids))) if margins else (),
        )

    async def scene_version(self) -> int:
        return await self._answer(self._next("scene_version"))

    async def reach(self, arm: str, T_base_tcp: Any) -> Mapping[str, float]:
        return await self._answer(self._next("reach", arm, poses=T_base_tcp))

    async def follow(self, arm: str, trajectory: object, what: str, guard: Callable[[], None] | None = None) -> None:
        await self._answer(self._next("follow", arm, what), guard)

    async def move(
        self, arm: str, to: Any, what: str, obstacles: Sequence[Box] = (), *, plan_only: bool = False
    ) -> None:
        poses = () if isinstance(to, str) else to
        await self._answer(self._next(*_moved(arm, to, what, plan_only), poses=poses))

    async def grip(self, arm: str, joint: str, position: float, what: str, effort: float = 0.0) -> bool:
        return await self._answer(self._next("grip", arm, joint, what, poses=(position, effort)))


def _renamed(refusals: Mapping[str, Verdict], names: Mapping[str, str]) -> dict[str, Verdict]:
    return {names[way]: why for way, why in refusals.items() if way in names}


class Requests:
    """Requests to a robot, one after the other, and what the strategies said meanwhile.

    Attributes:
        steps: States that were entered.
        trials: The simulation; None on a recording.
    """

    def __init__(self, scene: Scene, senses: SimulatedSenses, config: GraspConfig, task: Task | None = None) -> None:
        self._scene, self._senses, self._config = scene, senses, config
        self._task = task or Task("nominal", 1, scene, ())
        self.steps: list[Step] = []
        self.trials: Trials | None = None
        self.link: SimulatedRobot | RecordedRobot

    def simulate(self, *, clouds: bool) -> None:
        """Make the world of the scene."""
        self.trials = Trials(self._task, self._senses, self._config)
        self.steps, self.session = self.trials.steps, self.trials.session
        self.link = SimulatedRobot(self.trials, self._config, clouds=clouds)
        self.skills = self.trials.skills = Skills(self.link, self._config)

    def replay(self, tape: Tape) -> None:
        """Take the answers of a recording."""
        self.link = RecordedRobot(tape, self._config)
        self.skills = Skills(self.link, self._config)
        cameras = mounted(load_cameras(), {})
        self.session = GraspSession(GraspContext.of(self._config, self._scene.table, self.link.description, cameras))

    def pass_time(self, seconds: float) -> None:
        """Let time pass with nothing asked of the robot."""
        clock = self.link if self.trials is None else self.trials.robot
        end_ns = clock.t_ns + round(seconds * 1e9)
        while clock.t_ns < end_ns:
            clock.tick()

    def task(self, label: str = "", **request: Any) -> GraspTask:
        """A request, for a strategy."""
        asked = GraspRequest(label, **request)
        if self.trials is not None:
            return self.trials.grasp_task(asked)
        return GraspTask(self.session, self.skills, asked, self._report)

    def ask(self, label: str = "", **request: Any) -> GraspOutcome:
        """Carry out a request."""
        return self.link.run(carry_out(self.task(label, **request)))

    def succeeds(self, label: str = "", **request: Any) -> GraspOutcome:
        """Carry out a request that must succeed."""
        outcome = self.ask(label, **request)
        assert outcome.success, outcome.message
        return outcome

    def restart(self) -> None:
        """Forget the session, as a node that is started again."""
        self.session = GraspSession(self.session.context)
        if self.trials is not None:
            self.trials.session = self.session

    def pose(self, name: str) -> np.ndarray:
        """T_world_object (4, 4) of an object now, by ground truth."""
        tape = self.link.tape
        x, y, z, *q_xyzw = tape.truth[self.link.now_tick][tape.objects.index(name)]
        return se3.make(se3.matrix_from_quat_xyzw(np.array(q_xyzw)), (x, y, z))

    @property
    def said(self) -> str:
        """The reasons of all steps."""
        return " ".join(step.reason for step in self.steps)

    def _report(self, status: Status) -> None:
        entered = (status.state.value, status.previous.value, status.reason, status.attempt)
        self.steps.append(Step(self.link.t_ns, *entered, status.label, status.arm))


class Recordings:
    """Makes the robot of a test; the value of the fixture `recorded`.

    Args:
        path: Of the recording of the test, without number and suffix.
        simulated: Whether a world is simulated instead.
    """

    def __init__(self, path: Path, *, simulated: bool) -> None:
        self._path, self._simulated = path, simulated
        self.made: list[Requests] = []

    def __call__(
        self,
        scene: Scene,
        *,
        settle: float = 0.5,
        clouds: bool = True,
        senses: SimulatedSenses | None = None,
        config: GraspConfig | None = None,
        task: Task | None = None,
    ) -> Requests:
        """Make a robot with a scene before it.

        Args:
            scene: What is on the table.
            settle: Time that passes before the first request, s.
            clouds: Whether frames have points; a recording without is smaller.
            senses: How well it sees; noisy depth by default.
            config: Parameters of the grasp.
            task: Of which the fault is taken.
        """
        senses = senses or SimulatedSenses(depth_noise=True, detector="anything" if clouds else "color")
        config = config or GraspConfig()
        made = Requests(scene, senses, config, task)
        if self._simulated:
            made.simulate(clouds=clouds)
        else:
            path = self._file(len(self.made))
            if not path.exists():
                pytest.fail(f"no recording {path.name}; make it: openarm test --record PATH of the test")
            made.replay(Tape.read(path))
        self.made.append(made)
        made.pass_time(settle)
        return made

    def write(self) -> None:
        """Write the recordings of what was simulated."""
        for k, made in enumerate(self.made):
            assert isinstance(made.link, SimulatedRobot)
            made.link.tape.write(self._file(k))

    def _file(self, number: int) -> Path:
        return self._path.with_name(f"{self._path.name}{f'-{number}' if number else ''}.npz")
