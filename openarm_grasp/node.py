# SPDX-License-Identifier: Apache-2.0
"""The grasp node: /grasp (service, answers with the outcome), /grasp/pick (action), /grasp/status, /grasp/markers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from openarm_interfaces.action import Pick
from openarm_interfaces.msg import GraspStatus
from openarm_interfaces.srv import Grasp
from rclpy.action import CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.qos import QoSProfile
from visualization_msgs.msg import MarkerArray

from openarm_common.description import Side
from openarm_common.errors import Code, OpenArmError
from openarm_common.lockstep_node import NamedActionServer
from openarm_common.node import QOS_LATCHED, BaseNode, run
from openarm_common.scene import load_scene
from openarm_grasp import convert
from openarm_grasp.config import GraspConfig
from openarm_grasp.effects import GraspOutcome, GraspRequest
from openarm_grasp.executor import GraspExecutor
from openarm_grasp.legs import run_task
from openarm_grasp.machine import GraspMachine
from openarm_grasp.memory import Surroundings
from openarm_grasp.routing import ARMS
from openarm_grasp.states import State

OnStatus = Callable[[GraspStatus], None]

#: Latched, and deep enough that two transitions in a row both arrive.
_QOS_STATUS = QoSProfile(depth=20, reliability=QOS_LATCHED.reliability, durability=QOS_LATCHED.durability)


class GraspNode(BaseNode[GraspConfig]):
    """Serves one grasp at a time; asking for another while one runs is answered at once with BUSY."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("grasp", GraspConfig, **kwargs)
        shoulders = {arm: self._shoulder(arm) for arm in ARMS}
        self._machine = GraspMachine(Surroundings(self.config, load_scene(self.config.scene).table, shoulders))
        self._executor = GraspExecutor(self, self.config)
        self._running = False
        self._goal: ServerGoalHandle | None = None
        self._status_topic = self.create_publisher(GraspStatus, "/grasp/status", _QOS_STATUS)
        self._marker_topic = self.create_publisher(MarkerArray, "/grasp/markers", QOS_LATCHED)
        self.create_service(Grasp, "/grasp", self._on_grasp)
        self._pick = NamedActionServer(
            self, Pick, "/grasp/pick", execute_callback=self._on_pick, cancel_callback=self._on_cancel
        )
        self._tell(None)

    def close(self) -> None:
        """Stop listening and take the action down."""
        self._executor.close()
        self._pick.destroy()
        super().close()

    # --- callbacks
    async def _on_grasp(self, request: Grasp.Request, response: Grasp.Response) -> Grasp.Response:
        convert.fill_answer(response, await self._grasp(convert.request_from_msg(request), None))
        return response

    async def _on_pick(self, goal: ServerGoalHandle) -> Pick.Result:
        mine = not self._running
        if mine:
            self._goal = goal
        outcome = await self._grasp(
            convert.request_from_msg(goal.request), lambda status: goal.publish_feedback(Pick.Feedback(status=status))
        )
        if mine:
            self._goal = None
        result = Pick.Result()
        convert.fill_answer(result, outcome)
        if outcome.success:
            goal.succeed()
        elif goal.is_cancel_requested and outcome.code is Code.CANCELLED:
            goal.canceled()
        else:
            goal.abort()
        return result

    def _on_cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        if self._goal is None or goal.goal_id != self._goal.goal_id:
            return CancelResponse.REJECT
        self._executor.cancel()
        return CancelResponse.ACCEPT

    # --- one grasp
    async def _grasp(self, request: GraspRequest, on_status: OnStatus | None) -> GraspOutcome:
        if self._running:
            text = f"a grasp of {self._machine.label or 'an object'!r} is running; cancel it or wait until it has ended"
            return GraspOutcome(Code.BUSY, text, request.label)
        self._running = True
        try:
            await self._executor.begin(moves=not request.dry_run)
            return await self._run(request, on_status)
        except OpenArmError as error:
            self.get_logger().warning(f"grasp of {request.label!r} refused: {error}")
            self.diagnose(
                error.code is not Code.NOT_READY, f"{error.code}: {error.message}", state=self._machine.state.value
            )
            return GraspOutcome(error.code, error.message, request.label)
        finally:
            self._executor.end()
            self._running = False

    async def _run(self, request: GraspRequest, on_status: OnStatus | None) -> GraspOutcome:
        link = self._executor
        result = await run_task(self._machine, link.performer, link, request, lambda: self._tell(on_status))
        report = f"{result.code}: {result.message} (arm {result.arm or '-'}, attempts {result.attempts})"
        self.get_logger().info(report) if result.success else self.get_logger().warning(report)
        drift = self._machine.drift.of(self.config.camera)
        if drift.alarm:
            self.get_logger().error(drift.message)
        text = f"{drift.message}; {report}" if drift.alarm else report
        self.diagnose(not drift.alarm, text, state=self._machine.state.value, drift=drift.message)
        return result

    def _tell(self, on_status: OnStatus | None) -> None:
        machine, t_ns = self._machine, self._executor.now_ns
        status = convert.status_msg(machine, t_ns)
        self._status_topic.publish(status)
        if on_status is not None:
            on_status(status)
        if machine.memory is None and machine.outcome is None:
            return
        change = f"{status.previous_state} -> {status.state} at {t_ns * 1e-9:.2f} s, attempt {status.attempt}"
        self.get_logger().info(f"{change}: {status.reason}")
        self.diagnose(True, f"{status.state}: {status.reason}", state=status.state, label=status.label, arm=status.arm)
        memory = machine.memory
        if memory is not None and machine.state in (State.PLAN, State.MOVE_TO_PREGRASP):
            chosen = memory.candidate.id if memory.candidate else ""
            self._marker_topic.publish(convert.candidate_markers(memory.offered, chosen, t_ns))

    def _shoulder(self, arm: Side) -> tuple[float, float]:
        """(x, y) of the arm's first joint, base frame, m."""
        first = self.description.joint(self.description.arm_joints(arm)[0])
        T_base_shoulder = self.description.link_pose(first.parent, {}) @ first.T_parent_joint
        return float(T_base_shoulder[0, 3]), float(T_base_shoulder[1, 3])


def main() -> None:
    """Run the node."""
    run(GraspNode)


if __name__ == "__main__":
    main()
