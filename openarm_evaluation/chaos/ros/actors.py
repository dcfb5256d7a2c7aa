# SPDX-License-Identifier: Apache-2.0
"""What each kind of fault does to a running graph."""

from __future__ import annotations

import ctypes
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import yaml
from geometry_msgs.msg import PoseStamped
from openarm_interfaces.srv import ClearFaults, ComputeIK, Grasp, InjectFault
from sensor_msgs.msg import JointState

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.client import BackgroundNode
from openarm_common.ros.convert import point
from openarm_common.ros.node import reliable
from openarm_evaluation.chaos.judge import Violation
from openarm_evaluation.chaos.schedule import Fault

#: Longest answer of a service in a flood, s, and how many ask at the same time.
_ANSWER_S, _ASKERS = 20.0, 4
_COMMANDS_HZ = 1000.0
_JOINT = "openarm_right_joint4"
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
        self._commands = self._node.create_publisher(JointState, "/joint_commands", reliable(10))

    def carry_out(self, fault: Fault) -> list[Violation]:
        """Do it, wait as long as it lasts, and undo it; return what was not answered meanwhile.

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
        elif fault.kind == "commands":
            self._flood_commands(fault.seconds)
        elif fault.kind == "services":
            return self._flood_services(fault.seconds)
        else:
            with _full(self._run):
                time.sleep(fault.seconds)
        return []

    def _flood_commands(self, seconds: float) -> None:
        hostile = (
            JointState(name=[_JOINT], position=[math.nan]),
            JointState(name=[_JOINT], position=[]),
            JointState(name=["elbow\n\x1b[2J"], position=[1.0]),
            JointState(name=[_JOINT], position=[math.inf]),
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
            (ComputeIK, "/motion/compute_ik", ComputeIK.Request(arm="right", pose=pose)),
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
