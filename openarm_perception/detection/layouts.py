# SPDX-License-Identifier: Apache-2.0
"""Layouts of the outputs of networks: which one an output has, and its classes, scores and boxes.

An output is looked at as a table (channels, n), a column for each box. Four channels are the box; scores, classes and
what masks, key points and angles need follow. Boxes are pixels of the input, or shares of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openarm_perception.detection.boxes import Candidates, suppress

Table = NDArray[np.float32]
#: Columns, their classes and their scores.
Picked = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]

#: Boxes that end before this everywhere are shares of the input: as pixels they would be specks in its corner.
_LARGEST_SHARE = 2.0
#: Most boxes that are compared with each other.
_MOST = 2000


@dataclass(frozen=True)
class Layout:
    """How the output of a network says what is where.

    Attributes:
        pick: Finds the columns of a table with a score, given the number of classes and the least score.
        transposed: The output is (n, channels), not (channels, n).
        corners: Boxes are left, top, right, bottom, not the middle, width and height.
        stretched: Images are stretched to the input, not fitted into it.
        turned: The last channel is the angle of the box, rad; the box around it is used.
    """

    pick: Callable[[Table, int, float], Picked]
    transposed: bool = False
    corners: bool = False
    stretched: bool = False
    turned: bool = False

    def table(self, output: NDArray[np.floating]) -> Table:
        """Return the table (channels, n) of an output."""
        return (output.T if self.transposed else output).astype(np.float32, copy=False)

    def found(self, table: Table, classes: int, threshold: float, size: tuple[int, int]) -> Candidates:
        """Return all boxes of a table with at least this score, in pixels of an input (width, height)."""
        columns, kinds, scores = self.pick(table, classes, threshold)
        order = np.argsort(-scores, kind="stable")[:_MOST]
        first, second = table[:4, columns[order]].astype(np.float64).reshape(2, 2, -1)
        if table[:4].max(initial=0.0) <= _LARGEST_SHARE:
            sides = np.reshape(size, (2, 1))
            first, second = first * sides, second * sides
        if not self.corners:
            if self.turned:
                angle = table[-1, columns[order]].astype(np.float64)
                across, along = np.abs(np.cos(angle)), np.abs(np.sin(angle))
                second = second * across + second[::-1] * along
            first, second = first - second / 2.0, first + second / 2.0
        return Candidates(kinds[order], scores[order].astype(np.float64), np.concatenate([first, second]).T)


def _best(scores: Table, threshold: float) -> Picked:
    best = scores.max(axis=0)
    columns = np.nonzero(best >= threshold)[0]
    return columns, scores[:, columns].argmax(axis=0), best[columns]


def _scores(table: Table, classes: int, threshold: float) -> Picked:
    """A score for each class."""
    return _best(table[4 : 4 + classes], threshold)


def _objectness(table: Table, classes: int, threshold: float) -> Picked:
    """A score for being an object at all, then one for each class."""
    return _best(table[4] * table[5 : 5 + classes], threshold)


def _rows(table: Table, classes: int, threshold: float) -> Picked:
    """One score, then the number of the class; rows of class -1 are none."""
    columns = np.nonzero((table[4] >= threshold) & (table[5] != -1.0))[0]
    with np.errstate(invalid="ignore"):  # what is no number becomes one that no class has
        return columns, table[5, columns].astype(np.int64), table[4, columns]


#: (4 + classes, n), and the same (n, 4 + classes).
YOLOV8 = Layout(_scores)
TRANSPOSED = Layout(_scores, transposed=True)
#: (n, 4 + classes), the answers to n queries; its images are stretched.
RT_DETR = Layout(_scores, transposed=True, stretched=True)
#: (n, 6), the same after its choice of the best class.
RT_DETR_ROWS = Layout(_rows, transposed=True, stretched=True)
#: (n, 6), after non-maximum suppression or without need of any.
END_TO_END = Layout(_rows, transposed=True, corners=True)
#: (n, 5 + classes), three boxes for each cell.
YOLOV5 = Layout(_objectness, transposed=True)


def layout_of(output: NDArray[np.floating], classes: int, extra: int, size: tuple[int, int]) -> Layout | None:
    """Return the layout of an output, by its shape and what it says of an image.

    Args:
        output: (a, b).
        classes: Number of classes of the network.
        extra: Channels after those of scores and classes.
        size: (width, height) of the input.
    """
    rows, channels = output.shape
    if channels == 6 + extra and _has_rows(output, classes):
        boxes = output[:, :4]
        centred = 0.0 < boxes.max(initial=0.0) <= _LARGEST_SHARE and (boxes[:, 2:] < boxes[:, :2]).any()
        return RT_DETR_ROWS if centred else END_TO_END
    if rows == 4 + classes + extra:
        return YOLOV8
    if channels == 4 + classes + extra:
        return RT_DETR if 0.0 < output[:, :4].max(initial=0.0) <= _LARGEST_SHARE else TRANSPOSED
    # with one box for each cell it is of YOLOX, whose images are not scaled from 0 to 1, or of YOLOv6
    cells = np.cumsum([(size[0] // step) * (size[1] // step) for step in (8, 16, 32, 64)])
    return YOLOV5 if channels == 5 + classes + extra and rows not in cells[2:] else None


def _has_rows(output: NDArray[np.floating], classes: int) -> bool:
    """Whether the sixth channel holds numbers of classes; of one class, 1 is its score."""
    kinds = output[:, 5]
    whole = bool((kinds == np.round(kinds)).all()) and kinds.min(initial=0.0) >= -1.0
    return whole and (classes > 1 or kinds.max(initial=0.0) != 1.0)


def decode(table: Table, threshold: float, max_overlap: float, limit: int = 100) -> Candidates:
    """Return boxes of an output of YOLOv8 in pixels without the weaker ones of the same object.

    Args:
        table: (4 + classes, n): cx, cy, width, height, then a score for each class.
        threshold: Least score.
        max_overlap: Same as for `suppress`.
        limit: Most boxes.
    """
    found = YOLOV8.found(table, len(table) - 4, threshold, (1, 1))
    return suppress(found, max_overlap, limit)
