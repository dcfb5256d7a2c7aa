# SPDX-License-Identifier: Apache-2.0
"""The node `servo_node` of the motion node's process: MoveIt Servo's names, before `openarm_motion.servo.servo`.

Topics delta_twist_cmds, delta_joint_cmds and status, services start_servo, stop_servo, pause_servo and
switch_command_type, below /servo_node for all arms, and with two arms below /ARM/servo_node for each.
"""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from control_msgs.msg import JointJog
from geometry_msgs.msg import TwistStamped
from moveit_msgs.msg import ServoStatus
from moveit_msgs.srv import ServoCommandType
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from openarm_common.errors import Code, OpenArmError
from openarm_common.pacing import Pacer, PeriodMeter
from openarm_common.ros.convert import joints_from_msg, ns_to_stamp, stamp_to_ns, trajectory_to_msg
from openarm_common.ros.node import QOS_COMMAND, BaseNode
from openarm_common.ros.polled import Polled, Source
from openarm_motion.config import NoParameters, ServoingConfig
from openarm_motion.servo.arm_servo import ServoReport, ServoState
from openarm_motion.servo.servo import Servoing
from openarm_motion.timing.trajectory import Motion

if TYPE_CHECKING:
    from openarm_motion.service.motion_service import MotionService

#: How often is looked whether the surroundings have changed, s; and one of so many set points comes with a status.
_REFRESH, _TELL = 0.1, 5
#: From one look for commands to the next while none is taken, s: they are refused.
_IDLE = 0.05
#: Other threads of the process give way after this, s; by default they do after 5 ms.
_SWITCH = 0.0005

_TYPES = {ServoCommandType.Request.JOINT_JOG: "joint jog", ServoCommandType.Request.TWIST: "twist"}


class ServoNode(BaseNode[NoParameters]):
    """Servoing over ROS.

    Args:
        service: Service of the motion node.
        config: Parameters.
        controller: Name of the trajectory action of an arm, next to which its topic joint_trajectory is.
        check_hold: Refuses, by arm and goal, what would move an arm that another client holds.
    """

    def __init__(
        self,
        service: MotionService,
        config: ServoingConfig,
        controller: str,
        check_hold: Callable[[str, bytes], None],
        **kwargs: Any,
    ) -> None:
        super().__init__("servo_node", NoParameters, use_global_arguments=False, **kwargs)
        self.servo = Servoing(service, config, self._send)
        self._period_ns, self.check_hold = round(config.publish_period * 1e9), check_hold
        names = self.servo.names
        topic = f"{controller.rpartition('/')[0]}/joint_trajectory"
        self._outputs = {
            arm: self.create_publisher(JointTrajectory, topic.format(arm=arm), QOS_COMMAND) for arm in names
        }
        self._ends = [_End(self, "", names)]
        if len(names) > 1:
            self._ends += [_End(self, f"/{arm}", (arm,)) for arm in names]
        self._states = Polled(self, Source(JointState, "/joint_states", QOS_COMMAND))
        self._periods, self._refreshing, self._closing = PeriodMeter(), False, threading.Event()
        self._said: dict[str, ServoReport] = {}
        self.create_timer(_REFRESH, self._refresh, clock=self.steady_clock)  # pyright: ignore[reportArgumentType]
        self.create_timer(self.REPORT_PERIOD_S, self._report, clock=self.steady_clock)
        self._thread = threading.Thread(target=self._run, name="servo", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop, then as every node."""
        self._closing.set()
        self._thread.join(timeout=1.0)
        super().close()

    def tell(self, arm: str, report: ServoReport) -> None:
        """Publish what an arm does."""
        message = ServoStatus(code=int(report.status), message=report.text)
        for end in self._ends:
            if arm in end.arms:
                end.status.publish(message)

    def _run(self) -> None:
        """Take commands and give set points at their pace.

        Topics are polled here: the executor, which serves all nodes of the process, is late when there is much to do.
        """
        sys.setswitchinterval(_SWITCH)
        pacer, count = Pacer(self._period_ns, max_debt_ns=self._period_ns), 0
        while not self._closing.wait(0.0 if self.servo.started or self.servo.active else _IDLE):
            now_ns = time.monotonic_ns()
            wait_ns = pacer.wait_ns(now_ns)
            if wait_ns > 0:
                time.sleep(wait_ns * 1e-9)
                now_ns += wait_ns
            pacer.ticked(now_ns)
            try:
                self._listen()
                if self.servo.active:
                    self._periods.add(time.monotonic_ns())
                    self.servo.tick(time.monotonic())
                else:
                    self._periods.restart()
            except Exception as error:  # an arm must not go on, and the node has more to do than this
                self.get_logger().error(f"servoing ends: {error!r}\n{traceback.format_exc()}")
                self.servo.fail(f"{error!r}; call start_servo to go on")
            count += 1
            self._tell_all(every=count % _TELL == 0)

    def _listen(self) -> None:
        for message, at in self._states.take_timed():
            try:
                joints_from_msg(message)
            except OpenArmError:  # the motion node says so
                continue
            stamp_ns = stamp_to_ns(message.header.stamp)
            self.servo.hear(stamp_ns, dict(zip(message.name, message.position, strict=True)), at)
        for end in self._ends:
            end.listen()

    def _tell_all(self, *, every: bool = False) -> None:
        for arm, report in self.servo.reports().items():
            before = self._said.get(arm)
            if before is None or before.status != report.status or (every and self.servo.busy(arm)):
                self._said[arm] = report
                self.tell(arm, report)

    def _send(self, arm: str, motion: Motion, stamp_ns: int) -> None:
        message = trajectory_to_msg(motion.names, motion.t, motion.q, motion.v)
        message.header.stamp = ns_to_stamp(stamp_ns)
        self._outputs[arm].publish(message)

    async def _refresh(self) -> None:
        """Look at the surroundings while servoing is started."""
        if self._refreshing or not self.servo.started:
            return
        self._refreshing = True
        try:
            await self.servo.refresh()
        except OpenArmError as error:
            self.get_logger().warning(f"the arms do not move: {error.message}", throttle_duration_sec=5.0)
        finally:
            self._refreshing = False

    def _report(self) -> None:
        period = self._periods.figures()
        reports = self.servo.reports()
        halted = [one.text for one in reports.values() if one.status is ServoState.INVALID]
        self.diagnose(
            not halted,
            "; ".join(halted) or ("servoing" if self.servo.started else "not started"),
            started=", ".join(sorted(self.servo.started)) or "none",
            period_p50_ms=f"{period.p50_ms:.2f}",
            period_p99_ms=f"{period.p99_ms:.2f}",
            **{f"status_{arm}": f"{one.status.name}: {one.text}" for arm, one in reports.items()},
        )


class _End:
    """Topics and services of some arms.

    Args:
        node: Owner.
        prefix: Prefix of their names.
        arms: Arms that are commanded by them.
    """

    def __init__(self, node: ServoNode, prefix: str, arms: tuple[str, ...]) -> None:
        self._node, self.arms = node, arms
        #: The only type of commands that is taken; None: any.
        self._type: int | None = None
        name = f"{prefix}/servo_node"
        self._name = name
        self.status = node.create_publisher(ServoStatus, f"{name}/status", QOS_COMMAND)
        self._twists = Polled(node, Source(TwistStamped, f"{name}/delta_twist_cmds", QOS_COMMAND))
        self._jogs = Polled(node, Source(JointJog, f"{name}/delta_joint_cmds", QOS_COMMAND))
        node.create_service(Trigger, f"{name}/start_servo", self._on_start)
        node.create_service(Trigger, f"{name}/stop_servo", self._on_stop)
        node.create_service(SetBool, f"{name}/pause_servo", self._on_pause)
        node.create_service(ServoCommandType, f"{name}/switch_command_type", self._on_switch)

    def listen(self) -> None:
        """Take the commands that have come."""
        for message, at in self._twists.take_timed():
            self._answer("delta_twist_cmds", lambda m=message, at=at: self._take_twist(m, at))
        for message, at in self._jogs.take_timed():
            self._answer("delta_joint_cmds", lambda m=message, at=at: self._take_jog(m, at))

    async def _on_start(self, _: Any, response: Any) -> Any:
        try:
            await self._node.servo.start(self.arms)
            response.success, response.message = True, f"commands move {', '.join(self.arms)}"
        except OpenArmError as error:
            response.success, response.message = False, f"{error.code}: {error.message}"
        return response

    def _on_stop(self, _: Any, response: Any) -> Any:
        self._node.servo.stop(self.arms)
        response.success, response.message = True, f"{', '.join(self.arms)} come to rest; commands are refused"
        return response

    async def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        answer: SetBool.Response = (
            self._on_stop(request, response) if request.data else await self._on_start(request, response)
        )
        return answer

    def _on_switch(
        self, request: ServoCommandType.Request, response: ServoCommandType.Response
    ) -> ServoCommandType.Response:
        response.success = request.command_type in _TYPES
        if response.success:
            self._type = request.command_type
        else:
            valid = ", ".join(f"{number} ({name})" for number, name in _TYPES.items())
            text = f"{self._name}/switch_command_type: type {request.command_type} is not supported; valid: {valid}"
            self._node.get_logger().warning(text)
        return response

    def _take_twist(self, message: TwistStamped, at: float) -> None:
        linear, angular, frame = message.twist.linear, message.twist.angular, message.header.frame_id
        self._check_type(ServoCommandType.Request.TWIST)
        arm = self._arm_of(frame)
        self._node.check_hold(arm, b"")
        twist = np.array([linear.x, linear.y, linear.z, angular.x, angular.y, angular.z])
        self._node.servo.twist(arm, twist, frame, at)

    def _take_jog(self, message: JointJog, at: float) -> None:
        self._check_type(ServoCommandType.Request.JOINT_JOG)
        if message.displacements or message.duration:
            text = "displacements and duration are not supported, expected none; give velocities"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        arm = self._node.servo.arm_of(list(message.joint_names))
        if arm not in self.arms:
            text = f"joint_names are of the {arm} arm, expected joints of {', '.join(self.arms)}"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        self._node.check_hold(arm, b"")
        self._node.servo.jog(list(message.joint_names), list(message.velocities), at)

    def _answer(self, topic: str, take: Callable[[], None]) -> None:
        """Take a command; a refusal is a status, too."""
        try:
            take()
        except OpenArmError as error:
            self.status.publish(ServoStatus(code=int(ServoState.INVALID), message=f"{error.code}: {error.message}"))
            self._node.refuse(f"{self._name}/{topic}", error)

    def _check_type(self, given: int) -> None:
        if self._type not in (None, given):
            text = f"a {_TYPES[given]} came, expected {_TYPES[self._type or 0]}; call switch_command_type"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)

    def _arm_of(self, frame: str) -> str:
        """The arm that a twist in a frame moves."""
        if len(self.arms) == 1:
            return self.arms[0]
        moved = self._node.servo.arm_moving(frame)
        if moved is None:
            topics = ", ".join(f"/{arm}/servo_node/delta_twist_cmds" for arm in self.arms)
            text = f"frame_id {frame[:80]!r} says no arm; expected a frame of one, or a topic of one: {topics}"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        return moved
