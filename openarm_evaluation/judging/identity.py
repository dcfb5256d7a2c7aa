# SPDX-License-Identifier: Apache-2.0
"""Whether ids of objects live: IDF1 and switches of the MOTChallenge, and what is merged or split.

IDF1 (Ristani et al. 2016, Performance measures and a data set for multi-target, multi-camera tracking) pairs each true
object with one id for the whole sequence, as well as can be, and is the F1 score of the sights that these pairs share.
Switches are those of CLEAR MOT (Bernardin and Stiefelhagen 2008): in each frame a pair of the frame before stays, then
the nearest are paired; an object that is paired with another id than the last time has switched.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np
from scipy.optimize import linear_sum_assignment

from openarm_common.types import Array, Ints

T = TypeVar("T", bound=Hashable)
#: Stands for the distance of what is no pair.
_NO_PAIR = 1e9
#: An object is shown by an id from this overlap (intersection over union) on, and part of it from this share of it on.
_OVERLAP, _PART = 0.5, 0.2


@dataclass
class IdentityScore(Generic[T]):
    """Ids of one sequence, frame by frame, or of several.

    Attributes:
        sights: Number of sights of true objects.
        shown: Number of sights of ids.
        right: Sights that the best pairs of objects and ids share, in `close`d sequences.
        switches: Number of changes of the id of an object.
        merged: Sights of objects that share an id with a larger part of another object.
        split: Sights of objects that several ids show, each a part.
    """

    sights: int = 0
    shown: int = 0
    right: int = 0
    switches: int = 0
    merged: int = 0
    split: int = 0
    _pairs: Counter[tuple[T, T]] = field(default_factory=Counter[tuple[T, T]])
    _last: dict[T, T] = field(default_factory=dict[T, T])

    @property
    def idf1(self) -> float:
        """0 to 1; 1 when there is nothing."""
        return 2.0 * self.right / (self.sights + self.shown) if self.sights + self.shown else 1.0

    def add(self, objects: Sequence[T], ids: Sequence[T], distance: Array) -> None:
        """Take a frame.

        Args:
            objects: True ones in view.
            ids: Shown.
            distance: (objects, ids), NaN where they are no pair.
        """
        self.sights += len(objects)
        self.shown += len(ids)
        for a, b in np.argwhere(np.isfinite(distance)):
            self._pairs[objects[a], ids[b]] += 1
        cost = np.where(np.isfinite(distance), distance, _NO_PAIR)
        for a, one in enumerate(objects):
            if one in self._last and self._last[one] in ids:
                b = ids.index(self._last[one])
                if cost[a, b] < _NO_PAIR:
                    cost[a], cost[:, b], cost[a, b] = _NO_PAIR, _NO_PAIR, 0.0
        for a, b in zip(*linear_sum_assignment(cost), strict=True):
            if cost[a, b] < _NO_PAIR:
                one = objects[a]
                self.switches += self._last.get(one, ids[b]) != ids[b]
                self._last[one] = ids[b]

    def add_image(self, truth: Ints, shown: Ints, least: int) -> None:
        """Take an image.

        Args:
            truth: (n,) number of the object that a pixel shows, 0: none.
            shown: (n,) id that it has, 0: none.
            least: Objects and ids of fewer pixels do not count.
        """
        objects = [int(i) for i, n in zip(*np.unique(truth, return_counts=True), strict=True) if i and n >= least]
        ids = [int(i) for i, n in zip(*np.unique(shown, return_counts=True), strict=True) if i and n >= least]
        common = np.array([[np.count_nonzero((truth == a) & (shown == b)) for b in ids] for a in objects], np.int64)
        common = common.reshape(len(objects), len(ids))
        area = np.array([np.count_nonzero(truth == a) for a in objects], np.int64)
        union = area[:, None] + [np.count_nonzero(shown == b) for b in ids] - common
        overlap = common / np.maximum(union, 1)
        self.add(objects, ids, np.where(overlap >= _OVERLAP, 1.0 - overlap, np.nan))  # pyright: ignore[reportArgumentType]
        if common.size:
            parts = common >= _PART * area[:, None]
            larger = common < common.max(axis=0)
            self.merged += int((larger & parts)[np.arange(len(objects)), common.argmax(axis=1)].sum())
            self.split += int(np.count_nonzero(parts.sum(axis=1) > 1))

    def close(self) -> None:
        """End a sequence: objects and ids of the next one are others."""
        objects, ids = ({pair[k]: None for pair in self._pairs} for k in (0, 1))
        table = np.array([[self._pairs[a, b] for b in ids] for a in objects]).reshape(len(objects), len(ids))
        self.right += int(table[linear_sum_assignment(-table)].sum())
        self._pairs.clear()
        self._last.clear()
