# SPDX-License-Identifier: Apache-2.0
"""Injected faults of cameras, applied where images are drawn. Lengths in m, pixels (row v, column u), stamps in ns."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable
from dataclasses import replace
from typing import TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.types import Array
from openarm_sim_bridge.faults.faults import (
    CameraDelay,
    CameraDrop,
    CameraFreeze,
    DepthPatch,
    Fault,
    IntrinsicsBias,
    LightChanged,
    MountKnocked,
    OfCamera,
    StampOffset,
    find,
)

CameraFaultT = TypeVar("CameraFaultT", bound=OfCamera)

_LIGHTS = ("light_diffuse", "light_ambient", "light_specular")
_HEADLIGHT = ("diffuse", "ambient", "specular")


class CameraFaults:
    """Active faults."""

    def __init__(self) -> None:
        self._faults: dict[str, Fault] = {}
        self._rngs: dict[str, np.random.Generator] = {}
        self._model: mujoco.MjModel | None = None
        self._base: dict[str, Array] = {}
        self._changed = False

    def set(self, faults: Iterable[Fault]) -> None:
        """Take the faults that are active from now on; one that was active already continues."""
        before, self._faults = self._faults, {fault.name: fault for fault in faults}
        for name, fault in self._faults.items():
            if before.get(name) != fault:
                self._rngs[name] = np.random.default_rng(fault.seed)
        self._changed = True

    def apply(self, model: mujoco.MjModel) -> None:
        """Write changed mounts and light into the model that is drawn."""
        if model is not self._model:
            self._model = model
            self._base = {key: getattr(model, key).copy() for key in ("cam_pos", "cam_quat", *_LIGHTS)}
            self._base |= {key: getattr(model.vis.headlight, key).copy() for key in _HEADLIGHT}
            self._changed = self._changed or bool(self._faults)
        if not self._changed:
            return
        self._changed = False
        light = find(self._faults.values(), LightChanged)
        scale = light.scale if light is not None else 1.0
        for key in _LIGHTS:
            getattr(model, key)[:] = self._base[key] * scale
        for key in _HEADLIGHT:
            getattr(model.vis.headlight, key)[:] = self._base[key] * scale
        for i in range(model.ncam):
            model.cam_pos[i], model.cam_quat[i] = self._mount(model.camera(i).name, i)

    def _mount(self, name: str, i: int) -> tuple[Array, Array]:
        position, quaternion = self._base["cam_pos"][i], self._base["cam_quat"][i]
        knock = self._of(MountKnocked, name)
        if knock is None:
            return position, quaternion
        rng = np.random.default_rng([self._faults["mount_knocked"].seed, zlib.crc32(name.encode())])
        direction, axis = rng.normal(size=(2, 3))
        turn = se3.exp_so3(axis / np.linalg.norm(axis) * math.radians(knock.deg))
        rotation = se3.matrix_from_quat_xyzw(np.roll(quaternion, -1)) @ turn
        shifted = position + 1e-3 * knock.mm * direction / np.linalg.norm(direction)
        return shifted, np.roll(se3.quat_xyzw_from_matrix(rotation), 1)

    def drops(self, camera: str) -> bool:
        """Whether this frame of a camera is lost; ask once per frame."""
        drop = self._of(CameraDrop, camera)
        return drop is not None and bool(self._rngs["camera_drop"].random() < drop.share)

    def delay_s(self, camera: str) -> float:
        """Return by how much frames are late, s."""
        delay = self._of(CameraDelay, camera)
        return delay.seconds if delay is not None else 0.0

    def frozen(self, camera: str) -> bool:
        """Whether the picture stays the same."""
        return self._of(CameraFreeze, camera) is not None

    def stamp_ns(self, camera: str, t_ns: int) -> int:
        """Return the stamp that a frame carries; never before zero."""
        offset = self._of(StampOffset, camera)
        return max(0, t_ns + round(offset.ms * 1e6)) if offset is not None else t_ns

    def intrinsics(self, camera: str, true: Intrinsics) -> Intrinsics:
        """Return the intrinsics that are published."""
        bias = self._of(IntrinsicsBias, camera)
        if bias is None:
            return true
        fx, fy = true.fx * (1.0 + bias.focal), true.fy * (1.0 + bias.focal)
        return replace(true, fx=fx, fy=fy, cx=true.cx + bias.cx, cy=true.cy + bias.cy)

    def spoil_depth(self, camera: str, depth: NDArray[np.generic]) -> None:
        """Falsify a patch of a depth image (mm as uint16, or m as float32), in place."""
        patch = self._of(DepthPatch, camera)
        if patch is None:
            return
        part = depth[patch.v : patch.v + patch.height, patch.u : patch.u + patch.width]
        if part.dtype == np.uint16:
            wrong = np.clip(part.astype(np.int64) + round(1e3 * patch.metres), 0, 65535)
            part[:] = np.where(part > np.uint16(0), wrong, 0).astype(np.uint16)
        else:
            part[:] = np.maximum(part.astype(np.float32) + np.float32(patch.metres), np.float32(0.0))

    def _of(self, model: type[CameraFaultT], camera: str) -> CameraFaultT | None:
        fault = find(self._faults.values(), model)
        return fault if fault is not None and fault.hits(camera) else None
