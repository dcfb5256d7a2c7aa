# SPDX-License-Identifier: Apache-2.0
"""A calibration as text for a terminal and as one HTML page with pictures (SVG inside, nothing fetched).

The page says how the result was judged, and shows where the marks were in the image (coverage), what is left of them
after the fit (residuals, enlarged), where the camera was, each sample's held-out error and influence, every method side
by side, and the images with what was found in them.
"""

from __future__ import annotations

import html
import math
from typing import Any

from openarm_calibration.handeye.offline import Result
from openarm_calibration.report import drawings
from openarm_calibration.sampling.samples import SampleSet

_COLOURS = {"pass": drawings.GOOD, "warn": drawings.FAIR, "fail": drawings.BAD}
_SAID = {
    "pass": "Everything that was looked at is within its limit.",
    "warn": "Usable, but not all is as it should be:",
    "fail": "Not to be used:",
}
_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:60rem;padding:0 1rem;color:#1c1c1e;background:#fff}
h1{font-size:1.6rem;margin:0 0 .2rem}h2{font-size:1.1rem;margin:2.2rem 0 .6rem}p{margin:.3rem 0}
table{border-collapse:collapse;font-variant-numeric:tabular-nums}td,th{padding:.12rem .9rem .12rem 0;text-align:right}
td:first-child,th:first-child,td.t,th.t{text-align:left}th{font-weight:600;border-bottom:1px solid #8886}
.grade{display:inline-block;color:#fff;border-radius:.3rem;padding:.05rem .6rem;font-weight:600}
.figure{display:inline-block;margin:.8rem 2.5rem .4rem 0}.figure b{display:block;font-size:1.7rem;font-weight:600}
figure{margin:0;display:inline-block;vertical-align:top}figcaption,.dim{color:#777;font-size:.85rem}
svg{background:#fafafa;border:1px solid #8884;border-radius:.3rem}
svg.bare{background:none;border:0;vertical-align:middle;overflow:visible}.row{display:flex;flex-wrap:wrap;gap:1rem}.bad{color:#b3261e}
@media(prefers-color-scheme:dark){body{background:#161618;color:#e8e8ea}svg{background:#202023}.bad{color:#ff8a80}}
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
    if "intrinsics" in result.solution.estimate.extras:
        k = result.solution.problem.intrinsics[0]
        lines.append(
            f"intrinsics   fx {k.fx:.2f}  fy {k.fy:.2f}  cx {k.cx:.2f}  cy {k.cy:.2f} px, found with the mount"
        )
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
    f, calibration, verdict = result.verdict.figures, result.calibration, result.verdict
    camera = html.escape(calibration.camera)
    reasons = "".join(f"<li>{html.escape(reason)}</li>" for reason in verdict.reasons)
    grade = f'<span class="grade" style="background:{_COLOURS[verdict.grade]}">{verdict.grade}</span>'
    x, y, z = (v * 1e3 for v in calibration.position)
    quaternion = ", ".join(f"{v:.6f}" for v in calibration.quaternion_xyzw)
    seed = "" if calibration.mount_seed is None else f" Simulated mounts of seed {calibration.mount_seed}."
    large = [
        (f"{f['sigma_translation'] * 1e3:.3f} mm", "position, predicted error"),
        (f"{math.degrees(f['sigma_rotation']):.4f}°", "rotation, predicted error"),
        (f"{f['leave_one_out'] * 1e3:.3f} mm", "at the board, poses left out"),
        (f"{f['reprojection_px']:.3f} px", "from marks to fit, rms"),
    ]
    figures = "".join(
        f'<div class="figure"><b>{value}</b><span class="dim">{what}</span></div>' for value, what in large
    )
    pictures = "".join(drawings.picture(sample, k, samples) for k, sample in enumerate(samples.samples) if sample.png)
    return f"""<!doctype html><html lang="en"><meta charset="utf-8"><title>Calibration of {camera}</title>
<style>{_STYLE}</style>
<h1>Calibration of the {camera} camera {grade}</h1>
<p>{_SAID[verdict.grade]}</p><ul class="bad">{reasons}</ul>
{figures}
<p>{html.escape(calibration.parent)} to {camera}_link: <b>{x:.2f}, {y:.2f}, {z:.2f} mm</b>; quaternion (x, y, z, w)
{quaternion}.</p><p class="dim">{f["samples"]} poses of {html.escape(calibration.board)}.{seed}
{html.escape(calibration.created)}</p>
<h2>How it was judged</h2>{_checks(result)}
<h2>Where the camera was</h2>{drawings.poses(samples, result)}
<h2>Marks</h2><div class="row">{drawings.coverage(samples)}{drawings.residuals(result)}</div>
<h2>Samples</h2>{_samples(samples, result)}
<h2>Methods</h2>{_methods(result)}
<h2>Figures</h2>{_figures(result)}
{f'<h2>Images, and what was found in them</h2><div class="row">{pictures}</div>' if pictures else ""}</html>
"""


def _checks(result: Result) -> str:
    rows = "".join(
        f"<tr><td>{html.escape(check.name)}</td><td>{drawings.gauge(check)}</td>"
        f'<td class="t">{html.escape(check.text)}</td></tr>'
        for check in result.verdict.checks
    )
    return f'<table>{rows}</table><p class="dim">The tick is the limit; above three times the limit it fails.</p>'


def _figures(result: Result) -> str:
    f = result.verdict.figures
    rows = [
        ("left out, one by one", f"{f['leave_one_out'] * 1e3:.3f} mm", f"{f['leave_one_out_px']:.3f} px"),
        ("left out, in five groups", f"{f['five_fold'] * 1e3:.3f} mm", f"{f['five_fold_px']:.3f} px"),
        ("spread of the marks", f"{f['px']:.3f} px", ""),
        ("spread of the robot", f"{f['robot_translation'] * 1e3:.3f} mm", f"{math.degrees(f['robot_rotation']):.4f}°"),
        ("scale of the board", f"{f['scale']:.5f}", f"± {f['scale_sigma']:.5f}"),
        ("focal length over that of camera_info", f"{f['focal']:.5f}", f"± {f['focal_sigma']:.5f}"),
        ("condition of the problem", f"{f['condition']:.3g}", ""),
    ]
    if "drift" in f:
        rows.append(("from what was stored", f"{f['drift'] * 1e3:.2f} mm", f"{math.degrees(f['drift_rotation']):.3f}°"))
    return f"<table>{''.join(f'<tr><td>{a}</td><td>{b}</td><td>{c}</td></tr>' for a, b, c in rows)}</table>"


def _samples(samples: SampleSet, result: Result) -> str:
    f = result.verdict.figures
    most = max((held["metres"] for held in f["by_sample"].values()), default=0.0)
    head = (
        "<tr><th>sample</th><th>held out</th><th></th><th></th><th>influence</th><th></th><th>stamps apart</th>"
        "<th></th></tr>"
    )
    rows: list[str] = []
    for k, sample in enumerate(samples.samples):
        colour = drawings.hue(k, len(samples))
        held: dict[str, float] = f["by_sample"].get(sample.name, {})
        error = f"{held['metres'] * 1e3:.3f} mm</td><td>{held['px']:.3f} px" if held else "-</td><td>-"
        length = drawings.bar(held["metres"], most, colour) if held else ""
        influence: Any = f["influence"].get(sample.name, 0.0)
        apart = (sample.t_joints_ns - sample.t_image_ns) / 1e6
        reason = html.escape(f["outliers"].get(sample.name, ""))
        rows.append(
            f'<tr><td>{html.escape(sample.name)}</td><td>{error}</td><td class="t">{length}</td>'
            f'<td>{influence:.2f}</td><td class="t">{drawings.bar(influence, 1.0, colour)}</td><td>{apart:+.1f} ms</td>'
            f'<td class="bad t">{reason}</td></tr>'
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
