# SPDX-License-Identifier: Apache-2.0
"""Boards of black squares in a grey image: corners of chessboards, of ChArUco boards, of tags, and of one marker."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_calibration.board.detection import (
    MOST_DISTORTED,
    BoardDetection,
    Grey,
    consistent,
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
from openarm_calibration.board.saddles import located
from openarm_calibration.board.squares import AprilGrid, Charuco, Chessboard, Marker
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

_FEWEST_CORNERS = 8
#: In which a chessboard is searched for: the fast finder takes neither very large nor very small squares.
_ZOOMS = (1.0, 0.5, 2.0)
#: In which codes are read.
_NEARER = (1.0, 2.0)
#: Of the edges of a marker: share that is used, samples along them, and how far to either side, as shares of the edge.
_EDGE_SHARE, _ALONG, _ASIDE = 0.8, 40, 0.06


def detect_chessboard(board: Chessboard, image: Grey) -> BoardDetection:
    """Find a chessboard, all of it; errors as `detect`.

    Each finder of OpenCV misses boards that another one sees, or takes a wrong grid for them: one after another is
    asked, until the corners that it found are judged to be those of the board.
    """
    refused = OpenArmError(
        Code.NOTHING_DETECTED,
        f"no {board.label}; are all of its {board.columns}x{board.rows} inner corners in the image (counted are"
        " corners, not squares), with white around the squares, lit and sharp?",
    )
    plane = board.points[:, :2]
    for corners in _grids(board, image):
        orders = fronts(plane, corners, board.rows, board.columns)
        dark = [_first_is_dark(image, order, board) for order in orders]
        orders = [order for order, first in zip(orders, dark, strict=True) if first] or orders
        pixels = upright(orders, board.rows, board.columns)
        try:
            return _judged(board, image, np.arange(len(plane)), located(plane, image, pixels, board.spacing))
        except OpenArmError as error:
            refused = error
    raise refused


def _grids(board: Chessboard, image: Grey) -> Iterator[Array]:
    """Yield the corners (n, 2) of grids that finders take for the board, px; the fast finder first."""
    size, fast = (board.columns, board.rows), cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    for zoom in _ZOOMS:
        found, corners = cv2.findChessboardCorners(zoomed(image, zoom), size, flags=fast)
        if found:
            yield unzoomed(corners, zoom)
    thorough = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    for flags in (thorough, thorough | cv2.CALIB_CB_EXHAUSTIVE):
        found, corners = cv2.findChessboardCornersSB(image, size, flags=flags)
        if found:
            yield unzoomed(corners, 1.0)


def _first_is_dark(image: Grey, order: Array, board: Chessboard) -> bool:
    """Return whether the square between the first four corners is darker than the next ones."""
    H = robust_homography(board.points[:, :2], order)
    first = board.points[0, :2] + board.spacing / 2.0
    steps = np.array([(0, 0), (1, 1), (1, 0), (0, 1)]) * board.spacing
    at = np.clip(np.rint(mapped(H, first + steps)).astype(int), 0, np.array(image.shape[::-1]) - 1)
    grey = image[at[:, 1], at[:, 0]].astype(float)
    return bool(grey[:2].mean() < grey[2:].mean())


def detect_charuco(board: Charuco, image: Grey) -> BoardDetection:
    """Find the corners of a ChArUco board that are in view; errors as `detect`."""
    parameters = cv2.aruco.CharucoParameters()
    detector = cv2.aruco.CharucoDetector(board.board, parameters, _marker_parameters())
    index, pixels, markers = np.empty(0, np.int64), np.empty((0, 2)), 0
    for zoom in _NEARER:
        corners, ids, quads, _ = detector.detectBoard(zoomed(image, zoom))
        markers = max(markers, len(quads or ()))
        if ids is not None and len(ids) > len(index):  # pyright: ignore[reportUnnecessaryComparison]
            order = np.argsort(ids.ravel())
            index, pixels = ids.ravel()[order].astype(np.int64), unzoomed(corners, zoom)[order]
        if len(index) == len(board.points):
            break
    if len(index) < _FEWEST_CORNERS:
        raise OpenArmError(
            Code.NOTHING_DETECTED,
            f"{len(index)} corners and {markers} markers of {board.label}, at least {_FEWEST_CORNERS} corners are"
            " needed; is the board in the image, sharp, and of this size and dictionary?",
        )
    # the nearest edge is that of a marker
    reach = 0.5 * (board.spacing - board.diameter)
    return _judged(board, image, index, located(board.points[index, :2], image, pixels, reach))


def detect_aprilgrid(board: AprilGrid, image: Grey) -> BoardDetection:
    """Find the tags of an AprilGrid that are in view; errors as `detect`."""
    found = _markers(board.dictionary, image, board.border_bits, board.columns * board.rows)
    wanted = {number: quad for number, quad in found.items() if number < board.columns * board.rows}
    if 4 * len(wanted) < _FEWEST_CORNERS:
        raise OpenArmError(
            Code.NOTHING_DETECTED,
            f"{len(wanted)} tags of {board.label}, at least {_FEWEST_CORNERS // 4} are needed; is the board in the"
            f" image, sharp, and are its codes within {board.border_bits} modules of black (border_bits)?",
        )
    # OpenCV's drawing of a tag is upside down: its first corner, the upper left, is the lower right as read
    ids = np.concatenate([4 * number + np.array([1, 0, 3, 2]) for number in sorted(wanted)])
    pixels = np.concatenate([wanted[number] for number in sorted(wanted)])
    order = np.argsort(ids)
    ids, pixels = ids[order], pixels[order]
    reach = min(board.gap, board.diameter * board.border_bits / (6 + 2 * board.border_bits))
    return _judged(board, image, ids, located(board.points[ids, :2], image, pixels, reach))


def detect_marker(board: Marker, image: Grey) -> BoardDetection:
    """Find one marker, by lines along its edges; errors as `detect`."""
    found = _markers(board.dictionary, image, 1, 1)
    if board.id not in found:
        seen = ", ".join(str(number) for number in sorted(found)[:10]) or "none"
        raise OpenArmError(
            Code.NOTHING_DETECTED,
            f"no {board.label}; ids of that dictionary in the image: {seen}; is the marker in the image, whole, sharp"
            " and with white around it?",
        )
    pixels, deviation = _quad_by_edges(image, found[board.id])
    plane = board.points[:, :2]
    quality = examine(image, plane, pixels)
    _, mirrored = plane_fit(plane, pixels)
    if mirrored or deviation > quality.limit:
        why = "the image is mirrored" if mirrored else f"they are bent by {deviation:.2f} px rms, not {quality.text}"
        raise OpenArmError(Code.NOTHING_DETECTED, f"the edges of {board.label} are not those of a square: {why}")
    return BoardDetection(np.arange(4), pixels, deviation)


def _marker_parameters(border_bits: int = 1) -> cv2.aruco.DetectorParameters:
    """Return the parameters with which markers are found as small as they can be read."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.minMarkerPerimeterRate = 0.01
    return parameters


def _markers(dictionary: str, image: Grey, border_bits: int, wanted: int) -> dict[int, Array]:
    """Return the corners (4, 2) of all markers by id; an id that is there twice is left out.

    Args:
        dictionary: Name of the dictionary of the codes.
        image: (h, w) grey.
        border_bits: Modules of black around the code.
        wanted: Markers; where fewer are found, the image is enlarged.
    """
    codes = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    detector = cv2.aruco.ArucoDetector(codes, _marker_parameters(border_bits))
    best: dict[int, Array] = {}
    for zoom in _NEARER:
        quads, ids, _ = detector.detectMarkers(zoomed(image, zoom))
        if ids is None:  # pyright: ignore[reportUnnecessaryComparison] - None without a marker
            continue
        numbers = [int(number) for number in np.ravel(ids)]
        pairs = zip(numbers, quads, strict=True)
        found = {n: unzoomed(quad, zoom) for n, quad in pairs if numbers.count(n) == 1}
        best = max(best, found, key=len)
        if len(best) >= wanted:
            break
    return best


def _judged(board: Any, image: Grey, ids: NDArray[np.int64], pixels: Array) -> BoardDetection:
    """Judge corners by the picture: those that contradict the others are left out where ids tell the rest.

    Raises:
        OpenArmError: NOTHING_DETECTED.
    """
    plane = board.points[ids, :2]
    if np.linalg.matrix_rank(plane - plane.mean(axis=0), tol=1e-6) < 2:
        raise OpenArmError(Code.NOTHING_DETECTED, f"{len(ids)} corners of {board.label} lie on one line; show more")
    quality = examine(image, plane, pixels)
    good, deviation = np.ones(len(ids), dtype=bool), smooth_image(plane, pixels)[1]
    if not isinstance(board, Chessboard):
        good, deviation = consistent(plane, pixels, quality.limit)
    residual, mirrored = plane_fit(plane[good], pixels[good])
    bent = residual > max(MOST_DISTORTED * pitch(plane, pixels), quality.limit)
    if mirrored or bent or deviation > quality.limit or np.count_nonzero(good) < min(_FEWEST_CORNERS, len(ids)):
        why = "the image is mirrored" if mirrored else (
            f"{residual:.2f} px rms, {deviation:.2f} px without what a lens may do, expected at most {quality.text}"
        )  # fmt: skip
        raise OpenArmError(Code.NOTHING_DETECTED, f"{len(ids)} corners do not lie as on {board.label}: {why}")
    return BoardDetection(ids[good].astype(np.int64), pixels[good], residual)


def _quad_by_edges(image: Grey, rough: Array) -> tuple[Array, float]:
    """Return the corners (4, 2) of a black square as intersections of lines along its edges.

    Each edge is met by profiles across it; in each the edge is the centre of gravity of the grey values' slope.

    Args:
        image: (h, w) grey.
        rough: (4, 2) corners within a few pixels, in turn.

    Returns:
        The corners, and the deviation of the edges from lines, px rms.
    """
    grey = cv2.GaussianBlur(image, (0, 0), 0.7).astype(np.float32)
    corners, deviation = rough, 0.0
    for _ in range(3):
        lines: list[Array] = []
        squares: list[Array] = []
        for k in range(4):
            a, b = corners[k], corners[(k + 1) % 4]
            length = float(np.linalg.norm(b - a))
            along = (b - a) / length
            across = np.array([-along[1], along[0]])
            half = float(np.clip(_ASIDE * length, 2.5, 8.0))
            shares = 0.5 + (np.linspace(0.0, 1.0, _ALONG) - 0.5) * _EDGE_SHARE
            steps = np.arange(-half, half + 0.01, 0.5)
            places = (a + shares[:, None] * (b - a))[:, None] + steps[None, :, None] * across
            profile = cv2.remap(
                grey, places[..., 0].astype(np.float32), places[..., 1].astype(np.float32), cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )  # fmt: skip
            # corners come clockwise, so that the inside is dark ahead; what is beyond the paper may be dark, too
            slope = np.maximum(-np.gradient(profile, axis=1), 0.0).astype(np.float64)
            slope = np.maximum(slope - 0.2 * slope.max(axis=1, keepdims=True), 0.0)
            weight = slope.sum(axis=1)
            good = weight > 0.3 * float(np.median(weight))
            offset = (slope @ steps)[good] / np.maximum(weight[good], 1e-9)
            t = (shares[good] - 0.5) * length
            slant, shift = np.polyfit(t, offset, 1)
            squares.append((offset - slant * t - shift) ** 2)
            middle = (a + b) / 2.0 + shift * across
            direction = along + slant * across
            normal = np.array([-direction[1], direction[0]])
            lines.append(np.array([*normal, -normal @ middle]))
        joined = [np.cross(lines[k - 1], lines[k]) for k in range(4)]
        if any(abs(p[2]) < 1e-9 for p in joined):
            return rough, np.inf
        corners = np.array([p[:2] / p[2] for p in joined])
        deviation = float(np.sqrt(np.mean(np.concatenate(squares))))
    if np.linalg.norm(corners - rough, axis=1).max() > 0.15 * np.linalg.norm(rough[0] - rough[2]):
        return rough, np.inf
    return corners, deviation
