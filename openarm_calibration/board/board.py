# SPDX-License-Identifier: Apache-2.0
"""Calibration boards: an asymmetric circle grid, or ChArUco.

Board frame: origin in the middle of the marks, x right and y down as the board is read, z into the board, away from
the viewer; metres. A board lies in an image so that its axes turn as those of the image do. (The mirror image of
a circle grid is the grid itself after half a turn, so that a mirrored camera is detected by ChArUco only.)
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError, field_validator, model_validator

from openarm_common.config import Config, describe_faults, parse_yaml
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.types import Array

Pixels = NDArray[np.uint8]

DICTIONARIES = ("DICT_4X4_100", "DICT_5X5_100", "DICT_6X6_100")
#: Samples along each edge of a pixel of a picture.
_SAMPLES = 8


class CircleGrid(Config):
    """Rows of circles, every second row shifted by one spacing; 4 columns of 11 rows by default."""

    kind: Literal["circles"] = "circles"
    columns: int = Field(default=4, ge=2, le=20, description="circles in a row")
    rows: int = Field(default=11, ge=3, le=41, description="rows; odd, so that half a turn is another pattern")
    spacing: float = Field(
        default=0.02, gt=0.001, le=0.5, description="between rows, half of that between circles of a row, m"
    )
    diameter: float = Field(default=0.015, gt=0.0, le=0.5, description="of a circle, m")
    border: float = Field(default=0.02, ge=0.0, le=0.5, description="of white around the outer circle centres, m")

    @field_validator("rows")
    @classmethod
    def _odd(cls, value: int) -> int:
        if value % 2 == 0:
            raise ValueError("an even number of rows is the same after half a turn; expected an odd number")
        return value

    @model_validator(mode="after")
    def _fits(self) -> CircleGrid:
        # neighbours are sqrt(2) spacings apart
        if self.diameter > 1.2 * self.spacing:
            raise ValueError(f"circles of {self.diameter} m at a spacing of {self.spacing} m touch; at most 1.2 times")
        if self.border < 0.7 * self.diameter:
            raise ValueError(f"border {self.border} m cuts the outer circles; expected at least 0.7 of the diameter")
        return self

    @property
    def label(self) -> str:
        """Name for messages and reports."""
        size = f"{self.spacing * 1e3:g} mm spacing, {self.diameter * 1e3:g} mm circles"
        return f"asymmetric circles {self.columns}x{self.rows}, {size}"

    @property
    def points(self) -> Array:
        """(n, 3) circle centres, row by row."""
        grid = [(2 * j + i % 2, i, 0) for i in range(self.rows) for j in range(self.columns)]
        out = np.array(grid, dtype=np.float64) * self.spacing
        return out - (out.max(axis=0) + out.min(axis=0)) / 2.0

    @property
    def radius(self) -> float:
        """Of a circle, m."""
        return self.diameter / 2.0

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the plate, m."""
        extent = np.ptp(self.points[:, :2], axis=0)
        return float(extent[0]) + 2.0 * self.border, float(extent[1]) + 2.0 * self.border

    def draw(self, pixels_per_metre: float) -> Pixels:
        """Return the grey picture (h, w) of the plate, to scale within half a pixel; black circles on white."""
        width, height = self.size
        return self.picture(round(width * pixels_per_metre), round(height * pixels_per_metre))

    def picture(self, columns: int, rows: int) -> Pixels:
        """Return the grey picture (rows, columns) of exactly the plate; its pixels need not be square."""
        width, height = self.size
        # places of the samples on the plate, m
        u = ((np.arange(columns * _SAMPLES) + 0.5) / (columns * _SAMPLES) - 0.5) * width
        v = ((np.arange(rows * _SAMPLES) + 0.5) / (rows * _SAMPLES) - 0.5) * height
        image = np.full((rows, columns), 255, np.uint8)
        for x, y in self.points[:, :2]:
            left, right, top, bottom = (
                round(edge)
                for edge in (
                    ((x - self.radius) / width + 0.5) * columns - 1, ((x + self.radius) / width + 0.5) * columns + 1,
                    ((y - self.radius) / height + 0.5) * rows - 1, ((y + self.radius) / height + 0.5) * rows + 1,
                )
            )  # fmt: skip
            across = np.square(u[left * _SAMPLES : right * _SAMPLES] - x)
            along = np.square(v[top * _SAMPLES : bottom * _SAMPLES] - y)
            outside = (across[None, :] + along[:, None] > self.radius**2).astype(np.float32) * 255.0
            shares = outside.reshape(bottom - top, _SAMPLES, right - left, _SAMPLES).mean(axis=(1, 3))
            image[top:bottom, left:right] = np.minimum(image[top:bottom, left:right], np.rint(shares))
        return image


class Charuco(Config):
    """A chessboard with markers in its white squares; a part of it is enough."""

    kind: Literal["charuco"] = "charuco"
    columns: int = Field(default=7, ge=3, le=40, description="squares in a row")
    rows: int = Field(default=5, ge=3, le=40, description="rows of squares")
    spacing: float = Field(default=0.034, gt=0.001, le=0.5, description="edge of a square, m")
    diameter: float = Field(default=0.026, gt=0.0, le=0.5, description="edge of a marker, m")
    border: float = Field(default=0.012, ge=0.0, le=0.5, description="of white around the squares, m")
    dictionary: str = Field(default="DICT_5X5_100", description="of the markers")

    @field_validator("dictionary")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in DICTIONARIES:
            raise ValueError(f"unknown dictionary; dictionaries: {', '.join(DICTIONARIES)}")
        return value

    @model_validator(mode="after")
    def _fits(self) -> Charuco:
        if not 0.4 * self.spacing <= self.diameter <= 0.9 * self.spacing:
            raise ValueError(f"a marker of {self.diameter} m in a square of {self.spacing} m; expected 0.4 to 0.9")
        if self.columns * self.rows // 2 > 100:
            raise ValueError(f"{self.columns}x{self.rows} squares need more than the 100 markers of the dictionary")
        return self

    @property
    def label(self) -> str:
        """Name for messages and reports."""
        return f"ChArUco {self.columns}x{self.rows}, {self.spacing * 1e3:g} mm squares, {self.dictionary}"

    @property
    def board(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.spacing, self.diameter, dictionary)

    @property
    def points(self) -> Array:
        """(n, 3) inner corners, in the order of OpenCV's ids."""
        corners = np.asarray(self.board.getChessboardCorners(), dtype=np.float64).reshape(-1, 3)
        middle = np.array([self.columns, self.rows, 0]) * self.spacing / 2.0
        return corners - middle

    @property
    def radius(self) -> float:
        """Corners are points."""
        return 0.0

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the plate, m."""
        return self.columns * self.spacing + 2.0 * self.border, self.rows * self.spacing + 2.0 * self.border

    def draw(self, pixels_per_metre: float) -> Pixels:
        """Return the grey picture (h, w) of the plate, to scale within half a pixel of its size."""
        width, height = self.size
        return self.picture(round(width * pixels_per_metre), round(height * pixels_per_metre))

    def picture(self, columns: int, rows: int) -> Pixels:
        """Return the grey picture (rows, columns) of exactly the plate; its pixels need not be square."""
        width, height = self.size
        fine = 4 if columns * rows < 5_000_000 else 2
        # whole pixels a square here, then stretched to the samples without smoothing, then averaged
        k = max(round(self.spacing / width * columns * fine), 70)
        squares = self.board.generateImage((self.columns * k, self.rows * k), marginSize=0)
        sx, sy = columns * fine / width, rows * fine / height
        # sample centres: plate position of square pixel i is border + (i + 0.5) spacing / k
        to_samples = np.array(
            [
                [self.spacing / k * sx, 0.0, (self.border + 0.5 * self.spacing / k) * sx - 0.5],
                [0.0, self.spacing / k * sy, (self.border + 0.5 * self.spacing / k) * sy - 0.5],
            ]
        )
        samples = cv2.warpAffine(
            squares, to_samples, (columns * fine, rows * fine), flags=cv2.INTER_NEAREST, borderValue=(255,)
        )
        return cv2.resize(samples, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.uint8)


Board = CircleGrid | Charuco
_ADAPTER: TypeAdapter[Board] = TypeAdapter(Annotated[Board, Field(discriminator="kind")])
KINDS = ("circles", "charuco")


def parse_board(data: dict[str, Any], where: str = "board") -> Board:
    """Make a board of its keys; `kind` chooses, circles when it is missing.

    Raises:
        OpenArmError: CONFIG_INVALID, naming `where` and the key.
    """
    kind = data.get("kind", "circles")
    if kind not in KINDS:
        raise OpenArmError(Code.CONFIG_INVALID, f"{where}:kind: no board {brief(kind)}; boards: {', '.join(KINDS)}")
    try:
        return _ADAPTER.validate_python({**data, "kind": kind})
    except ValidationError as error:
        model = CircleGrid if kind == "circles" else Charuco
        raise OpenArmError(Code.CONFIG_INVALID, describe_faults(error, where, model)) from error


def read_board(text: str, where: str = "board") -> Board:
    """Make a board of its keys as YAML, such as `{kind: circles, rows: 11}`; an empty text is the default board.

    Raises:
        OpenArmError: CONFIG_INVALID, naming `where` and what is wrong.
    """
    keys: Any = parse_yaml(text, where) if text else {}
    if not isinstance(keys, dict):
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{where} is {brief(text)}, expected keys and values, such as {{kind: charuco}}"
        )
    return parse_board(keys, where)  # pyright: ignore[reportUnknownArgumentType]
