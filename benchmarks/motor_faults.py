# SPDX-License-Identifier: Apache-2.0
"""What the arms do when motors, buses or processes fail in the middle of a grasp, and how it is reset.

    python -m benchmarks.motor_faults [--only silent,power] [--out FOLDER] [--json PATH]

Starts the graph `real --emulate`. For each fault, the right arm picks the red cube of the scene `demo`; when it lifts
it, the fault begins. Printed are:

    still    from the fault until all joints of both arms are slower than 0.05 rad/s, for 0.3 s
    travel   of a joint meanwhile and until 3 s after the fault, at most; without the joint whose encoder lies
    answer   of the pick: when, code, sentence
    reset    until the arms follow again after the fault was ended and `/openarm_hardware/reset` was called
    moved    by a joint from the reset until then, at most

Joint states of each case, 100 Hz, are left in FOLDER/NAME.npz. They are those of the motors' encoders.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from diagnostic_msgs.msg import DiagnosticArray
from openarm_interfaces.srv import ClearFaults, InjectFault
from std_srvs.srv import Trigger

from benchmarks.report import Row, write_report
from openarm_bringup.supervision import environment, runs
from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.session import running_graph, work_until_stopped
from openarm_bringup.supervision.supervisor import Supervisor
from openarm_common.domain import reserve_domain
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import QOS_COMMAND
from openarm_common.scene.scene import load_scene
from openarm_evaluation.campaign.ros.graph import bring_home
from openarm_evaluation.judging.ros.observer import Observer
from openarm_evaluation.judging.trial import wait_scene
from openarm_grasp.ros.client import GraspClient, GraspResult

_NODE, _ARM = "openarm_hardware", "right"
_SLOW, _REST_S, _WATCHED_S = 0.05, 0.3, 3.0
_SPIN = "while True: pass"


@dataclass(frozen=True)
class Case:
    """A fault: parameters of `motor_fault`, or what is done to processes.

    Attributes:
        undo: What ends the fault, where it does not end by itself.
        lies: Position of the faulty joint in the arm, whose encoder says nothing true.
    """

    name: str
    parameters: str = ""
    undo: str = ""
    lies: int | None = None


def cases(joints: tuple[str, ...]) -> list[Case]:
    """Return all faults, of an arm with these joints."""
    elbow, shoulder = joints[3], joints[1]
    return [
        Case("silent", f"{{kind: silent, joint: {elbow}}}"),
        Case("error", f"{{kind: error, joint: {elbow}, value: 12}}"),
        Case("hot", f"{{kind: hot, joint: {elbow}, value: 95}}"),
        Case("lost frames", "{kind: loss, value: 0.2}"),
        Case("late frames", "{kind: late, value: 0.02}"),
        Case("frozen encoder", f"{{kind: freeze, joint: {shoulder}}}", lies=1),
        Case(
            "wrong zero",
            f"{{kind: zero, joint: {shoulder}, value: 0.3}}",
            lies=1,
            undo=f"{{kind: zero, joint: {shoulder}, value: -0.3}}",
        ),
        Case("bus off", f"{{kind: bus_off, joint: {elbow}}}"),
        Case("power cut", "{kind: power}"),
        Case("stop"),
        Case("node killed"),
        Case("node stopped 1 s"),
        Case("servo stopped 1 s"),
        Case("full run queue"),
        Case("servo killed"),
    ]


class Watch(Observer):
    """Also hears what the node says of itself."""

    def __init__(self, domain: int) -> None:
        super().__init__(domain)
        self.text, self.level = "", b"\2"
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_report, QOS_COMMAND)

    def _on_report(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(f"{_NODE}:"):
                with self._changed:
                    self.text, self.level = status.message, status.level
                    self._changed.notify_all()


class Bench:
    """A graph that runs."""

    def __init__(self, supervisor: Supervisor, observer: Watch, client: GraspClient, folder: Path) -> None:
        self._supervisor, self._observer, self._client, self._folder = supervisor, observer, client, folder

    def row(self, case: Case) -> dict[str, Any]:
        """Bring a fault into a grasp; return what came of it."""
        bring_home(self._client)
        wait_scene(self._observer, load_scene("demo"), self._observer.reset_world("demo", 0))
        answer = self._asked()
        self._observer.wait(
            lambda: any(s.state == "LIFT" for s in self._observer.steps()) or answer.done(), 90.0, "the state LIFT"
        )
        if answer.done():
            _, found = answer.result()
            raise OpenArmError(Code.EXECUTION_FAILED, f"the pick ended before it lifted: {found}")
        time.sleep(0.15)  # it moves upwards
        began_ns = time.time_ns()
        undo = self._begin(case)
        self._observer.wait(lambda: self._newest() > began_ns + _WATCHED_S * 1e9 or None, 60.0, "joint states")
        result, seconds = self._answered(answer, began_ns)
        times, positions = self._trace()
        np.savez(self._folder / f"{case.name.replace(' ', '_')}.npz", t_ns=times, began_ns=began_ns, position=positions)
        still, travel = _stopped(times, positions, began_ns, case.lies)
        said = self._observer.text
        undo()
        return {
            "name": case.name,
            "still_ms": still,
            "travel_rad": travel,
            "answer_ms": seconds * 1e3,
            "code": str(getattr(result, "code", "")),
            "message": str(getattr(result, "message", result)),
            "said": said,
            **self._reset(),
        }

    def _asked(self) -> Future[tuple[int, Any]]:
        future: Future[tuple[int, Any]] = Future()

        def work() -> None:
            try:
                found: GraspResult | OpenArmError = self._client.pick("red", arm=_ARM)
            except OpenArmError as error:
                found = error
            future.set_result((time.time_ns(), found))

        self._observer.forget()
        self._observer.joints()
        threading.Thread(target=work, daemon=True).start()
        return future

    def _answered(self, answer: Future[tuple[int, Any]], began_ns: int) -> tuple[Any, float]:
        at_ns, result = answer.result(90.0)
        return result, (at_ns - began_ns) * 1e-9

    def _begin(self, case: Case) -> Callable[[], None]:
        """Begin a fault; return what ends it."""
        if case.parameters:
            self._inject(case.parameters)

            def clear() -> None:
                if case.undo:
                    self._inject(case.undo)
                self._client.call(ClearFaults, "/sim/clear_faults", ClearFaults.Request())

            return clear
        node = self._supervisor.pid(_NODE)
        if case.name == "stop":
            self._client.call(Trigger, "/stop", Trigger.Request())
        elif case.name == "node killed":
            os.kill(node, signal.SIGKILL)
        elif case.name == "full run queue":
            busy = [subprocess.Popen([sys.executable, "-c", _SPIN]) for _ in range(8)]

            def end() -> None:
                for one in busy:
                    one.kill()
                    one.wait()

            return end
        else:
            pid = node if case.name.startswith("node") else _servo_of(node)
            os.kill(pid, signal.SIGKILL if case.name.endswith("killed") else signal.SIGSTOP)
            if not case.name.endswith("killed"):
                time.sleep(1.0)
                os.kill(pid, signal.SIGCONT)
        return lambda: None

    def _inject(self, parameters: str) -> None:
        request = InjectFault.Request(name="motor_fault", parameters=parameters, seed=1)
        answer = self._client.call(InjectFault, "/sim/inject_fault", request)
        assert answer.success, answer.message

    def _reset(self) -> dict[str, Any]:
        """Reset until the arms follow; return how long it took, and how far a joint moved."""
        now_ns = time.time_ns()
        with suppress(OpenArmError):  # what motors without power did is not of the reset
            self._observer.wait(lambda: self._newest() > now_ns or None, 3.0, "joint states")
        before = self._observer.joints()[-1][1]
        began = time.monotonic()
        ok = b"\0"
        while self._observer.level != ok or time.monotonic() - began < 1.5:  # a report that is newer than the fault
            if time.monotonic() - began > 40.0:
                return {"reset_s": float("nan"), "moved_rad": float("nan"), "left": self._observer.text}
            if self._observer.level != ok:
                try:
                    self._client.call(Trigger, f"/{_NODE}/reset", Trigger.Request(), 5.0)
                except OpenArmError:
                    time.sleep(0.5)
            time.sleep(0.3)
        after = self._observer.joints()[-1][1]
        return {"reset_s": time.monotonic() - began, "moved_rad": max(abs(after[j] - before[j]) for j in before)}

    def _newest(self) -> int:
        joints = self._observer.joints()
        return joints[-1][0] if joints else 0

    def _trace(self) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        joints = self._observer.joints()
        names = [name for name in joints[0][1] if "finger" not in name]
        times = np.array([t_ns for t_ns, _ in joints])
        return times, np.array([[q[name] for name in names] for _, q in joints])


def _stopped(
    times: np.ndarray[Any, Any], positions: np.ndarray[Any, Any], began_ns: int, lies: int | None
) -> tuple[float, float]:
    """Return the time until all joints rest, ms, and the most that one has moved, rad."""
    half = positions.shape[1] // 2
    kept = [i for i in range(positions.shape[1]) if lies is None or i % half != lies]
    at = int(np.searchsorted(times, began_ns))
    t, q = (times[at:] - began_ns) * 1e-9, positions[at:, kept]
    if len(t) < 10:
        return float("nan"), float("nan")
    window = t <= _WATCHED_S
    travel = float(np.abs(q[window] - q[0]).max())
    speed = np.abs(q[5:] - q[:-5]).max(axis=1) / np.maximum(t[5:] - t[:-5], 1e-3)
    for k in np.flatnonzero(speed < _SLOW):
        if (speed[(t[5:] >= t[k + 5]) & (t[5:] <= t[k + 5] + _REST_S)] < _SLOW).all():
            return float(t[k + 5] * 1e3), travel
    return float("nan"), travel


def _servo_of(node: int) -> int:
    return next(p.pid for p in psutil.Process(node).children() if "openarm_hardware.servo" in p.cmdline())


async def _run(only: list[str], folder: Path) -> list[dict[str, Any]]:
    overrides = {"domain": reserve_domain(), "scene": "demo"}
    graph = load_graph("real", overrides=overrides, emulate=True)
    folder.mkdir(parents=True, exist_ok=True)
    found = list[dict[str, Any]]()
    async with running_graph(graph, folder) as supervisor:
        await supervisor.wait_ready()
        with Watch(environment.domain_id(graph)) as observer, GraspClient() as client:
            bench = Bench(supervisor, observer, client, folder)
            from openarm_common.robot.description import RobotDescription

            joints = RobotDescription.load().arm_joints(_ARM)

            def work() -> None:
                for case in cases(joints):
                    if not only or case.name in only:
                        try:
                            found.append(row := bench.row(case))
                            print(_line(row), flush=True)
                        except OpenArmError as error:
                            print(f"{case.name:<18} {error}", flush=True)

            await work_until_stopped(supervisor, work, client.cancel)
    return found


def _line(row: dict[str, Any]) -> str:
    head = f"{row['name']:<18} still {row['still_ms']:6.0f} ms  travel {row['travel_rad']:.3f} rad"
    tail = f"reset {row['reset_s']:.1f} s  moved {row['moved_rad']:.3f} rad"
    said = f"\n    /diagnostics: {row['said']}" if row["said"] != "running" else ""
    return f"{head}  answer {row['answer_ms']:6.0f} ms {row['code']}  {tail}\n    {row['message']}{said}"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="names of faults, with commas")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    folder = options.out or runs.new_run_dir()
    rows = asyncio.run(_run([name for name in options.only.split(",") if name], folder))
    report = [
        Row(f"{key}, {row['name']}", float(row[key]), unit, "lower", None, n=1)
        for row in rows
        for key, unit in (("still_ms", "ms"), ("travel_rad", "rad"), ("answer_ms", "ms"), ("moved_rad", "rad"))
    ]
    write_report(report, options.json)


if __name__ == "__main__":
    main()
