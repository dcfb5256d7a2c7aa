# SPDX-License-Identifier: Apache-2.0
"""Pictures of a calibration as SVG: where the marks were, what the fit leaves of them, where camera and board stood.

A sample has the same colour in all of them. Pixels as in the image; poses in the frame of the board, m.
"""

from __future__ import annotations

import base64
import html
import math

import numpy as np

from openarm_calibration.handeye.offline import Result
from openarm_calibration.handeye.problem import chain
from openarm_calibration.handeye.projection import project
from openarm_calibration.handeye.verdict import Check
from openarm_calibration.sampling.samples import Sample, SampleSet
from openarm_common.types import Array

#: From where the poses are looked at: turned about the board's normal, and tilted, rad.
_AZIMUTH, _ELEVATION = math.radians(35.0), math.radians(22.0)
#: How far in front of the lens the drawn image plane of a camera is, m.
_FRUSTUM = 0.04
#: Of the picture of the poses, px.
_WIDE = 912.0
#: px that the residuals' rms is drawn as.
_DRAWN_RMS = 12.0
GOOD, FAIR, BAD = "#1a7f37", "#b26a00", "#b3261e"


def frame(width: float, height: float, body: str, caption: str, shown: int = 448) -> str:
    """A figure whose drawing is so many pixels wide."""
    return (
        f'<figure><svg viewBox="0 0 {width:g} {height:g}" width="{shown}" height="{shown * height / width:.0f}">{body}'
        f"</svg><figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def hue(k: int, n: int) -> str:
    """Colour of a sample."""
    return f"hsl({360.0 * k / max(n, 1):.0f} 65% 48%)"


def coverage(samples: SampleSet) -> str:
    """All marks in one image."""
    width, height = samples.head.intrinsics[:2]
    dots: list[str] = []
    cells = np.zeros((6, 8), dtype=bool)
    for k, sample in enumerate(samples.samples):
        colour = hue(k, len(samples))
        for u, v in sample.detection.pixels:
            dots.append(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="3" fill="{colour}" fill-opacity=".7"/>')
            cells[min(max(int(v / height * 6), 0), 5), min(max(int(u / width * 8), 0), 7)] = True
    told = f"where the marks were in the image; {cells.mean() * 100:.0f} % of it was covered"
    return frame(width, height, "".join(dots), told)


def residuals(result: Result) -> str:
    """What is left of each mark after the fit, enlarged."""
    problem, estimate = result.solution.problem, result.solution.estimate
    T, _ = chain(problem, estimate.X, estimate.Z, np.zeros((len(problem), 6)))
    rows = problem.camera_rows()
    away = [view.pixels - project(view.points, view.radius, T[k], rows[k]) for k, view in enumerate(problem.views)]
    used = [a for k, a in enumerate(away) if result.solution.used[k]]
    rms = float(np.sqrt(np.mean(np.concatenate(used) ** 2)))
    zoom = _DRAWN_RMS / max(rms, 1e-6)
    width, height = problem.intrinsics[0].width, problem.intrinsics[0].height
    lines: list[str] = []
    for k, view in enumerate(problem.views):
        if not result.solution.used[k]:
            continue
        colour = hue(k, len(problem))
        for (u, v), (du, dv) in zip(view.pixels, away[k] * zoom, strict=True):
            lines.append(f'<path d="M{u:.1f} {v:.1f}l{du:.1f} {dv:.1f}" stroke="{colour}" stroke-width="1.5"/>')
            lines.append(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="1.5" fill="{colour}"/>')
    told = f"what the fit leaves of them, {zoom:.0f} times enlarged; rms {rms:.3f} px by axis"
    return frame(width, height, "".join(lines), told)


def poses(samples: SampleSet, result: Result) -> str:
    """The board, and the camera as the board saw it at each sample; those that were left out are dashed."""
    problem = result.solution.problem
    optics = problem.intrinsics[0]
    corners = _FRUSTUM * np.array(
        [
            [(u - optics.cx) / optics.fx, (v - optics.cy) / optics.fy, 1.0]
            for u, v in ((0, 0), (optics.width, 0), (optics.width, optics.height), (0, optics.height))
        ]
    )
    eyes = np.array([-T[:3, :3].T @ T[:3, 3] for T in problem.free])
    planes = np.array([eyes[k] + corners @ T[:3, :3] for k, T in enumerate(problem.free)])
    w, h = (edge / 2.0 for edge in samples.board.size)
    outline = np.array([[-w, -h, 0.0], [w, -h, 0.0], [w, h, 0.0], [-w, h, 0.0]])
    every = _flat(np.concatenate([eyes, planes.reshape(-1, 3), outline]))
    low, high = every.min(axis=0), every.max(axis=0)
    scale = min((_WIDE - 60.0) / max(high[0] - low[0], 0.05), 560.0 / max(high[1] - low[1], 0.05))
    corner = np.array([(_WIDE - scale * (high[0] - low[0])) / 2.0, 30.0])

    def at(points: Array) -> Array:
        return (_flat(points) - low) * scale + corner

    body = [f'<path d="{_closed(at(outline))}" fill="#fff" stroke="#888"/>']
    turn = np.linspace(0.0, math.tau, 17)[:-1]
    rim = np.stack([np.cos(turn), np.sin(turn), np.zeros(16)], axis=1) * max(samples.board.radius, 0.003)
    body += [f'<path d="{_closed(at(point + rim))}" fill="#444"/>' for point in samples.board.points]
    (mx, my), n = at(np.zeros((1, 3)))[0], len(eyes)
    for k in np.argsort(-_depth(eyes)):  # the farthest first
        colour = hue(int(k), n)
        dash = "" if result.solution.used[k] else ' stroke-dasharray="5 4"'
        (x, y), plane = at(eyes[k : k + 1])[0], at(planes[k])
        body.append(f'<path d="M{x:.1f} {y:.1f}L{mx:.1f} {my:.1f}" stroke="{colour}" stroke-opacity=".25"/>')
        edges = "".join(f"M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}" for u, v in plane)
        body.append(
            f'<path d="{_closed(plane)}{edges}" fill="{colour}" fill-opacity=".18" stroke="{colour}"'
            f' stroke-width="1.8"{dash}/>'
        )
        name = html.escape(problem.views[k].name.removeprefix("s").lstrip("0"))
        body.append(f'<text x="{x + 7:.1f}" y="{y - 5:.1f}" fill="{colour}" font-size="15">{name}</text>')
    far = float(np.linalg.norm(eyes, axis=1).max()), float(np.linalg.norm(eyes, axis=1).min())
    told = f"the camera as the board saw it, {far[1] * 1e3:.0f} to {far[0] * 1e3:.0f} mm away"
    return frame(_WIDE, float(scale * (high[1] - low[1])) + 60.0, "".join(body), told, shown=round(_WIDE))


def _turned(points: Array) -> Array:
    """(n, 3) right, into the picture, up; the board lies flat, its front upwards."""
    x, y, up = points[:, 0], -points[:, 1], -points[:, 2]
    c, s = math.cos(_AZIMUTH), math.sin(_AZIMUTH)
    right, ahead = c * x - s * y, s * x + c * y
    c, s = math.cos(_ELEVATION), math.sin(_ELEVATION)
    return np.stack([right, c * ahead - s * up, s * ahead + c * up], axis=1)


def _flat(points: Array) -> Array:
    """(n, 2) on the picture, down positive."""
    turned = _turned(points)
    return np.stack([turned[:, 0], -turned[:, 2]], axis=1)


def _depth(points: Array) -> Array:
    return _turned(points)[:, 1]


def _closed(points: Array) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + "Z"


def picture(sample: Sample, k: int, samples: SampleSet) -> str:
    """The image of a sample with the marks that were found in it."""
    width, height = samples.head.intrinsics[:2]
    colour = hue(k, len(samples))
    data = base64.b64encode(sample.png).decode()
    body = f'<image width="{width}" height="{height}" href="data:image/png;base64,{data}"/>'
    body += "".join(
        f'<circle cx="{u:.1f}" cy="{v:.1f}" r="5" fill="none" stroke="{colour}" stroke-width="2.5"/>'
        for u, v in sample.detection.pixels
    )
    return frame(width, height, body, f"{sample.name}, {len(sample.detection.ids)} marks", shown=224)


def gauge(check: Check) -> str:
    """How near a figure is to its limit: the bar is full at twice the limit, the tick is the limit."""
    colour = GOOD if check.ratio <= 1.0 else FAIR if check.ratio <= 3.0 else BAD
    filled = 160.0 * min(max(check.ratio, 0.0), 2.0) / 2.0
    return (
        '<svg class="bare" viewBox="0 0 160 12" width="160" height="12"><rect width="160" height="12" rx="3"'
        f' fill="#8883"/><rect width="{max(filled, 2.0):.1f}" height="12" rx="3" fill="{colour}"/>'
        '<path d="M80 -1V13" stroke="currentColor"/></svg>'
    )


def bar(value: float, most: float, colour: str) -> str:
    """A bar beside a number of a table."""
    length = 90.0 * value / most if most > 0.0 else 0.0
    return (
        '<svg class="bare" viewBox="0 0 90 9" width="90" height="9">'
        f'<rect width="{max(length, 1.0):.1f}" height="9" rx="2" fill="{colour}"/></svg>'
    )
