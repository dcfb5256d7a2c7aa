# SPDX-License-Identifier: Apache-2.0
"""A calibration as text for a terminal and as one HTML page with pictures (SVG inside, nothing fetched).

The page shows where the marks were in the image (coverage), what is left of them after the fit (residuals, enlarged),
each sample's held-out error and influence, where camera and robot were (from above and from the side), and every
method side by side.
"""

from __future__ import annotations

import base64
import html
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openarm_calibration.offline import Result
from openarm_calibration.problem import chain
from openarm_calibration.projection import project
from openarm_calibration.samples import SampleSet

Array = NDArray[np.float64]

_COLOURS = {"pass": "#1a7f37", "warn": "#b26a00", "fail": "#b3261e"}
_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:60rem;padding:0 1rem;color:#1c1c1e;background:#fff}
h1{font-size:1.5rem;margin:0 0 .2rem}h2{font-size:1.1rem;margin:2rem 0 .5rem}
table{border-collapse:collapse;font-variant-numeric:tabular-nums}td,th{padding:.15rem .8rem .15rem 0;text-align:right}
td:first-child,th:first-child{text-align:left}th{font-weight:600;border-bottom:1px solid #ccc}
.grade{display:inline-block;color:#fff;border-radius:.3rem;padding:.1rem .6rem;font-weight:600}
figure{margin:0;display:inline-block;vertical-align:top}figcaption{color:#666;font-size:.85rem}
svg{background:#fafafa;border:1px solid #ddd}.row{display:flex;flex-wrap:wrap;gap:1rem}.bad{color:#b3261e}
@media(prefers-color-scheme:dark){body{background:#161618;color:#e8e8ea}svg{background:#202023;border-color:#444}}
"""


def summary(result: Result) -> str:
    """Lines for a terminal."""
    f = result.verdict.figures
    lines = [
        f"{result.calibration.camera} on {result.calibration.parent}, {f['samples']} poses, {result.calibration.board}",
        "position     " + "  ".join(f"{v * 1e3:9.2f}" for v in result.calibration.position) + " mm",
        f"predicted    {f['sigma_translation'] * 1e3:.3f} mm, {math.degrees(f['sigma_rotation']):.4f}°"
        f"  (marks {f['px']:.3f} px,"
        f" robot {f['robot_translation'] * 1e3:.3f} mm {math.degrees(f['robot_rotation']):.4f}°)",
        f"held out     {f['leave_one_out'] * 1e3:.3f} mm, {f['leave_one_out_px']:.3f} px (leave one out);"
        f" {f['five_fold'] * 1e3:.3f} mm, {f['five_fold_px']:.3f} px (five folds)",
        f"board scale  {f['scale']:.5f} ± {f['scale_sigma']:.5f}    condition {f['condition']:.2g}",
    ]
    if "drift" in f:
        lines.append(f"from stored  {f['drift'] * 1e3:.2f} mm, {math.degrees(f['drift_rotation']):.3f}°")
    lines += [f"outlier      {name}: {reason}" for name, reason in f["outliers"].items()]
    lines.append("method          from refined           reprojection")
    for name, row in result.methods.items():
        if isinstance(row, str):
            lines.append(f"  {name:<12} {row}")
        else:
            away = f"{row['translation'] * 1e3:8.3f} mm {math.degrees(row['rotation']):8.4f}°"
            lines.append(f"  {name:<12} {away} {row['px']:8.3f} px")
    return "\n".join(lines)


def page(samples: SampleSet, result: Result) -> str:
    """The HTML page."""
    f, calibration = result.verdict.figures, result.calibration
    reasons = "".join(f"<li>{html.escape(reason)}</li>" for reason in result.verdict.reasons)
    rows = [
        ("predicted error", f"{f['sigma_translation'] * 1e3:.3f} mm", f"{math.degrees(f['sigma_rotation']):.4f}°"),
        ("left out, one by one", f"{f['leave_one_out'] * 1e3:.3f} mm", f"{f['leave_one_out_px']:.3f} px"),
        ("left out, in five groups", f"{f['five_fold'] * 1e3:.3f} mm", f"{f['five_fold_px']:.3f} px"),
        ("spread of the marks", f"{f['px']:.3f} px", ""),
        ("spread of the robot", f"{f['robot_translation'] * 1e3:.3f} mm", f"{math.degrees(f['robot_rotation']):.4f}°"),
        ("scale of the board", f"{f['scale']:.5f}", f"± {f['scale_sigma']:.5f}"),
        ("condition", f"{f['condition']:.3g}", ""),
    ]
    if "drift" in f:
        rows.append(("from what was stored", f"{f['drift'] * 1e3:.2f} mm", f"{math.degrees(f['drift_rotation']):.3f}°"))
    x, y, z = (v * 1e3 for v in calibration.position)
    quaternion = ", ".join(f"{v:.6f}" for v in calibration.quaternion_xyzw)
    grade = f'<span class="grade" style="background:{_COLOURS[result.verdict.grade]}">{result.verdict.grade}</span>'
    return f"""<!doctype html><html lang="en"><meta charset="utf-8"><title>Calibration of {calibration.camera}</title>
<style>{_STYLE}</style>
<h1>Calibration of the {html.escape(calibration.camera)} camera {grade}</h1>
<p>{f["samples"]} poses of {html.escape(calibration.board)}. {html.escape(calibration.parent)} to
{html.escape(calibration.camera)}_link: {x:.2f}, {y:.2f}, {z:.2f} mm; quaternion (x, y, z, w) {quaternion}.
{html.escape(calibration.created)}</p><ul class="bad">{reasons}</ul>
<table>{"".join(f"<tr><td>{a}</td><td>{b}</td><td>{c}</td></tr>" for a, b, c in rows)}</table>
<h2>Where the marks were, and what the fit leaves of them</h2>
<div class="row">{_coverage(samples)}{_residuals(result)}</div>
<h2>Poses</h2>
<div class="row">{_poses(result, 0, 1, "from the front (x, y)")}{_poses(result, 0, 2, "along its plane (x, z)")}</div>
<h2>Samples</h2>{_samples(samples, result)}
<h2>Methods</h2>{_methods(result)}
{_pictures(samples)}</html>
"""


def _frame(width: float, height: float, body: str, caption: str, shown: int = 440) -> str:
    return (
        f'<figure><svg viewBox="0 0 {width:g} {height:g}" width="{shown}" height="{shown * height / width:.0f}">{body}'
        f"</svg><figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def _hue(k: int, n: int) -> str:
    return f"hsl({360.0 * k / max(n, 1):.0f} 65% 48%)"


def _coverage(samples: SampleSet) -> str:
    width, height = samples.head.intrinsics[:2]
    dots: list[str] = []
    cells = np.zeros((6, 8), dtype=bool)
    for k, sample in enumerate(samples.samples):
        colour = _hue(k, len(samples))
        for u, v in sample.detection.pixels:
            dots.append(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="2.2" fill="{colour}" fill-opacity=".6"/>')
            cells[min(max(int(v / height * 6), 0), 5), min(max(int(u / width * 8), 0), 7)] = True
    return _frame(
        width, height, "".join(dots), f"marks in the image, a colour a sample; {cells.mean() * 100:.0f} % covered"
    )


def _residuals(result: Result) -> str:
    problem, estimate = result.solution.problem, result.solution.estimate
    T, _ = chain(problem, estimate.X, estimate.Z, np.zeros((len(problem), 6)))
    rows = problem.camera_rows()
    away = [view.pixels - project(view.points, view.radius, T[k], rows[k]) for k, view in enumerate(problem.views)]
    used = [a for k, a in enumerate(away) if result.solution.used[k]]
    rms = float(np.sqrt(np.mean(np.concatenate(used) ** 2)))
    zoom = 12.0 / max(rms, 1e-6)
    width, height = problem.intrinsics[0].width, problem.intrinsics[0].height
    lines: list[str] = []
    for k, view in enumerate(problem.views):
        if not result.solution.used[k]:
            continue
        for (u, v), (du, dv) in zip(view.pixels, away[k] * zoom, strict=True):
            lines.append(f'<path d="M{u:.1f} {v:.1f}l{du:.1f} {dv:.1f}" stroke="{_hue(k, len(problem))}"/>')
    return _frame(width, height, "".join(lines), f"residuals, {zoom:.0f} times enlarged; rms {rms:.3f} px by axis")


def _poses(result: Result, a: int, b: int, caption: str) -> str:
    """Viewing directions: cameras as the board sees them, arrows of 40 mm along the optical axis."""
    problem = result.solution.problem
    eyes = np.array([-T[:3, :3].T @ T[:3, 3] for T in problem.free])
    ahead = np.array([T[2, :3] for T in problem.free])
    tips = eyes + 0.04 * ahead
    every = np.concatenate([eyes, tips, np.zeros((1, 3))])
    low, high = every[:, [a, b]].min(axis=0), every[:, [a, b]].max(axis=0)
    span = max(float((high - low).max()), 0.05) * 1.1
    middle = (low + high) / 2.0

    def at(p: Array) -> tuple[float, float]:
        return tuple((p[[a, b]] - middle) / span * 400.0 + 200.0)  # pyright: ignore[reportReturnType]

    body: list[str] = []
    for k in range(len(eyes)):
        (x, y), (u, v) = at(eyes[k]), at(tips[k])
        dash = "" if result.solution.used[k] else ' stroke-dasharray="3 3"'
        colour = _hue(k, len(eyes))
        body.append(f'<path d="M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}" stroke="{colour}" stroke-width="2"{dash}/>')
        body.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"/>')
    x, y = at(np.zeros(3))
    body.append(f'<path d="M{x - 6:.1f} {y:.1f}h12M{x:.1f} {y - 6:.1f}v12" stroke="currentColor" stroke-width="2"/>')
    return _frame(
        400, 400, "".join(body), f"camera in the board's frame, {caption}, {span * 1e3:.0f} mm wide; + the board", 300
    )


def _samples(samples: SampleSet, result: Result) -> str:
    f = result.verdict.figures
    head = "<tr><th>sample</th><th>held out</th><th></th><th>influence</th><th>stamps apart</th><th></th></tr>"
    rows: list[str] = []
    for sample in samples.samples:
        held: dict[str, float] = f["by_sample"].get(sample.name, {})
        error = f"{held['metres'] * 1e3:.3f} mm</td><td>{held['px']:.3f} px" if held else "-</td><td>-"
        apart = (sample.t_joints_ns - sample.t_image_ns) / 1e6
        reason = html.escape(f["outliers"].get(sample.name, ""))
        influence: Any = f["influence"].get(sample.name, 0.0)
        rows.append(
            f"<tr><td>{sample.name}</td><td>{error}</td><td>{influence:.2f}</td><td>{apart:+.1f} ms</td>"
            f'<td class="bad">{reason}</td></tr>'
        )
    return f"<table>{head}{''.join(rows)}</table>"


def _methods(result: Result) -> str:
    rows: list[str] = []
    for name, row in result.methods.items():
        if isinstance(row, str):
            rows.append(f'<tr><td>{name}</td><td colspan="3" class="bad">{html.escape(row)}</td></tr>')
        else:
            rows.append(
                f"<tr><td>{name}</td><td>{row['translation'] * 1e3:.3f} mm</td>"
                f"<td>{math.degrees(row['rotation']):.4f}°</td><td>{row['px']:.3f} px</td></tr>"
            )
    return f"<table><tr><th>method</th><th>from refined</th><th></th><th>reprojection</th></tr>{''.join(rows)}</table>"


def _pictures(samples: SampleSet) -> str:
    shown = [sample for sample in samples.samples if sample.png]
    if not shown:
        return ""
    images = "".join(
        f'<figure><img width="220" alt="{sample.name}" src="data:image/png;base64,'
        f'{base64.b64encode(sample.png).decode()}"><figcaption>{sample.name}</figcaption></figure>'
        for sample in shown
    )
    return f'<h2>Images</h2><div class="row">{images}</div>'
