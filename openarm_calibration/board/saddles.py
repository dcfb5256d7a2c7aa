# SPDX-License-Identifier: Apache-2.0
"""Corners between two black and two white fields, to a few hundredths of a pixel.

Around such a corner the grey value is `m + c E(d1 / s) E(d2 / s)`, with the distances `d1`, `d2` from two edges that
cross there and `E` the error function of blur `s`. Its seven unknowns are found by least squares, for all corners at
once. Nothing else may be in the window.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from openarm_calibration.board.detection import Grey, mapped, robust_homography, smooth_image
from openarm_common.types import Array

#: Half of the window as a share of the distance to the next edge, and its bounds, px.
_WINDOW, _SMALLEST, _LARGEST = 0.75, 2.0, 9.0
_ROUNDS = 12
#: Steps of the numeric derivatives: place, px; directions, rad; logarithm of the blur; contrast and grey value.
_STEPS = (1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-2, 1e-2)
_LEAST_BLUR, _MOST_BLUR = 0.3, 4.0
#: Least contrast of a corner, grey values.
_FAINT = 8.0


def located(plane: Array, image: Grey, rough: Array, reach: float) -> Array:
    """Return corners (n, 2) by the grey values around them; one without a clear saddle stays where it was, px.

    Args:
        plane: (n, 2) corners on the board, m.
        image: (h, w) grey.
        rough: (n, 2) within about a pixel; those that are farther off start where the others predict them.
        reach: Distance on the board to the next edge that is no part of the corner, m.
    """
    H = robust_homography(plane, rough)
    first, sure = _fitted(image, rough, *_around(plane, H, reach))
    if np.count_nonzero(sure) < 4:
        return rough
    wanted, _ = smooth_image(plane, first, sure)
    apart = np.linalg.norm(first - wanted, axis=1)
    astray = ~sure | (apart > 0.5 + 4.0 * np.median(apart[sure]))
    start = np.where(astray[:, None], wanted, first)
    again, settled = _fitted(image, start, *_around(plane, H, reach))
    return np.where(settled[:, None], again, rough)


def _around(plane: Array, H: Array, reach: float) -> tuple[Array, Array]:
    """Return the directions (n, 2) of the edges at each corner, rad, and half of its window (n,), px."""
    here = mapped(H, plane)
    steps = [mapped(H, plane + step) - here for step in ((reach, 0.0), (0.0, reach))]
    angles = np.stack([np.arctan2(step[:, 1], step[:, 0]) for step in steps], axis=1)
    # the distance of the next edge, which is parallel to one of the two
    area = np.abs(steps[0][:, 0] * steps[1][:, 1] - steps[0][:, 1] * steps[1][:, 0])
    spans = area / np.maximum(*(np.linalg.norm(step, axis=1) for step in steps))
    return angles, np.clip(_WINDOW * spans, _SMALLEST, _LARGEST)


def _fitted(image: Grey, rough: Array, angles: Array, halves: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the corners (n, 2) of least squares, and (n,) which of them are sure.

    Args:
        image: (h, w) grey.
        rough: (n, 2) where to begin, px.
        angles: (n, 2) directions of the edges, rad.
        halves: (n,) half of the windows, px.
    """
    base = np.rint(rough).astype(int)
    most = int(np.ceil(halves.max()))
    span = np.arange(-most, most + 1)
    offsets = np.stack(np.meshgrid(span, span), axis=-1).reshape(-1, 2)
    places = base[:, None] + offsets
    inside = ((places >= 0) & (places < np.array(image.shape[::-1]))).all(axis=2)
    at = np.clip(places, 0, np.array(image.shape[::-1]) - 1)
    grey = image[at[..., 1], at[..., 0]].astype(np.float64)
    weight = ((np.linalg.norm(places - rough[:, None], axis=2) <= halves[:, None] * 1.2) & inside).astype(np.float64)
    total = np.maximum(weight.sum(axis=1), 1.0)
    where: Array = places.astype(np.float64)
    mean = (weight * grey).sum(axis=1) / total
    spread = np.sqrt((weight * (grey - mean[:, None]) ** 2).sum(axis=1) / total)
    unknowns = np.concatenate(
        [rough, angles, np.zeros((len(rough), 1)), 1.3 * spread[:, None], mean[:, None]], axis=1
    )  # fmt: skip
    unknowns[:, 5] *= np.where(_correlation(unknowns, where, grey, weight) < 0.0, -1.0, 1.0)
    damping = np.full(len(rough), 1e-2)
    cost = _cost(unknowns, where, grey, weight)
    for _ in range(_ROUNDS):
        model = _model(unknowns, where)
        J = np.empty((*grey.shape, 7))
        for k, step in enumerate(_STEPS):
            ahead = unknowns.copy()
            ahead[:, k] += step
            J[..., k] = (_model(ahead, where) - model) / step
        JW = J * weight[..., None]
        normal = np.swapaxes(JW, 1, 2) @ J
        right = (np.swapaxes(JW, 1, 2) @ (grey - model)[..., None])[..., 0]
        diagonal = np.einsum("nii->ni", normal)
        normal = normal + np.eye(7) * (damping[:, None] * diagonal + 1e-9)[:, None, :]
        tried = unknowns + np.linalg.solve(normal, right[..., None])[..., 0]
        tried[:, 4] = np.clip(tried[:, 4], np.log(_LEAST_BLUR), np.log(_MOST_BLUR))
        now = _cost(tried, where, grey, weight)
        better = now < cost
        unknowns = np.where(better[:, None], tried, unknowns)
        cost = np.where(better, now, cost)
        damping = np.where(better, damping * 0.2, damping * 10.0)
    near = np.linalg.norm(unknowns[:, :2] - rough, axis=1) <= np.maximum(halves, 1.5)
    rest = np.sqrt(cost / total)
    sure = near & (np.abs(unknowns[:, 5]) > _FAINT) & (rest < 0.5 * np.abs(unknowns[:, 5])) & (total > 12.0)
    return np.where(sure[:, None], unknowns[:, :2], rough), sure


def _model(unknowns: Array, places: Array) -> Array:
    """Return the grey values (n, pixels) of corners: place, directions, logarithm of the blur, contrast, mean."""
    away = places - unknowns[:, None, :2]
    out = unknowns[:, 5, None].copy()
    for k in (2, 3):
        c, s = np.cos(unknowns[:, k, None]), np.sin(unknowns[:, k, None])
        out = out * erf((away[..., 1] * c - away[..., 0] * s) / (np.sqrt(2.0) * np.exp(unknowns[:, 4, None])))
    return out + unknowns[:, 6, None]


def _correlation(unknowns: Array, places: Array, grey: Array, weight: Array) -> Array:
    return (weight * (_model(unknowns, places) - unknowns[:, 6, None]) * (grey - unknowns[:, 6, None])).sum(axis=1)


def _cost(unknowns: Array, places: Array, grey: Array, weight: Array) -> Array:
    return (weight * (_model(unknowns, places) - grey) ** 2).sum(axis=1)
