# SPDX-License-Identifier: Apache-2.0
"""Grids of circles in a grey image.

Circles are located by their grey values once the grid is known. The centre of gravity of the darkness of a disc is the
centre of its ellipse however it is blurred, as long as the blur is even and all of it is counted. Contours of a disc of
ten pixels are three times as far off. The board's plane is in m.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_calibration.board.circles import CircleGrid, SymmetricCircles
from openarm_calibration.board.detection import (
    MOST_DISTORTED,
    BoardDetection,
    Grey,
    examine,
    mapped,
    pitch,
    plane_fit,
    robust_homography,
    smooth_image,
    unzoomed,
    zoomed,
)  # fmt: skip
from openarm_calibration.board.orientation import fronts, upright
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

Circles = CircleGrid | SymmetricCircles

#: Darkness is counted up to here, in radii of the circle; beyond it is the white that it is measured from.
_INNER, _OUTER = 1.45, 1.85
#: Of a correction, in radii; beyond it the circle is not where it was said to be.
_FARTHEST = 0.4
#: Pixels that the white is measured from.
_FEWEST = 12
#: Of the white around a circle, off its own plane, as a share of the contrast: more is a finger, or the edge of the
#: board. Blur and noise of a circle of six pixels make 0.14.
_UNEVEN = 0.2
#: Of the circles that must be seen well; with fewer it may be another board.
_LEAST_SHARE = 0.7
#: Blobs lie on the image of a plane to this, px; with more the lens distorts.
_BENT = 0.4
#: Directions about a circle, opposite ones as one, and of each the spread of the rim (2, 2).
_HALF_TURN = 12
_ANGLES = (np.arange(_HALF_TURN) + 0.5) * np.pi / _HALF_TURN
_RIM = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
_SPREAD = _RIM[:, :, None] * _RIM[:, None, :]
#: Middles of the parts of a pixel, (n, 2) from its own.
_PARTS = (np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0)), axis=-1).reshape(-1, 2) - 1.5) / 4.0
#: Most steps to a circle, and the last one, in radii.
_ROUNDS, _STILL = 8, 1e-3


def refined(image: Grey, centres: Array, plane: Array, radius: float, H: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the centres of circles (n, 2) by the grey values around them.

    Args:
        image: (h, w) grey.
        centres: (n, 2) within 0.4 radii, px.
        plane: (n, 2) circle centres on the board, m.
        radius: Radius, m; nothing but white within 1.85 radii of a centre, in half of the directions or more.
        H: (3, 3) homography from the plane to pixels.

    Returns:
        The centres, and (n,) which of them are sure: the others are as they were, because something else or the edge
        of the image lies too near.
    """
    out, sure = centres.copy(), np.zeros(len(centres), dtype=bool)
    for k, (centre, at) in enumerate(zip(centres, plane, strict=True)):
        # the board is flat and a circle is small: an ellipse, the image of the unit circle
        axes = [mapped(H, at + np.array([step, -step])) for step in radius * np.eye(2)]
        ellipse = np.column_stack([(one - other) / 2.0 for one, other in axes])
        found = _centre(image, centre, ellipse)
        if found is not None:
            out[k], sure[k] = found, True
    return out, sure


def _centre(image: Grey, start: Array, ellipse: Array) -> Array | None:
    """Return the centre (2,) of a dark ellipse on white, px; None when it is not where it was said to be.

    It is where the darkness balances. Where something other than white is near, the directions of that are left out,
    and those opposite: what is left balances about the same centre.

    Args:
        image: (h, w) grey.
        start: (2,) px.
        ellipse: (2, 2) that maps the unit circle to it, px.
    """
    reach = _OUTER * np.linalg.norm(ellipse, axis=1)
    low, high = np.floor(start - reach).astype(int), np.ceil(start + reach).astype(int) + 1
    if (low < 0).any() or high[0] > image.shape[1] or high[1] > image.shape[0]:
        return None
    u, v = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    places = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    grey = image[low[1] : high[1], low[0] : high[0]].ravel().astype(np.float64)
    to_circle = np.linalg.inv(ellipse).astype(np.float64)
    # white as a plane of grey: light may fall unevenly
    columns = np.column_stack([np.ones(len(places)), places - start])
    centre = start
    for _ in range(_ROUNDS):
        from_centre = (places - centre) @ to_circle.T
        away = np.linalg.norm(from_centre, axis=1)
        ring, inside = (away >= _INNER) & (away < _OUTER), away < _INNER
        if np.count_nonzero(ring) < _FEWEST:
            return None
        white = float(np.median(grey[ring]))
        contrast = white - float(grey[away < 0.5].min(initial=white))
        clean = ring & (np.abs(grey - white) <= 2.0 * _UNEVEN * contrast)
        dark = columns @ np.linalg.lstsq(columns[clean], grey[clean], rcond=None)[0] - grey
        used = np.ones(_HALF_TURN, dtype=bool)
        used[_direction(from_centre[ring & (np.abs(dark) > _UNEVEN * contrast)])] = False
        if not used.all():
            # of a pixel the part that lies in directions which are used
            parts = from_centre[inside, None] + _PARTS @ to_circle.T
            dark[inside] *= used[_direction(parts)].mean(axis=1)
        total = float(dark[inside].sum())
        if 2 * np.count_nonzero(used) < _HALF_TURN or not total > 0.0:
            return None
        # a shift moves the rim where it is counted: by all of it for a whole circle
        step = np.linalg.solve(2.0 * _SPREAD[used].mean(axis=0), dark[inside] @ from_centre[inside] / total)
        centre = centre + ellipse @ step
        if np.linalg.norm(to_circle @ (centre - start)) > _FARTHEST:
            return None
        if float(np.linalg.norm(step)) < _STILL:
            break
    return centre


def _direction(from_centre: Array) -> NDArray[np.int64]:
    """Return in which part of half a turn vectors (..., 2) point, opposite ones in the same."""
    turns = np.arctan2(from_centre[..., 1], from_centre[..., 0]) / np.pi
    return np.floor((turns + 1.0) * _HALF_TURN).astype(np.int64) % _HALF_TURN


def detect_circles(board: Circles, image: Grey) -> BoardDetection:
    """Find a grid of circles, all of it; errors as `detect`."""
    seen = 0
    size = (board.columns, board.rows)
    layout = cv2.CALIB_CB_ASYMMETRIC_GRID if isinstance(board, CircleGrid) else cv2.CALIB_CB_SYMMETRIC_GRID
    # A far board is searched for in an enlarged image; the contours of small blobs are too coarse otherwise.
    for zoom in (1, 2, 3):
        large = zoomed(image, zoom)
        blobs = _blob_detector(large.shape[0] * large.shape[1], len(board.points))
        for flags in (layout, layout | cv2.CALIB_CB_CLUSTERING):
            found, centres = cv2.findCirclesGrid(large, size, flags=flags, blobDetector=blobs)
            if not found:
                continue  # on failure there may be a part of a grid, which is no use
            ordered = _ordered(board, unzoomed(centres, zoom))
            if zoom < 3 and _diameter(board, ordered) * zoom < 9.0:
                break
            return _located(board, image, ordered)
        seen = max(seen, len(blobs.detect(large)))
    raise OpenArmError(
        Code.NOTHING_DETECTED,
        f"no {board.label}: {seen} dark blobs seen, {len(board.points)} circles expected; is all of the board in the"
        " image, lit, sharp and not tilted by more than 60°?",
    )


def _located(board: Circles, image: Grey, rough: Array) -> BoardDetection:
    """Locate the circles of a grid that was found, and judge them; errors as `detect`."""
    plane = board.points[:, :2]
    quality = examine(image, plane, rough)
    ids, exact = _refined(board, image, rough, quality.limit)
    if len(ids) < 4:
        deviation, residual = np.inf, np.inf
    else:
        deviation, residual = smooth_image(plane[ids], exact)[1], plane_fit(plane[ids], exact)[0]
    flat = deviation <= quality.limit and residual <= max(MOST_DISTORTED * quality.pitch, quality.limit)
    if len(ids) >= _LEAST_SHARE * len(rough) and flat:
        return BoardDetection(ids, exact, residual)
    if flat or len(ids) < 4:
        raise OpenArmError(
            Code.NOTHING_DETECTED,
            f"only {len(ids)} of {len(rough)} circles of {board.label} are whole, with white around them; is"
            " something before the board, or its edge at that of the image?",
        )
    raise OpenArmError(
        Code.NOTHING_DETECTED,
        f"{len(rough)} circles do not lie on a plane as {board.label} does: {residual:.2f} px rms, {deviation:.2f} px"
        f" without what a lens may do, expected at most {quality.text}; is it this board, flat, and the image sharp?",
    )


def _blob_detector(area: int, circles: int) -> cv2.SimpleBlobDetector:
    """Make a detector of circles of any size: OpenCV's own limits are 80 px of diameter and 10 px of distance."""
    params = cv2.SimpleBlobDetector.Params()
    params.filterByArea = True
    params.minArea = 12.0
    params.maxArea = area / circles
    params.minDistBetweenBlobs = 3.0
    params.filterByCircularity = False
    params.filterByInertia = True
    params.minInertiaRatio = 0.08
    params.filterByConvexity = True
    params.minConvexity = 0.8
    params.minThreshold, params.maxThreshold, params.thresholdStep = 40.0, 220.0, 12.0
    return cv2.SimpleBlobDetector.create(params)


def _diameter(board: Circles, pixels: Array) -> float:
    """Return the diameter of a circle in the image, px, by the area that the marks cover."""
    hull = cv2.contourArea(cv2.convexHull(pixels.astype(np.float32)))
    outline = cv2.contourArea(cv2.convexHull(board.points[:, :2].astype(np.float32)))
    return board.diameter * float(np.sqrt(hull / outline))


def _ordered(board: Circles, pixels: Array) -> Array:
    """Return the order of the marks in which they are the image of the board's front."""
    orders = fronts(board.points[:, :2], pixels, board.rows, board.columns)
    return orders[0] if isinstance(board, CircleGrid) else upright(orders, board.rows, board.columns)


def _refined(board: Circles, image: Grey, rough: Array, limit: float) -> tuple[NDArray[np.int64], Array]:
    """Return marks by their grey values: which, and where.

    A blob next to a circle is moved to where the others predict it; a mark that still is off is left out, and so is one
    that something else comes near to. Where the lens moves marks off the image of a plane by more than a few tenths of
    a pixel, the prediction is a smooth image of the plane.
    """
    plane = board.points[:, :2]
    H = robust_homography(plane, rough)
    wanted = mapped(H, plane)
    apart = np.linalg.norm(rough - wanted, axis=1)
    near = apart <= max(MOST_DISTORTED * pitch(plane, rough), 0.5)
    bent = float(np.median(apart)) > _BENT and np.count_nonzero(near) >= _LEAST_SHARE * len(plane)
    if bent:
        wanted = smooth_image(plane, rough, near)[0]
    astray = np.linalg.norm(rough - wanted, axis=1) > 0.5 + 0.05 * _diameter(board, rough)
    exact, sure = refined(image, np.where(astray[:, None], wanted, rough), plane, board.radius, H)
    if np.count_nonzero(sure) < 4:
        return np.flatnonzero(sure), exact[sure]
    flat = mapped(robust_homography(plane[sure], exact[sure]), plane)
    wanted = smooth_image(plane, exact, sure)[0] if bent else flat
    away = np.linalg.norm(wanted - exact, axis=1)
    ids = np.flatnonzero(sure & (away <= max(6.0 * float(np.median(away[sure])) + 0.1, limit if bent else 0.0)))
    return ids, exact[ids]
