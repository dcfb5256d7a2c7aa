# SPDX-License-Identifier: Apache-2.0
"""From frames to a map and all that is derived from it, one update at a time.

A `Mapper` may be called from several threads; each call has the map to itself. Coordinates are in the base frame, m.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from openarm_common.camera.cameras import CameraConfig
from openarm_common.camera.flying_pixels import FlyingConfig, label_flying
from openarm_common.camera.housings import with_housings
from openarm_common.errors import Code, OpenArmError
from openarm_common.octree.blocks import CellSet
from openarm_common.octree.codec import TREE_ID, Leaves, Payload, encode_states, read_file, write_file
from openarm_common.octree.lattice import DEPTH, Lattice
from openarm_common.printable import printable
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.held import HeldBox
from openarm_common.robot.self_filter import SelfFilter, Shapes
from openarm_common.types import Array, Floats
from openarm_octomap.config import FieldConfig, FilterConfig, GridConfig, UnknownPolicy
from openarm_octomap.distance import DistanceTransform
from openarm_octomap.grid import CloudScan, DepthScan, OccupancyGrid
from openarm_octomap.kernels import OCCUPIED, UNKNOWN

#: Beyond any workspace, and still a whole number of cells, m.
_FAR = 1e6
#: Of map files.
SUFFIXES = (".bt", ".ot")


@dataclass(frozen=True, eq=False)
class Frame:
    """A scan of a camera or another source, and the joints at its stamp.

    Attributes:
        source: Name of the camera or cloud.
        t_ns: Stamp.
        scan: The image or cloud.
        joints: Positions by joint name at the stamp; empty when the robot is not cut out.
    """

    source: str
    t_ns: int
    scan: DepthScan | CloudScan
    joints: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class MapSnapshot:
    """The map at one moment.

    Attributes:
        lattice: Cells of the map.
        binary: Octree of states.
        full: Octree of log-odds, where it was wanted.
        states: (nx, ny, nz) copy, where it was wanted.
    """

    lattice: Lattice
    binary: Payload
    full: Payload | None = None
    states: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class MapAnswer:
    """The state of the map at points.

    Attributes:
        states: (n,) UNKNOWN, FREE or OCCUPIED; a coarse cell is occupied when a part of it is.
        blocked: (n,) whether to keep clear.
        resolution: Edge of the cells that answered, m.
    """

    states: NDArray[np.uint8]
    blocked: NDArray[np.bool_]
    resolution: float


@dataclass(frozen=True, eq=False)
class MapReport:
    """What an update did.

    Attributes:
        snapshot: The map afterwards.
        changed: Cells whose state changed.
        removed: Pixels or points that each link (or held box) took, by source.
        flying: Pixels that were left out because they float between surfaces, by source.
        reset: Cells that the robot filled.
        ends: Cells that rays ended in.
        outdated: Whether the frames were left out, as the map was reset, loaded or edited after they were taken.
    """

    snapshot: MapSnapshot
    changed: CellSet
    removed: Mapping[str, Mapping[str, int]] = field(default_factory=dict[str, Mapping[str, int]])
    flying: Mapping[str, int] = field(default_factory=dict[str, int])
    reset: int = 0
    ends: int = 0
    outdated: bool = False


@dataclass(frozen=True)
class Taken:
    """What became of a tree that replaced the map.

    Attributes:
        nodes: Nodes of the tree.
        outside: Leaves that lie outside of the workspace, wholly or in part.
        text: A sentence that says so, and what was changed or left out.
    """

    nodes: int
    outside: int
    text: str


class Mapper:
    """The map with its self-filter and its distance field.

    Args:
        description: The robot.
        grid: Parameters of the map.
        robot: Parameters of what is cut out of the images.
        distances: Parameters of the distance field.
    """

    def __init__(
        self, description: RobotDescription, grid: GridConfig, robot: FilterConfig, distances: FieldConfig
    ) -> None:
        self._grid, self._robot = OccupancyGrid(grid), description.name
        self._description, self._config = description, robot
        self.mount({})
        self._filtering = robot.enabled
        self._reset_padding = robot.reset_padding
        self._flying = robot.flying
        self._transform = DistanceTransform(self._grid.lattice, distances.reach, distances.unknown)
        self._lock = threading.Lock()
        self._edition = 0

    def mount(self, cameras: Mapping[str, CameraConfig]) -> None:
        """Take the housings of cameras, by name, at these mounts for a part of the robot from now on."""
        self._filter = SelfFilter(with_housings(self._description, cameras.values()), self._config)

    @property
    def edition(self) -> int:
        """How often the map was reset, loaded or edited."""
        return self._edition

    @property
    def lattice(self) -> Lattice:
        """Which cells the map has."""
        return self._grid.lattice

    def update(
        self,
        frames: Sequence[Frame],
        held: Sequence[HeldBox] = (),
        distances: Floats | None = None,
        wanted: Collection[str] = (),
        edition: int | None = None,
    ) -> MapReport:
        """Put the frames of one moment into the map.

        Args:
            frames: Frames, at least one.
            held: Boxes that the hands hold.
            distances: (nx, ny, nz), filled with the distance field; None leaves it out.
            wanted: "full" and "states", where the snapshot needs them.
            edition: Edition of the map when the frames were taken: they are left out of a later one. None: of any.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when frames are missing or lack a joint; the map is as it was.
        """
        if not frames:
            raise OpenArmError(Code.INVALID_ARGUMENT, "an update needs at least one frame")
        scans: list[DepthScan | CloudScan] = []
        removed: dict[str, Mapping[str, int]] = {}
        flying: dict[str, int] = {}
        newest = max(frames, key=lambda frame: frame.t_ns)
        shapes: Shapes | None = None
        for frame in frames:
            scan = frame.scan
            if self._filtering:
                body = self._filter.shapes(frame.joints, held)
                shapes = body if frame is newest else shapes
                if isinstance(scan, DepthScan):
                    label, removed[frame.source] = self._filter.label_depth(scan, body)
                else:
                    label, removed[frame.source] = self._filter.label_points(scan.points, body)
                scan = replace(scan, label=label)
            if self._flying.enabled and isinstance(scan, DepthScan):
                scan, flying[frame.source] = _without_flying(scan, self._flying)
            scans.append(scan)
        with self._lock:
            outdated = edition is not None and edition != self._edition
            update = self._grid.integrate([] if outdated else scans, newest.t_ns)
            changed, reset = update.changed, 0
            changed |= self._grid.decay(newest.t_ns)
            if shapes is not None:
                gone = self._grid.forget(shapes, self._reset_padding)
                changed |= gone
                reset = gone.size
            if distances is not None:
                self._transform.compute(self._grid.blocks, distances)
            return MapReport(
                snapshot=self._snapshot(wanted),
                changed=changed,
                removed=removed,
                flying=flying,
                reset=reset,
                ends=update.ends,
                outdated=outdated,
            )

    def snapshot(self, wanted: Collection[str] = ()) -> MapSnapshot:
        """Return the map as it is; `wanted` as for `update`."""
        with self._lock:
            return self._snapshot(wanted)

    def coarse(self, depth: int) -> tuple[Lattice, Payload]:
        """Return the map at another depth, 1 to 16, as an octree whose smallest cells are of that depth."""
        with self._lock:
            if depth == DEPTH:
                return self._grid.lattice, self._grid.binary()
            lattice, states = self._grid.coarse(depth)
        return lattice, encode_states(lattice, states)

    def compute_distances(self, out: Floats) -> None:
        """Fill (nx, ny, nz) with the distance field of the map as it is."""
        with self._lock:
            self._transform.compute(self._grid.blocks, out)

    def counts(self, t_ns: int) -> dict[str, float]:
        """Return cells by state, and the longest time since an occupied cell was observed, s."""
        with self._lock:
            return self._grid.counts() | {"oldest_s": self._grid.oldest_s(t_ns)}

    def reset(self) -> None:
        """Forget everything."""
        with self._lock:
            self._edition += 1
            self._grid.reset()

    def clear_box(self, lower: ArrayLike, upper: ArrayLike, state: int) -> int:
        """Make a box FREE or UNKNOWN; see `OccupancyGrid.clear_box`.

        Args:
            lower: Corner (3,), m.
            upper: Opposite corner (3,), m.
            state: FREE or UNKNOWN.
        """
        with self._lock:
            self._edition += 1
            return self._grid.clear_box(lower, upper, state)

    def save(self, path: Path) -> int:
        """Write the map: .bt has occupied and free, .ot the log-odds.

        Returns:
            Nodes written.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for another suffix or a folder that can't be written.
        """
        if path.suffix not in SUFFIXES:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{str(path)!r} needs the suffix .bt or .ot")
        with self._lock:
            payload = self._grid.full() if path.suffix == ".ot" else self._grid.binary()
        write_file(path, payload, self._grid.lattice.resolution, self._robot)
        return payload.nodes

    def query(self, points: ArrayLike, resolution: float, unknown: UnknownPolicy) -> MapAnswer:
        """Look up the state of points.

        Args:
            points: (n, 3), finite, m.
            resolution: Largest cell that may answer, m; 0 is the map's own.
            unknown: State that unknown cells count as, and so does what lies outside of the workspace.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for points that are not finite, or a resolution finer than the map's.
        """
        at = np.asarray(points, np.float64).reshape(-1, 3)
        if not np.isfinite(at).all():
            raise OpenArmError(Code.INVALID_ARGUMENT, "points are not finite; expected metres in the base frame")
        edge = self._grid.lattice.resolution
        # a hair of tolerance: 0.04 means cells of twice 0.02
        if not (resolution == 0.0 or edge * (1.0 - 1e-6) <= resolution < math.inf):
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"resolution is {resolution:g} m; expected 0 or at least the map's {edge:g} m"
            )
        levels = math.floor(math.log2(resolution / edge) + 1e-6) if resolution > 0.0 else 0
        depth = max(DEPTH - levels, 1)
        at = np.clip(at, -_FAR, _FAR)
        with self._lock:
            states = self._grid.states_at(at, depth)
        blocked = (states == OCCUPIED) | ((states == UNKNOWN) & (unknown == "occupied"))
        return MapAnswer(states, blocked, edge * 2 ** (DEPTH - depth))

    def load(self, path: Path) -> Taken:
        """Replace the map by that of a file.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when the file is damaged or of another class of tree, or says that it is of
                another robot, whose base frame is elsewhere; the map is as it was.
        """
        leaves = read_file(path)
        if leaves.robot not in ("", self._robot):
            text = f"{path} is of robot {leaves.robot[:80]!r}, expected {self._robot!r}"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{text}: its cells are in another base frame")
        return self.take(leaves)

    def take(self, leaves: Leaves, T_base_tree: Array | None = None) -> Taken:
        """Replace the map by a tree; see `OccupancyGrid.load`.

        Args:
            leaves: The tree.
            T_base_tree: (4, 4) its frame in the base frame; None: it is the base frame.
        """
        with self._lock:
            self._edition += 1
            outside = self._grid.load(leaves, T_base_tree)
            counts = self._grid.counts()
        edge = self._grid.lattice.resolution
        text = f"{leaves.nodes} nodes"
        if abs(leaves.resolution - edge) > 1e-6 * edge:
            text += f" of {leaves.resolution:g} m in cells of {edge:g} m"
        if leaves.tree not in (TREE_ID, "1"):
            text += f" of a {printable(leaves.tree, longest=40)}, of which the occupancy alone is taken"
        text += f"; {counts['occupied']} cells are occupied and {counts['free']} free"
        return Taken(leaves.nodes, outside, f"{text}; {outside} leaves outside of the workspace")

    def _snapshot(self, wanted: Collection[str]) -> MapSnapshot:
        grid = self._grid
        return MapSnapshot(
            lattice=grid.lattice,
            binary=grid.binary(),
            full=grid.full() if "full" in wanted else None,
            states=grid.blocks.states() if "states" in wanted else None,
        )


def _without_flying(scan: DepthScan, config: FlyingConfig) -> tuple[DepthScan, int]:
    """Return the image with its flying pixels labelled, and how many there are.

    They mark nothing, and they clear nothing either. Of the two surfaces that such a pixel saw, only the nearer one's
    depth is surely free, and the neighbour on that surface clears the same cells: pixels are a few millimetres apart,
    cells 2 cm. To clear up to the pixel's own depth would free what the near surface hides.
    """
    label = np.zeros(scan.depth.shape, np.uint8) if scan.label is None else scan.label.copy()
    count = label_flying(scan, config, label)
    return replace(scan, label=label), count
