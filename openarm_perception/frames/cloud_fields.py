# SPDX-License-Identifier: Apache-2.0
"""Clouds as files have them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Bytes
from openarm_perception.geometry.depth import Points

#: Most points of a cloud.
MOST_POINTS = 8_000_000
#: Names of the three colours, each a field, in files.
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))


@dataclass(frozen=True, eq=False)
class Cloud:
    """A cloud.

    Attributes:
        points: (h, w, 3) float32, as in the file; NaN where nothing was measured. Organised is a cloud with a point per
            pixel of an image; h is 1 for another one.
        rgb: (h, w, 3) uint8; None without colours.
        label: (h, w) int64 of the field `label`; None without it.
    """

    points: Points
    rgb: Bytes | None
    label: NDArray[np.int64] | None

    @property
    def organised(self) -> bool:
        """Whether it has a point per pixel of an image."""
        return min(self.points.shape[:2]) > 1


def cloud_of(fields: Mapping[str, NDArray[np.generic]], shape: tuple[int, int]) -> Cloud:
    """Make a cloud of the fields of a file.

    Args:
        fields: (h * w,) by name: x, y, z; colours as `rgb` or `rgba` packed in four bytes, or each by itself; label.
        shape: (h, w).
    """
    with np.errstate(over="ignore", invalid="ignore"):
        points = np.stack([fields[axis].astype(np.float32) for axis in "xyz"], axis=-1).reshape(*shape, 3)
    # cameras give a point at their own place where they have measured nothing
    points[~np.isfinite(points).all(axis=-1) | ~points.any(axis=-1)] = np.nan
    label = fields["label"].reshape(shape) if "label" in fields else None
    if label is not None and label.dtype.kind == "f":
        label = np.nan_to_num(label, nan=0.0, posinf=0.0, neginf=0.0).clip(-(2**31), 2**31)
    with np.errstate(over="ignore", invalid="ignore"):
        rgb = _colors(fields, shape)
    return Cloud(points, rgb, None if label is None else label.astype(np.int64))


def refused(path: Path, what: str, expected: str) -> OpenArmError:
    """Return the error of a file that can't be read."""
    return OpenArmError(Code.BAD_IMAGE, f"{path} {what}; expected {expected}")


def _colors(fields: Mapping[str, NDArray[np.generic]], shape: tuple[int, int]) -> Bytes | None:
    packed = next((fields[name] for name in ("rgb", "rgba") if name in fields and fields[name].itemsize == 4), None)
    if packed is not None:
        four = np.ascontiguousarray(packed).view(np.uint8).reshape(*shape, 4)
        return np.ascontiguousarray(four[..., 2::-1])
    fields = {name.lower(): values for name, values in fields.items()}
    names = next((names for names in _COLORS if set(names) <= set(fields)), None)
    if names is None:
        return None
    whole = all(fields[name].dtype.kind != "f" for name in names)
    rgb = np.nan_to_num(np.stack([fields[name].astype(np.float32) for name in names], axis=-1).reshape(*shape, 3))
    if whole and rgb.max(initial=0.0) > 255.0:  # of 16 bits, as LAS has them
        rgb = rgb / np.float32(257.0)
    return np.clip(rgb if whole or rgb.max() > 1.0 else rgb * np.float32(255.0), 0, 255).astype(np.uint8)
