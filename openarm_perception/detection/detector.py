# SPDX-License-Identifier: Apache-2.0
"""Objects in colour images: the interface of detectors, one by colour, and the ranking of detections.

Pixel coordinates put the centre of the top-left pixel at (0, 0). A detection is a region of the image; its
position in space is computed by `detection.localize` from the mask and the depth, never from the box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol, cast

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray
from pydantic import Field, field_validator

from openarm_common.config import Config
from openarm_common.detection import KINDS, Described
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Mask

if TYPE_CHECKING:
    from openarm_perception.segmentation.clusters import Cluster

Image = NDArray[np.uint8]

#: Which detection comes first: the one most certain, or the one nearest to the middle of the image.
Policy = Literal["score", "centre"]


@dataclass(frozen=True)
class Detection2D(Described):
    """Something found in an image; pixels.

    Attributes:
        name: Same as for `Described`; so are `color` and `kind`, the shape where the detector knows it.
        score: Confidence, 0 to 1.
        centre: (u, v) of the middle of the box.
        size: (width, height) of the box.
        mask: (height, width) bool, the pixels of the box that belong to the object.
        truncated: Whether the border of the image cuts it.
        cluster: Result of the segmentation of depth; None of what was found by colour or a network.
    """

    name: str
    score: float
    centre: tuple[float, float]
    size: tuple[int, int]
    mask: Mask
    truncated: bool
    kind: str = ""
    color: str = ""
    cluster: Cluster | None = None

    @property
    def origin(self) -> tuple[int, int]:
        """(u, v) of the top-left pixel of the box."""
        (u, v), (width, height) = self.centre, self.size
        return round(u - (width - 1) / 2.0), round(v - (height - 1) / 2.0)

    @property
    def area(self) -> int:
        """Pixels of the mask."""
        return int(np.count_nonzero(self.mask))


def require_rgb(image: NDArray[Any]) -> None:
    """Refuse what is no colour image.

    Raises:
        OpenArmError: BAD_IMAGE, for another shape or type than (h, w, 3) uint8.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise OpenArmError(
            Code.BAD_IMAGE, f"colour image has shape {image.shape} and type {image.dtype}; expected (h, w, 3) of uint8"
        )


class Detector(Protocol):
    """Finds objects in a colour image."""

    def detect(self, rgb: Image) -> tuple[Detection2D, ...]:
        """Return objects of an image (h, w, 3) uint8, largest first; empty when there is none."""
        ...


class ColorClass(Config):
    """A colour: a label and the part of the HSV space that it covers."""

    label: str = Field(min_length=1, description="name of the detections")
    hue_deg: tuple[float, float] = Field(description="from, to, degrees 0..360; from > to wraps through 0 (red)")
    saturation: tuple[float, float] = Field(default=(0.45, 1.0), description="from, to, 0..1")
    value: tuple[float, float] = Field(default=(0.12, 1.0), description="from, to, 0..1; the lower end bounds shadow")

    @field_validator("label")
    @classmethod
    def _no_shape(cls, value: str) -> str:
        if value in KINDS:
            raise ValueError(f"{value!r} names a shape; expected the name of a colour")
        return value

    @field_validator("hue_deg")
    @classmethod
    def _hue(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not all(0.0 <= v <= 360.0 for v in value):
            raise ValueError("hue_deg must lie in 0..360")
        return value

    @field_validator("saturation", "value")
    @classmethod
    def _range(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not 0.0 <= value[0] < value[1] <= 1.0:
            raise ValueError("expected from < to, both in 0..1")
        return value


class ColorDetectorConfig(Config):
    """Colours to detect and how large an object must be."""

    classes: tuple[ColorClass, ...] = Field(min_length=1, description="colours that are detected")
    min_area: int = Field(default=120, ge=9, description="smallest object, pixels")
    cleanup: int = Field(default=3, ge=1, le=31, description="edge of the morphological kernel, pixels; odd")
    sure_saturation: float = Field(
        default=0.7, gt=0.0, le=1.0, description="a pixel as saturated as this counts in full, 0..1"
    )
    truncated_factor: float = Field(
        default=0.5, ge=0.0, le=1.0, description="factor on the score of what the border cuts"
    )
    min_score: float = Field(default=0.3, ge=0.0, le=1.0, description="detections below are dropped, 0..1")

    @field_validator("cleanup")
    @classmethod
    def _odd(cls, value: int) -> int:
        if value % 2 == 0:
            raise ValueError("expected an odd number of pixels")
        return value

    @field_validator("classes")
    @classmethod
    def _unique(cls, value: tuple[ColorClass, ...]) -> tuple[ColorClass, ...]:
        labels = [c.label for c in value]
        if len(set(labels)) != len(labels):
            raise ValueError(f"labels must be unique, got {', '.join(labels)}")
        return value


class ColorDetector:
    """Finds objects of plain colours.

    Args:
        config: Colours and sizes.
    """

    def __init__(self, config: ColorDetectorConfig) -> None:
        self.config = config
        self._bounds = {c.label: _hsv_bounds(c) for c in config.classes}
        self._kernel = np.ones((config.cleanup, config.cleanup), np.uint8)

    def detect(self, rgb: Image) -> tuple[Detection2D, ...]:
        """Objects of a colour image, largest first; one object an external contour, so that equal colours stay apart.

        Args:
            rgb: (h, w, 3) uint8.

        Returns:
            Detections; empty when nothing is found. The score is the share of the contour's convex hull that has the
            colour, times how saturated it is there; less when the border of the image cuts the object.

        Raises:
            OpenArmError: BAD_IMAGE, for another shape or type.
        """
        require_rgb(rgb)
        hsv = cast(Image, cv2.cvtColor(rgb, cv2.COLOR_RGB2HSV))
        found = [d for label, bounds in self._bounds.items() for d in self._of_colour(label, bounds, hsv)]
        return tuple(sorted((d for d in found if d.score >= self.config.min_score), key=lambda d: -d.area))

    def name(self, rgb: Image, mask: Mask) -> tuple[str, float]:
        """The colour of most pixels (h, w) of an image (h, w, 3), and how many share it, 0 to 1; "" and 0 of none."""
        hsv = cast(Image, cv2.cvtColor(rgb, cv2.COLOR_RGB2HSV))
        count = max(int(np.count_nonzero(mask)), 1)
        shares = {
            label: sum(np.count_nonzero(cv2.inRange(hsv, *ends)[mask]) for ends in bounds) / count
            for label, bounds in self._bounds.items()
        }
        best = max(shares, key=lambda label: shares[label])
        return (best, shares[best]) if shares[best] > 0.0 else ("", 0.0)

    def _of_colour(self, label: str, bounds: list[tuple[Image, Image]], hsv: Image) -> list[Detection2D]:
        raw = cv2.inRange(hsv, *bounds[0])
        for low, high in bounds[1:]:
            raw = cv2.bitwise_or(raw, cv2.inRange(hsv, low, high))
        if cv2.countNonZero(raw) < self.config.min_area:
            return []
        # opening cuts bridges and removes specks, closing then heals highlights
        clean = cv2.morphologyEx(cv2.morphologyEx(raw, cv2.MORPH_OPEN, self._kernel), cv2.MORPH_CLOSE, self._kernel)
        contours, _ = cv2.findContours(clean, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        saturation = hsv[..., 1]
        return [d for contour in contours if (d := self._detection(label, contour, raw, saturation)) is not None]

    def _detection(self, label: str, contour: MatLike, raw: MatLike, saturation: Image) -> Detection2D | None:
        u, v, width, height = cv2.boundingRect(contour)
        local = contour - np.array([u, v], np.int32)
        mask = cv2.drawContours(np.zeros((height, width), np.uint8), [local], -1, 1, cv2.FILLED)
        area = cv2.countNonZero(mask)
        if area < self.config.min_area:
            return None
        hull = cv2.fillConvexPoly(np.zeros((height, width), np.uint8), cv2.convexHull(local), 1)
        box = (slice(v, v + height), slice(u, u + width))
        coloured = (raw[box] > 0) & (mask > 0)
        fill = np.count_nonzero(coloured) / cv2.countNonZero(hull)
        sure = 255.0 * self.config.sure_saturation
        agreement = float(np.minimum(saturation[box][coloured] / sure, 1.0).mean())
        truncated = u == 0 or v == 0 or u + width == raw.shape[1] or v + height == raw.shape[0]
        score = fill * agreement * (self.config.truncated_factor if truncated else 1.0)
        centre = (u + (width - 1) / 2.0, v + (height - 1) / 2.0)
        box, found = (width, height), mask.astype(np.bool_)
        return Detection2D("", float(score), centre, box, found, truncated, color=label)


def rank(detections: Sequence[Detection2D], policy: Policy, image_size: tuple[int, int]) -> tuple[Detection2D, ...]:
    """Return detections in the order in which they should be taken.

    Args:
        detections: Detections in any order.
        policy: `score`: the most certain first; `centre`: the one nearest to the middle of the image first.
        image_size: (width, height), pixels.
    """
    if policy == "score":
        return tuple(sorted(detections, key=lambda d: -d.score))
    u, v = (image_size[0] - 1) / 2.0, (image_size[1] - 1) / 2.0
    return tuple(sorted(detections, key=lambda d: np.hypot(d.centre[0] - u, d.centre[1] - v)))


def _hsv_bounds(color: ColorClass) -> list[tuple[Image, Image]]:
    """Return OpenCV's 8-bit HSV (hue 0..179 at two degrees a count) of a colour; two ranges where the hue wraps."""
    low, high = color.hue_deg
    hues = [(low, high)] if low <= high else [(low, 360.0), (0.0, high)]
    s, v = color.saturation, color.value
    return [
        (
            np.array([round(h0 / 2.0), round(255 * s[0]), round(255 * v[0])], np.uint8),
            np.array([min(round(h1 / 2.0), 179), round(255 * s[1]), round(255 * v[1])], np.uint8),
        )
        for h0, h1 in hues
    ]
