# SPDX-License-Identifier: Apache-2.0
"""Why an answer is wrong: what may be wrong with the input is fitted, and compared with taking the input for right.

Each cause is a model of its own: one more unknown with a wide prior (size of the board, focal length, principal point,
distortion, delay), another board, or poses without a mistake (see `variants`). Compared is minus twice the logarithm of
the marginal likelihood of the same pixels, all unknowns and the spreads of robot and misfit fitted: its drop is twice
the logarithm of a Bayes factor (Kass and Raftery 1995, "Bayes factors", call 10 very strong). Where joints are known,
their zeros may be off in either model, so that a cause must say more than they do. m, rad, px.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from openarm_calibration.handeye.closed_form import closed_form
from openarm_calibration.handeye.marks import fit_poses
from openarm_calibration.handeye.problem import Extra, Problem, chain
from openarm_calibration.handeye.refine import fit_all, mount_error, pixel_noise, with_zeros
from openarm_calibration.handeye.unknowns import Estimate, Noise, Priors
from openarm_calibration.handeye.variants import variants
from openarm_common.errors import OpenArmError
from openarm_common.types import Array

#: Drop of minus twice the log likelihood from which a cause is evident.
EVIDENT = 10.0
#: Such a poor answer is looked at for mistakes in its poses: m and rad of the robot from pose to pose, px of a misfit.
_POOR = (3e-3, math.radians(0.3), 3.0)
#: What no arm in order exceeds: a variant of the poses that is as bad as that explains nothing.
_HOPELESS = (0.03, math.radians(3.0))
#: Marks farther from any flat board than this are on another one, px.
_OFF_BOARD = 2.0
#: What a wrong intrinsic may be off by, and what is taken for right while another one is looked at.
_RIGHT = {"focal": 1e-7, "centre": 1e-4}
#: Name, unknown, prior.
_FREED: tuple[tuple[str, Extra, Priors], ...] = (
    ("board size", "scale", Priors(scale=0.1)),
    ("focal length", "intrinsics", Priors(focal=0.1, centre=_RIGHT["centre"])),
    ("principal point", "intrinsics", Priors(focal=_RIGHT["focal"], centre=50.0)),
    ("distortion", "distortion", Priors(distortion=0.3)),
    ("delay", "delay", Priors(delay=0.1)),
)
#: Names of all causes.
CAUSES = (
    *(name for name, _, _ in _FREED), "wrong board", "set-up", "millimetres", "mirrored poses", "transposed rotations",
    "order of quaternions", "degrees", "swapped poses",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Cause:
    """What explains the views better than input that is right.

    Args:
        name: One of `CAUSES`.
        text: A sentence, with the figure.
        evidence: Twice the logarithm of the Bayes factor against input that is right; infinite where that has no
            answer at all.
        translation: Distance that the mount moves by when it is taken into account, m.
        rotation: The same, rad.
        score: Minus twice the log likelihood itself, by which causes are compared where `evidence` is infinite.
    """

    name: str
    text: str
    evidence: float
    translation: float
    rotation: float
    score: float = 0.0

    @property
    def sentence(self) -> str:
        """The text with the evidence."""
        if not math.isfinite(self.evidence):
            return f"{self.text} (as given, the poses have no answer)"
        return f"{self.text} (2 ln of the likelihood ratio: {self.evidence:.0f})"


@dataclass(frozen=True, eq=False)
class Freed:
    """An answer with one more unknown, and by how much it is more likely."""

    name: str
    estimate: Estimate
    evidence: float

    def value(self) -> tuple[float, float]:
        """Return scale of the board, focal length over the stated one, k1 or delay, with its standard deviation.

        Of fx and fy the one that is off by more deviations; of several cameras the first.
        """
        estimate = self.estimate
        first = 6 * (len(estimate.X) + len(estimate.Z))
        sigma = np.sqrt(np.maximum(np.diag(estimate.covariance())[first:], 0.0))
        if self.name == "board size":
            return float(estimate.scale), float(sigma[0])
        if self.name == "distortion":
            return float(estimate.distortion[0, 0]), float(sigma[0])
        if self.name == "delay":
            return float(estimate.delay), float(sigma[0])
        k = int(np.argmax(np.abs(estimate.intrinsics[0, :2]) / np.maximum(sigma[:2], 1e-12)))
        return float(estimate.intrinsics[0, k]), float(sigma[k])


def freed(problem: Problem, X: Array, Z: Array, noise: Noise) -> tuple[Estimate, dict[str, Freed]]:
    """Return the answer for input that is right, and those with one more unknown by name.

    In all of them the zeros of the joints are off where that is likelier.

    Args:
        problem: Views that the answer rests on.
        X: (cameras, 4, 4) to start from.
        Z: (boards, 4, 4) to start from.
        noise: Noise to start from.
    """
    base = with_zeros(problem, fit_all(problem, X, Z, noise))
    out: dict[str, Freed] = {}
    for name, extra, priors in _FREED:
        if extra == "delay" and not np.abs(problem.rate).max() > 1e-4:
            continue
        try:
            found = fit_all(problem, X, Z, noise, (extra,), priors)
        except (OpenArmError, np.linalg.LinAlgError):
            continue
        if "zeros" in base.extras:
            found = with_zeros(problem, found, priors)
        out[name] = Freed(name, found, base.evidence - found.evidence)
    return base, out


def diagnose(problem: Problem, base: Estimate | None, alternatives: dict[str, Freed]) -> tuple[Cause, ...]:
    """Return what explains the views far better than input that is right, the likeliest first.

    Args:
        problem: Views that the answer rests on.
        base: The answer for input that is right, as `freed` returns it; None where there is none.
        alternatives: The answers with one more unknown.
    """
    out = [_described(problem, base, found) for found in alternatives.values() if base is not None]
    poor = base is None or _poor(base.noise, float(np.mean(problem.marks)))
    px = pixel_noise(problem)
    best_px = min([px, *(found.estimate.noise.px for found in alternatives.values())])
    if (poor or px > 0.3) and (board := _other_board(problem, base, best_px)) is not None:
        out.append(board)
    if poor and problem.cameras == 1 and problem.boards == 1 and (problem.kind < 2).all():
        out += _mistakes(problem, base)
    evident = [cause for cause in out if cause.evidence > EVIDENT]
    return tuple(sorted(evident, key=lambda cause: (-cause.evidence, cause.score)))


def _poor(noise: Noise, marks: float) -> bool:
    return any(
        spread > limit
        for spread, limit in zip((noise.translation, noise.rotation, noise.misfit_px(marks)), _POOR, strict=True)
    )


def _described(problem: Problem, base: Estimate, found: Freed) -> Cause:
    estimate = found.estimate
    stated = problem.intrinsics[0]
    value, sigma = found.value()
    if found.name == "board size":
        text = f"the board seems {abs(value - 1.0) * 100:.2f} % off its stated size"
        text += f" ({value:.4f} ± {sigma:.4f} of it)"
    elif found.name == "focal length":
        f = stated.fx if abs(value - estimate.intrinsics[0, 0]) < 1e-12 else stated.fy
        text = (
            f"the focal length seems {value / f * 100:+.2f} % off its value in camera_info; are these its intrinsics?"
        )
    elif found.name == "principal point":
        cx, cy = estimate.intrinsics[0, 2:]
        text = f"the principal point seems ({cx:+.1f}, {cy:+.1f}) px off its value in camera_info"
    elif found.name == "distortion":
        text = f"the images seem distorted (k1 = {value:+.4f} ± {sigma:.4f}), which the intrinsics don't say"
    else:
        text = f"the images seem {value * 1e3:+.1f} ± {sigma * 1e3:.1f} ms old at their stamps"
    moved = max((mount_error(estimate.X[k], base.X[k]) for k in range(problem.cameras)), key=lambda m: m[0] + m[1])
    return Cause(found.name, text, found.evidence, *moved)


# --- another board
def _other_board(problem: Problem, base: Estimate | None, best_px: float) -> Cause | None:
    """Return the wrong board: marks that lie on no board of the stated kind, or on one that is longer one way."""
    flat = _homography_px(problem)
    if flat > _OFF_BOARD and best_px > _OFF_BOARD:
        text = f"the marks don't lie on the stated board ({flat:.1f} px off any picture of it): is it another board?"
        return Cause("wrong board", text, math.inf, math.inf, math.inf)

    def cost(log_ratio: float) -> float:
        return float(_stretched(problem, math.exp(log_ratio)).free_cost.sum())

    # bounded: the rows of a board are at most twice as far apart as stated, or half as far
    best: Any = minimize_scalar(cost, bounds=(-0.7, 0.7), method="bounded", options={"xatol": 1e-5, "maxiter": 40})
    longer = _stretched(problem, math.exp(best.x))
    px = pixel_noise(longer)
    if px > 0.9 * pixel_noise(problem):
        return None
    text = f"the rows of the board seem {(math.exp(best.x) - 1.0) * 100:+.2f} % off their stated distance"
    text += ": is it another board?"
    if base is None:
        return Cause("wrong board", text, math.inf, math.inf, math.inf)
    try:
        found = fit_all(longer, base.X, base.Z, Noise(px, 1e-4, 1e-4))
    except (OpenArmError, np.linalg.LinAlgError):
        return None
    if "zeros" in base.extras:
        found = with_zeros(longer, found)
    # the logarithm of a number that is known to one part in as many as there are marks
    unknown = math.log(2.0 * float(problem.marks.sum()))
    evidence = base.evidence - found.evidence - unknown
    return Cause("wrong board", text, evidence, *mount_error(found.X[0], base.X[0]))


def _stretched(problem: Problem, ratio: float) -> Problem:
    points = problem.points * np.array([1.0, ratio, 1.0])
    free, cost = fit_poses(
        points, problem.pixels, problem.offsets, problem.radii, problem.free, problem.camera_rows(), 8
    )
    views = tuple(replace(view, points=view.points * np.array([1.0, ratio, 1.0])) for view in problem.views)
    return replace(problem, views=views, points=points, free=free, free_cost=cost)


def _homography_px(problem: Problem) -> float:
    """Return the rms distance of the marks from a free plane picture of the board, median over the views, px."""
    out: list[float] = []
    for view in problem.views:
        n = len(view.points)
        if n < 6:
            continue
        p, u = view.points[:, :2] - view.points[:, :2].mean(axis=0), view.pixels - view.pixels.mean(axis=0)
        p, scale = p / max(float(np.abs(p).max()), 1e-12), max(float(np.abs(u).max()), 1e-12)
        u = u / scale
        one, zero = np.ones((n, 1)), np.zeros((n, 3))
        ph = np.hstack([p, one])
        M = np.vstack([np.hstack([ph, zero, -u[:, :1] * ph]), np.hstack([zero, ph, -u[:, 1:] * ph])])
        H = np.linalg.svd(M, full_matrices=False)[2][-1].reshape(3, 3)
        h = ph @ H.T
        away = h[:, :2] / h[:, 2:] - u
        out.append(float(np.sqrt(np.sum(away**2) / max(2 * n - 8, 1))) * scale)
    return float(np.median(out)) if out else 0.0


# --- mistakes in the poses
def _mistakes(problem: Problem, base: Estimate | None) -> Iterator[Cause]:
    """Yield variants of the poses that are far likelier, and in themselves an answer."""
    tried: list[tuple[float, int, str, str, Problem, Array, Array]] = []
    for number, variant in enumerate(variants(problem)):
        part = replace(problem, A=variant.A)
        for method in ("SHAH", "PARK"):
            try:
                mounts = closed_form(method, problem.views[0].setup, part.A, part.free)
            except OpenArmError:
                continue
            T, _ = chain(part, mounts.X[None], mounts.Z[None])
            _, _, cost = part.equations(T)
            if np.isfinite(cost).all():
                px = float(np.median(np.sqrt(cost / (2.0 * part.marks))))
                tried.append((px, number, variant.name, variant.text, part, mounts.X[None], mounts.Z[None]))
    done: set[int] = set()
    for _, number, name, text, part, X, Z in sorted(tried, key=lambda entry: entry[:2]):
        if number in done or len(done) == 4:
            continue
        done.add(number)
        try:
            found = fit_all(part, X, Z, Noise(pixel_noise(part), 1e-3, 1e-3))
        except (OpenArmError, np.linalg.LinAlgError):
            continue
        if found.noise.translation > _HOPELESS[0] or found.noise.rotation > _HOPELESS[1]:
            continue
        if not math.isfinite(found.evidence):
            continue
        evidence = math.inf if base is None else base.evidence - found.evidence
        moved = (math.inf, math.inf) if base is None else mount_error(found.X[0], base.X[0])
        yield Cause(name, text, evidence, *moved, score=found.evidence)
