# SPDX-License-Identifier: Apache-2.0
"""Handing states of the world to the process that draws them.

The bridge holds one end of a socket, the drawing process the other; when one of them dies, the other one sees the end.
What goes over it is small: a model now and then (as an anonymous file whose descriptor rides along), for each frame
the positions of all joints (a few hundred bytes), and back a report a few times a second. Images never go over it.
Nothing here waits for the other side: a frame that can't be handed over is dropped and counted.
"""

from __future__ import annotations

import json
import os
import select
import socket
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np
from pydantic import Field

from openarm_common.camera.cameras import CameraConfig
from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_sim_bridge.cameras.noise import ColourNoiseConfig, DepthNoiseConfig
from openarm_sim_bridge.faults.faults import Fault, checked_fault
from openarm_sim_bridge.world.world import Snapshot

_SETUP, _MODEL, _STATE, _FAULTS = b"C", b"M", b"S", b"F"
_STATE_HEAD = struct.Struct("<qI")  # stamp in ns, which cameras
_MAX_BYTES = 1 << 17


class CameraSetup(Config):
    """What the drawing process is told first."""

    cameras: tuple[CameraConfig, ...] = Field(description="all cameras; states name them by their place here")
    depth_encoding: Literal["16UC1", "32FC1"] = Field(description="whole millimetres, or metres")
    depth_noise: DepthNoiseConfig = DepthNoiseConfig()
    colour_noise: ColourNoiseConfig = ColourNoiseConfig()
    noise_seed: int = Field(default=0, ge=0, description="of all noise")
    topics: dict[str, str] = Field(description="name on the graph of each topic, by its name without remapping")


class CameraReport(Config):
    """What the drawing process tells."""

    ready: bool = Field(default=False, description="a frame of every camera was drawn, it can begin")
    fault: str = Field(default="", description="why it can't draw")
    watched: tuple[str, ...] = Field(default=(), description="cameras with a subscriber")
    rendered: dict[str, int] = Field(default={}, description="frames drawn so far, by camera")
    dropped: int = Field(default=0, description="frames that were replaced by newer ones before they were drawn")
    draw_ms: float = Field(default=0.0, description="mean time of the frames drawn since the last report")


def pair() -> tuple[socket.socket, socket.socket]:
    """Return the two ends; messages keep their borders and their order."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)


class StateSender:
    """The bridge's end. `offer` and `faults` want a lock where they are called by several threads.

    Args:
        end: Socket of `pair`.
        setup: For the other side.
    """

    def __init__(self, end: socket.socket, setup: CameraSetup) -> None:
        self._end = end
        self._end.setblocking(False)
        self._bit = {camera.name: 1 << i for i, camera in enumerate(setup.cameras)}
        self._model: mujoco.MjModel | None = None
        self._end.send(_SETUP + setup.model_dump_json().encode())

    def offer(self, snapshot: Snapshot, names: Iterable[str]) -> bool:
        """Hand over a state to draw for some cameras; False when it had to be dropped."""
        try:
            if self._model is not snapshot.model:
                self._send_model(snapshot.model)
                self._model = snapshot.model
            mask = sum(self._bit[name] for name in names)
            self._end.send(_STATE + _STATE_HEAD.pack(snapshot.t_ns, mask) + snapshot.qpos.tobytes())
        except (BlockingIOError, BrokenPipeError, ConnectionError):
            return False
        return True

    def faults(self, faults: Iterable[Fault]) -> None:
        """Hand over all faults that are active from now on.

        Raises:
            OpenArmError: BUSY, when the other side does not take anything at present.
        """
        told = [{"name": f.name, "parameters": f.parameters.model_dump(), "seed": f.seed} for f in faults]
        try:
            self._end.send(_FAULTS + json.dumps(told).encode())
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
        return [CameraReport.model_validate_json(body) for body in _received(self._end)]

    def close(self) -> None:
        """Let go: the other side ends."""
        self._end.close()

    def _send_model(self, model: mujoco.MjModel) -> None:
        data = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, data)
        file = os.memfd_create("model")
        try:
            with open(file, "wb", closefd=False) as out:
                out.write(data.tobytes())
            socket.send_fds(self._end, [_MODEL], [file])
        finally:
            os.close(file)


@dataclass(frozen=True)
class Work:
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
        self.setup = CameraSetup.model_validate_json(body[1:])
        self._end.setblocking(False)

    def take(self, timeout_s: float) -> Work | None:
        """Wait for states; return the newest one for all cameras that any of them was for, None when none came.

        Raises:
            EOFError: The bridge has ended.
        """
        ready, _, _ = select.select([self._end], [], [], timeout_s)
        work: Work | None = None
        while ready:
            try:
                body, files, _, _ = socket.recv_fds(self._end, _MAX_BYTES, 1)
            except BlockingIOError:
                break
            except ConnectionError as error:
                raise EOFError from error
            if not body:
                raise EOFError
            if body[:1] == _MODEL:
                self._model = _load_model(files)
            elif body[:1] == _FAULTS:
                self.faults = tuple(checked_fault(**told) for told in _parameters(body[1:]))
            elif self._model is not None:
                names = work.names if work is not None else frozenset[str]()
                self.dropped += len(names)
                t_ns, mask = _STATE_HEAD.unpack_from(body, 1)
                names |= {camera.name for i, camera in enumerate(self.setup.cameras) if mask >> i & 1}
                qpos = np.frombuffer(body, np.float64, offset=1 + _STATE_HEAD.size)
                work = Work(Snapshot(self._model, t_ns, qpos), names)
        return work

    def report(self, report: CameraReport) -> None:
        """Tell the bridge; a report that does not fit is lost, the next one says it all again."""
        try:
            self._end.send(report.model_dump_json().encode())
        except (BlockingIOError, ConnectionError):
            return


def _parameters(body: bytes) -> list[dict[str, Any]]:
    return [{"name": told["name"], "data": told["parameters"], "seed": told["seed"]} for told in json.loads(body)]


def _load_model(files: Sequence[int]) -> mujoco.MjModel:
    (file,) = files
    try:
        return mujoco.MjModel.from_binary_path(f"/proc/self/fd/{file}")
    finally:
        os.close(file)


def _received(end: socket.socket) -> list[bytes]:
    out: list[bytes] = []
    while True:
        try:
            body = end.recv(_MAX_BYTES)
        except BlockingIOError:
            return out
        except ConnectionError as error:
            raise EOFError from error
        if not body:
            raise EOFError
        out.append(body)
