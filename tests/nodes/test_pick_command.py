# SPDX-License-Identifier: Apache-2.0
"""`openarm pick` beside a grasp node that hangs."""

from __future__ import annotations

import os
import signal
import threading

import pytest
from openarm_interfaces.action import Pick
from openarm_interfaces.msg import GraspStatus
from rclpy.action import CancelResponse
from rclpy.node import Node
from rclpy.signals import install_signal_handlers, uninstall_signal_handlers
from rclpy.task import Future
from std_srvs.srv import Trigger

from openarm_bringup import cli
from openarm_common.ros.actions import ActionServer


def test_a_second_ctrl_c_is_the_emergency_stop(ros, capsys: pytest.CaptureFixture[str]) -> None:
    node: Node = ros.add(Node("grasp"))
    asked: list[str] = []

    async def hang(handle) -> None:
        asked.append("goal")
        handle.publish_feedback(Pick.Feedback(status=GraspStatus(state="LIFT", label="red")))
        await Future()

    def ignore(_) -> CancelResponse:
        asked.append("cancel")
        return CancelResponse.ACCEPT

    def stop(_, response: Trigger.Response) -> Trigger.Response:
        asked.append("stop")
        response.success, response.message = True, "the arms hold"
        return response

    def interrupted() -> None:
        """Press Ctrl-C when the goal runs, and again when it was cancelled and goes on."""
        for what in ("goal", "cancel"):
            while what not in asked:
                ros.executor.spin_once(timeout_sec=0.05)
                if ended.is_set():
                    return
            os.kill(os.getpid(), signal.SIGINT)
        while not ended.is_set():
            ros.executor.spin_once(timeout_sec=0.05)

    ended = threading.Event()
    server = ActionServer(node, Pick, "/grasp/pick", hang, cancel_callback=ignore)
    node.create_service(Trigger, "/stop", stop)
    spinning = threading.Thread(target=interrupted)
    spinning.start()
    uninstall_signal_handlers()  # those of rclpy would end the nodes of the test
    try:
        assert cli.run(["pick", "red", "--domain", os.environ["ROS_DOMAIN_ID"]]) == 1
    finally:
        install_signal_handlers()
        ended.set()
        spinning.join()
        server.destroy()
    assert list(dict.fromkeys(asked)) == ["goal", "cancel", "stop"]  # sent again where the answer takes long
    assert "openarm: STOPPED: emergency stop: the arms hold" in capsys.readouterr().err
