# SPDX-License-Identifier: Apache-2.0
"""Node `flight_recorder`: keeps the newest messages of the graph in memory, and writes them to a bag when it is asked.

The answer comes at once, the bag a moment later: it appears under its path when it is complete.
"""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from openarm_interfaces.srv import SaveRecording
from pydantic import Field

from openarm_bringup.bags.about import about
from openarm_bringup.bags.recordings import Recordings
from openarm_bringup.bags.ring import Moment, Ring
from openarm_bringup.bags.ros.listener import FLIGHT, Listener, flight_on_demand
from openarm_bringup.supervision import runs
from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.answers import answering
from openarm_common.ros.lifecycle_node import ManagedNode
from openarm_common.ros.node import run

_DRAIN_S, _DISCOVER_S = 0.05, 0.5
#: Messages that a reader keeps: half a second of the fastest topic.
_DEPTH = 50
#: Of the thread that writes: what moves the robot comes first.
_NICE = 10


class FlightRecorderConfig(Config):
    """Parameters of the node `flight_recorder`."""

    duration: float = Field(default=30.0, ge=1.0, le=600.0, description="messages are kept so long, s of wall clock")
    memory: int = Field(default=128, ge=8, le=4096, description="and within so much memory, MB")
    image_rate: float = Field(default=5.0, ge=0.0, le=60.0, description="of each camera, whole frames, Hz; 0: all")
    topics: tuple[str, ...] = Field(default=FLIGHT, description="regular expressions of topic names")
    on_demand: tuple[str, ...] = Field(
        default_factory=flight_on_demand,
        description="topics that are made for their subscribers: kept while another node subscribes",
    )
    folder: str = Field(default="", description="of the recordings; empty: recordings/ of the run")
    most: int = Field(default=20, ge=1, le=1000, description="recordings that are kept; the oldest are removed")
    disk: int = Field(default=1000, ge=10, le=1_000_000, description="that all recordings take, at most, MB")
    autostart: bool = Field(default=True, description="active from the start; false: a lifecycle manager activates it")


class FlightRecorder(ManagedNode[FlightRecorderConfig]):
    """Listens while its state is active."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("flight_recorder", FlightRecorderConfig, **kwargs)
        config = self.config
        self._ring = Ring(config.duration, config.memory * 10**6, self.count_publishers)
        self._listener = Listener(
            self,
            config.topics,
            self._ring.put,
            image_rate=config.image_rate,
            depth=_DEPTH,
            on_demand=config.on_demand,
        )
        own = runs.own()
        folder = Path(config.folder or Path(own.run_dir if own else runs.runs_root()) / runs.RECORDINGS).expanduser()
        self._recordings = Recordings(folder, config.most, config.disk * 10**6)
        self._fault = ""
        self.create_service(SaveRecording, "/flight_recorder/save", answering(self._save))
        self._work = [
            self.create_timer(period, work, clock=self.steady_clock, autostart=False)
            for period, work in ((_DISCOVER_S, self._listener.discover), (_DRAIN_S, self._listener.drain))
        ]
        self.create_timer(self.REPORT_PERIOD_S, self._report, clock=self.steady_clock)
        if config.autostart:
            self.autostart()

    # --- lifecycle
    def begin(self) -> None:
        """Listen."""
        for timer in self._work:
            timer.reset()

    def rest(self) -> None:
        """Leave the graph alone; what is in memory can still be saved."""
        for timer in self._work:
            timer.cancel()
        self._listener.leave()

    def forget(self) -> None:
        """Empty the memory."""
        self._ring.clear()

    # --- saving
    def _save(self, request: SaveRecording.Request, response: SaveRecording.Response) -> str:
        if self.active:
            self._listener.drain()
        moment = self._ring.moment()
        if not moment.packed:
            raise OpenArmError(Code.NOT_READY, "nothing was received yet")
        reason, *details = request.reason.strip().splitlines() or ["ASKED"]
        code = re.match(r"[A-Z][A-Z0-9_]*\b", reason)
        try:
            path = self._recordings.reserve(code[0] if code else "ASKED")
        except OpenArmError as error:
            self._failed(error)
            raise
        custom = {"reason": reason, "lost": str(self._listener.lost.total())}
        for key, _, value in (line.partition(": ") for line in details):
            custom[key] = value
        self.in_thread(self._write, path, moment, custom)
        response.path = str(path)
        return f"{len(moment.packed)} messages of {moment.seconds:.0f} s"

    def _write(self, path: Path, moment: Moment, custom: Mapping[str, str]) -> None:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)  # of this thread alone
        try:
            self._recordings.write(path, moment, {**about(runs.own()), **custom})
        except OpenArmError as error:
            self._failed(error)
            return
        self._fault = ""
        self.get_logger().info(f"recorded {path}")

    def _failed(self, error: OpenArmError) -> None:
        """Say it once, and on /diagnostics until a recording succeeds."""
        if not self._fault:
            self.get_logger().error(error.message)
        self._fault = error.message

    def _report(self) -> None:
        state = "keeps the newest messages" if self.active else "at rest"
        self.diagnose(
            not self._fault,
            self._fault or state,
            seconds=f"{self._ring.seconds:.1f}",
            megabytes=f"{1e-6 * self._ring.bytes:.1f}",
            topics=len(self._listener.readers),
            lost=self._listener.lost.total(),
        )


def main() -> None:
    """Run the node."""
    run(FlightRecorder)


if __name__ == "__main__":
    main()
