# SPDX-License-Identifier: Apache-2.0
"""A board in a grey image: its marks, in an order that is checked.

Pixels are (u, v) with the centre of the top-left pixel at (0, 0). The pose of the board in the optical frame,
`T_camera_board` (4, 4), is a starting point for least squares.

Circles are located by their grey values once the grid is known. The centre of gravity of the darkness of a disc is the
centre of its ellipse however it is blurred, as long as the blur is even and all of it is counted. Contours of a disc of
ten pixels are three times as far off. The board's plane is in m.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_calibration.board.board import Board, Charuco, CircleGrid
from openarm_calibration.handeye.problem import fit_poses
from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
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
    """Return the centres of circles (n, 2) by the grey values around them.

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
    """Return points (n, 2) through a homography (3, 3)."""
    p = points @ H[:, :2].T + H[:, 2]
    return p[:, :2] / p[:, 2:]


Grey = NDArray[np.uint8]

#: A plane's image is a homography but for distortion and the eccentricity of the circles, px rms.
MOST_RESIDUAL = 0.5
_FEWEST_CORNERS = 8
#: Of the circles that must be seen well; with fewer it may be another board.
_LEAST_SHARE = 0.7


@dataclass(frozen=True, eq=False)
class BoardDetection:
    """Marks of a board in an image.

    Args:
        ids: (n,) which marks, in ascending order.
        pixels: (n, 2).
        residual: Rms distance from a plane's image, px.
    """

    ids: NDArray[np.int64]
    pixels: Array
    residual: float


def detect(board: Board, image: Grey) -> BoardDetection:
    """Find a board.

    Args:
        board: Which.
        image: (h, w) grey.

    Raises:
        OpenArmError: NOTHING_DETECTED, saying what was seen instead; BAD_IMAGE, for an image that is not grey.
    """
    if image.ndim != 2 or image.dtype != np.uint8:
        raise OpenArmError(Code.BAD_IMAGE, f"detection needs a grey 8-bit image, got {image.dtype} {image.shape}")
    return _circles(board, image) if isinstance(board, CircleGrid) else _corners(board, image)


def _circles(board: CircleGrid, image: Grey) -> BoardDetection:
    seen = 0
    size = (board.columns, board.rows)
    # A far board is searched for in an enlarged image; the contours of small blobs are too coarse otherwise.
    for zoom in (1, 2, 3):
        large = image if zoom == 1 else cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
        blobs = _blob_detector(large.shape[0] * large.shape[1], len(board.points))
        for flags in (
            cv2.CALIB_CB_ASYMMETRIC_GRID,
            cv2.CALIB_CB_ASYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING,
        ):
            found, centres = cv2.findCirclesGrid(large, size, flags=flags, blobDetector=blobs)
            if not found:
                continue  # on failure there may be a part of a grid, which is no use
            pixels = np.asarray(centres, dtype=np.float64).reshape(-1, 2)
            # the resized image's pixel k covers (k + 0.5) / zoom - 0.5
            pixels = (pixels + 0.5) / zoom - 0.5
            ordered = _ordered(board, pixels)
            if zoom < 3 and _diameter(board, ordered) * zoom < 9.0:
                break
            ids, exact, residual = _refined(board, image, ordered)
            if len(ids) >= _LEAST_SHARE * len(ordered) and residual <= MOST_RESIDUAL:
                return BoardDetection(ids, exact, residual)
            if np.isfinite(residual) and residual <= MOST_RESIDUAL:
                raise OpenArmError(
                    Code.NOTHING_DETECTED,
                    f"only {len(ids)} of {len(ordered)} circles of {board.label} are whole, with white around them; is"
                    " something before the board, or its edge at that of the image?",
                )
            raise OpenArmError(
                Code.NOTHING_DETECTED,
                f"{len(pixels)} circles do not lie on a plane as {board.label} does: {residual:.2f} px rms, expected at"
                f" most {MOST_RESIDUAL} px; is it this board, flat, and is the image sharp?",
            )
        seen = max(seen, len(blobs.detect(large)))
    raise OpenArmError(
        Code.NOTHING_DETECTED,
        f"no {board.label}: {seen} dark blobs seen, {len(board.points)} circles expected; is all of the board in the"
        " image, lit, sharp and not tilted by more than 60°?",
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


def _diameter(board: CircleGrid, pixels: Array) -> float:
    """Return the diameter of a circle in the image, px, by the area that the marks cover."""
    hull = cv2.contourArea(cv2.convexHull(pixels.astype(np.float32)))
    outline = cv2.contourArea(cv2.convexHull(board.points[:, :2].astype(np.float32)))
    return board.diameter * float(np.sqrt(hull / outline))


def _ordered(board: CircleGrid, pixels: Array) -> Array:
    """Return the order of the marks in which they are the image of the board's front.

    The grid finder may start at either end. A mirrored order fits a plane as well; its chirality differs.
    """
    grid = pixels.reshape(board.rows, board.columns, 2)
    orders = [
        np.ascontiguousarray(order.reshape(-1, 2)) for order in (grid, grid[::-1, ::-1], grid[::-1], grid[:, ::-1])
    ]
    fits = [_fit(board.points[:, :2], order) for order in orders]
    fronts = [(residual, k) for k, (residual, mirrored) in enumerate(fits) if not mirrored]
    return orders[min(fronts, default=(0.0, 0))[1]]


def _refined(board: CircleGrid, image: Grey, rough: Array) -> tuple[NDArray[np.int64], Array, float]:
    """Return marks by their grey values: which, where, and their residual, px rms.

    A blob next to a circle is moved to where the others predict it; a mark that still is off is left out, and so is one
    that something else comes near to.
    """
    plane = board.points[:, :2]
    H = _robust_homography(plane, rough)
    wanted = mapped(H, plane)
    astray = np.linalg.norm(rough - wanted, axis=1) > 0.5 + 0.05 * _diameter(board, rough)
    exact, sure = refined(image, np.where(astray[:, None], wanted, rough), plane, board.radius, H)
    if np.count_nonzero(sure) < 4:
        return np.flatnonzero(sure), exact[sure], 0.0
    away = np.linalg.norm(mapped(_robust_homography(plane[sure], exact[sure]), plane) - exact, axis=1)
    ids = np.flatnonzero(sure & (away <= 6.0 * float(np.median(away[sure])) + 0.1))
    plane, exact = plane[ids], exact[ids]
    return ids, exact, _fit(plane, exact)[0] if len(ids) >= 4 else np.inf


def _corners(board: Charuco, image: Grey) -> BoardDetection:
    detector = cv2.aruco.CharucoDetector(board.board)
    corners, ids, markers, _ = detector.detectBoard(image)
    count = 0 if ids is None else len(ids)  # pyright: ignore[reportUnnecessaryComparison] - None without a board
    if count < _FEWEST_CORNERS:
        raise OpenArmError(
            Code.NOTHING_DETECTED,
            f"{count} corners and {len(markers or ())} markers of {board.label}, at least {_FEWEST_CORNERS} corners are"
            " needed; is the board in the image, sharp, and of this size and dictionary?",
        )
    order = np.argsort(ids.ravel())
    index = ids.ravel()[order].astype(np.int64)
    pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)[order]
    marks = board.points[index, :2]
    if np.linalg.matrix_rank(marks - marks.mean(axis=0), tol=1e-6) < 2:
        raise OpenArmError(Code.NOTHING_DETECTED, f"{count} corners of {board.label} lie on one line; show more of it")
    residual, mirrored = _fit(marks, pixels)
    if residual > MOST_RESIDUAL or mirrored:
        why = "the image is mirrored" if mirrored else f"{residual:.2f} px rms, expected at most {MOST_RESIDUAL} px"
        raise OpenArmError(Code.NOTHING_DETECTED, f"{count} corners do not lie as on {board.label}: {why}")
    return BoardDetection(index, pixels, residual)


def _robust_homography(plane: Array, pixels: Array) -> Array:
    """Return the homography as `homography` does, with up to half of the marks in wrong places."""
    H, _ = cv2.findHomography(plane, pixels, cv2.LMEDS)
    if H is None:  # pyright: ignore[reportUnnecessaryComparison] - None for marks in a heap
        return homography(plane, pixels)
    return H.astype(np.float64)


def homography(plane: Array, pixels: Array) -> Array:
    """Return the homography (3, 3) from plane points (n, 2) to pixels (n, 2), by least squares."""
    return cv2.findHomography(plane, pixels)[0].astype(np.float64)


def _fit(plane: Array, pixels: Array) -> tuple[float, bool]:
    """Return the rms distance of marks from the image of their plane, px, and whether that image is mirrored."""
    H = homography(plane, pixels)
    residual = float(np.sqrt(np.mean(np.sum((mapped(H, plane) - pixels) ** 2, axis=1))))
    return residual, bool(np.linalg.det(H[:2, :2] - np.outer(H[:2, 2], H[2, :2]) / H[2, 2]) <= 0.0)


def guess_pose(points: Array, pixels: Array, radius: float, intrinsics: Intrinsics) -> tuple[Array, float]:
    """Return the pose of a flat board and the rms residual, px.

    Args:
        points: (n, 3) marks in the board frame, m, z = 0.
        pixels: (n, 2).
        radius: Of the circles, m.
        intrinsics: Of the camera.

    Returns:
        (4, 4) T_camera_board, refined, the better of the two that a plane allows.

    Raises:
        OpenArmError: NOTHING_DETECTED, when there is none in front of the camera.
    """
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        points, pixels.reshape(-1, 1, 2), intrinsics.matrix, None, flags=cv2.SOLVEPNP_IPPE
    )
    best: tuple[Array, float] | None = None
    row = np.array([[intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]])
    offsets = np.array([0, len(points)], dtype=np.int64)
    for k in range(count):
        T = se3.make(cv2.Rodrigues(turns[k])[0], np.ravel(shifts[k]))
        if T[2, 3] <= 0.0:
            continue
        pose, cost = fit_poses(
            np.ascontiguousarray(points), np.ascontiguousarray(pixels), offsets, np.array([radius]), T[None], row
        )
        rms = float(np.sqrt(cost[0] / (2 * len(points))))
        if np.isfinite(rms) and (best is None or rms < best[1]):
            best = pose[0], rms
    if best is None:
        raise OpenArmError(Code.NOTHING_DETECTED, "the marks have no pose in front of the camera; are the ids right?")
    return best
