# SPDX-License-Identifier: Apache-2.0
"""The grasp node: service /grasp, actions /grasp/pick and /grasp/pick_two, topics /grasp/status and /grasp/markers."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

from openarm_interfaces.action import Pick, PickTwo
from openarm_interfaces.msg import GraspStatus
from openarm_interfaces.srv import Grasp
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.qos import QoSProfile
from visualization_msgs.msg import MarkerArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import QOS_LATCHED, BaseNode, run
from openarm_common.scene.scene import load_scene
from openarm_grasp.config import GraspConfig
from openarm_grasp.ros import convert
from openarm_grasp.ros.request_executor import RequestExecutor
from openarm_grasp.strategy.effects import GraspOutcome, GraspRequest
from openarm_grasp.strategy.machine import GraspMachine
from openarm_grasp.strategy.memory import Surroundings
from openarm_grasp.strategy.pair import PairOutcome
from openarm_grasp.strategy.states import State

AnswerT = TypeVar("AnswerT", GraspOutcome, PairOutcome)
OnStatus = Callable[[GraspMachine, GraspStatus], None]

#: Latched, and deep enough that two transitions in a row both arrive.
_QOS_STATUS = QoSProfile(depth=20, reliability=QOS_LATCHED.reliability, durability=QOS_LATCHED.durability)


class GraspNode(BaseNode[GraspConfig]):
    """Serves one request at a time, of one object or of two; another while it runs is answered at once with BUSY."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("grasp", GraspConfig, **kwargs)
        around = Surroundings.of(self.config, load_scene(self.config.scene).table, self.description)
        self._requests = RequestExecutor(self, around)
        self._goal: ServerGoalHandle | None = None
        self._status_topic = self.create_publisher(GraspStatus, "/grasp/status", _QOS_STATUS)
        self._marker_topic = self.create_publisher(MarkerArray, "/grasp/markers", QOS_LATCHED)
        self.create_service(Grasp, "/grasp", self._on_grasp)
        self._actions = [
            self._serve(Pick, "/grasp/pick", self._on_pick),
            self._serve(PickTwo, "/grasp/pick_two", self._on_pick_two),
        ]
        self._status_topic.publish(convert.status_msg(self._requests.machines[0], 0))

    def close(self) -> None:
        """Stop listening and take the actions down."""
        self._requests.close()
        while self._actions:
            self._actions.pop().destroy()
        super().close()

    # --- callbacks
    async def _on_grasp(self, request: Grasp.Request, response: Grasp.Response) -> Grasp.Response:
        convert.fill_answer(response, await self._one(convert.request_from_msg(request)))
        return response

    async def _on_pick(self, goal: ServerGoalHandle) -> Pick.Result:
        def feedback(_: GraspMachine, status: GraspStatus) -> None:
            goal.publish_feedback(Pick.Feedback(status=status))

        request, result = convert.request_from_msg(goal.request), Pick.Result()
        convert.fill_answer(result, await self._as_goal(goal, lambda: self._one(request, feedback)))
        return result

    async def _on_pick_two(self, goal: ServerGoalHandle) -> PickTwo.Result:
        def feedback(machine: GraspMachine, status: GraspStatus) -> None:
            which = self._requests.machines.index(machine)
            goal.publish_feedback(PickTwo.Feedback(request=which, status=status))

        requests = convert.requests_from_msg(goal.request)
        return convert.pair_result(await self._as_goal(goal, lambda: self._two(requests, feedback)))

    async def _as_goal(self, goal: ServerGoalHandle, work: Callable[[], Awaitable[AnswerT]]) -> AnswerT:
        """Carry a goal out; a cancel reaches the one that is being carried out."""
        mine = not self._requests.running
        if mine:
            self._goal = goal
        outcome = await work()
        if mine:
            self._goal = None
        if outcome.success:
            goal.succeed()
        elif goal.is_cancel_requested and outcome.code is Code.CANCELLED:
            goal.canceled()
        else:
            goal.abort()
        return outcome

    def _on_cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        if self._goal is None or goal.goal_id != self._goal.goal_id:
            return CancelResponse.REJECT
        self._requests.cancel()
        return CancelResponse.ACCEPT

    def _serve(self, kind: Any, name: str, execute: Callable[[ServerGoalHandle], Any]) -> ActionServer:
        return ActionServer(self, kind, name, execute_callback=execute, cancel_callback=self._on_cancel)

    # --- requests
    async def _one(self, request: GraspRequest, on_status: OnStatus | None = None) -> GraspOutcome:
        try:
            outcome = await self._requests.one(request, lambda machine: self._tell(machine, on_status))
        except OpenArmError as error:
            self._refused(f"grasp of {request.label!r}", error)
            return GraspOutcome(error.code, error.message, request.label)
        self._report(outcome)
        return outcome

    async def _two(self, requests: tuple[GraspRequest, GraspRequest], on_status: OnStatus) -> PairOutcome:
        try:
            outcome = await self._requests.two(requests, lambda machine: self._tell(machine, on_status))
        except OpenArmError as error:
            self._refused(f"grasp of {requests[0].label!r} and {requests[1].label!r}", error)
            return PairOutcome((), error.code, error.message)
        for answer in outcome.answers:
            self._report(answer)
        return outcome

    def _refused(self, what: str, error: OpenArmError) -> None:
        self.get_logger().warning(f"{what} refused: {error}")
        if error.code is Code.BUSY:
            return  # what runs tells of itself
        machine = self._requests.machines[0]
        self.diagnose(error.code is not Code.NOT_READY, f"{error.code}: {error.message}", state=machine.state.value)

    # --- telling
    def _report(self, outcome: GraspOutcome) -> None:
        """Say how a request ended."""
        report = f"{outcome.code}: {outcome.message} (arm {outcome.arm or '-'}, attempts {outcome.attempts})"
        self.get_logger().info(report) if outcome.success else self.get_logger().warning(report)
        machine = self._requests.machines[0]
        drift = machine.drift.of(self.config.camera)
        if drift.alarm:
            self.get_logger().error(drift.message)
        text = f"{drift.message}; {report}" if drift.alarm else report
        self.diagnose(not drift.alarm, text, state=machine.state.value, drift=drift.message)

    def _tell(self, machine: GraspMachine, on_status: OnStatus | None) -> None:
        """Say where a machine stands now."""
        t_ns = self._requests.now_ns
        status = convert.status_msg(machine, t_ns)
        self._status_topic.publish(status)
        if on_status is not None:
            on_status(machine, status)
        if status.state == State.IDLE.value:
            self._tell_of_others(machine, t_ns)
        change = f"{status.previous_state} -> {status.state} at {t_ns * 1e-9:.2f} s, attempt {status.attempt}"
        about = f"{status.label} " if status.label else ""
        self.get_logger().info(f"{about}{change}: {status.reason}")
        self.diagnose(True, f"{status.state}: {status.reason}", state=status.state, label=status.label, arm=status.arm)
        memory = machine.memory
        if memory is not None and machine.state in (State.PLAN, State.MOVE_TO_PREGRASP):
            chosen = memory.candidate.id if memory.candidate else ""
            refused = {o.id for o in memory.options.values() if o.arm == memory.arm and o.code not in ("", Code.OK)}
            self._marker_topic.publish(convert.candidate_markers(memory.offered, chosen, refused, t_ns))

    def _tell_of_others(self, idle: GraspMachine, t_ns: int) -> None:
        """The newest status is not that of one which has ended while the other is at work."""
        for machine in self._requests.machines:
            if machine is not idle and machine.memory is not None:
                self._status_topic.publish(convert.status_msg(machine, t_ns, again=True))


def main() -> None:
    """Run the node."""
    run(GraspNode)


if __name__ == "__main__":
    main()
