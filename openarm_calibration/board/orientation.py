# SPDX-License-Identifier: Apache-2.0
"""Which end of a grid without ids is its beginning: its front by chirality, then its colours, then "upright"."""

from __future__ import annotations

import numpy as np

from openarm_calibration.board.detection import plane_fit
from openarm_common.types import Array


def fronts(plane: Array, pixels: Array, rows: int, columns: int) -> list[Array]:
    """Return the orders (n, 2) of a grid's marks in which they are the image of the board's front.

    A finder may start at any corner. A mirrored order fits a plane as well; its chirality differs.

    Args:
        plane: (n, 2) marks on the board, row by row.
        pixels: (n, 2) in the order of the finder, row by row.
        rows: Rows of marks.
        columns: Columns of marks.
    """
    grid = pixels.reshape(rows, columns, 2)
    grids = [grid, grid[::-1, ::-1], grid[::-1], grid[:, ::-1]]
    if rows == columns:
        grids += [one.transpose(1, 0, 2) for one in grids]
    orders = [np.ascontiguousarray(order.reshape(-1, 2)) for order in grids]
    fits = [(*plane_fit(plane, order), k) for k, order in enumerate(orders)]
    return [orders[k] for _, mirrored, k in sorted(fits) if not mirrored] or [orders[0]]


def upright(orders: list[Array], rows: int, columns: int) -> Array:
    """Return the order in which the board's x axis points most to the right, and its y axis most down."""

    def score(order: Array) -> float:
        grid = order.reshape(rows, columns, 2)
        x, y = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0), grid[-1].mean(axis=0) - grid[0].mean(axis=0)
        return float(x[0] / np.linalg.norm(x) + y[1] / np.linalg.norm(y))

    return max(orders, key=score)
