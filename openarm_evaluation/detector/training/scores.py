# SPDX-License-Identifier: Apache-2.0
"""How good a detector is: average precision as COCO counts it, centre error, confusion. Needs no torch.

Boxes are left, top, right, bottom in pixels of the picture as it was taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openarm_common.types import Array
from openarm_perception.detection.boxes import Candidates, overlap

Truth = tuple[NDArray[np.int64], Array]

#: A detection counts as shown from this score on.
SHOWN = 0.5
_OVERLAPS = np.linspace(0.5, 0.95, 10)
_RECALLS = np.linspace(0.0, 1.0, 101)


@dataclass(frozen=True)
class Scores:
    """Figures of one set.

    Attributes:
        map50: Mean over the classes that are there of the average precision at an overlap of one half.
        map: The same, mean over overlaps from 0.5 to 0.95.
        ap50: Average precision at an overlap of 0.5, by class.
        any50: Average precision when the class does not matter.
        centre_median_px: Distance of the middles of boxes that are shown and right; NaN without one.
        centre_p95_px: The same, 95th percentile.
        precision: Share of shown detections that are right.
        recall: Share of objects that are shown.
        confusion: (classes + 1, classes + 1): row what it is, column what it was called; the last row is nothing
            that was called something, the last column something that was missed.
        objects: Number of objects.
        pictures: Number of pictures.
    """

    map50: float
    map: float
    ap50: tuple[float, ...]
    any50: float
    centre_median_px: float
    centre_p95_px: float
    precision: float
    recall: float
    confusion: NDArray[np.int64]
    objects: int
    pictures: int


def score(found: Sequence[Candidates], truth: Sequence[Truth], classes: int) -> Scores:
    """Figures of detections (score 0.05 and up) of pictures, and what is in these."""
    ap = np.array([_average_precision(found, truth, kind) for kind in range(classes)])
    there = [any((kinds == kind).any() for kinds, _ in truth) for kind in range(classes)]
    counted = ap[there] if any(there) else ap
    anything = [Candidates(np.zeros_like(f.classes), f.scores, f.boxes) for f in found]
    any50 = _average_precision(anything, [(np.zeros_like(kinds), boxes) for kinds, boxes in truth], 0)[0]
    confusion = np.zeros((classes + 1, classes + 1), np.int64)
    errors: list[float] = []
    for candidates, (kinds, boxes) in zip(found, truth, strict=True):
        errors += _confuse(candidates, kinds, boxes, confusion)
    right, shown, objects = int(np.trace(confusion)), int(confusion[:, :-1].sum()), int(confusion[:-1].sum())
    return Scores(
        map50=float(counted[:, 0].mean()),
        map=float(counted.mean()),
        ap50=tuple(float(value) for value in ap[:, 0]),
        any50=float(any50),
        centre_median_px=float(np.median(errors)) if errors else float("nan"),
        centre_p95_px=float(np.percentile(errors, 95)) if errors else float("nan"),
        precision=right / max(shown, 1),
        recall=right / max(objects, 1),
        confusion=confusion,
        objects=objects,
        pictures=len(truth),
    )


def _average_precision(found: Sequence[Candidates], truth: Sequence[Truth], kind: int) -> Array:
    """Of one class at each overlap, (10,)."""
    rows: list[tuple[float, NDArray[np.bool_]]] = []
    positives = 0
    for candidates, (kinds, boxes) in zip(found, truth, strict=True):
        mine = boxes[kinds == kind]
        positives += len(mine)
        used = np.zeros((len(_OVERLAPS), len(mine)), np.bool_)
        for i in np.nonzero(candidates.classes == kind)[0]:
            hit = np.zeros(len(_OVERLAPS), np.bool_)
            if len(mine):
                shared = overlap(candidates.boxes[i], mine)
                for level, least in enumerate(_OVERLAPS):
                    free = np.where(used[level], 0.0, shared)
                    best = int(free.argmax())
                    if free[best] >= least:
                        used[level, best] = hit[level] = True
            rows.append((float(candidates.scores[i]), hit))
    if not positives or not rows:
        return np.zeros(len(_OVERLAPS))
    rows.sort(key=lambda row: -row[0])
    hits = np.cumsum([hit for _, hit in rows], axis=0)
    recall, precision = hits / positives, hits / np.arange(1, len(rows) + 1)[:, None]
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    out = np.zeros(len(_OVERLAPS))
    for level in range(len(_OVERLAPS)):
        at = np.searchsorted(recall[:, level], _RECALLS)
        out[level] = np.where(at < len(rows), precision[at.clip(max=len(rows) - 1), level], 0.0).mean()
    return out


def _confuse(
    candidates: Candidates, kinds: NDArray[np.int64], boxes: Array, confusion: NDArray[np.int64]
) -> list[float]:
    """Count what is shown; centre errors of what is right."""
    left = set(range(len(kinds)))
    errors: list[float] = []
    for i in np.nonzero(candidates.scores >= SHOWN)[0]:
        shared = overlap(candidates.boxes[i], boxes) if len(boxes) else np.zeros(0)
        owner = max(left, key=lambda k: shared[k], default=-1)
        if owner < 0 or shared[owner] < 0.5:
            confusion[-1, candidates.classes[i]] += 1
            continue
        left.remove(owner)
        confusion[kinds[owner], candidates.classes[i]] += 1
        if kinds[owner] == candidates.classes[i]:
            middle = (candidates.boxes[i, :2] + candidates.boxes[i, 2:] - boxes[owner, :2] - boxes[owner, 2:]) / 2.0
            errors.append(float(np.hypot(*middle)))
    for owner in left:
        confusion[kinds[owner], -1] += 1
    return errors
