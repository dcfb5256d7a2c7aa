# SPDX-License-Identifier: Apache-2.0
"""Centres of dark circles by their grey values, once the grid is known.

The centre of gravity of the darkness of a disc is the centre of its ellipse however it is blurred, as long as the
blur is even and all of it is counted. Contours of a disc of ten pixels are three times as far off. Pixels are (u, v)
with the centre of the top-left pixel at (0, 0); the board's plane is in m.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from openarm_common.types import Array

#: Darkness is counted up to here, in radii of the circle; beyond it is the white that it is measured from.
_INNER, _OUTER = 1.45, 1.85
#: Of a correction, in radii; beyond it the circle is not where it was said to be.
_FARTHEST = 0.4
#: Pixels that the white is measured from.
_FEWEST = 12
#: Of the white around a circle, off its own plane, as a share of the contrast: more is a finger, or the edge of the
#: board. Blur and noise of a circle of six pixels make 0.14.
_UNEVEN = 0.2
_TURN = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
_RIM: Array = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1)


def refined(
    image: NDArray[np.uint8], centres: Array, plane: Array, radius: float, H: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Centres of circles (n, 2) by the grey values around them.

    Args:
        image: (h, w) grey.
        centres: (n, 2) within 0.4 radii, px.
        plane: (n, 2) circle centres on the board, m.
        radius: Of the circles, m; nothing but white within 1.85 radii of a centre.
        H: (3, 3) homography from the plane to pixels.

    Returns:
        The centres, and (n,) which of them are sure: the others are as they were, because something else or the edge
        of the image lies too near.
    """
    out, sure = centres.copy(), np.zeros(len(centres), dtype=bool)
    back: Array = np.linalg.inv(H).astype(np.float64)
    for k, (centre, at) in enumerate(zip(centres, plane, strict=True)):
        reach = mapped(H, at + _OUTER * radius * _RIM)
        low, high = np.floor(reach.min(axis=0)).astype(int), np.ceil(reach.max(axis=0)).astype(int) + 1
        if (low < 0).any() or high[0] > image.shape[1] or high[1] > image.shape[0]:
            continue
        u, v = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        places = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
        away = np.linalg.norm(mapped(back, places) - at, axis=1) / radius
        grey = image[low[1] : high[1], low[0] : high[0]].ravel().astype(np.float64)
        offset = places - centre
        ring, inside = (away >= _INNER) & (away < _OUTER), away < _INNER
        if np.count_nonzero(ring) < _FEWEST:
            continue
        # white as a plane of grey: light may fall unevenly
        columns = np.column_stack([np.ones(len(offset)), offset])
        dark = columns @ np.linalg.lstsq(columns[ring], grey[ring], rcond=None)[0] - grey
        total, contrast = float(dark[inside].sum()), float(dark[away < 0.5].max(initial=0.0))
        if not total > 0.0 or float(np.abs(dark[ring]).max()) > _UNEVEN * contrast:
            continue
        correction = dark[inside] @ offset[inside] / total
        limit = _FARTHEST * float(np.ptp(reach, axis=0).min()) / (2.0 * _OUTER)
        if float(np.linalg.norm(correction)) <= limit:
            out[k], sure[k] = centre + correction, True
    return out, sure


def mapped(H: Array, points: Array) -> Array:
    """Points (n, 2) through a homography (3, 3)."""
    p = points @ H[:, :2].T + H[:, 2]
    return p[:, :2] / p[:, 2:]
