# SPDX-License-Identifier: Apache-2.0
"""A calibration as text for a terminal and as one self-contained HTML page with figures.

The page shows the verdict, coverage of the image, residuals, poses of the camera, each sample's held-out error and
influence, all methods for comparison, and the images with the detected marks.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from openarm_calibration.handeye.offline import Result
from openarm_calibration.handeye.zero_sets import ZerosCalibration
from openarm_calibration.sampling.samples import SampleSet
from openarm_common.figures import data_uri, render_page


def summary(result: Result) -> str:
    """Lines for a terminal."""
    f = result.verdict.figures
    lines = [
        f"{result.calibration.camera} on {result.calibration.parent}, {f['samples']} poses, {result.calibration.board}",
        "position     " + "  ".join(f"{v * 1e3:9.2f}" for v in result.calibration.position) + " mm",
        f"repeatable   to {f['sigma_translation'] * 1e3:.3f} mm, {math.degrees(f['sigma_rotation']):.4f}°"
        f"  (marks {f['px']:.3f} px,"
        f" robot {f['robot_translation'] * 1e3:.3f} mm {math.degrees(f['robot_rotation']):.4f}°)",
        f"accurate     to {f['accuracy_translation'] * 1e3:.3f} mm, {math.degrees(f['accuracy_rotation']):.4f}°"
        f" in the frame of {result.calibration.parent}{_by_zeros(f)}",
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


def _by_zeros(figures: dict[str, Any]) -> str:
    """Return what zeros of the joints that may be off do to mount and hand, in words; "" where joints are not known."""
    if "hand" not in figures:
        return ""
    zeros, hand = math.degrees(max(figures["zeros_sigma"].values())), figures["hand"] * 1e3
    return f" (zeros of joints ± {zeros:.3f}° at most); the hand meets what the camera sees to {hand:.3f} mm"


def zeros_page(found: ZerosCalibration) -> str:
    """Return the HTML page of joint zeros: each joint, and each sample without the zeros and with them."""
    return render_page(
        Path(__file__).with_name("zeros.html"),
        **{name: getattr(found, name) for name in ("zeros", "mounts", "before", "after", "failures", "warnings")},
        outliers={outlier.name: outlier.reason for outlier in found.result.solution.outliers},
        degrees=math.degrees,
    )


def page(samples: SampleSet, result: Result) -> str:
    """Return the HTML page."""
    from openarm_calibration.report import drawings

    width, height = samples.head.intrinsics[:2]
    return render_page(
        Path(__file__).with_name("report.html"),
        calibration=result.calibration,
        verdict=result.verdict,
        methods=result.methods,
        samples=samples.samples,
        width=width,
        height=height,
        poses=drawings.poses(samples, result),
        coverage=drawings.coverage(samples),
        residuals=drawings.residuals(result),
        arrows=(arrows := drawings.arrows(result)),
        zoom=next(iter(arrows.values())).zoom,
        zip=zip,
        hue=drawings.hue,
        data_uri=data_uri,
        degrees=math.degrees,
    )
