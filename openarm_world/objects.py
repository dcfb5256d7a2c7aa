# SPDX-License-Identifier: Apache-2.0
"""The tracker: objects in, a depth image and what was detected in it in, objects out; nothing else is remembered.

Each object is predicted (it stands, or it moves with the box that holds it) and explained in the new image. Detections
go to the objects that have most of their points in view in them; one that several objects share is divided among them:
detections merge, objects do not. An object whose place is seen through is followed to what came near by, or is gone.
What is hidden stays. What no object explains is born.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from openarm_common import se3
from openarm_common.camera.depth_view import DepthView
from openarm_common.labelled_cloud import LabelledCloud
from openarm_common.types import Array, Ints
from openarm_world.carried import Grip, HeldBoxes, gripped, let_go, motions
from openarm_world.config import WorldConfig
from openarm_world.shares import FREE, HIDDEN, SEEN, explain, look

_STANDS = np.eye(4)
#: Spreads of what is put down again differ by no more, as a share of them: it shows other sides.
_ALIKE = 0.25
K = TypeVar("K")
L = TypeVar("L")


@dataclass(frozen=True, eq=False)
class Track:
    """An object.

    Attributes:
        id: Its number, never given again.
        points: (n, 3) of its surface where it is believed to be, base frame, m.
        seen_ns: Stamp of the newest image that showed it.
    """

    id: int
    points: Array
    seen_ns: int


@dataclass(frozen=True, eq=False)
class Sight:
    """What an image has said of the objects.

    Attributes:
        ids: Id of the object that a detection shows, by its label; unique in the image: of an object that is seen in
            two parts, the lesser one has `3.2`.
        owner: (n,) id of the object of each point of the cloud; 0: none.
        born: Ids of new objects.
        gone: Ids of objects whose place is empty.
    """

    ids: Mapping[int, str]
    owner: Ints
    born: tuple[int, ...] = ()
    gone: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Objects:
    """All objects; a value.

    Attributes:
        config: Thresholds of what counts as the same object.
        tracks: The objects, oldest first.
        next_id: Number of the next one.
        t_ns: Stamp of the newest image.
        grips: Grips of each hand, by its name.
    """

    config: WorldConfig = field(default_factory=WorldConfig)
    tracks: tuple[Track, ...] = ()
    next_id: int = 1
    t_ns: int = 0
    grips: Mapping[str, Grip] = field(default_factory=dict[str, Grip])

    def update(
        self, view: DepthView, cloud: LabelledCloud, t_ns: int, carriers: Mapping[str, HeldBoxes] | None = None
    ) -> tuple[Objects, Sight]:
        """Return the objects after an image, and what it has said of them.

        Args:
            view: Depth without the noise of single pixels.
            cloud: Points of the image in the base frame, and what was detected in it.
            t_ns: Stamp; one before the last (a world that was reset) forgets all objects.
            carriers: Boxes of the hands at this stamp, by name: objects in one move with it; None: not known.
        """
        if t_ns < self.t_ns:
            return Objects(self.config, next_id=self.next_id).update(view, cloud, t_ns, carriers)
        T = motions(self.grips, carriers or {})
        moved = [_moved(track, T[track.id], view, self.config) if track.id in T else track for track in self.tracks]
        shown = _Shown(moved, view, cloud, self.config)
        parts, left, lost = shown.associated(frozenset() if carriers is None else let_go(self.grips, carriers))
        after = list[Track]()
        for t, track in enumerate(moved):
            if t in parts:
                kept = track.points[shown.state[t] == HIDDEN]
                points = thinned(np.concatenate([shown.points[parts[t]], kept]), self.config.spacing)
                after.append(Track(track.id, points, t_ns))
            elif t not in lost and t_ns - track.seen_ns <= self.config.forget * 1e9:
                after.append(track)
        born = list[int]()
        for c in left:
            born.append(self.next_id + len(born))
            mine = shown.label == c
            shown.owner[mine] = born[-1]
            after.append(Track(born[-1], thinned(shown.points[mine], self.config.spacing), t_ns))
        owner = np.zeros(len(cloud.labels), np.int64)
        owner[cloud.labels > 0] = shown.owner
        grips = self.grips if carriers is None else gripped(self.grips, carriers, after, self.config.same)
        waiting = {name: held.middle for name, held in (carriers or {}).items() if not grips[name].ids}
        # a hand that has closed since the last image holds what has left its place below it
        for t, name in _nearest(
            {t: np.median(moved[t].points[:, :2], axis=0) for t in lost},
            {name: middle[:2] for name, middle in waiting.items()},
            self.config.gate,
        ):
            track, middle = moved[t], np.median(moved[t].points, axis=0)
            after.append(replace(track, points=track.points + waiting[name] - middle))
            grips = {**grips, name: replace(grips[name], ids=(track.id,))}
            lost.remove(t)
        tracks = tuple(sorted(after, key=lambda track: track.id))
        objects = replace(self, tracks=tracks, next_id=self.next_id + len(born), t_ns=t_ns, grips=grips)
        gone = tuple(moved[t].id for t in lost)
        return objects, Sight(_names(shown.label, shown.owner), owner, tuple(born), gone)


class _Shown:
    """Objects, predicted, in an image.

    Attributes:
        points: (n, 3) of all detections, m.
        label: (n,) detection of each, from 1 on.
        owner: (n,) id of its object, once associated; 0: none.
        state: State of each point of each object: SEEN, FREE, HIDDEN.
    """

    def __init__(self, tracks: list[Track], view: DepthView, cloud: LabelledCloud, config: WorldConfig) -> None:
        on = cloud.labels > 0
        self.points, self.label = cloud.points[on].astype(np.float64), cloud.labels[on].astype(np.int64)
        self.owner = np.zeros(len(self.label), np.int64)
        self.state = [look(track.points, _STANDS, view, config) for track in tracks]
        self._tracks, self._config = tracks, config

    def associated(self, let_go: frozenset[int]) -> tuple[dict[int, Ints], list[int], list[int]]:
        """Give points to objects.

        Args:
            let_go: Ids of what hands have let go since the last image: it may be anywhere.

        Returns:
            Indices of its points by number of the object; detections that no object explains; numbers of objects that
            have left their places, and were not found near by.
        """
        own, back = self._shares()
        view = np.array([np.mean(state != HIDDEN) for state in self.state])
        judged = view >= self._config.in_view
        who = dict[int, list[int]]()
        for c in np.unique(self.label).tolist():
            mine = np.flatnonzero((own[:, c] >= self._config.same) & judged) if len(own) else np.zeros(0, np.int64)
            if not len(mine) and len(back) and back[:, c].max() >= self._config.same:
                mine = np.array([back[:, c].argmax()])  # a piece of it
            who[c] = mine.tolist()
        left = [c for c in who if not who[c]]
        found = {t for some in who.values() for t in some}
        free = np.array([np.count_nonzero(state == FREE) / max(np.count_nonzero(state), 1) for state in self.state])
        lost = [t for t in range(len(view)) if t not in found and judged[t] and free[t] >= self._config.gone]
        loose = [t for t, track in enumerate(self._tracks) if track.id in let_go and t not in found]
        for t, c in self._put_down(loose, left) + self._followed(lost, left):
            if t not in found and c in left:
                who[c] = [t]
                found.add(t)
                left.remove(c)
        lost = [t for t in lost if t not in found]
        parts = dict[int, list[Ints]]()
        for c, some in who.items():
            for t, mine in self._divided(c, some):
                self.owner[mine] = self._tracks[t].id
                parts.setdefault(t, []).append(mine)
        return {t: np.concatenate(mine) for t, mine in parts.items()}, left, lost

    def _shares(self) -> tuple[Array, Array]:
        """Share of each object's points in view that is in each detection, and of each detection's in each object."""
        n, m = len(self._tracks), int(self.label.max(initial=0)) + 1
        own, back = np.zeros((n, m)), np.zeros((n, m))
        if not n or m == 1:
            return own, back
        reach = 1.5 * self._config.spacing
        sparse = _first_of_voxels(self.points, self._config.spacing)
        points, label = self.points[sparse], self.label[sparse]
        tree = KDTree(points)
        for t, track in enumerate(self._tracks):
            seen = track.points[self.state[t] == SEEN]
            if len(seen):
                far, at = (np.asarray(each) for each in tree.query(seen, distance_upper_bound=reach))
                own[t] = np.bincount(label[at[np.isfinite(far)]], minlength=m) / len(seen)
        there = [track.points[self.state[t] != FREE] for t, track in enumerate(self._tracks)]
        whose = np.repeat(np.arange(n), [len(each) for each in there])
        if len(whose):
            nearest = KDTree(np.concatenate(there)).query(points, distance_upper_bound=reach)
            far, at = (np.asarray(each) for each in nearest)
            near = np.isfinite(far)
            np.add.at(back, (whose[at[near]], label[near]), 1.0)
            back /= np.maximum(np.bincount(label, minlength=m), 1)
        return own, back

    def _followed(self, some: list[int], left: list[int]) -> list[tuple[int, int]]:
        """Return objects that have moved, each with what came near by."""
        old = {t: np.median(self._tracks[t].points, axis=0) for t in some}
        new = {c: np.median(self.points[self.label == c], axis=0) for c in left}
        return _nearest(old, new, self._config.gate)

    def _put_down(self, some: list[int], left: list[int]) -> list[tuple[int, int]]:
        """Return objects that were let go, each with what is most like it, wherever that is."""
        old = {t: _spread(self._tracks[t].points) for t in some}
        new = {c: _spread(thinned(self.points[self.label == c], self._config.spacing)) for c in left}
        return _nearest(old, new, _ALIKE)

    def _divided(self, c: int, some: list[int]) -> list[tuple[int, Ints]]:
        """Divide a detection among objects: each point goes to the one with the nearest point in view."""
        mine = np.flatnonzero(self.label == c)
        if len(some) < 2:
            return [(t, mine) for t in some]
        seen = [self._tracks[t].points[self.state[t] == SEEN] for t in some]
        whose = np.repeat(some, [len(points) for points in seen])
        nearest = whose[KDTree(np.concatenate(seen)).query(self.points[mine])[1]]
        return [(t, mine[nearest == t]) for t in some if (nearest == t).any()]


def _nearest(a: Mapping[K, Array], b: Mapping[L, Array], gate: float) -> list[tuple[K, L]]:
    """Return pairs of the nearest of two sets of places, none farther apart than the gate, m."""
    if not a or not b:
        return []
    away = np.linalg.norm(np.array([*a.values()])[:, None] - [*b.values()], axis=2)
    pairs = zip(*linear_sum_assignment(np.minimum(away, gate)), strict=True)
    return [([*a][i], [*b][j]) for i, j in pairs if away[i, j] < gate]


def _spread(points: Array) -> Array:
    """Return the logarithms of the larger two standard deviations (2,) of points along their main axes, m."""
    return np.log(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[:2] / np.sqrt(len(points)) + 1e-4)


def thinned(points: Array, spacing: float) -> Array:
    """Return the first of the points (n, 3) in each voxel, m."""
    return points[_first_of_voxels(points, spacing)]


def _first_of_voxels(points: Array, spacing: float) -> Ints:
    """Return the index of the first of the points (n, 3) in each voxel."""
    key = np.floor(points / spacing).astype(np.int64) & 0x1FFFFF
    return np.sort(np.unique(key @ np.array([1 << 42, 1 << 21, 1]), return_index=True)[1])


def _moved(track: Track, T: Array, view: DepthView, config: WorldConfig) -> Track:
    """Return an object that moves with a hand, unless more of it is seen where it was: the hand did not take it."""
    stands, moves = (explain(track.points, each, view, config) for each in (_STANDS, T))
    return track if stands.seen > moves.seen else replace(track, points=se3.apply(T, track.points))


def _names(label: Ints, owner: Ints) -> dict[int, str]:
    """Return the id of each detection: of the object that most of its points show."""
    shown = dict[int, list[tuple[int, int]]]()
    for c in np.unique(label).tolist():
        ids, count = np.unique(owner[label == c], return_counts=True)
        shown.setdefault(int(ids[count.argmax()]), []).append((-int(count.max()), c))
    out = dict[int, str]()
    for i, some in shown.items():
        for k, (_, c) in enumerate(sorted(some), start=1):
            out[c] = f"{i}" if k == 1 else f"{i}.{k}"
    return out
