# SPDX-License-Identifier: Apache-2.0
"""What each kind of fault does to a running graph."""

from __future__ import annotations

import ctypes
import itertools
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from openarm_interfaces.action import MoveArm
from openarm_interfaces.srv import ClearFaults, ComputeIK, Grasp, InjectFault
from rcl_interfaces.msg import Log
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.client import BackgroundNode
from openarm_common.ros.convert import point
from openarm_common.ros.holds import TOPIC as HOLDS
from openarm_common.ros.node import reliable
from openarm_evaluation.chaos.judge import Violation
from openarm_evaluation.chaos.schedule import Fault

#: Longest answer of a service in a flood, s, and how many ask at the same time.
_ANSWER_S, _ASKERS = 20.0, 4
_COMMANDS_HZ, _INTRUDER_HZ = 1000.0, 50.0
#: A hold that was announced so long ago counts no more, s; a refusal is in the log so soon.
_HELD_S, _LOGGED_S = 0.6, 5.0
#: Of `mount(8)`, by the C library: Python offers neither unshare nor mount.
_CLONE_NEWNS, _MS_REC_PRIVATE = 0x20000, 0x4000 | 0x40000


def mount_small(folder: Path, mib: int = 32) -> bool:
    """Mount a small file system on a folder, for this process and its children only; False where that is not allowed.

    To be called in the main thread before anything is started.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    return (
        libc.unshare(_CLONE_NEWNS) == 0
        and libc.mount(b"none", b"/", None, _MS_REC_PRIVATE, None) == 0
        and libc.mount(b"tmpfs", os.fsencode(folder), b"tmpfs", 0, f"size={mib}m".encode()) == 0
    )


class Actors(BackgroundNode):
    """Carries out faults; a context manager.

    Args:
        domain: ROS_DOMAIN_ID of the graph.
        pid: Gives the process id of a node.
        run: Folder of the run, on a file system of its own if it is to be filled.
    """

    def __init__(self, domain: int, pid: Callable[[str], int], run: Path) -> None:
        super().__init__("openarm_chaos", domain=domain)
        self._pid, self._run = pid, run
        self._robot = RobotDescription.load()
        self._arm = self._robot.arm_names[-1]
        self._joint = self._robot.arm_joints(self._arm)[3]
        self._commands = self._node.create_publisher(JointState, "/joint_commands", reliable(10))
        self._holds: tuple[float, list[str]] = (0.0, [])
        self._refused = threading.Event()
        self._node.create_subscription(DiagnosticStatus, HOLDS, self._on_hold, reliable(10))
        self._node.create_subscription(Log, "/rosout", self._on_log, reliable(100))

    def carry_out(self, fault: Fault, holding: Callable[[], bool]) -> list[Violation]:
        """Do it, wait as long as it lasts, and undo it; return what was not answered as it should be.

        Args:
            fault: Fault to carry out.
            holding: Whether a request is in a state in which it holds an arm.

        Raises:
            OpenArmError: NOT_READY, when the node is not running.
        """
        if fault.injected is not None:
            name, parameters = fault.injected
            request = InjectFault.Request(name=name, parameters=yaml.safe_dump(dict(parameters)), seed=1)
            self.call(InjectFault, "/sim/inject_fault", request, _ANSWER_S)
            time.sleep(fault.seconds)
            self.call(ClearFaults, "/sim/clear_faults", ClearFaults.Request(), _ANSWER_S)
        elif fault.kind == "kill":
            os.kill(self._pid(fault.node), signal.SIGKILL)
        elif fault.kind == "stop":
            with _stopped(self._pid(fault.node)):
                time.sleep(fault.seconds)
        elif fault.share[0]:
            name, share = fault.share
            self._set(fault.node, name, share)
            time.sleep(fault.seconds)
            self._set(fault.node, name, 0.0)
        elif fault.kind == "intruder":
            return self._intrude(fault.seconds, holding)
        elif fault.kind == "rival":
            return self._compete(fault.seconds, holding)
        elif fault.kind == "commands":
            self._flood_commands(fault.seconds)
        elif fault.kind == "services":
            return self._flood_services(fault.seconds)
        else:
            with _full(self._run):
                time.sleep(fault.seconds)
        return []

    def _set(self, node: str, name: str, value: float) -> None:
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        result = self.call(SetParameters, f"/{node}/set_parameters", request, _ANSWER_S).results[0]
        if not result.successful:
            raise OpenArmError(Code.CONFIG_INVALID, f"{name} of {node}: {result.reason}")

    def _on_hold(self, message: DiagnosticStatus) -> None:
        self._holds = (time.monotonic(), [value.key for value in message.values])

    def _on_log(self, message: Log) -> None:
        if "/joint_commands refused" in message.msg and "is held by the grasp node (" in message.msg:
            self._refused.set()

    def _held(self, holding: Callable[[], bool]) -> list[str]:
        """The arms that the request holds."""
        since, arms = self._holds
        return arms if holding() and time.monotonic() - since < _HELD_S else []

    def _intrude(self, seconds: float, holding: Callable[[], bool]) -> list[Violation]:
        """Command joints of arms that are held; the answer's code says whether an arm left its path."""
        end, sent = time.monotonic() + seconds, 0
        self._refused.clear()
        while time.monotonic() < end and holding():
            for arm in self._held(holding):
                self._commands.publish(JointState(name=[self._robot.arm_joints(arm)[-1]], position=[0.5]))
                sent += 1
            time.sleep(1.0 / _INTRUDER_HZ)
        if sent < _INTRUDER_HZ / 2.0 or self._refused.wait(_LOGGED_S):
            return []
        text = f"{sent} /joint_commands to an arm that is held, and no refusal that names its holder"
        return [Violation("an arm that is held obeys its holder", text)]

    def _compete(self, seconds: float, holding: Callable[[], bool]) -> list[Violation]:
        """Ask for a grasp and for motions as another client; both are BUSY, and say with what."""
        found: list[Violation] = []
        end = time.monotonic() + seconds
        asked = itertools.cycle((self._ask_grasp, self._ask_motion))
        while time.monotonic() < end and (arms := self._held(holding)):
            try:
                what, code, text = next(asked)(arms[0])
            except OpenArmError as error:
                what, code, text = "a second client", error.code, error.message
            named = "grasp of" in text
            if self._held(holding) and (code != Code.BUSY or not named):
                found.append(Violation("an arm that is held obeys its holder", f"{what} got {code}: {text}"))
        return found

    def _ask_grasp(self, _: str) -> tuple[str, str, str]:
        answer = self.call(Grasp, "/grasp", Grasp.Request(label="another", dry_run=True), _ANSWER_S)
        return "/grasp", answer.code, answer.message

    def _ask_motion(self, arm: str) -> tuple[str, str, str]:
        goal = MoveArm.Goal(arm=arm, kind=MoveArm.Goal.NAMED, named="home")
        answer = self.do(MoveArm, "/motion/move", goal, timeout=_ANSWER_S)
        return "/motion/move", answer.code, answer.message

    def _flood_commands(self, seconds: float) -> None:
        hostile = (
            JointState(name=[self._joint], position=[math.nan]),
            JointState(name=[self._joint], position=[]),
            JointState(name=["elbow\n\x1b[2J"], position=[1.0]),
            JointState(name=[self._joint], position=[math.inf]),
        )
        end, k = time.monotonic() + seconds, 0
        while time.monotonic() < end:
            self._commands.publish(hostile[k % len(hostile)])
            k += 1
            time.sleep(1.0 / _COMMANDS_HZ)

    def _flood_services(self, seconds: float) -> list[Violation]:
        found: list[Violation] = []
        end = time.monotonic() + seconds
        pose = PoseStamped()
        pose.pose.position, pose.pose.orientation.w = point((0.3, -0.2, 0.5)), 1.0
        asks = (
            (ComputeIK, "/motion/compute_ik", ComputeIK.Request(arm=self._arm, pose=pose)),
            (ComputeIK, "/motion/compute_ik", ComputeIK.Request(arm="third\n")),
            (Grasp, "/grasp", Grasp.Request(label="x" * 10_000)),
        )

        def ask(k: int) -> None:
            while time.monotonic() < end:
                kind, name, request = asks[k % len(asks)]
                try:
                    self.call(kind, name, request, _ANSWER_S)
                except OpenArmError as error:
                    if error.code is Code.TIMEOUT:
                        found.append(Violation("every request is answered", f"{name} in a flood: {error}"))

        _together(ask, range(_ASKERS))
        return found


def _together(work: Callable[[int], None], numbers: Sequence[int]) -> None:
    threads = [threading.Thread(target=work, args=(k,), daemon=True) for k in numbers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


@contextmanager
def _stopped(pid: int) -> Iterator[None]:
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)


@contextmanager
def _full(folder: Path) -> Iterator[None]:
    """Fill the file system of a folder to its last byte."""
    path = folder / "filler"
    try:
        with path.open("wb", buffering=0) as file, suppress(OSError):
            while file.write(bytes(4096)):
                pass
        yield
    finally:
        path.unlink(missing_ok=True)
