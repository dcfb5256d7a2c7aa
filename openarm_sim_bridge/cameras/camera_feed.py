# SPDX-License-Identifier: Apache-2.0
"""The process that draws the cameras: started, fed with states, restarted when it dies, ended.

Drawing in software takes most of a core and, in the same process, keeps the interpreter from the thread that steps the
world; in a process of its own it can delay physics only through the scheduler of the machine.
"""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping

from openarm_common.pacing import RateDivider
from openarm_sim_bridge.cameras.handover import CameraReport, CameraSetup, StateSender, pair
from openarm_sim_bridge.faults.faults import Fault
from openarm_sim_bridge.world.world import Snapshot, World

_MODULE = "openarm_sim_bridge.ros.camera_node"
_AGAIN_S = 1.0
_END_S = 3.0


class CameraFeed:
    """Keeps a drawing process and feeds it.

    It ends when the bridge closes its end of the socket, however the bridge ended. A process that reports that it can't
    draw is not restarted: another one could not either.

    Args:
        setup: First message to it.
        environ: Its environment.
        first: A state to warm up with.
        on_fault: Called (from `poll`) with a sentence when it died or can't draw, with "" when it draws again.
        speed: Simulated seconds per second of wall time. Above 1 the cameras keep their rates on the wall clock.

    Attributes:
        rendered: Frames drawn so far, by camera.
        lost: Frames that could not be handed over.
        fault: Why there are no images.
        report: The newest report.
    """

    def __init__(
        self,
        setup: CameraSetup,
        environ: Mapping[str, str],
        first: Snapshot,
        on_fault: Callable[[str], None],
        speed: float = 1.0,
    ) -> None:
        self._setup = setup
        self._environ = dict(environ)
        self._first = first
        self._on_fault = on_fault
        self._ticks = {camera.name: RateDivider(camera.rate / max(1.0, speed)) for camera in setup.cameras}
        self._lock = threading.Lock()  # of the sender, which is exchanged when the process is started again
        self.rendered = self._earlier = {camera.name: 0 for camera in setup.cameras}
        self._died_at: float | None = None
        self._faults: tuple[Fault, ...] = ()
        self.lost = 0
        self.fault = ""
        self.report = CameraReport()
        self._start()

    @property
    def dropped(self) -> int:
        """Frames that were not drawn because the machine was too slow."""
        return self.lost + self.report.dropped

    def wait_ready(self, timeout_s: float) -> bool:
        """Wait until it has drawn a first frame of every camera, or can't; False when it took too long."""
        deadline = time.monotonic() + timeout_s
        while not (self.report.ready or self.fault):
            left_s = deadline - time.monotonic()
            if left_s <= 0.0:
                return False
            self._sender.wait(left_s)
            self.poll()
        return True

    def set_faults(self, faults: tuple[Fault, ...]) -> None:
        """Hand over all faults that are active from now on.

        Raises:
            OpenArmError: BUSY, when the process does not take them at present.
        """
        with self._lock:
            self._faults = faults
            self._sender.faults(faults)

    def tick(self, world: World) -> None:
        """Hand the tick over for the cameras that are due and watched; in the thread of the simulation, never waits."""
        watched = self.report.watched
        names = [name for name, ticks in self._ticks.items() if ticks.due(world.t_ns) and name in watched]
        if names:
            snapshot = world.snapshot()
            with self._lock:
                if not self._sender.offer(snapshot, names):
                    self.lost += len(names)

    def poll(self) -> None:
        """Take its reports and restart it when it died; for a timer of a few hertz."""
        if self._died_at is not None:
            if time.monotonic() - self._died_at > _AGAIN_S:
                self._start()
            return
        try:
            for report in self._sender.reports():
                self.report = report
                self.rendered = {name: n + report.rendered.get(name, 0) for name, n in self._earlier.items()}
                if report.fault != self.fault:
                    self.fault = report.fault
                    self._on_fault(report.fault)
        except EOFError:
            self._on_death()

    def close(self) -> None:
        """End it."""
        with self._lock:
            self._sender.close()
        self._wait()

    def _start(self) -> None:
        ours, theirs = pair()
        with self._lock:
            self._sender = StateSender(ours, self._setup)
            self._sender.offer(self._first, ())
            if self._faults:
                self._sender.faults(self._faults)
        self._process = subprocess.Popen(
            [sys.executable, "-m", _MODULE, str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            env=self._environ,
        )
        theirs.close()
        self._died_at = None

    def _on_death(self) -> None:
        with self._lock:
            self._sender.close()
            self._earlier = self.rendered
            self.lost += self.report.dropped
            self.report = CameraReport()
        code = self._wait()
        self._died_at = time.monotonic()
        self.fault = f"the process that draws ended with code {code}; it is started again"
        self._on_fault(self.fault)

    def _wait(self) -> int:
        try:
            return self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()
