# SPDX-License-Identifier: Apache-2.0
"""What is found of a board in an image, and whether it is right: how far marks may be off is judged by the picture.

Marks lie on the image of a plane but for the distortion of the lens, which is smooth. So the image of the plane is
taken out, then a smooth field as far as the number of marks allows, and what is left is compared with what noise, blur
and size of the board in this picture make of a mark that was found well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.types import Array

Grey = NDArray[np.uint8]

#: Fewest marks from which a field of degree 3, 2 is distinguished from errors of single marks.
_CUBIC, _QUADRATIC = 18, 12
#: What marks may be off, px: always; by the blur (its sd); by the noise over contrast, times blur; by the pitch, for
#: boards that are not quite flat or not quite printed to scale.
_ALWAYS, _BY_BLUR, _BY_NOISE, _BY_PITCH = 0.15, 0.15, 6.0, 0.005
#: The lens may move marks off the image of a plane by this share of their pitch, rms; more is another order of marks.
MOST_DISTORTED = 0.3
#: A mark that is off by more than this times the limit is none.
_GROSS = 3.0


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


@dataclass(frozen=True)
class Quality:
    """A picture of a board.

    Args:
        noise: Standard deviation of the grey values.
        contrast: Between black and white.
        blur: Standard deviation of an edge, px.
        pitch: Distance of neighbouring marks, px.
    """

    noise: float
    contrast: float
    blur: float
    pitch: float

    @property
    def limit(self) -> float:
        """What marks may be off when they were found well, px rms by axis."""
        relative = self.noise / max(self.contrast, 1.0)
        return _ALWAYS + (_BY_BLUR + _BY_NOISE * min(relative, 0.2)) * min(self.blur, 6.0) + _BY_PITCH * self.pitch

    @property
    def text(self) -> str:
        """For errors."""
        return (
            f"{self.limit:.2f} px in this picture (contrast {self.contrast:.0f}, noise {self.noise:.1f}, blur"
            f" {self.blur:.1f} px, marks {self.pitch:.0f} px apart)"
        )


def examine(image: Grey, plane: Array, pixels: Array) -> Quality:
    """Return the quality of the part of a picture that shows a board.

    The noise is by Immerkaer's difference of Laplacians (1996), with a median in place of the mean.

    Args:
        image: (h, w) grey.
        plane: (n, 2) marks on the board, m.
        pixels: (n, 2) the same in the image.
    """
    low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - 3, 0, None)
    high = np.ceil(pixels.max(axis=0)).astype(int) + 4
    part = image[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    if min(part.shape) < 8:
        return Quality(0.0, 1.0, 1.0, pitch(plane, pixels))
    bumps = cv2.filter2D(part, -1, np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32))[1:-1, 1:-1]
    noise = float(np.median(np.abs(bumps))) / 0.6745 / 6.0
    dark, light = np.percentile(part, (5.0, 95.0))
    down, across = np.gradient(part)
    steepest = float(np.percentile(np.hypot(down, across), 99.0))
    contrast = float(light - dark)
    blur = contrast / (np.sqrt(2.0 * np.pi) * max(steepest, 0.02 * contrast, 1e-3))
    return Quality(noise, contrast, blur, pitch(plane, pixels))


def zoomed(image: Grey, zoom: float) -> Grey:
    """Return an image with `zoom` times as many pixels a side."""
    if zoom == 1.0:
        return image
    way = cv2.INTER_CUBIC if zoom > 1.0 else cv2.INTER_AREA
    return cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=way).astype(np.uint8)


def unzoomed(pixels: Any, zoom: float) -> Array:
    """Return pixels (n, 2) of a `zoomed` image as those of the image: pixel centres are whole numbers in both."""
    return (np.asarray(pixels, dtype=np.float64).reshape(-1, 2) + 0.5) / zoom - 0.5


def pitch(plane: Array, pixels: Array) -> float:
    """Return the distance of neighbouring marks in the image, px: the median over the marks."""
    apart = np.linalg.norm(plane[:, None] - plane, axis=2)
    np.fill_diagonal(apart, np.inf)
    return float(np.median(np.linalg.norm(pixels - pixels[np.argmin(apart, axis=1)], axis=1)))


def mapped(H: Array, points: Array) -> Array:
    """Return points (n, 2) through a homography (3, 3)."""
    p = points @ H[:, :2].T + H[:, 2]
    return p[:, :2] / p[:, 2:]


def homography(plane: Array, pixels: Array) -> Array:
    """Return the homography (3, 3) from plane points (n, 2) to pixels (n, 2), by least squares."""
    return cv2.findHomography(plane, pixels)[0].astype(np.float64)


def robust_homography(plane: Array, pixels: Array) -> Array:
    """Return the homography as `homography` does, with up to half of the marks in wrong places."""
    H, _ = cv2.findHomography(plane, pixels, cv2.LMEDS)
    if H is None:  # pyright: ignore[reportUnnecessaryComparison] - None for marks in a heap
        return homography(plane, pixels)
    return H.astype(np.float64)


def plane_fit(plane: Array, pixels: Array) -> tuple[float, bool]:
    """Return the rms distance of marks from the image of their plane, px, and whether that image is mirrored."""
    H = homography(plane, pixels)
    residual = float(np.sqrt(np.mean(np.sum((mapped(H, plane) - pixels) ** 2, axis=1))))
    return residual, bool(np.linalg.det(H[:2, :2] - np.outer(H[:2, 2], H[2, :2]) / H[2, 2]) <= 0.0)


def smooth_image(plane: Array, pixels: Array, sure: NDArray[np.bool_] | None = None) -> tuple[Array, float]:
    """Return where marks lie by a smooth image of their plane, and the deviation from it, px rms by axis.

    Args:
        plane: (n, 2) marks on the board, m.
        pixels: (n, 2) in the image.
        sure: (n,) which of them the image is fitted to; all when None.

    Returns:
        (n, 2) px, and the deviation; its degrees of freedom are counted, and it is infinite when none is left.
    """
    sure = np.ones(len(plane), dtype=bool) if sure is None else sure
    H = robust_homography(plane[sure], pixels[sure])
    flat = mapped(H, plane)
    # by all marks, so that it is the same field without a few of them
    count = len(plane) if 4 * sure.sum() >= 3 * len(plane) else int(sure.sum())
    degree = 3 if count >= _CUBIC else 2 if count >= _QUADRATIC else 0
    if degree == 0:
        out, unknowns = mapped(homography(plane[sure], pixels[sure]), plane), 8
    else:
        middle = flat[sure].mean(axis=0)
        u, v = ((flat - middle) / max(float(np.abs(flat[sure] - middle).max()), 1.0)).T
        columns = np.stack([u**a * v**b for a in range(degree + 1) for b in range(degree + 1 - a)], axis=1)
        out = flat + columns @ np.linalg.lstsq(columns[sure], (pixels - flat)[sure], rcond=None)[0]
        unknowns = 2 * columns.shape[1] + 2
    freedom = 2 * int(sure.sum()) - unknowns
    squares = float(np.sum((out - pixels)[sure] ** 2))
    return out, float(np.sqrt(squares / freedom)) if freedom > 0 else 0.0 if squares < 1e-12 else np.inf


def consistent(plane: Array, pixels: Array, limit: float) -> tuple[NDArray[np.bool_], float]:
    """Return which marks (n,) lie on a smooth image of their plane, and the deviation of those, px rms by axis.

    One mark at a time is taken out, the worst first, up to a quarter of them.

    Args:
        plane: (n, 2) marks on the board, m.
        pixels: (n, 2) in the image.
        limit: Deviation of marks that were found well, px.
    """
    good = np.ones(len(plane), dtype=bool)
    for _ in range(max(len(plane) // 4, 1)):
        image, _ = smooth_image(plane, pixels, good)
        away = np.where(good, np.linalg.norm(image - pixels, axis=1), 0.0)
        worst = int(np.argmax(away))
        if away[worst] <= _GROSS * limit or good.sum() <= 6:
            break
        good[worst] = False
    return good, smooth_image(plane, pixels, good)[1]
