# SPDX-License-Identifier: Apache-2.0
"""Figures of a calibration as SVG: marks in the image, residuals of the fit, poses of camera and board.

A sample has the same colour in all of them. Pixels as in the image; poses in the frame of the board, m.
"""

from __future__ import annotations

import colorsys
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from openarm_calibration.handeye.offline import Result
from openarm_calibration.handeye.problem import residuals as problem_residuals
from openarm_calibration.sampling.samples import SampleSet
from openarm_common import se3
from openarm_common.figures import data_uri, render_figure, sheet
from openarm_common.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: From the board's axes to right, down and ahead in the figure of the poses.
_VIEW = se3.rot_x(math.radians(-68.0)) @ se3.rot_z(math.radians(-35.0))
#: Width of the figure of the poses, px.
_WIDE = 912.0
#: Distance of the drawn image plane from a camera, m.
_FRUSTUM = 0.04
#: Length that the rms of the residuals is drawn with, px.
_DRAWN_RMS = 12.0
#: Longest arrow on an image, px.
_LONGEST = 120.0


class Drawing(NamedTuple):
    """An SVG as a data URI, with its caption."""

    uri: str
    caption: str


def hue(k: int, n: int) -> str:
    """Return the colour of sample `k` of `n` as `#rrggbb`."""
    return "#" + "".join(f"{round(255 * part):02x}" for part in colorsys.hls_to_rgb(k / max(n, 1), 0.48, 0.65))


def coverage(samples: SampleSet) -> Drawing:
    """Draw all marks in one image."""
    size = np.array(samples.head.intrinsics[:2])
    axes = sheet(*size)
    cells = np.zeros((8, 6), dtype=bool)
    for k, sample in enumerate(samples.samples):
        pixels = sample.detection.pixels
        axes.plot(*pixels.T, "o", ms=6.0, mew=0.0, color=hue(k, len(samples)), alpha=0.7)
        cells[tuple(np.clip(pixels / size * cells.shape, 0, np.subtract(cells.shape, 1)).astype(int).T)] = True
    return _drawing(axes, f"marks in the image; they cover {cells.mean() * 100:.0f} % of it")


def residuals(result: Result) -> Drawing:
    """Draw the residual of each mark, enlarged."""
    from matplotlib.collections import LineCollection

    problem = result.solution.problem
    away, rms, zoom = _away(result)
    axes = sheet(problem.intrinsics[0].width, problem.intrinsics[0].height)
    for k, residual in away.items():
        pixels, colour = problem.views[k].pixels, hue(k, len(problem))
        segments = np.stack([pixels, pixels + zoom * residual], axis=1)
        axes.add_collection(LineCollection([*segments], color=colour, lw=1.5))
        axes.plot(*pixels.T, "o", ms=3.0, mew=0.0, color=colour)
    return _drawing(axes, f"residuals of the fit, {zoom:.0f} times enlarged; rms {rms:.3f} px per axis")


def _away(result: Result) -> tuple[dict[int, Array], float, float]:
    """Return measured minus predicted pixels (marks, 2) of the views that were used, their rms, and how far to zoom."""
    problem, estimate = result.solution.problem, result.solution.estimate
    every = enumerate(problem_residuals(problem, estimate.X, estimate.Z))
    away = {k: residual for k, residual in every if result.solution.used[k]}
    rms = float(np.sqrt(np.mean(np.concatenate(list(away.values())) ** 2)))
    return away, rms, _DRAWN_RMS / max(rms, 1e-6)


class Arrows(NamedTuple):
    """From marks of an image to where the answer has them, (marks, 2) px, enlarged by `zoom`; the true rms, px."""

    away: list[list[float]]
    rms: float
    zoom: float


def arrows(result: Result) -> dict[str, Arrows]:
    """Return the arrows of each sample, also of those that were left out; longer ones are cut."""
    problem, estimate = result.solution.problem, result.solution.estimate
    _, _, zoom = _away(result)
    out: dict[str, Arrows] = {}
    for view, residual in zip(problem.views, problem_residuals(problem, estimate.X, estimate.Z), strict=True):
        lengths = np.linalg.norm(residual, axis=1, keepdims=True) * zoom
        cut = np.minimum(1.0, _LONGEST / np.maximum(lengths, 1e-9))
        drawn = np.nan_to_num(-zoom * residual * cut)
        out[view.name] = Arrows(drawn.tolist(), float(np.sqrt(np.mean(residual**2))), zoom)
    return out


def poses(samples: SampleSet, result: Result) -> Drawing:
    """Draw the board and the camera's pose against it at each sample; samples that were left out are dashed."""
    problem = result.solution.problem
    optics = problem.intrinsics[0]
    pixels = np.array([(0, 0), (optics.width, 0), (optics.width, optics.height), (0, optics.height)])
    corners = _FRUSTUM * np.column_stack([(pixels - (optics.cx, optics.cy)) / (optics.fx, optics.fy), np.ones(4)])
    eyes = np.array([-T[:3, :3].T @ T[:3, 3] for T in problem.free])
    planes = np.array([eye + corners @ T[:3, :3] for eye, T in zip(eyes, problem.free, strict=True)])
    plate = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * (*samples.board.size, 0.0) / 2.0
    turn = np.linspace(0.0, 2.0 * np.pi, 17)
    rim = np.stack([np.cos(turn), np.sin(turn), np.zeros(17)], axis=1) * max(samples.board.radius, 0.003)

    every = (np.concatenate([eyes, *planes, plate]) @ _VIEW.T)[:, :2]
    low, extent = every.min(axis=0), np.maximum(np.ptp(every, axis=0), 0.05)
    scale = min((_WIDE - 60.0) / extent[0], 560.0 / extent[1])
    axes = sheet(_WIDE, scale * extent[1] + 60.0)
    corner = np.array([(_WIDE - scale * extent[0]) / 2.0, 30.0])

    def at(points: Array) -> Array:
        return ((points @ _VIEW.T)[..., :2] - low) * scale + corner

    axes.fill(*at(plate).T, fc="white", ec="#888888")
    for point in samples.board.points:
        axes.fill(*at(point + rim).T, fc="#444444")
    for k in np.argsort(-(eyes @ _VIEW.T)[:, 2]):  # the farthest first
        colour, style = hue(int(k), len(eyes)), "-" if result.solution.used[k] else "--"
        axes.plot(*at(np.array([eyes[k], np.zeros(3)])).T, color=colour, alpha=0.25, lw=1.0)
        axes.fill(*at(planes[k]).T, fc=f"{colour}2e", ec=colour, lw=1.8, ls=style)
        for end in planes[k]:
            axes.plot(*at(np.array([eyes[k], end])).T, color=colour, lw=1.8, ls=style)
        x, y = at(eyes[k])
        name = problem.views[k].name.removeprefix("s").lstrip("0")
        axes.text(x + 7.0, y - 5.0, name, color=colour, fontsize=15.0, parse_math=False)
    away = np.linalg.norm(eyes, axis=1) * 1e3
    return _drawing(axes, f"poses of the camera over the board, {away.min():.0f} to {away.max():.0f} mm away")


def _drawing(axes: Axes, caption: str) -> Drawing:
    axes.figure.patch.set_alpha(0.0)  # the page has a background, light or dark
    return Drawing(data_uri(render_figure(axes, "svg"), "image/svg+xml"), caption)
