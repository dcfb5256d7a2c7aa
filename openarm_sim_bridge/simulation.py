# SPDX-License-Identifier: Apache-2.0
"""The thread that steps the simulated robot in real time and reports every tick to those who publish it."""

from __future__ import annotations

import tempfile
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.pacing import Pacer, PeriodMeter, RateDivider, RealTimeFactor
from openarm_common.types import Array
from openarm_control.joints import JointReadout
from openarm_control.loop import ControlLoop
from openarm_sim_bridge.robot import SimulatedRobot

#: Stamps that are further than this from the wall clock, ns, are set to it.
_LATE_NS = 100_000_000


class Simulation(ControlLoop):
    """Steps a simulated robot in real time.

    Args:
        robot: The robot in its world; while the thread runs, only functions given to `call` may touch it.
        observe: Called with the joint states at the end of a tick, in the thread.
        speed: Simulated seconds per second of wall time; 0 is as fast as possible. Faster than real time, `observe` is
            called about once per tick period of wall time.
        wall_stamps: Simulated time is that of the wall clock, as of a robot whose messages are stamped by it.
        dump_folder: Receives the last second before physics diverged; None is the system's folder for temporary files.
        crashed: Called when the thread ends by an unexpected error.
        clock: Monotonic wall clock, ns.
    """

    #: Period in which a paused world reports its (unchanged) state, so that a pause is not taken for a failure.
    PAUSED_PERIOD_S = 0.1

    def __init__(
        self,
        robot: SimulatedRobot[Any],
        observe: Callable[[JointReadout], None],
        *,
        speed: float = 1.0,
        wall_stamps: bool = False,
        dump_folder: Path | None = None,
        crashed: Callable[[Exception], None] | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__("physics", robot.controller, crashed)
        self.robot = robot
        self.world = world = robot.world
        #: Injected faults; to be changed through `call` only.
        self.faults = robot.faults
        self.real_time_factor = RealTimeFactor()
        self.periods = PeriodMeter()
        self._observe = observe
        self._wall_stamps = wall_stamps
        self._dump_folder = dump_folder or Path(tempfile.gettempdir())
        self._history: deque[tuple[JointReadout, Array]] = deque(maxlen=max(1, 1_000_000_000 // world.period_ns))
        self._clock = clock
        self._pacer = Pacer(world.period_ns, speed)
        #: Faster than the wall clock, one tick in each of its periods is observed.
        self._slots = RateDivider(1e9 / world.period_ns) if speed == 0.0 or speed > 1.0 else None
        self._paused = False
        self._steps_left = 0
        self._stepped: Future[int] | None = None

    @property
    def paused(self) -> bool:
        """Whether simulated time is paused."""
        return self._paused

    @property
    def skipped_s(self) -> float:
        """Wall time that was given up because the machine was too slow, s."""
        return self._pacer.skipped_ns * 1e-9

    def _read(self) -> JointReadout:
        return self.world.read_joints()

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
    def _turn(self) -> float:
        """Do what is due; return for how long there is nothing to do, s."""
        if self.fault or (self._paused and not self._steps_left):
            self._idle()
            return self.PAUSED_PERIOD_S
        wait_ns = 0 if self._paused else self._pacer.wait_ns(self._clock())
        if wait_ns <= 0:
            self._tick(self._clock())
        return max(0.0, wait_ns * 1e-9)

    def _idle(self) -> None:
        """Report the state while simulated time is paused."""
        self._pacer.restart()
        self.periods.restart()
        self._observe(self.world.read_joints())

    def _tick(self, now_ns: int) -> None:
        world = self.world
        steps = min(world.steps_per_tick, self._steps_left) if self._paused else world.steps_per_tick
        self._pacer.ticked(now_ns)
        if self._wall_stamps and abs(lag_ns := time.time_ns() - world.t_ns) > _LATE_NS:
            world.shift_time(lag_ns)
            self._pacer.restart()  # what was made up now would run ahead, and stamps would go back
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
