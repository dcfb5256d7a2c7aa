# SPDX-License-Identifier: Apache-2.0
"""Centres of dark circles by their grey values, once the grid is known.

The centre of gravity of the darkness of a disc is the centre of its ellipse however it is blurred, as long as the
blur is even and all of it is counted. Contours of a disc of ten pixels are three times as far off. Pixels are (u, v)
with the centre of the top-left pixel at (0, 0); the board's plane is in m.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Darkness is counted up to here, in radii of the circle; beyond it is the white that it is measured from.
_INNER, _OUTER = 1.45, 1.85
#: Of a correction, in radii: beyond it something else lies in the window.
_FARTHEST = 0.4
#: Pixels that the white is measured from.
_FEWEST = 12
_TURN = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
_RIM: Array = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1)


def refined(image: NDArray[np.uint8], centres: Array, plane: Array, radius: float, H: Array) -> Array:
    """Centres of circles (n, 2) by the grey values around them; as they were where a window leaves the image.

    Args:
        image: (h, w) grey.
        centres: (n, 2) within half a radius, px.
        plane: (n, 2) circle centres on the board, m.
        radius: Of the circles, m; neighbours are at least 3.7 radii apart in the plane or cut the window short.
        H: (3, 3) homography from the plane to pixels.
    """
    back: Array = np.linalg.inv(H).astype(np.float64)
    height, width = image.shape
    out = centres.copy()
    for k, (centre, at) in enumerate(zip(centres, plane, strict=True)):
        reach = _mapped(H, at + _OUTER * radius * _RIM)
        low, high = np.floor(reach.min(axis=0)).astype(int), np.ceil(reach.max(axis=0)).astype(int) + 1
        if (low < 0).any() or high[0] > width or high[1] > height:
            continue
        u, v = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        places = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
        away = np.linalg.norm(_mapped(back, places) - at, axis=1) / radius
        grey = image[low[1] : high[1], low[0] : high[0]].ravel().astype(np.float64)
        offset = places - centre
        ring, inside = (away >= _INNER) & (away < _OUTER), away < _INNER
        if np.count_nonzero(ring) < _FEWEST:
            continue
        # white as a plane of grey: light may fall unevenly
        columns = np.column_stack([np.ones(len(offset)), offset])
        white = columns @ np.linalg.lstsq(columns[ring], grey[ring], rcond=None)[0]
        dark = (white - grey)[inside]
        total = float(dark.sum())
        if not total > 0.0:
            continue
        correction = dark @ offset[inside] / total
        limit = _FARTHEST * float(np.ptp(reach, axis=0).min()) / (2.0 * _OUTER)
        if float(np.linalg.norm(correction)) <= limit:
            out[k] = centre + correction
    return out


def _mapped(H: Array, points: Array) -> Array:
    p = points @ H[:, :2].T + H[:, 2]
    return p[:, :2] / p[:, 2:]
