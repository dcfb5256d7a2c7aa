# SPDX-License-Identifier: Apache-2.0
"""Boards as files: PNG and PDF true to scale for a printer, MJCF for a simulated scene. Lengths in m."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np

from openarm_calibration.board.board import Board
from openarm_calibration.board.circles import CircleGrid, SymmetricCircles
from openarm_common.errors import Code, OpenArmError
from openarm_common.figures import METRE, render_figure, sheet
from openarm_common.types import Array

SUFFIXES = (".png", ".pdf", ".xml")
_A4 = (0.210, 0.297)
_MARGIN = 0.008  # that printers can't reach, m
_THICKNESS = 0.003
_OVERLAP = 1e-5  # of neighbouring modules, so that no viewer shows a seam, m
#: Corners of a box of (left, top, right, bottom), in turn.
_CORNERS = (0, 1, 2, 1, 2, 3, 0, 3)
#: Edge of a simulated board's texture, pixels. A power of two: half of an odd edge is no whole number of pixels, so
#: that the smaller copies that a renderer makes of it do not quite lie on it, and the board seems 0.06 % too large.
TEXTURE_EDGE = 2048


def write_board(board: Board, path: Path, dpi: int = 300) -> str:
    """Write a board in the form that the file's name ends in; returns a sentence on what to do with it.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for another ending or a dpi out of range; ENVIRONMENT, when it can't be written.
    """
    if path.suffix not in SUFFIXES:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{path}: a board is written as {', '.join(SUFFIXES)}")
    if not 50 <= dpi <= 2400:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"dpi is {dpi}; expected 50 to 2400")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".png":
            path.write_bytes(png(board, dpi))
        elif path.suffix == ".pdf":
            path.write_bytes(pdf(board))
        else:
            texture = path.with_suffix(".png")
            picture = board.picture(TEXTURE_EDGE, TEXTURE_EDGE)
            texture.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
            path.write_text(mjcf(board, texture.name), encoding="utf-8")
    except OSError as error:
        raise OpenArmError(Code.ENVIRONMENT, f"can't write {path}: {error.strerror}") from error
    width, height = (edge * 1e3 for edge in board.size)
    if path.suffix == ".xml":
        return f"{board.label}: body `calibration_board`, {width:g} x {height:g} mm, in {path}; include it in a scene"
    return (
        f"{board.label}, {width:g} x {height:g} mm in {path}; print at 100 % (no fit to page), glue it on something"
        " flat and measure it"
    )


def png(board: Board, dpi: int) -> bytes:
    """PNG that carries its resolution, so that it prints true to scale."""
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(board.draw(dpi / 0.0254)).save(data, "png", dpi=(dpi, dpi))
    return data.getvalue()


def pdf(board: Board) -> bytes:
    """PDF of one page: the board as vectors, its name, and a bar of 100 mm to measure; A4 where it fits."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Circle

    width, height = board.size
    tall = height + 0.022  # for name and bar
    pages = [
        page for page in (_A4, (_A4[1], _A4[0])) if width + 2 * _MARGIN <= page[0] and tall + 2 * _MARGIN <= page[1]
    ]
    page = pages[0] if pages else (max(width, 0.12) + 2 * _MARGIN, tall + 2 * _MARGIN)
    axes = sheet(*page, unit=METRE)
    centre = np.array([page[0] / 2.0, (page[1] - tall + height) / 2.0])
    if isinstance(board, CircleGrid | SymmetricCircles):
        for mark in board.points[:, :2] + centre:
            axes.add_patch(Circle((mark[0], mark[1]), board.radius, color="black", lw=0.0))
    else:
        boxes = _without_seams(board.boxes) + np.tile(centre, 2)
        axes.add_collection(PolyCollection([*boxes[:, _CORNERS].reshape(-1, 4, 2)], color="black", lw=0.0))
    start, base = (page[0] - 0.1) / 2.0, centre[1] + height / 2.0 + 0.010
    axes.broken_barh([(start, 0.1)], (base - 0.001, 0.001), color="black", lw=0.0)
    axes.broken_barh([(x - 0.0001, 0.0002) for x in (start, start + 0.1)], (base - 0.003, 0.005), color="black", lw=0.0)
    axes.text(start, base + 0.006, f"{board.label}. The bar is 100 mm.", fontsize=8.0)
    return render_figure(axes, "pdf")


def _without_seams(boxes: Array) -> Array:
    """Return boxes (n, 4) of which those that stand on another one reach a little into it."""
    stands = np.abs(boxes[:, None, 3] - boxes[None, :, 1]) < 1e-9
    stands &= (boxes[:, None, 0] < boxes[None, :, 2] - 1e-9) & (boxes[None, :, 0] < boxes[:, None, 2] - 1e-9)
    out = boxes.copy()
    out[stands.any(axis=1), 3] += _OVERLAP
    return out


def mesh(board: Board) -> tuple[list[float], list[float], list[int]]:
    """A thin plate as vertices (m), texture coordinates and triangles; its front, at z = 0, carries the picture.

    Only the front has the whole picture; the other faces take the white of its corner.
    """
    w, h = (edge / 2.0 for edge in board.size)
    front = [(-w, -h, 0.0), (w, -h, 0.0), (w, h, 0.0), (-w, h, 0.0)]
    back = [(x, y, _THICKNESS) for x, y, _ in front]
    vertices = [*front, *front, *back]
    uv = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0), *[(0.004, 0.004)] * 8]
    # board axes are x right, y down, z away: seen from the front the order below is counter-clockwise
    faces = [(0, 2, 1), (0, 3, 2), (8, 9, 10), (8, 10, 11)]
    for a in range(4):
        b = (a + 1) % 4
        faces += [(4 + a, 4 + b, 8 + b), (4 + a, 8 + b, 8 + a)]
    return [v for p in vertices for v in p], [v for p in uv for v in p], [v for f in faces for v in f]


def mjcf(board: Board, texture: str) -> str:
    """MJCF with the board as a body `calibration_board` in its own frame; `texture` is the PNG next to it."""
    vertices, uv, faces = mesh(board)
    numbers = [" ".join(f"{v:g}" for v in values) for values in (vertices, uv)]
    return f"""<mujoco model="calibration_board">
  <asset>
    <texture name="calibration_board" type="2d" file="{texture}"/>
    <material name="calibration_board" texture="calibration_board" specular="0" shininess="0"/>
    <mesh name="calibration_board" inertia="shell" vertex="{numbers[0]}"
          texcoord="{numbers[1]}" face="{" ".join(str(v) for v in faces)}"/>
  </asset>
  <worldbody>
    <body name="calibration_board">
      <geom name="calibration_board" type="mesh" mesh="calibration_board" material="calibration_board"
            mass="0.1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
