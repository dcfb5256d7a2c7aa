# SPDX-License-Identifier: Apache-2.0
"""Antipodal grasps on a fused surface, ranked.

Two contacts hold an object by friction when the line between them lies in both friction cones (Nguyen, "Constructing
force-closure grasps", IJRR 1988). Pairs of such contacts are found by marching from the surface through the object;
around each, hand poses turn about the closing axis and reach to several depths, and stay when the shape of the hand
has room (ten Pas and Platt, "Using geometry to detect grasp poses in 3D point clouds", ISRR 2015). From coarse to fine:
each pair first with an upright hand, then the best of them in all ways; where the open hand has no room, one that is
opened less, so that a finger goes into what is hollow. The score weighs how much touches, how well
it faces the pads, how far the weight is from the pads, room, tilt, and how much of it was seen.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from math import acos, cos, radians

import numpy as np

from openarm_common.octree.distance_field import DistanceField
from openarm_common.types import Array
from openarm_grasp.config import ApproachConfig, CloudConfig
from openarm_grasp.sampling import antipodal_kernels as kernels
from openarm_grasp.sampling import ranking_kernels
from openarm_grasp.sampling.hand_shape import HandShape
from openarm_grasp.sampling.surface import Surface
from openarm_grasp.sampling.voxel_kernels import SHADOW, boundary

#: Boundary voxels that pairs start from, a multiple of the pairs that are kept.
_STARTS = 4
#: Pairs are one when their middles are in one cell of this edge, voxels, and their axes in one sector, rad.
_SAME_MIDDLE, _SAME_AXIS = 3.0, radians(12.0)
#: Widths that pairs of are kept each, m: below, between and above.
_WIDTHS = (0.012, 0.030, 0.055)
#: Sine of the steepest closing axis.
_LEAN = 0.5
#: Contact along the pad, 0 its upper end: upright hands first, then all.
_FIRST_DEPTHS, _DEPTHS = (0.35, 0.8), (0.15, 0.4, 0.65, 0.9)
#: Good poses of one pair that lean alike, and of all.
_PER_KIND, _ENOUGH = 2, 400
#: Candidates whose hands are turned alike, within these angles: arms reach other turns, too.
_ALIKE, _TURN = 6, radians(30.0)
#: Candidates differ by a displacement of the TCP, m, or a turn.
_APART, _TURNED = 0.008, radians(12.0)
#: A pad that touches with this share of its area holds as well as one that touches with all.
_TOUCH = 0.35
#: Weights of the score; lengths m, angles rad.
_WEIGHTS = {"contact": 1.5, "align": 10.0, "lever": -25.0, "aside": -10.0, "tilt": -0.8, "level": -0.8, "wide": -1.5,
            "room": 0.3, "narrow": -1.0, "certainty": 1.0, "balance": -2.0, "unseen": -2.0}  # fmt: skip
#: The weight may be this far from the pads before it counts, m.
_LEVER = 0.005
#: A width this near to the widest begins to count, m; alignments count from here.
_WIDE, _ALIGNED = 0.020, 0.9
#: And a width may be larger or smaller by this share: what is steep is measured too narrow, what is thin too wide.
_SLACK = 0.08
#: Share of the margin that is kept where there is no grasp with all of it.
_TIGHT = 0.5
#: What a pair without an upright hand lost against one with it.
_NOT_UPRIGHT = 1.0


@dataclass(frozen=True, eq=False)
class Antipodal:
    """One grasp on a surface.

    Attributes:
        T_base_tcp: (4, 4).
        width: Extent between the pads, m.
        apertures: Least and greatest aperture that the closed hand may have, m.
        patch_area: Area of the smaller patch, m2.
        tilt: Tilt of the approach from straight down, rad.
        score: The sum of `parts`.
        parts: Terms of the score.
        opened: Aperture of the hand on its approach, m; None: wide open.
    """

    T_base_tcp: Array
    width: float
    apertures: tuple[float, float]
    patch_area: float
    tilt: float
    score: float
    parts: Mapping[str, float]
    opened: float | None


@dataclass(frozen=True)
class Tried:
    """How many poses were tried, and why the others were refused."""

    pairs: int
    poses: int
    good: int
    why: Mapping[str, int]


_WHY = ("tried", "object", "table", "hand in something", "too wide, or something between", "approach", "contact",
        "alignment")  # fmt: skip


class Search:
    """Looks for grasps of one hand on one surface.

    Args:
        surface: Surface to grasp on.
        shape: Shape of the hand.
        config: Parameters of the search.
        approach: Distance and tilts.
        field: Distances to obstacles; read where the surface knows nothing.
        centre: (3,) centre of mass of the target, base frame; None: of its volume.
    """

    def __init__(
        self,
        surface: Surface,
        shape: HandShape,
        config: CloudConfig,
        approach: ApproachConfig,
        field: DistanceField | None = None,
        centre: Array | None = None,
    ) -> None:
        self._surface, self._shape, self._config, self._approach = surface, shape, config, approach
        self._field = field
        self._centre = surface.voxel(surface.centroid if centre is None else centre)
        step = surface.step
        self._pads, self._tips = shape.pads / step, shape.tips / step
        self._margin = config.margin
        self._widest, self._obstacles = self._fits(shape), surface.obstacles
        self._least_cos = cos(radians(config.cone_deg))
        self._why = np.zeros(len(_WHY), np.int64)
        self._pairs = np.empty((0, 8))
        self._good = 0

    @property
    def widest(self) -> float:
        """Width that the open hand had room around in what was searched last, m."""
        return self._widest * self._surface.step

    @property
    def tried(self) -> Tried:
        """What the search has done so far."""
        why = {str(name): int(count) for name, count in zip(_WHY[1:], self._why[1:], strict=True)}
        return Tried(len(self._pairs), int(self._why[0]), self._good, why)

    def best(self) -> tuple[Antipodal, ...]:
        """Find grasps, best first; the same for the same surface.

        Where the hand has no room for any with a voxel to spare, those are searched that have none, and half of the
        clearance to the fingers.
        """
        found = self._best()
        if not found:
            self._margin *= _TIGHT
            self._widest, self._obstacles = self._fits(self._shape), self._surface.tight
            found = self._best()
        return found

    def _best(self) -> tuple[Antipodal, ...]:
        self._pairs = self._find_pairs()
        if not len(self._pairs):
            return ()
        bound = self._bound(self._pairs)
        order = np.argsort(-bound, kind="stable")
        first = _hypotheses(order, (0.0,), _FIRST_DEPTHS, (1.0,))
        upright = self._search(first, self._shape, per_kind=1, enough=len(order))
        expected = bound - _WEIGHTS["contact"] - _NOT_UPRIGHT
        if len(upright):
            expected[upright[:, kernels.PAIR].astype(int)] = self._scores(upright)[0]
        turns = [sign * radians(t) for t in self._approach.tilts_deg for sign in ((1.0, -1.0) if t else (1.0,))]
        rest = _hypotheses(np.arange(len(expected)), turns, _DEPTHS, (1.0, -1.0))
        hoped = expected[rest[:, 0].astype(int)] + _WEIGHTS["tilt"] * np.abs(rest[:, 1])
        rest = rest[np.argsort(-hoped, kind="stable")]
        found = [upright, self._search(rest, self._shape, per_kind=_PER_KIND, enough=_ENOUGH)]
        for shape in self._shape.narrower:
            roomy = np.concatenate([rows[:, kernels.PAIR] for rows in found]).astype(int)
            tight = self._pairs[:, 6] <= self._fits(shape)
            tight[roomy] = False
            one = rest[tight[rest[:, 0].astype(int)]]
            found.append(self._search(one, shape, per_kind=_PER_KIND, enough=_ENOUGH))
        return self._ranked(np.concatenate(found))

    def exhaustive(self) -> tuple[Antipodal, ...]:
        """Find grasps without the coarse stage: every pair in all ways; what `best` is compared with."""
        self._config = self._config.model_copy(update={"poses": 10**9})
        self._pairs = self._find_pairs()
        turns = [sign * radians(t) for t in self._approach.tilts_deg for sign in ((1.0, -1.0) if t else (1.0,))]
        every = _hypotheses(np.arange(len(self._pairs)), turns, _DEPTHS, (1.0, -1.0))
        shapes = (self._shape, *self._shape.narrower)
        found = [self._search(every, shape, per_kind=len(every) + 1, enough=len(every)) for shape in shapes]
        return self._ranked(np.concatenate(found))

    def near(self, T_base_tcp: Array, width: float, opened: float | None) -> tuple[Antipodal, ...]:
        """Find grasps next to a pose of the hand, best first.

        Args:
            T_base_tcp: (4, 4).
            width: Extent between the pads there, m.
            opened: Aperture of the hand, m; None: wide open.
        """
        T, every = T_base_tcp, (self._shape, *self._shape.narrower)
        shape = self._shape if opened is None else min(every, key=lambda s: abs(2.0 * s.opening - opened))
        pad = shape.pads[int(np.abs(shape.fingers - 0.5 * width).argmin())]
        middle = self._surface.voxel(T[:3, 3] + 0.5 * (pad[2] + pad[3]) * T[:3, 2])
        down = np.array([0.0, 0.0, -1.0])
        down -= (down @ T[:3, 1]) * T[:3, 1]
        turn = acos(float(np.clip(down @ T[:3, 2] / max(float(np.linalg.norm(down)), 1e-9), -1.0, 1.0)))
        turn *= 1.0 if float(np.cross(down, T[:3, 2]) @ T[:3, 1]) >= 0.0 else -1.0
        tries = np.array([(0.0, turn, depth, 1.0, 0.0) for depth in (0.5, 0.35, 0.65, 0.2, 0.8)])
        self._pairs = np.array([[*middle, *T[:3, 1], width / self._surface.step, 1.0]])
        return self._ranked(self._search(tries, shape, per_kind=2, enough=_ENOUGH))

    def _find_pairs(self) -> Array:
        """Pairs of contacts (p, 8), one of each kind."""
        surface, most = self._surface, self._config.pairs
        edge = boundary(surface.cells)
        edge = edge[surface.normals[tuple(edge.T)].any(axis=1)]
        # shuffled by a generator of its own, so that the same surface gives the same starts, spread over all of it
        starts = edge[np.random.default_rng(0).permutation(len(edge))[: _STARTS * most]]
        out = np.empty((4 * len(starts), 8))
        n = kernels.pairs(surface.cells, surface.normals, starts, _LEAN, self._widest, self._least_cos, out)
        pairs = out[:n]
        pairs[(pairs[:, 3] < 0.0) | ((pairs[:, 3] == 0.0) & (pairs[:, 4] < 0.0)), 3:6] *= -1.0
        sector = np.floor(np.arctan2(pairs[:, 4], pairs[:, 3]) / _SAME_AXIS)
        keys = np.column_stack([np.floor(pairs[:, :3] / _SAME_MIDDLE), sector, np.abs(pairs[:, 5]) > 1e-9])
        pairs = pairs[np.argsort(-pairs[:, 7], kind="stable")]
        keys = keys[np.argsort(-out[:n, 7], kind="stable")] if n else keys
        _, first = np.unique(keys, axis=0, return_index=True)
        pairs = pairs[np.sort(first)]
        # the best of each width in turn: the rim of a mug has hundreds of pairs, its body a few
        order = np.argsort(-self._bound(pairs), kind="stable")
        width = np.digitize(pairs[order, 6] * surface.step, _WIDTHS)
        rank = np.empty(len(order), np.int64)
        for one in range(len(_WIDTHS) + 1):
            rank[width == one] = np.arange(np.count_nonzero(width == one))
        return np.ascontiguousarray(pairs[order[np.sort(np.argsort(rank, kind="stable")[:most])]])

    def _bound(self, pairs: Array) -> Array:
        """About the best score (p,) of a hand at each pair."""
        step = self._surface.step
        off = (self._centre - pairs[:, :3])[:, :2]
        level = np.maximum(np.linalg.norm(pairs[:, 3:5], axis=1), 1e-6)
        lever = np.abs(off[:, 0] * pairs[:, 4] - off[:, 1] * pairs[:, 3]) / level * step
        aside = np.abs((off * pairs[:, 3:5]).sum(axis=1)) / level * step
        w = _WEIGHTS
        return np.asarray(
            w["contact"]
            + w["align"] * (pairs[:, 7] - _ALIGNED)
            + w["lever"] * np.maximum(lever - _LEVER, 0.0)
            + w["aside"] * aside
            + w["level"] * np.abs(pairs[:, 5])
            + w["wide"] * self._wide(pairs[:, 6])
        )

    def _wide(self, widths: Array) -> Array:
        """How far widths (n,), voxels, are in the last part of what the hand takes, 0 to 1."""
        return np.maximum(1.0 - (self._widest - widths) * self._surface.step / _WIDE, 0.0)

    def _fits(self, shape: HandShape) -> float:
        """Width that a hand has room around, voxels."""
        return 2.0 * (shape.opening - self._margin) / self._surface.step

    def _search(self, hypotheses: Array, shape: HandShape, *, per_kind: int, enough: int) -> Array:
        """Rows of `found`, one a pose of a hand that has room; each hand may try so many poses."""
        surface, step = self._surface, self._surface.step
        found = np.zeros((enough, kernels.COLUMNS))
        if not len(hypotheses):
            return found[:0]
        count = kernels.search(
            surface.cells, self._obstacles, surface.normals, self._pairs, hypotheses, shape.points / step, self._pads,
            self._tips, shape.opening / step, (self._shape.fingers[1] - self._shape.fingers[0]) / step,
            self._config.table_clearance / step, self._approach.pregrasp_distance / step,
            self._centre, self._fits(shape), self._least_cos, per_kind, enough,
            int(self._why[0]) + self._config.poses, found, self._why,
        )  # fmt: skip
        self._good += count
        return found[:count]

    def _scores(self, found: Array) -> tuple[Array, dict[str, Array]]:
        """Scores (n,) of rows, and their parts."""
        step, k, w = self._surface.step, kernels, _WEIGHTS
        parts = {
            "contact": w["contact"] * np.minimum(found[:, k.TOUCH] / _TOUCH, 1.0),
            "align": w["align"] * (found[:, k.ALIGN] - _ALIGNED),
            "lever": w["lever"] * np.maximum(found[:, k.LEVER] * step - _LEVER, 0.0),
            "aside": w["aside"] * found[:, k.ASIDE] * step,
            "tilt": w["tilt"] * found[:, k.TILT],
            "level": w["level"] * np.abs(found[:, 9]),
            "wide": w["wide"] * self._wide(found[:, k.WIDTH]),
            "room": w["room"] * (found[:, k.ROOM] - 1.0),
            "narrow": w["narrow"] * (1.0 - found[:, k.OPENING] * step / self._shape.opening),
            "certainty": w["certainty"] * (found[:, k.SURE] - 1.0),
            "balance": w["balance"] * np.arctan(found[:, k.SLOPE]),
            "unseen": w["unseen"] * (found[:, k.BLIND] + found[:, k.UNSEEN] * step / _WIDE),
        }
        return np.asarray(sum(parts.values())), parts

    def _ranked(self, found: Array) -> tuple[Antipodal, ...]:
        """Best first, no two alike, none whose hand is in a voxel that was seen or near an obstacle of the map."""
        if not len(found):
            return ()
        found = found[np.argsort(-self._scores(found)[0], kind="stable")]
        step, surface = self._surface.step, self._surface
        apart = ranking_kernels.distinct(found, _APART / step, cos(_TURNED), len(found))
        found = found[apart]
        scores, parts = self._scores(found)
        seen = surface.middles(np.argwhere((surface.cells > 0) & (surface.cells < SHADOW)))
        shapes = {one.opening: one for one in (self._shape, *self._shape.narrower)}
        best: list[Antipodal] = []
        rest: list[Antipodal] = []
        alike: Counter[tuple[int, ...]] = Counter()
        for row in range(len(found)):
            T = np.eye(4)
            T[:3] = found[row, :12].reshape(3, 4)
            T[:3, 3] = surface.low + T[:3, 3] * step
            turned = tuple(int(v) for v in np.round(np.append(T[:2, 1], T[:2, 2]) / _TURN))
            if alike[turned] >= _ALIKE and len(rest) == self._config.best:
                continue
            R, p = np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()
            shape = shapes[min(shapes, key=lambda o: abs(o - float(found[row, kernels.OPENING]) * step))]
            low, high = shape.points.min(axis=0), shape.points.max(axis=0)
            if ranking_kernels.inside(seen, R, p, shape.planes, shape.starts, low, high):
                continue
            if not self._clear_of_map(T, shape):
                continue
            alike[turned] += 1
            one = self._grasp(found[row], T, float(scores[row]), {n: float(v[row]) for n, v in parts.items()})
            (best if alike[turned] <= _ALIKE else rest).append(one)
            if len(best) == self._config.best:
                break
        best += rest[: self._config.best - len(best)]
        return tuple(sorted(best, key=lambda one: -one.score))

    def _grasp(self, row: Array, T: Array, score: float, parts: dict[str, float]) -> Antipodal:
        step, k = self._surface.step, kernels
        width = float(row[k.WIDTH]) * step
        pad = self._shape.pads[int(np.abs(self._shape.fingers - 0.5 * width).argmin())]
        area = float(row[k.TOUCH] * (pad[1] - pad[0]) * (pad[3] - pad[2]))
        # a voxel each way, and more at a side that was not seen; an object that turns in the hand gets narrower
        unsure = float(row[k.UNSEEN]) * step
        least = max((1.0 - _SLACK) * float(row[k.NARROW]) * step - 2.0 * step, 0.0)
        most = min(width * (1.0 + _SLACK) + 2.0 * step + unsure, 2.0 * float(row[k.OPENING]) * step)
        finger = float(row[k.OPENING]) * step
        opened = 2.0 * finger if finger < self._shape.opening - 1e-6 else None
        return Antipodal(T, width, (least, most), area, float(row[k.TILT]), score, parts, opened)

    def _clear_of_map(self, T: Array, shape: HandShape) -> bool:
        """Whether the hand keeps out of the cells of the map beyond the voxels of the surface."""
        if self._field is None:
            return True
        points = shape.points @ T[:3, :3].T + T[:3, 3]
        local = self._surface.voxel(points)[:, :2]
        beyond = ((local < 0.0) | (local >= self._surface.cells.shape[:2])).any(axis=1)
        return not bool((self._field.at(points[beyond]) < 0.87 * self._field.lattice.resolution).any())


def _hypotheses(
    pairs: np.ndarray[tuple[int, ...], np.dtype[np.int64]],
    turns: tuple[float, ...] | list[float],
    depths: tuple[float, ...],
    signs: tuple[float, ...],
) -> Array:
    """Every combination (n, 5) of pair, turn, depth and sign, pair by pair; kinds are pairs and turns."""
    grids = np.meshgrid(pairs, turns, depths, signs, indexing="ij")
    kind = np.arange(len(pairs) * len(turns)).repeat(len(depths) * len(signs))
    return np.column_stack([*(grid.ravel() for grid in grids), kind]).astype(np.float64)
