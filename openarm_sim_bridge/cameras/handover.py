# SPDX-License-Identifier: Apache-2.0
"""Handing states of the world to the process that draws them.

The bridge holds one end of a socket, the drawing process the other; when one of them ends, the other one sees it. The
messages are small (pickled): a model now and then (an anonymous file whose descriptor is passed along), for each frame
the positions of all joints (a few hundred bytes), and back a report a few times a second; never an image. No side waits
for the other: a frame that can't be handed over is dropped and counted.
"""

from __future__ import annotations

import os
import pickle
import select
import socket
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import mujoco

from openarm_common.camera.cameras import CameraConfig
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_sim_bridge.cameras.noise import ColourNoiseConfig, DepthNoiseConfig
from openarm_sim_bridge.faults.faults import Fault
from openarm_sim_bridge.world.world import Snapshot

_MAX_BYTES = 1 << 17


@dataclass(frozen=True)
class CameraSetup:
    """First message to the drawing process.

    Attributes:
        cameras: All cameras.
        depth_encoding: Whole millimetres, or metres.
        topics: Name on the graph of each topic, by its name without remapping.
        depth_noise: Noise of depth images.
        colour_noise: Noise of colour images.
        noise_seed: Seed of all noise.
    """

    cameras: tuple[CameraConfig, ...]
    depth_encoding: Literal["16UC1", "32FC1"]
    topics: Mapping[str, str]
    depth_noise: DepthNoiseConfig
    colour_noise: ColourNoiseConfig
    noise_seed: int = 0


@dataclass(frozen=True)
class CameraReport:
    """What the drawing process reports.

    Attributes:
        ready: A frame of every camera was drawn, it can begin.
        fault: Why it can't draw.
        rates: Rates that a camera is subscribed to at, Hz: infinite: all its frames; 0: no subscriber needs one.
        rendered: Frames drawn so far, by camera.
        dropped: Frames that newer ones replaced before they were drawn.
        draw_ms: Mean time of the frames drawn since the last report.
    """

    ready: bool = False
    fault: str = ""
    rates: Mapping[str, float] = field(default_factory=dict[str, float])
    rendered: Mapping[str, int] = field(default_factory=dict[str, int])
    dropped: int = 0
    draw_ms: float = 0.0


@dataclass(frozen=True, eq=False)
class _RenderState:
    t_ns: int
    qpos: Array
    names: frozenset[str]


def pair() -> tuple[socket.socket, socket.socket]:
    """Return the two ends; messages keep their borders and their order."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)


class StateSender:
    """The bridge's end. `offer` and `faults` need a lock where several threads call them.

    Args:
        end: Socket of `pair`.
        setup: Set-up for the other side.
    """

    def __init__(self, end: socket.socket, setup: CameraSetup) -> None:
        self._end = end
        self._end.setblocking(False)
        self._model: mujoco.MjModel | None = None
        self._send(setup)

    def offer(self, snapshot: Snapshot, names: Iterable[str]) -> bool:
        """Hand over a state to draw for some cameras; False when it had to be dropped."""
        try:
            if self._model is not snapshot.model:
                self._send_model(snapshot.model)
                self._model = snapshot.model
            self._send(_RenderState(snapshot.t_ns, snapshot.qpos, frozenset(names)))
        except (BlockingIOError, ConnectionError):
            return False
        return True

    def faults(self, faults: Iterable[Fault]) -> None:
        """Hand over all faults that are active from now on.

        Raises:
            OpenArmError: BUSY, when the other side does not take anything at present.
        """
        try:
            self._send(tuple(faults))
        except (BlockingIOError, ConnectionError) as error:
            raise OpenArmError(Code.BUSY, "the process that draws does not answer; try again") from error

    def wait(self, timeout_s: float) -> None:
        """Wait until there is a report, or the other side has ended."""
        select.select([self._end], [], [], timeout_s)

    def reports(self) -> list[CameraReport]:
        """Take the reports that have come.

        Raises:
            EOFError: The other side has ended.
        """
        return [message for message, _ in _received(self._end)]

    def close(self) -> None:
        """Close this end; the other side ends."""
        self._end.close()

    def _send(self, message: object, files: Sequence[int] = ()) -> None:
        socket.send_fds(self._end, [pickle.dumps(message)], files)

    def _send_model(self, model: mujoco.MjModel) -> None:
        file = os.memfd_create("model")
        try:
            mujoco.mj_saveModel(model, f"/proc/self/fd/{file}", None)
            self._send(None, [file])
        finally:
            os.close(file)


@dataclass(frozen=True)
class RenderWork:
    """A state to draw, and for which cameras."""

    snapshot: Snapshot
    names: frozenset[str]


class StateReceiver:
    """The drawing process's end.

    Args:
        end: Socket of `pair`.

    Raises:
        EOFError: The bridge has ended.
    """

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._model: mujoco.MjModel | None = None
        self.dropped = 0
        self.faults: tuple[Fault, ...] = ()
        body = end.recv(_MAX_BYTES)
        if not body:
            raise EOFError
        self.setup: CameraSetup = pickle.loads(body)
        self._end.setblocking(False)

    def take(self, timeout_s: float) -> RenderWork | None:
        """Wait for states; return the newest one for all cameras that any of them was for, None when none came.

        Raises:
            EOFError: The bridge has ended.
        """
        select.select([self._end], [], [], timeout_s)
        work: RenderWork | None = None
        for message, files in _received(self._end):
            if files:
                self._model = _load_model(files)
            elif isinstance(message, tuple):
                self.faults = message
            elif self._model is not None:
                names = work.names if work is not None else frozenset[str]()
                self.dropped += len(names)
                work = RenderWork(Snapshot(self._model, message.t_ns, message.qpos), names | message.names)
        return work

    def report(self, report: CameraReport) -> None:
        """Send a report; one that does not fit is lost, the next one repeats it all."""
        try:
            self._end.send(pickle.dumps(report))
        except (BlockingIOError, ConnectionError):
            return


def _load_model(files: Sequence[int]) -> mujoco.MjModel:
    (file,) = files
    try:
        return mujoco.MjModel.from_binary_path(f"/proc/self/fd/{file}")
    finally:
        os.close(file)


def _received(end: socket.socket) -> Iterator[tuple[Any, list[int]]]:
    """Yield the messages that have come, with the descriptors that came along."""
    while True:
        try:
            body, files, _, _ = socket.recv_fds(end, _MAX_BYTES, 1)
        except BlockingIOError:
            return
        except ConnectionError as error:
            raise EOFError from error
        if not body:
            raise EOFError
        yield pickle.loads(body), files
