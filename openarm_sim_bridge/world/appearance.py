# SPDX-License-Identifier: Apache-2.0
"""What varies in pictures and not in contacts: lamps, colours, textures of the table, sheets of paper on it.

Draws from a generator are in a fixed order: the same state gives the same appearance. Lengths in m, colours 0 to 1.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from openarm_common.robot.work import Table
from openarm_common.scene.scene import PALETTE
from openarm_common.types import Array

Rng = np.random.Generator

#: Share of things without colour.
GREY = 0.15
#: Kinds of `pattern`; edge of its picture, pixels; of the texture of the table in a scene.
PATTERNS, _PIXELS = 3, 128
#: Half of the edges of a sheet of paper, its thickness, and from the edges of the table to its middle, m.
SHEET_HALF, SHEET_THICKNESS, _INSIDE = (0.02, 0.09), 0.001, 0.1
_SHEETS = 4


@dataclass(frozen=True)
class Lamps:
    """Light of a scene.

    Attributes:
        ambient: Light of all directions.
        diffuse: Light from the camera.
        directions: (n, 3) unit, of each lamp.
        colors: (n, 3) of each lamp.
        specular: (n,) of each lamp.
    """

    ambient: float
    diffuse: float
    directions: Array
    colors: Array
    specular: Array


def draw_lamps(rng: Rng, count: int) -> Lamps:
    """Draw the light of a scene with so many lamps."""
    ambient, diffuse = rng.uniform(0.2, 0.5), rng.uniform(0.05, 0.4)
    directions, colors, specular = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    for i in range(count):
        direction = np.array([*rng.uniform(-0.9, 0.9, 2), -1.0])
        directions[i] = direction / np.linalg.norm(direction)
        colors[i] = rng.uniform(0.1, 0.65) * rng.uniform(0.88, 1.0, 3)
        specular[i] = rng.uniform(0.0, 0.2)
    return Lamps(float(ambient), float(diffuse), directions, colors, specular)


def draw_table(rng: Rng, patterns: int) -> tuple[int | None, Array]:
    """Draw the number of the table's pattern (None: plain), and its tint (3,)."""
    if rng.random() < 0.5:
        return None, rng.uniform(0.45, 0.95) * rng.uniform(0.9, 1.0, 3)
    return int(rng.integers(patterns)), rng.uniform(0.4, 1.0) * rng.uniform(0.75, 1.0, 3)


def draw_floor(rng: Rng) -> Array:
    """Draw the colour (3,) of the floor."""
    return rng.uniform(0.2, 0.75) * rng.uniform(0.8, 1.0, 3)


def colour(rng: Rng) -> Array:
    """Red, green, blue, 0 to 1: of the palette, any, or none."""
    draw = rng.random()
    if draw < GREY:
        return np.clip(rng.uniform(0.08, 0.95) + rng.uniform(-0.04, 0.04, 3), 0.0, 1.0)
    if draw < 0.5:
        return np.array(colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.4, 1.0), rng.uniform(0.3, 1.0)))
    base = np.array(PALETTE[str(rng.choice(list(PALETTE)))][:3])
    return np.clip(base * rng.uniform(0.8, 1.15) + rng.uniform(-0.04, 0.04, 3), 0.0, 1.0)


def pattern(rng: Rng, kind: int) -> NDArray[np.uint8]:
    """A texture (128, 128, 3): planks, tiles or cloudy stone."""
    light, dark = rng.uniform(0.6, 1.0), rng.uniform(0.45, 0.9)
    tone = rng.uniform(0.8, 1.0, 3)
    if kind == 0:
        grain = rng.random(128)[:, None] * 0.5 + cv2.GaussianBlur(rng.random((128, 128)), (31, 1), 0) * 0.5
    elif kind == 1:
        grain = np.indices((128, 128)).sum(0) // 16 % 2 * 1.0
    else:
        grain = cv2.GaussianBlur(rng.random((128, 128)), (0, 0), 5.0)
        grain = (grain - grain.min()) / (grain.max() - grain.min())
    value = dark + (light - dark) * grain
    return np.clip(value[..., None] * tone * 255.0, 0, 255).astype(np.uint8)


def add_texture(spec: mujoco.MjSpec, name: str, picture: NDArray[np.uint8]) -> None:
    """Add a two-dimensional texture of a picture (h, w, 3)."""
    height, width = picture.shape[:2]
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height)
    texture.nchannel = 3
    texture.data = picture.tobytes()


def vary(spec: mujoco.MjSpec, table: Table, seed: int) -> None:
    """Give the environment of a scene the appearance of a seed.

    Args:
        spec: Model with floor, lamps and table, changed.
        table: Table on which sheets of paper lie that are seen and touch nothing.
        seed: Same seed, same appearance.
    """
    rng = np.random.default_rng([seed, 31])
    lamps = draw_lamps(rng, len(spec.lights))
    spec.visual.headlight.ambient = (lamps.ambient,) * 3
    spec.visual.headlight.diffuse = (lamps.diffuse,) * 3
    for light, direction, color, specular in zip(
        spec.lights, lamps.directions, lamps.colors, lamps.specular, strict=True
    ):
        light.dir, light.diffuse, light.specular = direction, color, (specular,) * 3
    kind, tint = draw_table(rng, PATTERNS)
    material = spec.material("table")
    material.rgba = (*tint, 1.0)
    if kind is not None:
        add_texture(spec, "table", pattern(rng, kind))
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "table"
        material.texrepeat = tuple(rng.uniform(0.5, 4.0, 2))
    spec.geom("floor").rgba = (*draw_floor(rng), 1.0)
    for k in range(int(rng.integers(_SHEETS))):
        half = (*rng.uniform(*SHEET_HALF, 2), 0.5 * SHEET_THICKNESS)
        x, y = (rng.uniform(low + _INSIDE, high - _INSIDE) for low, high in (table.x, table.y))
        turn = float(rng.uniform(-np.pi, np.pi)) / 2.0
        spec.worldbody.add_geom(
            name=f"paper_{k}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=half,
            pos=(x, y, table.top_z + 0.25 * SHEET_THICKNESS * (k - 1)),
            quat=(np.cos(turn), 0.0, 0.0, np.sin(turn)),
            rgba=(*colour(rng), 1.0),
            contype=0,
            conaffinity=0,
            group=0,
        )
