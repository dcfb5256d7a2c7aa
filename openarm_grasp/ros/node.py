# SPDX-License-Identifier: Apache-2.0
"""The grasp node.

Services /grasp, /grasp/confirm, /grasp/release and /grasp/learn_hand/ARM, actions /grasp/pick and /grasp/pick_two,
topics /grasp/status and /grasp/markers.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from openarm_interfaces.action import Pick, PickTwo
from openarm_interfaces.msg import GraspStatus
from openarm_interfaces.srv import ConfirmPlan, Grasp, ReleaseHand
from rclpy.action import CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from openarm_common.camera.cameras import CameraConfig
from openarm_common.errors import Code, OpenArmError
from openarm_common.records import default_folder
from openarm_common.robot.learned import keep_hand
from openarm_common.robot.zeros import keep_zeros, read_zeros, zeros_of, zeros_path
from openarm_common.ros.actions import ActionServer
from openarm_common.ros.node import QOS_LATCHED, BaseNode, run
from openarm_common.scene.scene import load_scene
from openarm_grasp.config import GraspConfig
from openarm_grasp.context import GraspContext
from openarm_grasp.requests.request import GraspOutcome, GraspRequest, PairOutcome
from openarm_grasp.requests.states import State
from openarm_grasp.requests.task import GraspSession, Status, Task
from openarm_grasp.robot.coordination import ArmCoordination, coordinated
from openarm_grasp.robot.learn import learn_hand
from openarm_grasp.robot.skills import Skills
from openarm_grasp.ros import messages
from openarm_grasp.ros.flight_recorder_client import FlightRecorderClient
from openarm_grasp.ros.graph_robot import GraphRobot
from openarm_grasp.sampling.samplers import make_sampler
from openarm_grasp.strategies.pair import Requests, pick_two
from openarm_grasp.strategies.registry import carry_out

AnswerT = TypeVar("AnswerT")
OutcomeT = TypeVar("OutcomeT", GraspOutcome, PairOutcome)
OnStatus = Callable[[GraspStatus], None]

#: Latched, and deep enough that two transitions in a row both arrive.
_QOS_STATUS = QoSProfile(depth=20, reliability=QOS_LATCHED.reliability, durability=QOS_LATCHED.durability)


class GraspNode(BaseNode[GraspConfig]):
    """Serves a request for each arm at a time, or one for all; another meanwhile is answered at once with BUSY.

    A request for an arm by name takes that arm alone, and one for any arm both of them, or the one that is free.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("grasp", GraspConfig, **kwargs)
        make_sampler(self.config.sampler)  # one that does not exist is refused now
        context = GraspContext.of(self.config, load_scene(self.config.scene).table, self.description)
        self._robot = GraphRobot(self, self.config, context.table.top_z)
        self._skills = Skills(self._robot, self.config)
        self._session = GraspSession(context)
        self._flight_recorder = FlightRecorderClient(self)
        self._robot.follow_table(self._take_table)
        self._robot.follow_mounts(self._take_mounts)
        #: What each arm is at work on, for the answer to what comes meanwhile.
        self._coordination = ArmCoordination()
        #: The newest state of a request of each arm, and of one of all arms.
        self._newest: dict[str, Status] = {}
        #: What a cancel of a goal reaches, by id of each goal that is carried out.
        self._cancels: dict[bytes, list[GraphRobot]] = {}
        self._status_topic = self.create_publisher(GraspStatus, "/grasp/status", _QOS_STATUS)
        self._marker_topic = self.create_publisher(MarkerArray, "/grasp/markers", QOS_LATCHED)
        self.create_service(Grasp, "/grasp", self._on_grasp)
        self.create_service(ConfirmPlan, "/grasp/confirm", self._on_confirm)
        self.create_service(ReleaseHand, "/grasp/release", self._on_release)
        for arm in self.description.hands:
            self.create_service(Trigger, f"/grasp/learn_hand/{arm}", partial(self._on_learn, arm))
        self._actions = [
            self._serve(Pick, "/grasp/pick", self._on_pick),
            self._serve(PickTwo, "/grasp/pick_two", self._on_pick_two),
        ]
        self._status_topic.publish(
            messages.status_msg(Status(State.IDLE, State.IDLE, "waiting for a request"), self.description.base, 0)
        )

    def close(self) -> None:
        """Stop listening and take the actions down."""
        self._robot.close()
        while self._actions:
            self._actions.pop().destroy()
        super().close()

    def _take_table(self, height: float) -> None:
        context = self._session.context
        self._session.context = replace(context, table=context.table.at(height))

    def _take_mounts(self, cameras: Mapping[str, CameraConfig]) -> None:
        self._session.context = replace(self._session.context, cameras=tuple(cameras.values()))

    # --- callbacks
    async def _on_grasp(self, request: Grasp.Request, response: Grasp.Response) -> Grasp.Response:
        messages.fill_answer(response, await self._one(messages.request_from_msg(request)))
        return response

    async def _on_confirm(self, request: ConfirmPlan.Request, response: ConfirmPlan.Response) -> ConfirmPlan.Response:
        async def answer() -> str:
            return self._session.gate.answer(request.plan_id, accept=request.accept)

        return await _told(response, answer())

    async def _on_release(self, request: ReleaseHand.Request, response: ReleaseHand.Response) -> ReleaseHand.Response:
        def work() -> Awaitable[str]:
            return self._session.release(self._skills, request.arm)

        await _told(response, self._take("the release of a hand", self._arms, work))
        self.get_logger().info(f"release of the {request.arm or 'full'} hand: {response.message}")
        return response

    async def _on_learn(self, arm: str, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        await _told(response, self._take("the learning of a hand", self._arms, lambda: self._learn(arm, self._robot)))
        self.get_logger().info(response.message)
        return response

    async def _on_pick(self, goal: ServerGoalHandle) -> Pick.Result:
        def feedback(status: GraspStatus) -> None:
            goal.publish_feedback(Pick.Feedback(status=status))

        request, result = messages.request_from_msg(goal.request), Pick.Result()
        messages.fill_answer(result, await self._as_goal(goal, self._one(request, feedback, goal)))
        return result

    async def _on_pick_two(self, goal: ServerGoalHandle) -> PickTwo.Result:
        def feedback(which: int, status: GraspStatus) -> None:
            goal.publish_feedback(PickTwo.Feedback(request=which, status=status))

        on_status = partial(feedback, 0), partial(feedback, 1)
        two = self._two(messages.requests_from_msg(goal.request), on_status, goal)
        return messages.pair_result(await self._as_goal(goal, two))

    async def _as_goal(self, goal: ServerGoalHandle, work: Awaitable[OutcomeT]) -> OutcomeT:
        """Carry a goal out."""
        self._cancels[_id_of(goal)] = []
        try:
            outcome = await work
        finally:
            del self._cancels[_id_of(goal)]
            self._rest()
        if outcome.success:
            goal.succeed()
        elif goal.is_cancel_requested and outcome.code is Code.CANCELLED:
            goal.canceled()
        else:
            goal.abort()
        return outcome

    def _on_cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        robots = self._cancels.get(_id_of(goal), [])
        for robot in robots:
            robot.cancel()
        return CancelResponse.ACCEPT if robots else CancelResponse.REJECT

    def _serve(self, kind: Any, name: str, execute: Callable[[ServerGoalHandle], Any]) -> ActionServer:
        return ActionServer(self, kind, name, execute, cancel_callback=self._on_cancel)

    # --- hands
    async def _learn(self, arm: str, robot: GraphRobot) -> str:
        """Learn a hand, use it as it is from now on, and store it; return what was learned, in a sentence."""
        reach = await learn_hand(Skills(robot, self.config), arm, self.config.timing.settle_limit)
        folder = Path(self.config.calibrations).expanduser() if self.config.calibrations else default_folder()
        path = keep_hand(folder, zeros_of(), arm, reach)
        if run := zeros_path():  # of nodes of this run that start again
            held = read_zeros(Path(run))
            keep_zeros(held.model_copy(update={"hands": {**held.hands, arm: reach}}), Path(run).parent)
        self.description = self.description.with_hands({arm: reach})
        self._skills = Skills(self._robot, self.config)
        self._session.context = replace(self._session.context, hands=self.description.hands)
        return f"the {arm} hand goes from {reach}, and presses with {reach.effort:.0f} N closed on nothing; in {path}"

    async def _learn_unknown(self, robot: GraphRobot, arms: Sequence[str], *requests: GraspRequest) -> None:
        """Learn the hands of which nothing was learned, where that is allowed, before requests that may move them."""
        if self.config.hand.learn and not any(one.dry_run or one.phase == "place" for one in requests):
            for arm, hand in self.description.hands.items():
                if arm in arms and hand.reach is None:
                    self.get_logger().info(await self._learn(arm, robot))

    # --- requests
    @property
    def _arms(self) -> Sequence[str]:
        return self.description.arm_names

    def _arm_of(self, request: GraspRequest) -> str:
        """The arm that a request takes alone; "": it takes all."""
        free = [arm for arm in self._arms if arm not in self._coordination.at_work]
        if request.confirm or len(self._arms) < 2:  # plans are shown one at a time
            return ""
        if request.arm in self._arms:
            return request.arm
        return free[0] if len(free) == 1 and request.arm in ("", "auto") else ""

    async def _one(
        self, request: GraspRequest, on_status: OnStatus | None = None, goal: ServerGoalHandle | None = None
    ) -> GraspOutcome:
        arm, arms, robot = self._arm_of(request), self._arms, self._robot
        if arm:
            request, arms, robot = replace(request, arm=arm), (arm,), self._robot.next_to_other()
        report = partial(self._publish, arm=arm, on_status=on_status)

        async def work() -> GraspOutcome:
            await self._learn_unknown(robot, arms, request)
            skills = coordinated(arm, robot, self._coordination, self.config) if arm else self._skills
            return await carry_out(Task(self._session, skills, request, report))

        try:
            outcome = await self._take(
                _grasp_of(request.cut()), arms, work, robot=robot, goal=goal, moves=not request.dry_run
            )
        except OpenArmError as error:
            request = request.cut()
            self._refused(f"grasp of {request.label!r}", error, arm)
            outcome = GraspOutcome(error.code, error.message, request.label)
        else:
            self._report(outcome)
        return replace(outcome, recording=await self._flight_recorder.save(outcome, request))

    async def _two(self, asked: Requests, on_status: Sequence[OnStatus], goal: ServerGoalHandle) -> PairOutcome:
        named = _grasp_of(*(request.cut() for request in asked))

        def with_all_arms(work: Callable[[], Awaitable[Requests]]) -> Awaitable[Requests]:
            async def learned() -> Requests:
                await self._learn_unknown(self._robot, self._arms, *asked)
                return await work()

            return self._take(named, self._arms, learned, goal=goal, moves=not asked[0].dry_run)

        def carry_out_one(i: int, request: GraspRequest) -> Awaitable[GraspOutcome]:
            return self._one(request, on_status[i], goal)

        def note(reason: str) -> None:
            self._publish(Status(State.IDLE, State.IDLE, reason), on_status=on_status[0])

        try:
            return await pick_two(self._session, self._skills, asked, with_all_arms, carry_out_one, note)
        except OpenArmError as error:
            self._refused(named, error)
            return PairOutcome((), error.code, error.message)

    async def _take(
        self,
        what: str,
        arms: Sequence[str],
        work: Callable[[], Awaitable[AnswerT]],
        *,
        robot: GraphRobot | None = None,
        goal: ServerGoalHandle | None = None,
        moves: bool = True,
    ) -> AnswerT:
        """Carry something out with arms that are free.

        Args:
            what: Description of the work.
            arms: Arms that it needs.
            work: Carries it out.
            robot: Robot that a cancel of the goal reaches; None: that of all arms.
            goal: Goal that asks for it; None: a service does.
            moves: It will move arms.

        Raises:
            OpenArmError: BUSY, NOT_READY or INVALID_ARGUMENT, when it is not taken; CANCELLED before it began.
        """
        robot = robot or self._robot
        cancels = [] if goal is None else self._cancels[_id_of(goal)]
        try:
            with self._coordination.taking(arms, what):
                cancels.append(robot)
                named = " and ".join(dict.fromkeys(self._coordination.at_work.values()))
                await robot.begin(named, arms if moves else ())
                return await work()
        finally:
            cancels[:] = [one for one in cancels if one is not robot]
            self._rest()

    def _rest(self) -> None:
        """Stop listening when nothing is carried out any more."""
        if not (self._coordination.at_work or self._cancels):
            self._robot.end()

    def _refused(self, what: str, error: OpenArmError, arm: str = "") -> None:
        self.get_logger().warning(f"{what} refused: {error}")
        if error.code is not Code.BUSY:  # what runs publishes its own state
            self._publish(Status(State.IDLE, State.IDLE, error.message, code=error.code.value), arm)
            self._diagnose(error.code is not Code.NOT_READY, f"{error.code}: {error.message}")

    # --- publishing
    def _diagnose(self, ok: bool, text: str, *, late: bool = False, **values: str) -> None:
        working = (one.state for one in self._newest.values() if one.state is not State.IDLE)
        values.setdefault("state", next(working, State.IDLE).value)
        if ok and late:
            self.diagnose_warning(text, **values)
        else:
            self.diagnose(ok, text, **values)

    def _report(self, outcome: GraspOutcome) -> None:
        """Publish how a request ended."""
        report = f"{outcome.code}: {outcome.message} (arm {outcome.arm or '-'}, attempts {outcome.attempts})"
        late = [f"{one.state} {one.longest:.1f} of {one.budget:g} s" for one in outcome.state_times if one.exceeded]
        report += f"; longer than expected: {', '.join(late)}" if late else ""
        self.get_logger().info(report) if outcome.success else self.get_logger().warning(report)
        drift = self._session.drift.drift()
        if drift.alarm:
            self.get_logger().error(drift.message)
        text = f"{drift.message}; {report}" if drift.alarm else report
        self._diagnose(not drift.alarm, text, late=bool(late), drift=drift.message)

    def _publish(self, status: Status, arm: str = "", on_status: OnStatus | None = None) -> None:
        """Publish a state that was entered by a request of an arm, or of all."""
        t_ns = self._robot.now_ns
        before = self._newest.get(arm)
        self._newest[arm] = status
        message = messages.status_msg(status, self.description.base, t_ns)
        self._status_topic.publish(message)
        if on_status is not None:
            on_status(message)
        if status.state is State.IDLE:
            # The newest status is not that of one which has ended while the other is at work.
            for other in self._newest.values():
                if other.state is not State.IDLE:
                    self._status_topic.publish(
                        messages.status_msg(replace(other, previous=other.state), self.description.base, t_ns)
                    )
        change = f"{message.previous_state} -> {message.state} at {t_ns * 1e-9:.2f} s, attempt {status.attempt}"
        about = f"{status.label} " if status.label else ""
        self.get_logger().info(f"{about}{change}: {status.reason}")
        text = f"{message.state}: {status.reason}" + (f"; {status.late}" if status.late else "")
        self._diagnose(True, text, late=bool(status.late), state=message.state, label=status.label, arm=status.arm)
        answered = before is not None and before.plan is not None
        if status.candidates or status.plan or answered:
            self._marker_topic.publish(messages.status_markers(status, self.description, t_ns))


async def _told(response: Any, work: Awaitable[str]) -> Any:
    """Write what came of work into the response of a service; one of `Trigger` has its code in the message."""
    code = Code.OK
    try:
        response.message = await work
    except OpenArmError as error:
        code, response.message = error.code, error.message
    response.success = code is Code.OK
    if not isinstance(response, Trigger.Response):
        response.code = code.value
    elif not response.success:
        response.message = f"{code}: {response.message}"
    return response


def _id_of(goal: ServerGoalHandle) -> bytes:
    return bytes(goal.goal_id.uuid)


def _grasp_of(*requests: GraspRequest) -> str:
    return "a grasp of " + " and ".join(repr(one.label) if one.label else "an object" for one in requests)


def main() -> None:
    """Run the node."""
    run(GraspNode)


if __name__ == "__main__":
    main()
