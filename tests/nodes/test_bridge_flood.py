# SPDX-License-Identifier: Apache-2.0
"""The process of the bridge while a client floods it: it keeps its rate, or says that it does not."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from openarm_interfaces.srv import SetPause
from sensor_msgs.msg import JointState

from openarm_common.ros.node import QOS_COMMAND, reliable

#: What a client gone wild sends, s and messages a second: right ones, ones of bad sizes and values, bytes that are no
#: message, and messages of another type on a topic of the controller. It prints when it had sent how many.
FLOOD = """
import sys, time
import rclpy
from sensor_msgs.msg import JointState
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("flood")
publisher = node.create_publisher(JointState, "/joint_commands", 10)
other = node.create_publisher(String, "/right_joint_trajectory_controller/joint_trajectory", 10)
arm = [f"openarm_right_joint{i}" for i in range(1, 8)]
messages = [
    JointState(name=["openarm_right_joint4"], position=[1.2]),
    JointState(name=arm, position=[0.1]),
    JointState(name=arm, position=[float("nan")] * 7),
    JointState(name=["tail"], position=[1.0]),
    bytes([0, 1, 0, 0]) + bytes(8) + bytes([0, 0, 0, 0, 255, 255, 255, 127]),
]
rate, began, sent, told = float(sys.argv[1]), None, 0, 0.0
while True:
    if not publisher.get_subscription_count():
        time.sleep(0.01)
        continue
    began = began or time.monotonic()
    due = int((time.monotonic() - began) * rate)
    for i in range(sent, due):
        publisher.publish(messages[i % len(messages)])
    other.publish(String(data="go"))
    sent = due
    if time.monotonic() > told + 0.1:
        told = time.monotonic()
        print(told, sent, flush=True)
    time.sleep(0.0005)
"""


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.requirement("N-23")
def test_four_thousand_commands_a_second_leave_the_rate_or_are_reported(ros, tmp_path) -> None:
    published: list[int] = []
    ros.node.create_subscription(
        JointState,
        "/joint_states",
        lambda _raw, info: published.append(info["source_timestamp"]),
        reliable(1000),  # what a busy probe takes late is not lost
        raw=True,
    )
    diagnostics = ros.hear(DiagnosticArray, "/diagnostics", QOS_COMMAND)

    def status() -> dict:
        if not diagnostics:
            return {}
        (last,) = diagnostics[-1].status
        return {"message": last.message, "ok": last.level == DiagnosticStatus.OK} | {
            v.key: v.value for v in last.values
        }

    log, told = (tmp_path / "log").open("w"), (tmp_path / "told").open("w")  # a pipe would hold up who writes to it

    def run(*command: str) -> subprocess.Popen:
        return subprocess.Popen([sys.executable, *command], stdout=told, stderr=log, env=os.environ)

    def sent() -> tuple[float, int]:
        """When the flood last said how many commands it had sent, and how many."""
        moment, count = (tmp_path / "told").read_text().rpartition("\n")[0].rpartition("\n")[2].split()
        return float(moment), int(count)

    bridge = run("-m", "openarm_sim_bridge.ros.node", "--ros-args", "-p", "scene:=empty", "-p", "images:=false")
    flood: subprocess.Popen | None = None
    try:
        ros.spin_until(lambda: published and diagnostics, what="the bridge")
        flood = run("-c", FLOOD, "4000")
        ros.spin_until(lambda: int(status().get("commands_per_s", 0)) > 300, what="the flood to be counted")
        published.clear()
        heard = len(diagnostics)
        begin = sent()
        ros.spin_until(lambda: len(published) > 1000, what="as many joint states as a report is about")
        periods = np.diff(published) * 1e-6
        end = sent()
        assert end[1] - begin[1] > 3000.0 * (end[0] - begin[0]) > 0.0, "no flood"
        reports = len(diagnostics)
        ros.spin_until(lambda: len(diagnostics) >= reports + 2, what="/diagnostics")
        mean, p99 = periods.mean(), np.percentile(periods, 99)
        kept = abs(mean - 10.0) < 0.2 and p99 <= 17.0  # 15 is reported, which is measured before they are published
        said = [report.status[0].message for report in diagnostics[heard:]]
        assert kept or any(message.startswith(("late", "slower")) for message in said), (mean, p99, said, status())
        # It still listens to others.
        assert ros.call(ros.node.create_client(SetPause, "/sim/set_pause"), SetPause.Request(paused=True)).success
        ros.spin_until(lambda: status()["message"] == "paused", what="the pause on /diagnostics")
        bridge.send_signal(signal.SIGINT)
        code = bridge.wait(timeout=60.0)
        errors = (tmp_path / "log").read_text()
        assert code == 0, errors[-2000:]
        assert "1 positions, expected as many" in errors  # said once a second, not four thousand times
        assert errors.count("refused") < 60
    finally:
        for process in (bridge, flood):
            if process is not None:
                process.kill()
                process.wait()
        log.close()
        told.close()
