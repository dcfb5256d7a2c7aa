# SPDX-License-Identifier: Apache-2.0
"""`openarm pick` beside a grasp node that hangs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from openarm_interfaces.action import Pick
from openarm_interfaces.msg import GraspStatus
from rclpy.action import CancelResponse
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from openarm_common.ros.actions import ActionServer


def test_a_second_ctrl_c_is_the_emergency_stop(ros, tmp_path: Path) -> None:
    node: Node = ros.add(Node("grasp"))
    asked: list[str] = []

    async def hang(handle) -> None:
        handle.publish_feedback(Pick.Feedback(status=GraspStatus(state="LIFT", label="red")))
        await Future()

    def ignore(_) -> CancelResponse:
        asked.append("cancel")
        return CancelResponse.ACCEPT

    def stop(_, response: Trigger.Response) -> Trigger.Response:
        asked.append("stop")
        response.success, response.message = True, "the arms hold"
        return response

    server = ActionServer(node, Pick, "/grasp/pick", hang, cancel_callback=ignore)
    node.create_service(Trigger, "/stop", stop)
    words = [sys.executable, "-m", "openarm_bringup.cli", "pick", "red", "--domain", os.environ["ROS_DOMAIN_ID"]]
    printed = tmp_path / "printed"
    with printed.open("w") as output:
        command = subprocess.Popen(words, stdout=output, stderr=output)
    try:
        ros.spin_until(lambda: "LIFT" in printed.read_text(), what="the state")
        command.send_signal(signal.SIGINT)
        ros.spin_until(lambda: "cancel" in asked, what="the cancel")  # sent again where the answer takes long
        command.send_signal(signal.SIGINT)
        ended = time.monotonic()
        ros.spin_until(lambda: command.poll() is not None, what="the end of the command")
        assert time.monotonic() - ended < 5.0
        assert list(dict.fromkeys(asked)) == ["cancel", "stop"]
        assert "openarm: STOPPED: emergency stop: the arms hold" in printed.read_text()
        assert command.returncode == 1
    finally:
        command.kill()
        command.wait()
        sys.stdout.write(printed.read_text())  # pytest shows it where the test fails
        server.destroy()
