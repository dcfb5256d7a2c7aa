# SPDX-License-Identifier: Apache-2.0
"""How soon an arm holds after the emergency stop, and after the death or hang of the node that moves it.

    python benchmarks/graph_stop.py [--runs N] [--json PATH]

Starts the graph `sim` and has the right arm swing at about 1 rad/s; in mid-swing something happens. Each case is run N
times without and N times with two busy processes a core:

    stop               /stop is called
    stop, all hang     as before, while motion, grasp, flight recorder and supervisor are stopped by SIGSTOP
    motion killed      SIGKILL of motion; its client waits for the goal
    motion hangs       SIGSTOP of motion for 3 s

    answer   from the call to the answer; for a kill or hang: until the client knew
    hold     until the reference of the joints stays where it is (controller_state, to its period); wall clock
    travel   of a joint after the call, at most: an arm that holds at once still rings by 11 mrad from 0.7 rad/s
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from control_msgs.msg import JointTrajectoryControllerState
from std_srvs.srv import Trigger

from benchmarks.report import Row, write_report
from openarm_bringup.supervision import runs
from openarm_common.domain import reserve_domain
from openarm_common.errors import OpenArmError
from openarm_common.ros.node import QOS_COMMAND
from openarm_common.types import Array
from openarm_motion.ros.client import MotionClient

_ROOT = Path(__file__).parents[1]
_ARM = "right"
_SWING = np.array([0.9, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


class Client(MotionClient):
    """Moves the right arm and hears the state of its controller with the time of its publication."""

    def __init__(self) -> None:
        super().__init__()
        #: Time of publication, ns, reference, positions and velocities.
        self._heard: list[tuple[int, Array, Array, Array]] = []
        topic = f"/{_ARM}_joint_trajectory_controller/controller_state"
        self._node.create_subscription(JointTrajectoryControllerState, topic, self._take, QOS_COMMAND)

    def _take(self, message: JointTrajectoryControllerState, info: dict[str, int]) -> None:
        reference, q, dq = (
            np.array(values)
            for values in (message.reference.positions, message.feedback.positions, message.feedback.velocities)
        )
        self._heard.append((info["source_timestamp"], reference, q, dq))

    def wait(self, condition: Callable[[], bool], seconds: float, what: str) -> None:
        """Wait until a condition holds."""
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"{what} within {seconds:g} s")
            time.sleep(0.002)

    def state(self) -> tuple[int, Array, Array, Array]:
        """Return the newest time, ns, reference, positions and velocities."""
        self.wait(lambda: bool(self._heard), 20.0, "the state of the controller")
        return self._heard[-1]

    def held_after(self, t0_ns: int) -> tuple[float, float]:
        """Return when the reference last changed, ms after a time of the wall clock, and how far a joint went, mrad."""
        self.wait(lambda: self.state()[0] > t0_ns + 1_500_000_000, 30.0, "1.5 s of the state")
        heard = [one for one in list(self._heard) if one[0] <= t0_ns + 1_500_000_000]
        before = [q for t, _, q, _ in heard if t <= t0_ns][-1]
        after = [one for one in heard if one[0] > t0_ns]
        moving = [t for t, reference, _, _ in after if np.abs(reference - after[-1][1]).max() > 1e-6]
        travel = max(float(np.abs(q - before).max()) for _, _, q, _ in after)
        return (moving[-1] - t0_ns) * 1e-6 if moving else 0.0, 1e3 * travel

    def swinging(self, sign: float) -> tuple[threading.Thread, list[tuple[int, str]]]:
        """Begin a swing; return its thread and, when it has ended, the time and what was answered."""
        self._heard.clear()
        target, ended = self.state()[2] + sign * _SWING, []

        def move() -> None:
            try:
                answer = str(self.move_to_joints(_ARM, target, scale=0.6).code)
            except OpenArmError as error:
                answer = str(error.code)
            ended.append((time.time_ns(), answer))

        thread = threading.Thread(target=move, daemon=True)
        thread.start()
        self.wait(lambda: abs(self.state()[3][0]) > 0.6, 30.0, "a swing")
        return thread, ended


@contextmanager
def graph(domain: int, folder: str) -> Iterator[int]:
    """A running graph; gives the process id of its supervisor."""
    command = [sys.executable, "-m", "openarm_bringup.cli", "up", "sim", "--domain", str(domain)]
    environ = os.environ | {"OPENARM_RUNS": folder, "PYTHONPATH": str(_ROOT)}
    process = subprocess.Popen(command, env=environ, stdout=subprocess.DEVNULL)
    try:
        yield process.pid
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30.0)


def ready(domain: int) -> runs.RunRecord:
    """Wait until all nodes of the graph are ready."""
    deadline = time.monotonic() + 120.0
    while time.monotonic() < deadline:
        found = [one for one in runs.running() if one.domain == domain and one.ready]
        if found and all(node.state == "ready" for node in found[0].nodes.values()):
            return found[0]
        time.sleep(0.2)
    raise TimeoutError("the graph is not ready within 120 s")


@contextmanager
def hanging(pids: list[int]) -> Iterator[None]:
    """Processes that hang."""
    with ExitStack() as stack:
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
            stack.callback(os.kill, pid, signal.SIGCONT)
        yield


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Processes that use all they get."""
    burning = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in burning:
            process.kill()
            process.wait()


def stopped(client: Client, pids: list[int], sign: float) -> tuple[float, float, float]:
    """Answer and hold of /stop in mid-swing, ms, and travel, mrad, while processes hang."""
    for name in ("/stop", "/mujoco_bridge/reset"):  # a client that is ready to stop
        client.call(Trigger, name, Trigger.Request(), 10.0)
    thread, ended = client.swinging(sign)
    with hanging(pids):
        t0 = time.time_ns()
        answer = client.call(Trigger, "/stop", Trigger.Request(), 10.0)
        answered = (time.time_ns() - t0) * 1e-6
        if not answer.success:
            raise RuntimeError(answer.message)
        held = client.held_after(t0)
    thread.join(30.0)
    if not ended or ended[0][1] not in ("STOPPED", "NOT_READY" if pids else "STOPPED"):
        raise RuntimeError(f"the goal ended with {ended}, expected STOPPED")
    client.call(Trigger, "/mujoco_bridge/reset", Trigger.Request(), 10.0)
    return answered, *held


def lost(client: Client, pid: int, sign: float, kill: bool) -> tuple[float, float, float]:
    """Until the client knew, and hold, ms, and travel, mrad, after motion died or hung."""
    thread, ended = client.swinging(sign)
    t0 = time.time_ns()
    if kill:
        os.kill(pid, signal.SIGKILL)
        held = client.held_after(t0)
    else:
        with hanging([pid]):
            held = client.held_after(t0)
            client.wait(lambda: time.time_ns() - t0 > 3_000_000_000, 5.0, "3 s")
    thread.join(60.0)
    return ((ended[0][0] - t0) * 1e-6 if ended else float("inf")), *held


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5, help="of each case")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    domain = reserve_domain()
    os.environ |= {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    measured: dict[str, list[tuple[float, float, float]]] = {}
    sign = 1.0
    with tempfile.TemporaryDirectory() as folder, graph(domain, folder) as supervisor:
        ready(domain)
        for load in (0, 2 * (os.cpu_count() or 1)):
            for case in ("stop", "stop, all hang", "motion killed", "motion hangs"):
                for _ in range(args.runs):
                    # a client of its own: what hung or died under it is no part of the next case
                    with Client() as client:
                        at = ready(domain).nodes
                        # a motion node that hung takes a moment to end what it was doing
                        client.wait(lambda c=client: c.move_to_named(_ARM, "home").success, 30.0, "the way home")
                        with busy(load):
                            figures = _one(client, case, at, supervisor, sign)
                    measured.setdefault(f"{case}, {'load' if load else 'idle'}", []).append(figures)
                    answer, hold, travel = figures
                    text = f"answer {answer:.1f} ms, hold {hold:.1f} ms, travel {travel:.0f} mrad"
                    print(f"{case}, {load} busy: {text}", flush=True)
    rows: list[Row] = []
    for case, figures in measured.items():
        target = 50.0 if case.startswith("stop") else 200.0
        for k, (what, unit) in enumerate((("answer", "ms"), ("hold", "ms"), ("travel", "mrad"))):
            values = [one[k] for one in figures]
            best = target if what == "hold" else None
            rows.append(Row(f"{case}: {what}, median", statistics.median(values), unit, "lower", best, n=len(values)))
            rows.append(Row(f"{case}: {what}, worst", max(values), unit, "lower", best, n=len(values)))
    write_report(rows, args.json)


def _one(client: Client, case: str, nodes: dict[str, Any], supervisor: int, sign: float) -> tuple[float, float, float]:
    if case == "stop":
        return stopped(client, [], sign)
    if case == "stop, all hang":
        pids = [nodes[name].pid for name in ("motion", "grasp", "flight_recorder")]
        return stopped(client, [*pids, supervisor], sign)
    return lost(client, nodes["motion"].pid, sign, case == "motion killed")


if __name__ == "__main__":
    main()
