# SPDX-License-Identifier: Apache-2.0
"""The process that draws the cameras: started, fed with states, restarted when it dies, ended.

Drawing in software takes most of a core and, in the same process, keeps the interpreter from the thread that steps the
world; in a process of its own it can delay physics only through the scheduler of the machine.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping

from openarm_common import ports
from openarm_common.camera.cameras import CameraConfig
from openarm_common.forked import run_and_exit
from openarm_common.pacing import AdaptiveShare, RateDivider
from openarm_sim_bridge.cameras.handover import CameraReport, CameraSetup, StateSender, pair
from openarm_sim_bridge.faults.faults import Fault
from openarm_sim_bridge.world.world import Snapshot, World

_MODULE = "openarm_sim_bridge.ros.camera_node"
_AGAIN_S = 1.0
_END_S = 3.0
#: However slow the machine is, a camera is drawn so often, Hz of simulated time.
_LEAST_HZ = 5.0


class SpareProcess:
    """A process that waits for its first message, forked while this one has no thread, participant or GL context yet.

    It has imported what drawing needs, so that the first images come a second sooner.

    Args:
        serve: Function that it runs, given its end of the socket.
    """

    def __init__(self, serve: Callable[[socket.socket], None]) -> None:
        self.ours, theirs = pair()
        self.pid = os.fork()
        if self.pid == 0:
            self.ours.close()
            run_and_exit(lambda: serve(theirs))
        theirs.close()

    def release(self) -> None:
        """End it: nothing is to be drawn."""
        self.ours.close()
        self.wait()

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end, s; return its exit code, as `subprocess.Popen.wait`."""
        deadline = math.inf if timeout is None else time.monotonic() + timeout
        while (ended := os.waitpid(self.pid, os.WNOHANG)) == (0, 0):
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired(_MODULE, timeout or 0.0)
            time.sleep(0.01)
        return os.waitstatus_to_exitcode(ended[1])

    def kill(self) -> None:
        """Kill it."""
        os.kill(self.pid, signal.SIGKILL)


class RenderedFeed:
    """Keeps a drawing process and feeds it.

    It ends when the bridge closes its end of the socket, however the bridge ended. A process that reports that it can't
    draw is not restarted: another one could not either.

    Args:
        setup: First message to it.
        environ: Its environment.
        first: A state to warm up with.
        on_fault: Called (from `poll`) with a sentence when it died or can't draw, with "" when it draws again.
        speed: Simulated seconds per second of wall time. Above 1 the cameras keep their rates on the wall clock.
        spare: A process that has not drawn yet, to begin with.

    On a machine that is too slow for all frames, fewer are drawn; simulated time does not wait for them.

    Attributes:
        rates: Frames a second of each camera that are drawn at present, Hz; 0: no subscriber needs one.
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
        spare: SpareProcess | None = None,
    ) -> None:
        self._setup = setup
        self._environ = dict(environ)
        self._first = first
        self._on_fault = on_fault
        self._speed = max(1.0, speed)
        self._share = AdaptiveShare()
        self.rates = {camera.name: 0.0 for camera in setup.cameras}
        self._ticks = {name: RateDivider(1.0) for name in self.rates}
        self._lock = threading.Lock()  # of the sender and the rates, which change when the process is started again
        self.rendered = self._earlier = {camera.name: 0 for camera in setup.cameras}
        self._died_at: float | None = None
        #: UDP ports of the process, and those of the one that died before it.
        self._ports: frozenset[int] = frozenset()
        self._held = contextlib.ExitStack()
        self._faults: tuple[Fault, ...] = ()
        self.lost = 0
        self.fault = ""
        self.report = CameraReport()
        self._process: subprocess.Popen[bytes] | SpareProcess
        self._start(spare)

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
        """Hand the tick over for the cameras that are due; in the thread of the simulation, never waits."""
        with self._lock:
            names = [name for name, ticks in self._ticks.items() if ticks.due(world.t_ns) and self.rates[name] > 0.0]
            if names and not self._sender.offer(world.snapshot(), names):
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
                self._pace()
                if report.ready and not self._ports:
                    self._ports = ports.used_by(self._process.pid, int(self._environ["ROS_DOMAIN_ID"]))
                if report.fault != self.fault:
                    self.fault = report.fault
                    self._on_fault(report.fault)
        except EOFError:
            self._on_death()

    def _pace(self) -> None:
        """Draw at the rate that subscribers need and the machine can draw."""
        share = self._share.update(sum(self.rendered.values()), self.dropped)
        for camera in self._setup.cameras:
            rate = min(self._wanted(camera), max(_LEAST_HZ, share * camera.rate))
            if rate not in (0.0, self.rates[camera.name]):
                self._ticks[camera.name] = RateDivider(rate / self._speed)
            self.rates[camera.name] = rate

    def _wanted(self, camera: CameraConfig) -> float:
        return min(camera.rate, self.report.rates.get(camera.name, 0.0))

    @property
    def limited(self) -> str:
        """Says which cameras the machine does not draw as often as subscribers need; empty when it does."""
        wanted = ((camera.name, self._wanted(camera)) for camera in self._setup.cameras)
        slow = [f"{name} at {self.rates[name]:.0f} of {hz:.0f} Hz" for name, hz in wanted if self.rates[name] < hz]
        return f"this machine draws no faster: {', '.join(slow)}" if slow else ""

    def close(self) -> None:
        """End it."""
        with self._lock:
            self._sender.close()
        self._wait()
        self._held.close()

    def _start(self, spare: SpareProcess | None = None) -> None:
        self._process, ours = (spare, spare.ours) if spare is not None else self._spawned()
        with self._lock:
            self._sender = StateSender(ours, self._setup)
            self._sender.offer(self._first, ())
            if self._faults:
                self._sender.faults(self._faults)
        self._died_at = None

    def _spawned(self) -> tuple[subprocess.Popen[bytes], socket.socket]:
        ours, theirs = pair()
        with theirs:
            command = [sys.executable, "-m", _MODULE, str(theirs.fileno())]
            process = subprocess.Popen(command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, env=self._environ)
        return process, ours

    def _on_death(self) -> None:
        with self._lock:
            self._sender.close()
            self._earlier = self.rendered
            self.lost += self.report.dropped
            self.report = CameraReport()
            self.rates = dict.fromkeys(self.rates, 0.0)
        code = self._wait()
        self._held.close()
        self._held, self._ports = ports.held(self._ports), frozenset()
        self._died_at = time.monotonic()
        self.fault = f"the process that draws ended with code {code}; it is started again"
        self._on_fault(self.fault)

    def _wait(self) -> int:
        try:
            return self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()
