# SPDX-License-Identifier: Apache-2.0
"""Boards of black squares: chessboard, ChArUco, AprilGrid, and a single marker. Lengths in m, in the board's frame.

All are drawn from the same list of black boxes, as picture and as vectors.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
from pydantic import Field, field_validator, model_validator

from openarm_calibration.board.circles import Pixels, upright_rule
from openarm_common.config import Config
from openarm_common.types import Array

#: All of OpenCV; names in either case are accepted.
DICTIONARIES: tuple[str, ...] = tuple(
    sorted({name.replace("_36H", "_36h").replace("_25H", "_25h").replace("_16H", "_16h") for name in dir(cv2.aruco)
            if name.startswith("DICT_")})
)  # fmt: skip


def known_dictionary(name: str) -> str:
    """Return the proper name of a dictionary of markers; `DICT_` may be left out.

    Raises:
        ValueError: Listing all there are.
    """
    wanted = name.upper().removeprefix("DICT_")
    for known in DICTIONARIES:
        if known.upper().removeprefix("DICT_") == wanted:
            return known
    raise ValueError(f"unknown dictionary; dictionaries: {', '.join(DICTIONARIES)}")


class _Boxes(Config, ABC):
    """Black axis-aligned boxes on white; what these boards have in common."""

    border: float

    @property
    @abstractmethod
    def feature(self) -> float:
        """Edge of what must be large enough in an image, m."""

    @property
    @abstractmethod
    def pattern(self) -> tuple[float, float]:
        """Width and height without the border, m."""

    @property
    @abstractmethod
    def boxes(self) -> Array:
        """(n, 4) left, top, right and bottom of the black boxes, which do not overlap, m from the middle."""

    @property
    def radius(self) -> float:
        """Corners are points."""
        return 0.0

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the plate, m."""
        width, height = self.pattern
        return width + 2.0 * self.border, height + 2.0 * self.border

    def draw(self, pixels_per_metre: float) -> Pixels:
        """Return the grey picture (h, w) of the plate, to scale within half a pixel of its size."""
        width, height = self.size
        return self.picture(round(width * pixels_per_metre), round(height * pixels_per_metre))

    def picture(self, columns: int, rows: int) -> Pixels:
        """Return the grey picture (rows, columns) of exactly the plate; its pixels need not be square."""
        width, height = self.size
        ends = self.boxes * np.array([columns / width, rows / height] * 2) + np.array([columns, rows] * 2) / 2.0
        light = np.full((rows, columns), 255.0)
        for left, top, right, bottom in ends:
            across, u = _shares(left, right, columns)
            down, v = _shares(top, bottom, rows)
            light[v : v + len(down), u : u + len(across)] -= 255.0 * np.outer(down, across)
        return np.clip(np.rint(light), 0, 255).astype(np.uint8)


def _shares(low: float, high: float, count: int) -> tuple[Array, int]:
    """Return what share of each pixel lies between two places, and the first of them."""
    first, last = max(int(np.floor(low)), 0), min(int(np.ceil(high)), count)
    edges = np.arange(first, last + 1, dtype=np.float64)
    return np.clip(np.minimum(edges[1:], high) - np.maximum(edges[:-1], low), 0.0, 1.0), first


def _marker_boxes(dictionary: str, number: int, edge: float, border_bits: int, turned: bool = False) -> Array:
    """Return the black boxes (n, 4) of a marker from its upper left corner, m; runs of a row are one box."""
    codes = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    modules = codes.markerSize + 2 * border_bits
    dark = cv2.aruco.generateImageMarker(codes, number, modules, borderBits=border_bits) == 0
    if turned:
        dark = dark[::-1, ::-1]
    out: list[tuple[float, float, float, float]] = []
    for row, line in enumerate(dark):
        ends = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(np.int8)))
        out += [(a, row, b, row + 1) for a, b in ends.reshape(-1, 2)]
    return np.array(out, dtype=np.float64) * edge / modules


class Chessboard(_Boxes):
    """Black and white squares without ids: it must be in the image whole. Counted are the inner corners, as in ROS."""

    kind: Literal["chessboard"] = "chessboard"
    columns: int = Field(default=8, ge=3, le=60, description="inner corners in a row")
    rows: int = Field(default=5, ge=3, le=60, description="rows of inner corners")
    spacing: float = Field(default=0.025, gt=0.001, le=0.5, description="edge of a square, m")
    border: float = Field(default=0.012, ge=0.0, le=0.5, description="of white around the squares, m")

    @property
    def feature(self) -> float:
        """Edge of what must be large enough in an image, m."""
        return self.spacing

    @property
    def ambiguity(self) -> str:
        """By which rule the board's direction is chosen; "" where its colours tell."""
        return "" if (self.columns + self.rows) % 2 else upright_rule(False)

    @property
    def label(self) -> str:
        """Name for messages and reports."""
        rule = f" ({self.ambiguity})" if self.ambiguity else ""
        return f"chessboard {self.columns}x{self.rows} corners, {self.spacing * 1e3:g} mm squares{rule}"

    @property
    def points(self) -> Array:
        """(n, 3) inner corners, row by row; the square between the first four is black."""
        grid = np.array([(j, i, 0) for i in range(self.rows) for j in range(self.columns)], dtype=np.float64)
        return (grid - np.array([self.columns - 1, self.rows - 1, 0]) / 2.0) * self.spacing

    @property
    def pattern(self) -> tuple[float, float]:
        """Width and height without the border, m."""
        return (self.columns + 1) * self.spacing, (self.rows + 1) * self.spacing

    @property
    def boxes(self) -> Array:
        """(n, 4) black squares."""
        cells = [(j, i) for i in range(self.rows + 1) for j in range(self.columns + 1) if (i + j) % 2 == 0]
        corner = np.array(cells, dtype=np.float64) * self.spacing - np.array(self.pattern) / 2.0
        return np.hstack([corner, corner + self.spacing])


class Charuco(_Boxes):
    """A chessboard with markers in its white squares; a part of it is enough."""

    kind: Literal["charuco"] = "charuco"
    columns: int = Field(default=7, ge=3, le=60, description="squares in a row")
    rows: int = Field(default=5, ge=3, le=60, description="rows of squares")
    spacing: float = Field(default=0.034, gt=0.001, le=0.5, description="edge of a square, m")
    diameter: float = Field(default=0.026, gt=0.0, le=0.5, description="edge of a marker, m")
    border: float = Field(default=0.012, ge=0.0, le=0.5, description="of white around the squares, m")
    dictionary: str = Field(default="DICT_5X5_100", description="of the markers")
    legacy: bool = Field(default=False, description="markers as OpenCV before 4.6 placed them in even rows")

    @field_validator("dictionary")
    @classmethod
    def _known(cls, value: str) -> str:
        return known_dictionary(value)

    @model_validator(mode="after")
    def _fits(self) -> Charuco:
        if not 0.4 * self.spacing <= self.diameter <= 0.9 * self.spacing:
            raise ValueError(f"a marker of {self.diameter} m in a square of {self.spacing} m; expected 0.4 to 0.9")
        there = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary)).bytesList)
        if self.columns * self.rows // 2 > there:
            raise ValueError(
                f"{self.columns}x{self.rows} squares need more than the {there} markers of {self.dictionary}"
            )
        return self

    @property
    def feature(self) -> float:
        """Edge of what must be large enough in an image, m."""
        return self.diameter

    @property
    def ambiguity(self) -> str:
        """Ids tell the direction."""
        return ""

    @property
    def label(self) -> str:
        """Name for messages and reports."""
        markers = f"{self.dictionary}{', legacy' if self.legacy else ''}"
        return f"ChArUco {self.columns}x{self.rows}, {self.spacing * 1e3:g} mm squares, {markers}"

    @cached_property
    def board(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.spacing, self.diameter, dictionary)
        board.setLegacyPattern(self.legacy)
        return board

    @property
    def points(self) -> Array:
        """(n, 3) inner corners, in the order of OpenCV's ids."""
        corners = np.asarray(self.board.getChessboardCorners(), dtype=np.float64).reshape(-1, 3)
        return corners - np.array([self.columns, self.rows, 0]) * self.spacing / 2.0

    @property
    def pattern(self) -> tuple[float, float]:
        """Width and height without the border, m."""
        return self.columns * self.spacing, self.rows * self.spacing

    @property
    def boxes(self) -> Array:
        """(n, 4) black squares, and what is black of the markers."""
        markers = np.array(self.board.getObjPoints(), dtype=np.float64)[:, 0, :2]  # upper left corners
        white = {tuple(cell) for cell in np.floor((markers + self.diameter / 2.0) / self.spacing).astype(int).tolist()}
        cells = [(j, i) for i in range(self.rows) for j in range(self.columns) if (j, i) not in white]
        corner = np.array(cells, dtype=np.float64) * self.spacing
        parts = [np.hstack([corner, corner + self.spacing])]
        for number, at in zip(np.ravel(self.board.getIds()), markers, strict=True):
            parts.append(_marker_boxes(self.dictionary, int(number), self.diameter, 1) + np.tile(at, 2))
        return np.concatenate(parts) - np.tile(np.array(self.pattern) / 2.0, 2)


class AprilGrid(_Boxes):
    """Kalibr's grid of tags 36h11 with black squares at their corners; a part of it is enough.

    Tag 0 is at the lower left, ids grow to the right and then upwards; a tag has two modules of black around its code.
    """

    kind: Literal["aprilgrid"] = "aprilgrid"
    columns: int = Field(default=6, ge=1, le=24, description="tags in a row (tagCols)")
    rows: int = Field(default=6, ge=1, le=24, description="rows of tags (tagRows)")
    diameter: float = Field(default=0.024, gt=0.001, le=1.0, description="edge of a tag (tagSize), m")
    ratio: float = Field(default=0.3, ge=0.1, le=1.0, description="gap between tags over their edge (tagSpacing)")
    border: float = Field(default=0.012, ge=0.0, le=0.5, description="of white around the corner squares, m")
    border_bits: Literal[1, 2] = Field(default=2, description="black modules around a code; Kalibr's have two")

    @model_validator(mode="after")
    def _fits(self) -> AprilGrid:
        if self.columns * self.rows > 587:
            raise ValueError(f"{self.columns}x{self.rows} tags, but the family 36h11 has 587")
        return self

    @property
    def dictionary(self) -> str:
        """Of the tags."""
        return "DICT_APRILTAG_36h11"

    @property
    def gap(self) -> float:
        """Between tags, m."""
        return self.ratio * self.diameter

    @property
    def feature(self) -> float:
        """Edge of what must be large enough in an image, m."""
        return self.diameter

    @property
    def ambiguity(self) -> str:
        """Ids tell the direction."""
        return ""

    @property
    def label(self) -> str:
        """Name for messages and reports."""
        return f"AprilGrid {self.columns}x{self.rows}, {self.diameter * 1e3:g} mm tags, {self.gap * 1e3:g} mm gaps"

    @property
    def pattern(self) -> tuple[float, float]:
        """Width and height without the border, m."""
        pitch = self.diameter + self.gap
        return self.columns * pitch + self.gap, self.rows * pitch + self.gap

    @property
    def corners(self) -> Array:
        """(tags, 2) upper left corners of the tags, by id, m from the middle."""
        pitch = self.diameter + self.gap
        cells = [(j, self.rows - 1 - i) for i in range(self.rows) for j in range(self.columns)]
        return np.array(cells, dtype=np.float64) * pitch + self.gap - np.array(self.pattern) / 2.0

    @property
    def points(self) -> Array:
        """(n, 3) corners of the tags: of each by id lower left, lower right, upper right, upper left as read."""
        steps = np.array([(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)]) * self.diameter
        flat = (self.corners[:, None] + steps).reshape(-1, 2)
        return np.hstack([flat, np.zeros((len(flat), 1))])

    @property
    def boxes(self) -> Array:
        """(n, 4) corner squares, and what is black of the tags, which OpenCV draws upside down."""
        pitch = self.diameter + self.gap
        cells = [(j, i) for i in range(self.rows + 1) for j in range(self.columns + 1)]
        corner = np.array(cells, dtype=np.float64) * pitch - np.array(self.pattern) / 2.0
        parts = [np.hstack([corner, corner + self.gap])]
        for number, at in enumerate(self.corners):
            tag = _marker_boxes(self.dictionary, number, self.diameter, self.border_bits, turned=True)
            parts.append(tag + np.tile(at, 2))
        return np.concatenate(parts)


class Marker(_Boxes):
    """One ArUco marker or AprilTag: four corners, which leave the tilt uncertain; a board is better."""

    kind: Literal["marker"] = "marker"
    dictionary: str = Field(default="DICT_APRILTAG_36h11", description="of the marker")
    id: int = Field(default=0, ge=0, description="of the marker")
    diameter: float = Field(default=0.1, gt=0.001, le=2.0, description="edge of the black square, m")
    border: float = Field(default=0.02, ge=0.0, le=0.5, description="of white around it, m")

    @field_validator("dictionary")
    @classmethod
    def _known(cls, value: str) -> str:
        return known_dictionary(value)

    @model_validator(mode="after")
    def _fits(self) -> Marker:
        there = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary)).bytesList)
        if self.id >= there:
            raise ValueError(f"id {self.id}: {self.dictionary} has ids 0 to {there - 1}")
        return self

    @property
    def feature(self) -> float:
        """Edge of what must be large enough in an image, m."""
        return self.diameter

    @property
    def ambiguity(self) -> str:
        """Its code tells the direction."""
        return ""

    @property
    def label(self) -> str:
        """Name for messages and reports."""
        return f"marker {self.id} of {self.dictionary}, {self.diameter * 1e3:g} mm"

    @property
    def points(self) -> Array:
        """(4, 3) corners as OpenCV orders them: upper left, upper right, lower right, lower left of its drawing."""
        half = self.diameter / 2.0
        return np.array([(-half, -half, 0.0), (half, -half, 0.0), (half, half, 0.0), (-half, half, 0.0)])

    @property
    def pattern(self) -> tuple[float, float]:
        """Width and height without the border, m."""
        return self.diameter, self.diameter

    @property
    def boxes(self) -> Array:
        """(n, 4) what is black."""
        return _marker_boxes(self.dictionary, self.id, self.diameter, 1) - self.diameter / 2.0
