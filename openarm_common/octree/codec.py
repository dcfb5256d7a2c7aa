# SPDX-License-Identifier: Apache-2.0
"""OctoMap's octrees as bytes: payloads of octomap_msgs/Octomap, and .bt and .ot files.

Two forms. *Binary* has occupied, free and unknown (a reader takes the clamping limits as log-odds); *full* has the
log-odds of every node. A tree is written pruned, each in the one form that liboctomap has for it, so equal maps give
equal bytes. Cells are in the frame of the map, see `openarm_common.octree.lattice`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.octree import codec_kernels as kernels
from openarm_common.octree.lattice import DEPTH, Lattice
from openarm_common.resources import write_whole
from openarm_common.types import Bytes, Floats, Ints

ScalarT = TypeVar("ScalarT", bound=np.generic)

#: The class of tree that MoveIt and RViz know as a plain octree.
TREE_ID = "OcTree"
#: liboctomap's clamping limits (probabilities 0.1192 and 0.971), given to what is read from the binary form.
CLAMP_MIN, CLAMP_MAX = -2.0, 3.5
#: A file that is longer is refused before it is read.
MAX_FILE_BYTES = 256 * 2**20

_FIRST_LINE = {".bt": "# Octomap OcTree binary file", ".ot": "# Octomap OcTree file"}
_NOTE = "# (feel free to add / change comments, but leave the first line as it is!)\n#"


@dataclass(frozen=True)
class Payload:
    """A tree as bytes, without a file header."""

    data: Bytes
    nodes: int
    binary: bool


class OctreeEncoder:
    """Writes a dense box as an octree; keeps its buffers.

    Args:
        lattice: The box; its faces must lie at even keys.

    Raises:
        OpenArmError: CONFIG_INVALID, when a face lies at an odd key.
    """

    def __init__(self, lattice: Lattice) -> None:
        if any(k % 2 or n % 2 for k, n in zip(lattice.key_min, lattice.shape, strict=True)):
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"box begins at key {lattice.key_min} and has {lattice.shape} cells; an octree needs even numbers",
            )
        self._lattice = lattice
        self._offset = np.zeros(DEPTH + 1, np.int64)
        self._shape = np.zeros((DEPTH + 1, 3), np.int64)
        self._origin = np.zeros((DEPTH + 1, 3), np.int64)
        self._shift = np.zeros((DEPTH + 1, 3), np.int64)  # of the level below in each level
        first: Ints = np.array(lattice.key_min, np.int64)
        end: Ints = first + np.array(lattice.shape, np.int64)
        total = 0
        for level in range(DEPTH + 1):
            if level:
                parent_first, parent_end = first >> 1, end >> 1
                first, end = parent_first, parent_end
                if level < DEPTH:  # the root is a single node
                    first, end = parent_first & ~1, (parent_end + 1) & ~1
                self._shift[level] = parent_first - first
            self._origin[level], self._shape[level], self._offset[level] = first, end - first, total
            total += int(np.prod(end - first))
        self._states = np.zeros(total, np.uint8)
        self._levels = [self._view(self._states, level) for level in range(DEPTH + 1)]
        self._values = np.zeros(0, np.float32)
        self._out = np.empty(2 * total + 2, np.uint8)

    def binary(self, states: Bytes) -> Payload:
        """Write a box of states.

        Args:
            states: (nx, ny, nz): 0 unknown, 1 free, 2 occupied.

        Returns:
            The payload; no bytes at all for a map without a known cell. The data is a copy.
        """
        self._levels[0][...] = states
        for level in range(DEPTH):
            kernels.merge_states(self._levels[level], self._levels[level + 1], self._shift[level + 1])
        if self._levels[DEPTH][0, 0, 0] == 0:
            return Payload(np.empty(0, np.uint8), 0, True)
        n, nodes = kernels.write_states(self._states, self._offset, self._shape, self._origin, self._out)
        return Payload(self._out[:n].copy(), nodes, True)

    def full(self, log_odds: Floats) -> Payload:
        """Write a box of log-odds (nx, ny, nz), NaN where unknown; as `binary`."""
        if not self._values.size:
            self._values = np.zeros(self._states.size, np.float32)
        values = [self._view(self._values, level) for level in range(DEPTH + 1)]
        self._levels[0][...], values[0][...] = ~np.isnan(log_odds), log_odds
        for level in range(DEPTH):
            above = level + 1
            kernels.merge_values(
                self._levels[level], values[level], self._levels[above], values[above], self._shift[above]
            )
        if self._levels[DEPTH][0, 0, 0] == 0:
            return Payload(np.empty(0, np.uint8), 0, False)
        known = sum(int(np.count_nonzero(level)) for level in self._levels)
        out = np.empty(5 * known, np.uint8)
        raw = self._values.astype("<f4", copy=False).view(np.uint8).reshape(-1, 4)
        n, nodes = kernels.write_values(self._states, raw, self._offset, self._shape, self._origin, out)
        return Payload(out[:n].copy(), nodes, False)

    def _view(self, flat: NDArray[ScalarT], level: int) -> NDArray[ScalarT]:
        start = int(self._offset[level])
        shape = tuple(int(n) for n in self._shape[level])
        return flat[start : start + int(np.prod(shape))].reshape(shape)


def encode_states(lattice: Lattice, states: Bytes) -> Payload:
    """Write any box of states once; `OctreeEncoder` is the faster way for a box that is written again and again."""
    padded = np.pad(states, [(k % 2, (k + n) % 2) for k, n in zip(lattice.key_min, lattice.shape, strict=True)])
    x, y, z = (k - k % 2 for k in lattice.key_min)
    return OctreeEncoder(Lattice(lattice.resolution, (x, y, z), padded.shape)).binary(padded)


@dataclass(frozen=True, eq=False)
class Leaves:
    """The leaves of a tree.

    Attributes:
        resolution: Edge of a cell of level 0, m.
        cells: (n, 5) level, x, y, z key at that level, and a column of no meaning to readers.
        log_odds: (n,).
        nodes: Nodes of the tree, inner ones too.
    """

    resolution: float
    cells: Ints
    log_odds: Floats
    nodes: int

    def on(self, lattice: Lattice) -> tuple[Floats, int]:
        """Return log-odds of a box, NaN where unknown, and how many leaves lie outside of it, wholly or in part.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when the resolutions differ.
        """
        if abs(lattice.resolution - self.resolution) > 1e-6 * self.resolution:
            raise _invalid(f"the map has cells of {self.resolution:g} m, expected {lattice.resolution:g} m")
        out = np.full(lattice.shape, np.nan, np.float32)
        outside = kernels.paint(self.cells, self.log_odds, np.array(lattice.key_min, np.int64), out)
        return out, outside


def decode(data: Bytes | bytes, resolution: float, *, binary: bool) -> Leaves:
    """Read a payload.

    Args:
        data: Payload without a file header; empty is the empty map.
        resolution: Edge of a cell, m.
        binary: Which form it has.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the payload ends too early, goes on after its end, is deeper than 16
            levels, or holds log-odds that are not finite.
    """
    if not 1e-4 <= resolution <= 100.0:
        raise _invalid(f"res is {resolution} m, expected 0.0001 .. 100")
    raw = np.frombuffer(data, np.uint8) if isinstance(data, bytes) else data.view(np.uint8)
    if raw.size == 0:
        return Leaves(resolution, np.empty((0, 5), np.int64), np.empty(0, np.float32), 0)
    leaves = np.empty((4 * raw.size if binary else raw.size // 5, 5), np.int64)
    count, used, nodes = kernels.read_states(raw, leaves) if binary else kernels.read_values(raw, leaves)
    if count == kernels.TRUNCATED:
        raise _damaged(f"ends after {raw.size} bytes in the middle of the tree")
    if count == kernels.TOO_DEEP:
        raise _damaged(f"goes deeper than {DEPTH} levels at byte {used}")
    if used != raw.size:
        raise _damaged(f"goes on for {raw.size - used} bytes after the tree's end")
    cells = leaves[:count].copy()
    if binary:
        values = np.where(cells[:, 4] == 2, np.float32(CLAMP_MAX), np.float32(CLAMP_MIN))
    else:
        values = raw[cells[:, 4, None] + np.arange(4)].copy().view("<f4")[:, 0].astype(np.float32)
        if not np.isfinite(values).all():
            raise _damaged("holds log-odds that are not finite")
    return Leaves(resolution, cells, values, nodes)


def write_file(path: Path, payload: Payload, resolution: float) -> None:
    """Write a .bt (binary) or .ot (full) file; the file is there whole or not at all.

    Args:
        path: Ends in .bt or .ot.
        payload: The tree.
        resolution: Edge of a cell, m.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the suffix does not fit the payload or the folder can't be written.
    """
    suffix = ".bt" if payload.binary else ".ot"
    if path.suffix != suffix:
        raise _invalid(f"{path.name}: the {suffix[1:]} form needs the suffix {suffix}")
    text = f"{_FIRST_LINE[suffix]}\n{_NOTE}\nid {TREE_ID}\nsize {payload.nodes}\nres {resolution:g}\ndata\n"
    if not path.parent.is_dir():
        raise _invalid(f"{path} can't be written: there is no folder {path.parent}")
    write_whole(path, text.encode("ascii") + payload.data.tobytes(), Code.INVALID_ARGUMENT)


def read_file(path: Path) -> Leaves:
    """Read a .bt or .ot file.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the file and what is wrong with it.
    """
    try:
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise _invalid(f"{path} has {size} bytes, expected at most {MAX_FILE_BYTES}")
        content = path.read_bytes()
    except OSError as error:
        raise _invalid(f"{path} can't be read: {error}") from error
    try:
        return _parse(content)
    except OpenArmError as error:
        raise OpenArmError(error.code, f"{path}: {error.message}") from error


def _parse(content: bytes) -> Leaves:
    head, found, data = content.partition(b"\ndata\n")
    lines = head.decode("ascii", errors="replace").splitlines() if found else []
    forms = [suffix for suffix, first in _FIRST_LINE.items() if lines and lines[0].startswith(first)]
    if not forms:
        first = " or ".join(map(repr, _FIRST_LINE.values()))
        raise _invalid(f"not an octree file: expected it to begin with {first} and to have a line 'data'")
    fields = dict(line.split(None, 1) for line in lines if re.fullmatch(r"[a-z]+\s+\S.*", line))
    if fields.get("id") != TREE_ID:
        raise _invalid(f"tree is of class {fields.get('id')!r}, expected {TREE_ID!r}")
    try:
        resolution, nodes = float(fields["res"]), int(fields["size"])
    except (KeyError, ValueError) as error:
        raise _invalid(f"header needs numbers 'size' and 'res': {error}") from error
    leaves = decode(data, resolution, binary=forms[0] == ".bt")
    if leaves.nodes != nodes:
        raise _damaged(f"has {leaves.nodes} nodes, its header says {nodes}")
    return leaves


def _damaged(what: str) -> OpenArmError:
    return _invalid(f"octree is damaged: it {what}")


def _invalid(message: str) -> OpenArmError:
    return OpenArmError(Code.INVALID_ARGUMENT, message)
