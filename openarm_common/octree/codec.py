# SPDX-License-Identifier: Apache-2.0
"""OctoMap's octrees as bytes: payloads of octomap_msgs/Octomap, and .bt and .ot files.

Two forms. *Binary* has occupied, free and unknown (a reader takes the clamping limits as log-odds); *full* has the
log-odds of every node. A tree is written pruned, each in the one form that liboctomap has for it, so equal maps give
give equal bytes. Cells are in the frame of the map, see `openarm_common.octree.lattice`.

Trees of other programs are read for their occupancy: the binary form is the same for every class, and the full form of
some has more bytes in each node (AbstractOccupancyOcTree.cpp and ColorOcTree.cpp of octomap 1.10).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.octree import codec_kernels as kernels
from openarm_common.octree.block_kernels import EDGE, LEVEL, UNKNOWN
from openarm_common.octree.blocks import VoxelBlocks
from openarm_common.octree.lattice import DEPTH, Lattice
from openarm_common.octree.resample import resampled
from openarm_common.printable import brief
from openarm_common.resources import write_whole
from openarm_common.types import Array, Bytes, Floats, Ints

ScalarT = TypeVar("ScalarT", bound=np.generic)

#: The class of tree that MoveIt and RViz know as a plain octree.
TREE_ID = "OcTree"
#: liboctomap's clamping limits (probabilities 0.1192 and 0.971), given to what is read from the binary form.
CLAMP_MIN, CLAMP_MAX = -2.0, 3.5
#: A file that is longer is refused before it is read.
MAX_FILE_BYTES = 256 * 2**20

#: Bytes that a node of the full form has besides its log-odds, by class of tree: OcTreeStamped writes no times, and "1"
#: is what OcTree was called once.
_EXTRA = {TREE_ID: 0, "OcTreeStamped": 0, "1": 0, "ColorOcTree": 3}
#: Header of the first .bt files: the number 3 (an octree), edge of a cell, nodes.
_FIRST_HEADER = struct.Struct("<idI")

#: Leaves that are read at a time.
_PART = 1 << 14
_FIRST_LINE = {".bt": "# Octomap OcTree binary file", ".ot": "# Octomap OcTree file"}
_FLAT = "a flat map, as of Nav2, has no heights; one with heights is saved by `openarm map save`"
_CLOUD = (
    "a cloud is inserted with pyoctomap: tree = OcTree(0.02); tree.insertPointCloud(points, origin); tree.writeBinary"
)
#: What other files are that maps are kept in, and what to do.
OTHERS = {
    ".gz": "unpack it: gunzip -c FILE > OTHER.bt",
    ".zip": "unpack it: unzip FILE",
    ".binvox": "convert it with a tool of OctoMap: binvox2bt FILE",
    **dict.fromkeys((".pgm", ".png", ".yaml"), _FLAT),
    **dict.fromkeys((".ply", ".pcd", ".xyz", ".las", ".npy", ".npz"), _CLOUD),
}
_NOTE = "# (feel free to add / change comments, but leave the first line as it is!)\n#"
#: A comment, which liboctomap skips: the robot in whose base frame the map is.
_ROBOT = "# robot "


@dataclass(frozen=True)
class Payload:
    """A tree as bytes, without a file header."""

    data: Bytes
    nodes: int
    binary: bool


def encode_binary(blocks: VoxelBlocks) -> Payload:
    """Write cells as occupied, free and unknown; no bytes at all for a map without a known cell."""
    levels, states = _Levels(blocks), blocks.palette.states
    inner = kernels.block_states(
        blocks.rows, states, blocks.shape, levels.of(levels.states, LEVEL), levels.shift[LEVEL]
    )
    for level in range(LEVEL, DEPTH):
        below, above = (levels.of(levels.states, n) for n in (level, level + 1))
        kernels.merge_states(below, above, levels.shift[level + 1])
        inner += int(np.count_nonzero(above == kernels.INNER))
    if levels.states[-1] == UNKNOWN:
        return Payload(np.empty(0, np.uint8), 0, True)
    out = np.empty(2 * inner, np.uint8)
    n, nodes = kernels.write_states(blocks.rows, states, levels.blocks, levels.states, *levels.layout, out)
    out.resize(n, refcheck=False)  # in place, without a copy next to it
    return Payload(out, nodes, True)


def encode_full(blocks: VoxelBlocks) -> Payload:
    """Write cells with their log-odds; as `encode_binary`."""
    levels = _Levels(blocks)
    values = np.zeros(levels.states.size, np.float32)
    known = kernels.block_values(
        blocks.rows, blocks.palette, blocks.shape,
        levels.of(levels.states, LEVEL), levels.of(values, LEVEL), levels.shift[LEVEL],
    )  # fmt: skip
    for level in range(LEVEL, DEPTH):
        below, above = ((levels.of(levels.states, n), levels.of(values, n)) for n in (level, level + 1))
        kernels.merge_values(*below, *above, levels.shift[level + 1])
    if levels.states[-1] == UNKNOWN:
        return Payload(np.empty(0, np.uint8), 0, False)
    out = np.empty(5 * (known + int(np.count_nonzero(levels.states))), np.uint8)
    n, nodes = kernels.write_values(
        blocks.rows, blocks.palette, levels.blocks, levels.states, values.view(np.int32), *levels.layout, out
    )
    return Payload(out[:n], nodes, False)


def encode_states(lattice: Lattice, states: Bytes) -> Payload:
    """Write any box of states (nx, ny, nz): 0 unknown, 1 free, 2 occupied."""
    pads = [(k % EDGE, -(k + n) % EDGE) for k, n in zip(lattice.key_min, lattice.shape, strict=True)]
    padded = np.pad(states, pads)
    x, y, z = (k - k % EDGE for k in lattice.key_min)
    blocks = VoxelBlocks(Lattice(lattice.resolution, (x, y, z), padded.shape))
    blocks.set_layers(0, np.array([np.nan, CLAMP_MIN, CLAMP_MAX], np.float32)[padded])
    return encode_binary(blocks)


class _Levels:
    """Where the nodes of a box of blocks are at levels 3 to 16, and their states.

    Attributes:
        blocks: (2, 3) key of the first block at level 3, and blocks along each axis.
        shift: (17, 3) index in each level of the parent of the first node of the level below.
        layout: (17,) where each level begins in an array of all nodes, (17, 3) shape, (17, 3) key of the first node.
        states: States of all nodes, 0 at first.
    """

    def __init__(self, blocks: VoxelBlocks) -> None:
        offset, total = np.zeros(DEPTH + 1, np.int64), 0
        shape, origin, self.shift = (np.zeros((DEPTH + 1, 3), np.int64) for _ in range(3))
        first: Ints = blocks.key_min // EDGE
        end = first + blocks.shape
        self.blocks: Ints = np.stack([first, blocks.shape])
        for level in range(LEVEL, DEPTH + 1):
            # the root is a single node
            even, even_end = (first & ~1, (end + 1) & ~1) if level < DEPTH else (first, end)
            self.shift[level], origin[level], shape[level], offset[level] = first - even, even, even_end - even, total
            total += int(np.prod(shape[level]))
            first, end = even >> 1, even_end >> 1
        self.layout = (offset, shape, origin)
        self.states: Bytes = np.zeros(total, np.uint8)

    def of(self, flat: NDArray[ScalarT], level: int) -> NDArray[ScalarT]:
        """Return the part of an array of all nodes that is one level."""
        start, shape = int(self.layout[0][level]), tuple(int(n) for n in self.layout[1][level])
        return flat[start : start + int(np.prod(shape))].reshape(shape)


@dataclass(frozen=True, eq=False)
class Leaves:
    """The leaves of a tree; they are read from its bytes part by part, as there are many times as many bytes of them.

    Attributes:
        resolution: Edge of a cell of level 0, m.
        raw: The tree, sound.
        binary: True for the binary form.
        nodes: Nodes of the tree, inner ones too.
        tree: Class of the tree.
        robot: Robot in whose base frame it is; "" where a file does not say it, as those of other programs.
    """

    resolution: float
    raw: Bytes
    binary: bool
    nodes: int
    tree: str = TREE_ID
    robot: str = ""

    def arrays(self) -> tuple[NDArray[np.int32], Floats]:
        """Return (n, 4) level, x, y, z key at that level, and log-odds (n,)."""
        parts = [(cells.copy(), values.copy()) for cells, values in self._parts()]
        cells, values = zip(*parts, strict=True) if parts else ([np.empty((0, 4), np.int32)], [np.empty(0, np.float32)])
        return np.concatenate(cells), np.concatenate(values)

    def on(self, lattice: Lattice) -> tuple[Floats, int]:
        """Return log-odds of a box, NaN where unknown, and how many leaves lie outside of it, wholly or in part.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when the resolutions differ.
        """
        if not self._fits(lattice):
            raise _invalid(f"the map has cells of {self.resolution:g} m, expected {lattice.resolution:g} m")
        out = np.full(lattice.shape, np.nan, np.float32)
        where = (np.array(lattice.key_min, np.int64), np.array(lattice.shape, np.int64))
        return out, sum(kernels.paint(*part, *where, out) for part in self._parts())

    def put(self, blocks: VoxelBlocks, low: float, high: float, T_map_tree: Array | None = None) -> int:
        """Replace cells; see `openarm_common.octree.resample` for a tree of cells of another size or in another frame.

        Args:
            blocks: Changed.
            low: Log-odds are cut to this,
            high: and to this.
            T_map_tree: (4, 4) frame of the tree in that of the cells; None: they are the same.

        Returns:
            How many leaves lie outside of the box, wholly or in part.
        """
        blocks.clear()
        outside, lattice = 0, blocks.lattice
        if T_map_tree is not None or not self._fits(lattice):
            T = np.eye(4) if T_map_tree is None else T_map_tree
            for first, values, number in resampled(self._parts, self.resolution, lattice, T):
                blocks.set_layers(first, np.clip(values, low, high, out=values))
                outside += number
            return outside
        shape, nothing = np.array(lattice.shape, np.int64), np.empty((0, 0, 0), np.float32)
        for cells, values in self._parts():
            outside += kernels.paint(cells, values, blocks.key_min, shape, nothing)
            blocks.paint(cells, np.clip(values, low, high))
        return outside

    def _fits(self, lattice: Lattice) -> bool:
        return abs(lattice.resolution - self.resolution) <= 1e-6 * self.resolution

    def _parts(self) -> Iterator[tuple[NDArray[np.int32], Floats]]:
        return _Reader(self.raw, self.binary, self.tree).parts()


class _Reader:
    """Reads the leaves of a tree.

    Args:
        raw: The tree.
        binary: True for the binary form.
        tree: Class of the tree.
    """

    def __init__(self, raw: Bytes, binary: bool, tree: str) -> None:
        self._raw, self._binary, self._extra = raw, binary, 0 if binary else _EXTRA[tree]
        self._stack = np.zeros((8 * (DEPTH + 1), 4), np.int64)
        self._stack[0, 0] = DEPTH
        self._at = np.array([1, 0, 1], np.int64)

    @property
    def used(self) -> int:
        """Bytes that are read."""
        return int(self._at[1])

    @property
    def nodes(self) -> int:
        """Nodes that are read."""
        return int(self._at[2])

    def parts(self) -> Iterator[tuple[NDArray[np.int32], Floats]]:
        """Yield (n, 4) level, x, y, z key at that level, and log-odds (n,), in arrays that the next ones replace.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when the tree ends too early or is deeper than 16 levels.
        """
        if self._raw.size == 0:
            return
        cells, values = np.empty((_PART, 4), np.int32), np.empty(_PART, np.float32)
        free, occupied = np.float32(CLAMP_MIN), np.float32(CLAMP_MAX)
        while self._at[0] > 0:
            if self._binary:
                n = kernels.read_states(self._raw, free, occupied, self._stack, self._at, cells, values)
            else:
                n = kernels.read_values(self._raw, self._extra, self._stack, self._at, cells, values.view(np.int32))
            if n == kernels.TRUNCATED:
                raise _damaged(f"ends after {self._raw.size} bytes in the middle of the tree")
            if n == kernels.TOO_DEEP:
                raise _damaged(f"goes deeper than {DEPTH} levels at byte {self.used}")
            yield cells[:n], values[:n]


def decode(data: Bytes | bytes, resolution: float, *, binary: bool, tree: str = TREE_ID) -> Leaves:
    """Read a payload.

    Args:
        data: Payload without a file header; empty is the empty map.
        resolution: Edge of a cell, m.
        binary: True for the binary form.
        tree: Class of the tree.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the payload ends too early, goes on after its end, is deeper than 16
            levels, or holds log-odds that are not finite, and for the full form of a class that is not known.
    """
    if not binary and tree not in _EXTRA:
        raise _invalid(
            f"tree is of class {brief(tree)}, expected one of {', '.join(_EXTRA)}; the binary form (.bt, writeBinary of"
            " octomap) is read of any class with occupancy"
        )
    if not 1e-4 <= resolution <= 100.0:
        raise _invalid(f"res is {resolution} m, expected 0.0001 .. 100")
    raw = np.frombuffer(data, np.uint8) if isinstance(data, bytes) else data.view(np.uint8)
    reader = _Reader(raw, binary, tree)
    finite = all([np.isfinite(values).all() for _, values in reader.parts()])  # all parts, that the tree is sound
    if reader.used != raw.size:
        raise _damaged(f"goes on for {raw.size - reader.used} bytes after the tree's end")
    if not finite:
        raise _damaged("holds log-odds that are not finite")
    return Leaves(resolution, raw, binary, reader.nodes if raw.size else 0, tree)


def write_file(path: Path, payload: Payload, resolution: float, robot: str = "") -> None:
    """Write a .bt (binary) or .ot (full) file; the file is there whole or not at all.

    Args:
        path: Ends in .bt or .ot.
        payload: The tree.
        resolution: Edge of a cell, m.
        robot: Robot in whose base frame it is; "" is not written.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the suffix does not fit the payload or the folder can't be written.
    """
    suffix = ".bt" if payload.binary else ".ot"
    if path.suffix != suffix:
        raise _invalid(f"{path.name}: the {suffix[1:]} form needs the suffix {suffix}")
    whose = f"{_ROBOT}{' '.join(robot.split())}\n" if robot else ""
    text = f"{_FIRST_LINE[suffix]}\n{_NOTE}\n{whose}id {TREE_ID}\nsize {payload.nodes}\nres {resolution:g}\ndata\n"
    if not path.parent.is_dir():
        raise _invalid(f"{path} can't be written: there is no folder {path.parent}")
    write_whole(path, text.encode() + payload.data.tobytes(), Code.INVALID_ARGUMENT)


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
        way = OTHERS.get(".gz" if content.startswith(b"\x1f\x8b") else path.suffix)
        raise OpenArmError(error.code, f"{path}: {error.message}" + (f"; {way}" if way else "")) from error


def _parse(content: bytes) -> Leaves:
    form = next((suffix for suffix, first in _FIRST_LINE.items() if content.startswith(first.encode())), "")
    head = re.match(rb"(.*?\n)[ \t]*data(?:[ \t\r][^\n]*)?\n", content, re.DOTALL) if form else None
    if content.startswith(struct.pack("<i", 3)) and len(content) >= _FIRST_HEADER.size:
        _, resolution, nodes = _FIRST_HEADER.unpack_from(content)
        leaves, robot = decode(content[_FIRST_HEADER.size :], resolution, binary=True), ""
    elif head is not None:
        lines = head[1].decode(errors="replace").splitlines()
        fields = _fields(lines)
        try:
            resolution, nodes = float(fields["res"]), int(fields.get("size", -1))
        except (KeyError, ValueError) as error:
            raise _invalid(
                f"header needs the edge of a cell in metres, a line such as 'res 0.05' above the line 'data': {error}"
            ) from error
        tree = fields.get("id", TREE_ID)
        leaves = decode(content[head.end() :], resolution, binary=form == ".bt", tree=tree)
        robot = next((line.removeprefix(_ROBOT) for line in lines if line.startswith(_ROBOT)), "")
    else:
        first = " or ".join(map(repr, _FIRST_LINE.values()))
        raise _invalid(f"not an octree file: expected it to begin with {first} and to have a line 'data'")
    if leaves.nodes != nodes and nodes >= 0:
        raise _damaged(f"has {leaves.nodes} nodes, its header says {nodes}")
    return replace(leaves, robot=robot)


def _fields(lines: list[str]) -> dict[str, str]:
    """Return what a header says, in any order; several on a line as octomap reads them."""
    fields: dict[str, str] = {}
    for line in lines:
        words = line.split()
        while len(words) > 1 and words[0] in ("id", "size", "res"):
            fields[words[0]] = words[1]
            words = words[2:]
    return fields


def _damaged(what: str) -> OpenArmError:
    return _invalid(f"octree is damaged: it {what}")


def _invalid(message: str) -> OpenArmError:
    return OpenArmError(Code.INVALID_ARGUMENT, message)
