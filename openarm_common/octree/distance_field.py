# SPDX-License-Identifier: Apache-2.0
"""Distances to the nearest obstacle, shared between processes on one machine without a copy.

The field lies in a file in memory (/dev/shm) that the writer and its readers map: a header, then two slots of float32
distances. The writer computes into the slot that is not in use and then makes it the current one; a reader uses the
current slot in place. It is unchanged until the writer reuses that slot, one update later at the earliest;
`DistanceFieldReader.intact` tells afterwards whether it did.

Distances are between centres of cells, m, cut at `reach`. Moments are given twice: stamps of the images (`t_ns`) and
the machine's monotonic clock (`now_ns`), which all processes share, so that ages are right whatever the images' clock.
"""

from __future__ import annotations

import mmap
import os
import stat
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from openarm_common.errors import Code, OpenArmError
from openarm_common.octree.lattice import Lattice
from openarm_common.types import Array, Floats

_MAGIC = b"OADIST02"
_MAX_CAMERAS = 8
_SLOTS = 2
_SLOT_HEAD = np.dtype(
    [
        ("version", "<i8"),  # 0 while it is written
        ("t_ns", "<i8"),
        ("now_ns", "<i8"),
        ("cameras", [("t_ns", "<i8"), ("now_ns", "<i8")], (_MAX_CAMERAS,)),
    ]
)
_HEAD = np.dtype(
    [
        ("magic", "S8"),
        ("resolution", "<f8"),
        ("reach", "<f8"),
        ("key_min", "<i8", (3,)),
        ("shape", "<i8", (3,)),
        ("frame", "S64"),
        ("cameras", "S32", (_MAX_CAMERAS,)),
        ("current", "<i8"),
        ("slots", _SLOT_HEAD, (_SLOTS,)),
    ]
)
_DATA_AT = 4096
#: A field may be made while its reader asks for the time, s.
_AHEAD = 0.1


class CameraMoment(NamedTuple):
    """When a camera last contributed: stamp of its image, and the monotonic clock then (0: never)."""

    t_ns: int
    now_ns: int


@dataclass(frozen=True, eq=False)
class DistanceField:
    """One version of the field.

    Attributes:
        lattice: Cells of the map.
        distances: (nx, ny, nz) float32, read-only, m.
        reach: Largest distance; others are cut to it, m.
        frame: Frame of the cells.
        version: Counts up with every update, from 1.
        t_ns: Stamp of the newest image in it.
        now_ns: Monotonic clock when it was made.
        cameras: When each camera last contributed.
    """

    lattice: Lattice
    distances: Floats
    reach: float
    frame: str
    version: int
    t_ns: int
    now_ns: int
    cameras: Mapping[str, CameraMoment]

    def at(self, points: ArrayLike) -> Floats:
        """Return the distances (n,), m, at points (n, 3) of the frame; `reach` outside of the workspace."""
        index = self.lattice.indices(np.asarray(points, np.float64).reshape(-1, 3))
        inside = self.lattice.contains(index)
        out = np.full(index.shape[0], self.reach, np.float32)
        out[inside] = self.distances[tuple(index[inside].T)]
        return out

    def clearance(self, centres: Array, radii: Array) -> float:
        """Return the smallest clearance between spheres and occupied cells, m; too small by a cell's diagonal at most.

        Args:
            centres: (n, 3) in the frame, m.
            radii: (n,) m.
        """
        index = self.lattice.indices(centres)
        inside = self.lattice.contains(index)
        # a sphere's centre is up to half a diagonal from that of its cell, and a surface as far from that of its own
        gaps = self.distances[tuple(index[inside].T)] - radii[inside] - np.sqrt(3.0) * self.lattice.resolution
        return float(gaps.min(initial=np.inf))

    def require_fresh(self, now_ns: int, limit_s: float, cameras: Sequence[str] | None = None) -> None:
        """Refuse a field that is too old to plan with.

        Args:
            now_ns: The monotonic clock.
            limit_s: Longest age of the field and of every camera's last contribution, s.
            cameras: Cameras that matter; None is all.

        Raises:
            OpenArmError: STALE_DATA, with what is how old.
        """
        age = (now_ns - self.now_ns) * 1e-9
        if age < -_AHEAD:
            raise OpenArmError(
                Code.STALE_DATA, f"the distance field is stamped {-age:.1f} s in the future; is it of this machine?"
            )
        if age > limit_s:
            raise OpenArmError(
                Code.STALE_DATA,
                f"the distance field is {age:.1f} s old, expected at most {limit_s:g} s; is octomap up?",
            )
        for name in self.cameras if cameras is None else cameras:
            moment = self.cameras.get(name)
            if moment is None or moment.now_ns == 0:
                raise OpenArmError(Code.STALE_DATA, f"camera {name!r} has not contributed to the map yet")
            age = (now_ns - moment.now_ns) * 1e-9
            if age > limit_s:
                raise OpenArmError(
                    Code.STALE_DATA,
                    f"camera {name!r} last contributed to the map {age:.1f} s ago, expected at most {limit_s:g} s",
                )


def field_path(name: str) -> Path:
    """Return the path of the field of a name: in memory where the system has a file system for that."""
    shm = Path("/dev/shm")
    return (shm if shm.is_dir() else Path(tempfile.gettempdir())) / f"openarm_field_{name}"


class DistanceFieldWriter:
    """Owns the shared field; one at a time for a name. The field of an earlier one is replaced.

    Args:
        path: Path from `field_path`.
        lattice: Cells of the map.
        reach: Largest distance; others are cut to it, m.
        frame: Frame of the cells.
        cameras: Names of those that contribute, at most 8.

    Raises:
        OpenArmError: ENVIRONMENT, when there is no room for it.
    """

    def __init__(self, path: Path, lattice: Lattice, reach: float, frame: str, cameras: Sequence[str]) -> None:
        if len(cameras) > _MAX_CAMERAS:
            raise OpenArmError(
                Code.CONFIG_INVALID, f"{len(cameras)} cameras; a distance field has room for {_MAX_CAMERAS}"
            )
        self._path = path
        self._cameras = tuple(cameras)
        self._moments: dict[str, CameraMoment] = {name: CameraMoment(0, 0) for name in cameras}
        size = _DATA_AT + _SLOTS * lattice.cells * 4
        try:
            handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name)
            try:
                # reserved now: a full file system would otherwise end the process at the first write
                os.posix_fallocate(handle, 0, size)
                self._map = mmap.mmap(handle, size)
                self._inode = os.fstat(handle).st_ino
                head = _header(self._map)
                head["magic"], head["resolution"], head["reach"] = _MAGIC, lattice.resolution, reach
                head["key_min"], head["shape"], head["frame"] = lattice.key_min, lattice.shape, frame.encode()
                head["current"] = -1
                for i, name in enumerate(cameras):
                    head["cameras"][i] = name.encode()
                os.replace(temporary, path)
            except OSError:
                os.unlink(temporary)
                raise
            finally:
                os.close(handle)
        except OSError as error:
            raise OpenArmError(
                Code.ENVIRONMENT,
                f"a distance field of {size / 2**20:.1f} MiB can't be made at {path}: {error.strerror}",
            ) from error
        self._head = head
        self._slots = _slots(self._map, lattice)
        self._version = 0

    def begin(self) -> Floats:
        """Return the slot to compute into, (nx, ny, nz); readers do not use it before `commit`."""
        slot = self._next
        self._head["slots"][slot]["version"] = 0
        return self._slots[slot]

    def commit(self, t_ns: int, now_ns: int, cameras: Mapping[str, CameraMoment]) -> int:
        """Make what was computed since `begin` the current version; returns its number.

        Args:
            t_ns: Stamp of the newest image.
            now_ns: Monotonic clock.
            cameras: When cameras last contributed; those left out keep their moments.
        """
        slot = self._next
        head = self._head["slots"][slot]
        self._moments |= cameras
        head["t_ns"], head["now_ns"] = t_ns, now_ns
        head["cameras"][: len(self._cameras)] = [self._moments[name] for name in self._cameras]
        self._version += 1
        head["version"] = self._version
        self._head["current"] = slot
        return self._version

    def close(self) -> None:
        """Remove the field; readers keep their mapping."""
        try:
            if self._path.stat().st_ino == self._inode:
                self._path.unlink()
        except FileNotFoundError:
            pass  # taken away already

    @property
    def _next(self) -> int:
        return (int(self._head["current"]) + 1) % _SLOTS


class DistanceFieldReader:
    """Reads the field of a name; may be made before the writer, and survives its restart.

    Args:
        path: Path from `field_path`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._inode = -1
        self._head: Any = None
        self._slots: list[Floats] = []
        self._lattice: Lattice | None = None

    def latest(self) -> DistanceField:
        """Return the current version, in place (no copy).

        Raises:
            OpenArmError: NOT_READY, when nothing has been published yet.
        """
        self._open()
        slot = int(self._head["current"])
        if slot < 0 or self._lattice is None:
            raise OpenArmError(Code.NOT_READY, f"the distance field at {self._path} has no version yet")
        head = self._head["slots"][slot]
        names = [bytes(name).decode() for name in self._head["cameras"] if name]
        return DistanceField(
            lattice=self._lattice,
            distances=self._slots[slot],
            reach=float(self._head["reach"]),
            frame=bytes(self._head["frame"]).decode(),
            version=int(head["version"]),
            t_ns=int(head["t_ns"]),
            now_ns=int(head["now_ns"]),
            cameras={name: CameraMoment(*head["cameras"][i].item()) for i, name in enumerate(names)},
        )

    def intact(self, field: DistanceField) -> bool:
        """Whether a field of this reader is still as it was: ask after using it."""
        return any(
            slot is field.distances and int(self._head["slots"][i]["version"]) == field.version
            for i, slot in enumerate(self._slots)
        )

    def _open(self) -> None:
        try:
            if self._path.lstat().st_ino == self._inode:
                return
            handle = os.open(self._path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                status = os.fstat(handle)
                _require_own(self._path, status)
                memory = mmap.mmap(handle, 0, access=mmap.ACCESS_READ)
            finally:
                os.close(handle)
        except (FileNotFoundError, ValueError) as error:
            raise OpenArmError(
                Code.NOT_READY, f"no distance field at {self._path}; is the node octomap running?"
            ) from error
        except OSError as error:
            raise OpenArmError(
                Code.ENVIRONMENT, f"the distance field at {self._path} can't be opened: {error.strerror}"
            ) from error
        lattice = _lattice(memory)
        if lattice is None:
            raise OpenArmError(Code.NOT_READY, f"{self._path} is no distance field of this version of the suite")
        self._lattice, self._head, self._inode = lattice, _header(memory), status.st_ino
        self._slots = _slots(memory, lattice)


def _require_own(path: Path, status: os.stat_result) -> None:
    """Refuse a field that another user made or may change.

    Raises:
        OpenArmError: ENVIRONMENT, naming the owner.
    """
    if not stat.S_ISREG(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o022:
        raise OpenArmError(
            Code.ENVIRONMENT,
            f"the distance field at {path} belongs to user {status.st_uid} (mode {stat.filemode(status.st_mode)});"
            f" expected a file that only user {os.getuid()} can write: have it removed, or choose another map.name",
        )


def _lattice(memory: mmap.mmap) -> Lattice | None:
    """Return the cells of a field; None when it is none, or does not hold what its header says."""
    if len(memory) < _DATA_AT:
        return None
    head = _header(memory)
    key, shape = ([int(v) for v in head[k]] for k in ("key_min", "shape"))
    resolution, reach = float(head["resolution"]), float(head["reach"])
    sound = (
        bytes(head["magic"]) == _MAGIC
        and 0.0 < resolution < np.inf
        and 0.0 < reach < np.inf
        and min(shape) > 0
        and len(memory) == _DATA_AT + _SLOTS * 4 * shape[0] * shape[1] * shape[2]
        and -1 <= int(head["current"]) < _SLOTS
    )
    return Lattice(resolution, (key[0], key[1], key[2]), (shape[0], shape[1], shape[2])) if sound else None


def _header(memory: mmap.mmap) -> Any:
    return np.frombuffer(memory, _HEAD, count=1)[0]


def _slots(memory: mmap.mmap, lattice: Lattice) -> list[Floats]:
    n = lattice.cells
    return [
        np.frombuffer(memory, np.float32, count=n, offset=_DATA_AT + i * 4 * n).reshape(lattice.shape)
        for i in range(_SLOTS)
    ]
