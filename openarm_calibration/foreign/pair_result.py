# SPDX-License-Identifier: Apache-2.0
"""A result of pose pairs: grade against the limits that images have, what is to be stored, lines for a terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from openarm_calibration.foreign.image_sets import Names
from openarm_calibration.handeye.closed_form import REFINED
from openarm_calibration.handeye.observability import axis_name
from openarm_calibration.handeye.pose_pairs import LeftOut, PairSolution, PosePairs, residuals, solve_pairs
from openarm_calibration.handeye.verdict import Grade, Limits
from openarm_calibration.store.store import StoredCalibration, versions
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL

#: Ratio to a limit from which a calibration fails.
_FAIL = 3.0


@dataclass(frozen=True, eq=False)
class JudgedPairs:
    """A solution with its grade, the reasons for it, and what is to be stored."""

    pairs: PosePairs
    solution: PairSolution
    names: Names
    grade: Grade
    reasons: tuple[str, ...]
    calibration: StoredCalibration

    def as_json(self) -> dict[str, Any]:
        """Return the result for `--json`."""
        solution = self.solution
        left_out = {
            name: row if isinstance(row, str) else {"translation": row.translation, "rotation": row.rotation}
            for name, row in solution.left_out.items()
        }
        outliers = [name for name, used in zip(self.pairs.names, solution.used, strict=True) if not used]
        return {
            "grade": self.grade,
            "reasons": list(self.reasons),
            "method": solution.method,
            "figures": {
                "sigma_translation": solution.sigma[0], "sigma_rotation": solution.sigma[1],
                "pair_translation": solution.noise[0], "pair_rotation": solution.noise[1],
                "samples": int(solution.used.sum()), "outliers": outliers,
            },
            "left_out": left_out,
            "covariance": solution.covariance[:6, :6].tolist(),
            "T_parent_optical": solution.X.tolist(),
            f"T_{'base' if self.pairs.setup == 'in_hand' else 'tip'}_board": solution.Z.tolist(),
            "free": solution.free.tolist(),
            "calibration": self.calibration.model_dump(mode="json"),
        }  # fmt: skip

    @property
    def text(self) -> str:
        """Lines for a terminal."""
        solution, item = self.solution, self.calibration
        sigma_t, sigma_r = solution.sigma
        x, y, z = (v * 1e3 for v in item.position)
        q = "  ".join(f"{v:8.5f}" for v in item.quaternion_xyzw)
        lines = [
            f"{item.camera} on {item.parent}, {item.samples} pairs of poses, no pixels",
            f"position     {x:9.2f}  {y:9.2f}  {z:9.2f} mm",
            f"quaternion   {q}  (x y z w)",
            f"predicted    {sigma_t * 1e3:.3f} mm, {math.degrees(sigma_r):.4f}°  (a pair"
            f" {solution.noise[0] * 1e3:.3f} mm {math.degrees(solution.noise[1]):.4f}° by axis)",
        ]
        if solution.free.any():
            lines.append(f"undetermined the place along {item.parent}'s {axis_name(solution.free)}: it may be any")
        x, y, z = (v * 1e3 for v in solution.Z[:3, 3])
        q = "  ".join(f"{v:8.5f}" for v in se3.quat_xyzw_from_matrix(solution.Z[:3, :3]))
        carrier = self.names.base if self.pairs.setup == "in_hand" else self.names.tip
        lines += [f"board        {x:9.2f}  {y:9.2f}  {z:9.2f} mm  {q} on {carrier}"]
        lines.append("method       left-out pairs, rms at the board")
        for name, row in solution.left_out.items():
            figures = (
                row if isinstance(row, str) else f"{row.translation * 1e3:8.3f} mm {math.degrees(row.rotation):8.4f}°"
            )
            lines.append(f"  {name:<12} {figures}{'  <- taken' if name == solution.method else ''}")
        away = residuals(self.pairs, solution.X, solution.Z)
        for name, used, off in zip(self.pairs.names, solution.used, away, strict=True):
            if not used:
                far, turned = np.linalg.norm(off[:3]) * 1e3, math.degrees(np.linalg.norm(off[3:]))
                lines.append(f"left out     {name}: {far:.1f} mm and {turned:.2f}° from where the others put it")
        return "\n".join(lines)


def pair_result(
    pairs: PosePairs, names: Names, limits: Limits | None = None, created: str = "",
    fixed: Mapping[str, float] | None = None, scale: float = 1.0,
) -> JudgedPairs:  # fmt: skip
    """Solve pairs and grade the result.

    Args:
        pairs: Pairs of one camera.
        names: Names of camera and frames.
        limits: None is the defaults.
        created: When, as ISO 8601.
        fixed: Place of the camera that `solve_pairs` is given.
        scale: Factor that the lengths of the board lack.

    Raises:
        OpenArmError: Same as `solve_pairs`.
    """
    limits = limits or Limits()
    solution = solve_pairs(pairs, fixed)
    sigma_t, sigma_r = solution.sigma
    own = solution.left_out[solution.method]
    used, count = int(np.count_nonzero(solution.used)), len(solution.used)
    checks = [
        (sigma_t / limits.translation, f"predicted error of the position {sigma_t * 1e3:.3f} mm"),
        (sigma_r / limits.rotation, f"predicted error of the rotation {math.degrees(sigma_r):.4f}°"),
        ((count - used) / count / 0.1, f"{count - used} of {count} pairs contradict the others"),
        (1.5 if used < limits.samples else 0.0, f"{used} pairs, {limits.samples} are wanted"),
        (
            1.5 if solution.method != REFINED else 0.0,
            f"{solution.method} predicts left-out pairs better than the refinement and is taken: errors are not"
            " independent from pair to pair",
        ),
    ]
    if isinstance(own, LeftOut):
        off = own.translation
        checks.append((off / limits.held_out, f"left-out pairs are {off * 1e3:.3f} mm off at the board"))
    if solution.free.any():
        axis = "xyz"[int(np.argmax(np.abs(solution.free)))]
        parent = names.tip if pairs.setup == "in_hand" else names.base
        checks.append((
            _FAIL, "all rotations are about one axis: five numbers of the camera are determined, not its place along"
            f" {parent}'s {axis_name(solution.free)}; measure it (or touch one point that the camera sees) and give"
            f" --fix {axis}=METRES"
        ))  # fmt: skip
    if scale != 1.0:
        checks.append((
            _FAIL, f"the lengths of the board's poses are {1.0 / scale:.3f} times what the robot's motion says: measure"
            " the board's squares"
        ))  # fmt: skip
    reasons = tuple(text for ratio, text in checks if ratio > 1.0)
    worst = max(ratio for ratio, _ in checks)
    calibration = StoredCalibration.of_mount(
        names.camera, names.tip if pairs.setup == "in_hand" else names.base, solution.X @ se3.inverse(T_LINK_OPTICAL),
        sigma_translation=sigma_t, sigma_rotation=sigma_r, method=f"PAIRS {solution.method}", board="pose pairs",
        samples=used, created=created, versions=versions(),
    )  # fmt: skip
    grade: Grade = "fail" if worst >= _FAIL else "warn" if worst > 1.0 else "pass"
    return JudgedPairs(pairs, solution, names, grade, reasons, calibration)
