# SPDX-License-Identifier: Apache-2.0
"""The thread that runs the controllers of a robot, simulated or real.

Everything that touches the controllers happens in this thread. Others hand it functions (`call`), which it runs between
two ticks; they never wait for a tick, and no tick waits for them.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

from openarm_common.errors import Code, OpenArmError
from openarm_control.controller import JointController
from openarm_control.joints import JointReadout
from openarm_control.trajectory import JointGroup

T = TypeVar("T")

_STOPPED = "the emergency stop is latched; when it is safe to move, `openarm stop --reset` releases it"


class ControlLoop(ABC):
    """Runs controllers, one control tick at a time.

    Args:
        name: Name of the thread.
        controller: While the thread runs, only functions given to `call` may touch it.
        crashed: Called when the thread ends by an unexpected error.

    Attributes:
        fault: Why no command is taken; empty: nothing is wrong.
        stopped: Whether the emergency stop is latched.
    """

    def __init__(
        self, name: str, controller: JointController, crashed: Callable[[Exception], None] | None = None
    ) -> None:
        self.controller = controller
        self.fault = ""
        self.stopped = False
        self._crashed = crashed
        self._calls: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._wake = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @abstractmethod
    def _read(self) -> JointReadout:
        """Return the present state of all joints.

        Raises:
            OpenArmError: NOT_READY, when it is not known.
        """

    @abstractmethod
    def _turn(self) -> float:
        """Do what is due; return for how long there is nothing to do, s."""

    def read_joints(self, group: JointGroup) -> JointReadout:
        """Return the present state of a group of joints. For `call`.

        Raises:
            OpenArmError: NOT_READY, when it is not known.
        """
        state = self._read()
        at = [self.controller.joint_names.index(name) for name in group.names]
        return JointReadout(state.t_ns, state.position[at], state.velocity[at], state.effort[at])

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread and wait for it; calls that still wait are cancelled."""
        self._stopping = True
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()
        while self._calls:
            self._calls.popleft()[1].cancel()

    def call(self, fn: Callable[[], T]) -> Future[T]:
        """Run a (short) function between two ticks; the future has its result within a tick or so."""
        future: Future[T] = Future()
        self._calls.append((fn, future))
        self._wake.set()
        return future

    def stop_motion(self) -> None:
        """Latch the emergency stop: all joints hold, and no goal and no command is taken. For `call`."""
        self.stopped = True
        self.controller.stop(_STOPPED)

    def release(self) -> str:
        """Release the emergency stop; return what still keeps the robot from moving, else nothing. For `call`."""
        self.stopped = False
        return ""

    def check_able(self) -> None:
        """Refuse commands after an emergency stop or a fault.

        Raises:
            OpenArmError: STOPPED; NOT_READY, with the fault.
        """
        if self.stopped:
            raise OpenArmError(Code.STOPPED, _STOPPED)
        if self.fault:
            raise OpenArmError(Code.NOT_READY, f"no command is taken: {self.fault}")

    # --- the thread
    def _run(self) -> None:
        try:
            while not self._stopping:
                self._run_calls()
                wait_s = self._turn()
                if wait_s > 0.0 and not self._calls and self._wake.wait(wait_s):
                    self._wake.clear()
        except Exception as error:  # a dead thread must not go unnoticed: the robot would just stop answering
            self.fault = f"the thread {self._thread.name} ended: {error!r}"
            if self._crashed is None:
                raise
            self._crashed(error)

    def _run_calls(self) -> None:
        while self._calls:
            fn, future = self._calls.popleft()
            if not future.set_running_or_notify_cancel():
                continue
            try:
                result = fn()
            except BaseException as error:  # handed to the caller, never dropped
                future.set_exception(error)
            else:
                future.set_result(result)
