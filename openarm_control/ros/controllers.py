# SPDX-License-Identifier: Apache-2.0
"""All by which a robot is commanded: the actions of arms and grippers, /joint_commands, the emergency stop."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from openarm_common.errors import OpenArmError
from openarm_common.printable import brief
from openarm_common.ros.holds import HoldListener
from openarm_common.ros.node import QOS_COMMAND, BaseNode
from openarm_control.controller import RobotController
from openarm_control.gripper import GripperAction
from openarm_control.joints import carriers
from openarm_control.loop import ControlLoop
from openarm_control.ros.gripper_server import GripperServer
from openarm_control.ros.trajectory_server import TrajectoryServer
from openarm_control.servos import KnownServos

#: So many unknown joints of commands are named in the log.
_NAMED = 20
#: Identified servos that are stored are in use after this long, s.
_STORE_PERIOD_S = 1.0


class Controllers:
    """Serves the controllers of a robot.

    Args:
        node: Owner.
        loop: Loop whose thread runs them.
        controller: Controller of all joints.
        servos: Servos that carry the arms.
        gripper_action: Type of `gripper_cmd`.
        prefix: Prefix of the names of the actions and topics of arms and grippers.
    """

    def __init__(
        self,
        node: BaseNode[Any],
        loop: ControlLoop,
        controller: RobotController,
        servos: KnownServos,
        gripper_action: GripperAction,
        prefix: str = "",
    ) -> None:
        self._node, self._loop, self._controller, self._servos = node, loop, controller, servos
        node.create_subscription(JointState, "/joint_commands", self._on_command, QOS_COMMAND)
        self.holds = HoldListener(node)
        self._arms = [
            TrajectoryServer(node, prefix, side, arm, loop, partial(self.holds.check, side))
            for side, arm in controller.arms.items()
        ]
        self._grippers = [
            GripperServer(node, prefix, side, gripper, loop, partial(self.holds.check, side), gripper_action)
            for side, gripper in controller.grippers.items()
        ]
        node.create_service(Trigger, "/stop", self._on_stop)
        node.create_service(Trigger, "~/reset", self._on_reset)
        node.create_timer(_STORE_PERIOD_S, self._update_servos, clock=node.steady_clock)
        node.get_logger().info(f"servos: {servos}")
        self._warned: set[str] = set()
        self._commands = 0  # since the last report

    def destroy(self) -> None:
        """Take the actions away."""
        for server in (*self._arms, *self._grippers):
            server.destroy()

    def publish_states(self) -> None:
        """Publish the state of the arms' controllers at the end of a tick, in the thread of the loop."""
        for arm in self._arms:
            arm.publish_state()

    def values(self) -> Mapping[str, object]:
        """Return what /diagnostics says of them; once a second."""
        commands, self._commands = self._commands, 0
        return {
            **{f"servos_{side}": text for side, text in self._servos.sources.items()},
            **{f"payload_{side}_kg": f"{arm.carrier.payload:.2f}" for side, arm in self._controller.arms.items()},
            "commands_per_s": commands,
            "refused_of_held_arms": self.holds.refused,
        }

    def _update_servos(self) -> None:
        """Carry the arms by servos that were identified meanwhile."""
        if self._servos.update():
            config = next(iter(self._controller.arms.values())).carrier.config
            found = carriers(self._node.description, config, self._servos.models)
            self._loop.call(lambda: self._controller.carry_by(found))
            self._node.get_logger().info(f"servos: {self._servos}")

    def _on_command(self, message: JointState) -> None:
        """Follow position targets of some or all joints."""
        self._commands += 1
        controller, logger = self._controller, self._node.get_logger()
        try:
            self._loop.check_able()
            command = controller.check_command(message.name, message.position)
            for side in controller.sides(command):
                self.holds.check(side)
        except OpenArmError as error:
            logger.error(f"/joint_commands refused: {error}", throttle_duration_sec=1.0)
            return
        for name in sorted(set(command.unknown) - self._warned)[: _NAMED - len(self._warned)]:
            self._warned.add(name)
            known = ", ".join(controller.joint_names)
            logger.warning(f"/joint_commands: unknown joint {brief(name)} is ignored; joints: {known}")
        busy = controller.busy(command)
        if busy:
            names = ", ".join(busy)
            logger.warning(f"/joint_commands: {names} follow a goal; ignored until it ends", throttle_duration_sec=1.0)
        self._loop.call(lambda: controller.command(command))

    async def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Emergency stop; the answer says that the joints hold."""
        await self._node.awaitable(self._loop.call(self._loop.stop_motion))
        response.success, response.message = True, "arms and hands hold; `openarm stop --reset` releases them"
        self._node.get_logger().error(f"emergency stop: {response.message}")
        return response

    async def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Release the emergency stop."""
        stopped = self._loop.stopped
        kept: str = await self._node.awaitable(self._loop.call(self._loop.release))
        done = "the emergency stop is released" if stopped else "it was not latched"
        response.success, response.message = not kept, kept or done
        self._node.get_logger().warning(response.message)
        return response
