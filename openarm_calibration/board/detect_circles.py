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
_TURN = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
_RIM: Array = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1)


def refined(
    image: Grey, centres: Array, plane: Array, radius: float, H: Array, shift: Array | None = None
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the centres of circles (n, 2) by the grey values around them.

    Args:
        image: (h, w) grey.
        centres: (n, 2) within 0.4 radii, px.
        plane: (n, 2) circle centres on the board, m.
        radius: Of the circles, m; nothing but white within 1.85 radii of a centre.
        H: (3, 3) homography from the plane to pixels.
        shift: (n, 2) by which the lens moves each circle off that, px.

    Returns:
        The centres, and (n,) which of them are sure: the others are as they were, because something else or the edge
        of the image lies too near.
    """
    out, sure = centres.copy(), np.zeros(len(centres), dtype=bool)
    back: Array = np.linalg.inv(H).astype(np.float64)
    for k, (centre, at) in enumerate(zip(centres, plane, strict=True)):
        by = np.zeros(2) if shift is None else shift[k]
        reach = mapped(H, at + _OUTER * radius * _RIM) + by
        low, high = np.floor(reach.min(axis=0)).astype(int), np.ceil(reach.max(axis=0)).astype(int) + 1
        if (low < 0).any() or high[0] > image.shape[1] or high[1] > image.shape[0]:
            continue
        u, v = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        places = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
        away = np.linalg.norm(mapped(back, places - by) - at, axis=1) / radius
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


def detect_circles(board: Circles, image: Grey) -> BoardDetection:
    """Find a grid of circles, all of it; errors as `detect`."""
    seen = 0
    size = (board.columns, board.rows)
    layout = cv2.CALIB_CB_ASYMMETRIC_GRID if isinstance(board, CircleGrid) else cv2.CALIB_CB_SYMMETRIC_GRID
    # A far board is searched for in an enlarged image; the contours of small blobs are too coarse otherwise.
    for zoom in (1, 2, 3):
        large = image if zoom == 1 else cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
        blobs = _blob_detector(large.shape[0] * large.shape[1], len(board.points))
        for flags in (layout, layout | cv2.CALIB_CB_CLUSTERING):
            found, centres = cv2.findCirclesGrid(large, size, flags=flags, blobDetector=blobs)
            if not found:
                continue  # on failure there may be a part of a grid, which is no use
            pixels = np.asarray(centres, dtype=np.float64).reshape(-1, 2)
            # the resized image's pixel k covers (k + 0.5) / zoom - 0.5
            pixels = (pixels + 0.5) / zoom - 0.5
            ordered = _ordered(board, pixels)
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
    wanted, by = mapped(H, plane), np.zeros_like(plane)
    apart = np.linalg.norm(rough - wanted, axis=1)
    near = apart <= max(MOST_DISTORTED * pitch(plane, rough), 0.5)
    bent = float(np.median(apart)) > _BENT and np.count_nonzero(near) >= _LEAST_SHARE * len(plane)
    if bent:
        wanted = smooth_image(plane, rough, near)[0]
        by = wanted - mapped(H, plane)
    astray = np.linalg.norm(rough - wanted, axis=1) > 0.5 + 0.05 * _diameter(board, rough)
    exact, sure = refined(image, np.where(astray[:, None], wanted, rough), plane, board.radius, H, by)
    if np.count_nonzero(sure) < 4:
        return np.flatnonzero(sure), exact[sure]
    flat = mapped(robust_homography(plane[sure], exact[sure]), plane)
    wanted = smooth_image(plane, exact, sure)[0] if bent else flat
    away = np.linalg.norm(wanted - exact, axis=1)
    ids = np.flatnonzero(sure & (away <= max(6.0 * float(np.median(away[sure])) + 0.1, limit if bent else 0.0)))
    return ids, exact[ids]
