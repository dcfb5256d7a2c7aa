# SPDX-License-Identifier: Apache-2.0
"""The thread that steps the simulated robot in real time and reports every tick to those who publish it.

Everything that touches the world or the controllers happens in this thread. Others hand it functions (`call`), which it
runs between two ticks; they never wait for physics, and physics never waits for them.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_sim_bridge.pacing import Pacer, PeriodMeter, RateDivider, RealTimeFactor
from openarm_sim_bridge.robot import SimulatedRobot
from openarm_sim_bridge.world.world import JointReadout

T = TypeVar("T")

_STOPPED = "the emergency stop is latched; when it is safe to move, call /mujoco_bridge/reset (`openarm stop --reset`)"


class Simulation:
    """Steps a simulated robot in real time.

    Args:
        robot: The robot in its world; while the thread runs, only functions given to `call` may touch it.
        observe: Called with the joint states at the end of a tick, in the thread.
        speed: Simulated seconds per second of wall time; 0 is as fast as possible. Faster than real time, `observe` is
            called about once per tick period of wall time.
        dump_folder: Receives the last second before physics diverged; None is the system's folder for temporary files.
        crashed: Called when the thread ends by an unexpected error.
        clock: Monotonic wall clock, ns.
    """

    #: Period in which a paused world reports its (unchanged) state, so that a pause is not taken for a failure.
    PAUSED_PERIOD_S = 0.1

    def __init__(
        self,
        robot: SimulatedRobot,
        observe: Callable[[JointReadout], None],
        *,
        speed: float = 1.0,
        dump_folder: Path | None = None,
        crashed: Callable[[Exception], None] | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.robot = robot
        self.world = world = robot.world
        self.controller = robot.controller
        #: Injected faults; to be changed through `call` only.
        self.faults = robot.faults
        self.real_time_factor = RealTimeFactor()
        self.periods = PeriodMeter()
        self.fault = ""
        #: Whether the emergency stop is latched.
        self.stopped = False
        self._observe = observe
        self._dump_folder = dump_folder or Path(tempfile.gettempdir())
        self._history: deque[tuple[JointReadout, Array]] = deque(maxlen=max(1, 1_000_000_000 // world.period_ns))
        self._crashed = crashed
        self._clock = clock
        self._pacer = Pacer(world.period_ns, speed)
        #: Faster than the wall clock, one tick in each of its periods is observed.
        self._slots = RateDivider(1e9 / world.period_ns) if speed == 0.0 or speed > 1.0 else None
        self._paused = False
        self._steps_left = 0
        self._stepped: Future[int] | None = None
        self._calls: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._wake = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="physics", daemon=True)

    @property
    def paused(self) -> bool:
        """Whether simulated time is paused."""
        return self._paused

    @property
    def skipped_s(self) -> float:
        """Wall time that was given up because the machine was too slow, s."""
        return self._pacer.skipped_ns * 1e-9

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
        if self._paused:
            self._wake.set()
        return future

    def set_paused(self, paused: bool) -> None:
        """Pause or resume simulated time. For `call`."""
        self._paused = paused
        self._end_stepping("the simulation was resumed" if not paused else "the simulation was paused again")

    def advance(self, steps: int) -> Future[int]:
        """Advance a paused world by physics steps, as fast as it can. For `call`.

        Returns:
            A future with the simulated time, ns, when all steps are done.

        Raises:
            OpenArmError: INVALID_ARGUMENT for no steps; NOT_READY when the world runs; BUSY when it steps already.
        """
        if steps < 1:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"steps is {steps}, expected 1 or more")
        if not self._paused:
            raise OpenArmError(Code.NOT_READY, "the simulation is running; pause it first with /sim/set_pause")
        if self._stepped is not None:
            raise OpenArmError(Code.BUSY, f"still stepping, {self._steps_left} steps to go; wait for the answer")
        self._steps_left, self._stepped = steps, Future()
        return self._stepped

    def restart(self, change: Callable[[], None]) -> None:
        """Reset or exchange the world and continue: forget goals and a divergence. For `call`."""
        change()
        self.fault = ""
        self._history.clear()
        self._end_stepping("the world was reset")
        self.robot.restart()

    # --- the thread
    def _run(self) -> None:
        try:
            self._loop()
        except Exception as error:  # a dead thread must not go unnoticed: the robot would just stop answering
            self.fault = f"the physics thread ended: {error!r}"
            if self._crashed is None:
                raise
            self._crashed(error)

    def _loop(self) -> None:
        while not self._stopping:
            wait_s = self._turn()
            if wait_s > 0.0 and not self._calls and self._wake.wait(wait_s):
                self._wake.clear()

    def _turn(self) -> float:
        """Do what is due: calls, and a tick; return for how long there is nothing to do, s."""
        self._run_calls()
        if self.fault or (self._paused and not self._steps_left):
            self._idle()
            return self.PAUSED_PERIOD_S
        wait_ns = 0 if self._paused else self._pacer.wait_ns(self._clock())
        if wait_ns <= 0:
            self._tick(self._clock())
        return max(0.0, wait_ns * 1e-9)

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

    def _idle(self) -> None:
        """Report the state while simulated time is paused."""
        self._pacer.restart()
        self.periods.restart()
        self._observe(self.world.read_joints())

    def _tick(self, now_ns: int) -> None:
        world = self.world
        steps = min(world.steps_per_tick, self._steps_left) if self._paused else world.steps_per_tick
        self._pacer.ticked(now_ns)
        try:
            self.robot.tick(steps)
        except OpenArmError as error:
            self._history.append((self.robot.state, self.robot.targets))
            self.fault = f"{error.message} {self._dump()}"
            self._end_stepping(self.fault)
            self.controller.abort(self.fault)
            return
        self._history.append((self.robot.state, self.robot.targets))
        self.real_time_factor.add(now_ns, world.t_ns)
        last = self._paused and steps == self._steps_left
        if self._slots is None or self._slots.due(now_ns) or last:
            self.periods.add(self._clock())
            self._observe(world.read_joints())
        if self._paused:
            self._steps_left -= steps
            if self._steps_left == 0 and self._stepped is not None:
                stepped, self._stepped = self._stepped, None
                stepped.set_result(world.t_ns)

    def stop_motion(self) -> None:
        """Latch the emergency stop: all joints hold, and no goal and no command is taken. For `call`."""
        self.stopped = True
        self.controller.stop(_STOPPED)

    def check_able(self) -> None:
        """Refuse commands after an emergency stop or a divergence.

        Raises:
            OpenArmError: STOPPED; NOT_READY, with the fault.
        """
        if self.stopped:
            raise OpenArmError(Code.STOPPED, _STOPPED)
        if self.fault:
            raise OpenArmError(Code.NOT_READY, f"no command is taken until the world is reset: {self.fault}")

    def _dump(self) -> str:
        """Write the last second to a file; return a sentence that names it."""
        states, targets = zip(*self._history, strict=True)
        columns: dict[str, Any] = {
            key: np.array([getattr(state, key) for state in states])
            for key in ("t_ns", "position", "velocity", "effort")
        }
        try:
            with tempfile.NamedTemporaryFile(
                dir=self._dump_folder, prefix="openarm_diverged_", suffix=".npz", delete=False
            ) as file:
                np.savez(file, joint_names=np.array(self.world.joint_names), target=np.array(targets), **columns)
        except OSError as error:
            return f"The last second could not be written to {self._dump_folder}: {error}."
        return f"The last second is in {file.name}."

    def _end_stepping(self, why: str) -> None:
        self._steps_left = 0
        if self._stepped is not None:
            stepped, self._stepped = self._stepped, None
            stepped.set_exception(OpenArmError(Code.CANCELLED, f"stepping ended early: {why}"))
