# SPDX-License-Identifier: Apache-2.0
"""From sessions of one robot to its joint zeros and the mounts of its cameras, with what they predict; m, rad, px.

Left-out poses are predicted by the other ones twice: with the zeros that these give, and with those of the description.
Zeros that predict them no better are not to be stored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from openarm_calibration.handeye.accuracy import accuracies
from openarm_calibration.handeye.left_out import in_space_squares
from openarm_calibration.handeye.limits import Limits
from openarm_calibration.handeye.marks import project
from openarm_calibration.handeye.offline import Result, judged, part_of
from openarm_calibration.handeye.problem import chain
from openarm_calibration.handeye.unknowns import Solution
from openarm_calibration.handeye.verdict import GRADES, Grade
from openarm_calibration.handeye.zeros import ArmView, ZerosConfig, ZerosResult, arm_problem, solve_zeros
from openarm_calibration.sampling.samples import SampleSet
from openarm_calibration.store.store import StoredCalibration
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.learned import StoredZeros

#: Groups of poses that are left out in turn.
_FOLDS = 5
#: Offsets that say "as described": far less than an encoder resolves, rad.
_AS_DESCRIBED = 1e-7
#: A zero that is farther off is more likely a wrong joint, sign or robot, rad.
_LIKELY = math.radians(15.0)
#: More poses left out than this share make an answer doubtful.
_OUTLIERS = 0.1


@dataclass(frozen=True)
class Predicted:
    """Errors of the marks of poses that an answer did not see: in the image, px, and in space, m.

    Args:
        px: Median over the poses of the rms.
        metres: The same.
        by_name: Rms of both by view.
    """

    px: float
    metres: float
    by_name: dict[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class ZerosCalibration:
    """Zeros of a robot, the mounts that go with them, and whether to believe them.

    Args:
        result: Result of the solver.
        zeros: Zeros to store.
        cameras: Each session with the zeros that were found, judged.
        mounts: Mounts of the cameras, to be stored with them.
        before: Errors of left-out poses with the zeros of the description.
        after: The same with the zeros that were found.
        failures: Why they are not to be stored; none if they are.
        warnings: Doubts, a sentence each.
    """

    result: ZerosResult
    zeros: StoredZeros
    cameras: tuple[Result, ...]
    mounts: tuple[StoredCalibration, ...]
    before: Predicted
    after: Predicted
    failures: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def grade(self) -> Grade:
        """The worst of all; fail, when zeros and mounts are not to be stored."""
        grades: list[Grade] = [self.verdict(mount.camera)[0] for mount in self.mounts]
        return max(grades, key=GRADES.index)

    def verdict(self, camera: str) -> tuple[Grade, tuple[str, ...]]:
        """Return the worst grade of the sessions of a camera, and why it is no pass."""
        mine = [one.verdict for one in self.cameras if one.calibration.camera == camera]
        grades: list[Grade] = [one.grade for one in mine]
        grades.append("fail" if self.failures else "warn" if self.warnings else "pass")
        reasons = dict.fromkeys(reason for one in mine for reason in one.reasons)
        return max(grades, key=GRADES.index), (*reasons, *self.failures, *self.warnings)

    def hand(self, camera: str) -> float:
        """Return the distance of the hand from what a camera sees, of the arm with the largest, rms, m."""
        return max(one.verdict.figures["hand"] for one in self.cameras if one.calibration.camera == camera)

    def as_json(self) -> dict[str, Any]:
        """Return it for `--json` and reports."""
        solution = self.result.solution
        return {
            "zeros": self.zeros.model_dump(mode="json"),
            "mounts": {mount.camera: mount.model_dump(mode="json") for mount in self.mounts},
            "sessions": [
                {
                    "camera": one.calibration.camera,
                    "grade": one.verdict.grade,
                    "reasons": list(one.verdict.reasons),
                    "figures": one.verdict.figures,
                }
                for one in self.cameras
            ],
            "left_out": {"before": vars(self.before), "after": vars(self.after)},
            "outliers": {outlier.name: outlier.reason for outlier in solution.outliers},
            "noise": vars(solution.estimate.noise),
            "failures": list(self.failures),
            "warnings": list(self.warnings),
        }


def arm_views(sessions: Sequence[SampleSet]) -> tuple[tuple[ArmView, ...], tuple[Intrinsics, ...]]:
    """Return the views of sessions, and the intrinsics of their cameras, as `solve_zeros` takes them.

    Sessions of one camera on the same link share its mount; each session has a board of its own.

    Args:
        sessions: Sessions of one robot, of any cameras and arms.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for sessions of different robots, or of one camera with different intrinsics.
    """
    robots = sorted({samples.head.robot for samples in sessions if samples.head.robot})
    if len(robots) > 1:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"sessions of {', '.join(robots)}; joints have the same zeros in one robot only"
        )
    if len(whose := sorted({samples.head.zeros_of for samples in sessions})) > 1:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"sessions of {' and of '.join(whose)}: not the same joints")
    mounts: dict[tuple[str, str], Intrinsics] = {}
    out: list[ArmView] = []
    for board, samples in enumerate(sessions):
        place = samples.head.camera, samples.head.parent
        if mounts.setdefault(place, samples.head.optics) != samples.head.optics:
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"sessions of camera {place[0]!r} with different intrinsics; solve them apart"
            )
        chain = samples.kinematics(())
        for sample, view in zip(samples.samples, samples.problem().views, strict=True):
            name = f"{place[0]}_{board + 1}/{view.name}"
            numbered = replace(view, camera=list(mounts).index(place), board=board, pose=len(out), name=name)
            out.append(ArmView(numbered, chain.base, chain.tip, sample.joints, sample.T_camera_board))
    return tuple(out), tuple(mounts.values())


def calibrate_zeros(
    sessions: Sequence[SampleSet],
    config: ZerosConfig | None = None,
    *,
    limits: Limits | None = None,
    hashes: Sequence[str] = (),
    created: str = "",
) -> ZerosCalibration:
    """Find the zeros of the joints with the mounts of all cameras, and judge them by poses that are left out.

    Args:
        sessions: Sessions of one robot; any number of cameras and arms.
        config: Priors.
        limits: Limits of the verdicts.
        hashes: Hashes of the sessions, for the record.
        created: When, as ISO 8601, for the record.

    Raises:
        OpenArmError: Same as `arm_views` and `solve_zeros`.
    """
    config = config or ZerosConfig()
    views, optics = arm_views(sessions)
    described = sessions[0].description.described
    result = solve_zeros(described, views, optics, config)
    fixed = config.model_copy(update={"sigma": max(float(result.prior.max()), _AS_DESCRIBED)})
    plain = config.model_copy(update={"sigma": _AS_DESCRIBED, "by_joint": {}})
    before = _predicted(described, views, optics, plain, None)
    after = _predicted(described, views, optics, fixed, result.solution)
    joints = dict(zip(result.names, zip(result.values, result.sigma, result.observable, strict=True), strict=True))
    joints = {name: row for name, row in joints.items() if name in described.joints}
    offsets = {name: float(value) if result.off else 0.0 for name, (value, _, _) in joints.items()}
    heads = [(samples.head.camera, samples.head.parent) for samples in sessions]
    places = list(dict.fromkeys(heads))
    zeros = StoredZeros(
        of=sessions[0].head.zeros_of,
        offsets=offsets,
        sigma={name: float(sigma) for name, (_, sigma, _) in joints.items()},
        by_prior=tuple(name for name, (_, _, observable) in joints.items() if not observable),
        cameras=tuple(camera for camera, _ in places),
        samples=int(np.count_nonzero(result.solution.used)),
        sessions=tuple(hashes),
        created=created,
    )
    cameras: list[Result] = []
    hashes = hashes or [""] * len(sessions)
    for board, (samples, accuracy) in enumerate(zip(sessions, accuracies(sessions, result), strict=True)):
        zeroed = samples.with_zeros(offsets)
        part = part_of(result.solution, result.solution.problem.board == board, zeroed.problem())
        cameras.append(judged(zeroed, part, limits=limits, session=hashes[board], created=created, accuracy=accuracy))
    used = result.solution.problem.camera[result.solution.used]
    mounts = tuple(
        cameras[heads.index(place)].calibration.model_copy(update={"samples": int(np.count_nonzero(used == k))})
        for k, place in enumerate(places)
    )
    failures, warnings = _doubts(result, before, after, len(views))
    return ZerosCalibration(result, zeros, tuple(cameras), mounts, before, after, failures, warnings)


def _doubts(
    result: ZerosResult, before: Predicted, after: Predicted, views: int
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    failures: list[str] = []
    warnings: list[str] = []
    if result.off and not (after.metres < before.metres and after.px < before.px):
        failures.append(
            f"with the zeros left-out poses are predicted no better ({after.px:.2f} px, {after.metres * 1e3:.2f} mm)"
            f" than without ({before.px:.2f} px, {before.metres * 1e3:.2f} mm); take more samples, of all joints"
        )
    for name, value, prior, observable in zip(
        result.names, result.values, result.prior, result.observable, strict=True
    ):
        if observable and abs(value) > max(_LIKELY, 4.0 * prior):
            failures.append(
                f"{name} seems off by {math.degrees(value):.1f}°, which no zero is: check order and signs of the"
                " joints, and the robot (--robot)"
            )
    if result.solution.outliers:
        count = len(result.solution.outliers)
        names = ", ".join(outlier.name for outlier in result.solution.outliers)
        text = f"{count} of {views} samples contradict the others and are left out: {names}"
        (failures if count > 3 * _OUTLIERS * views else warnings).append(text)
    return tuple(failures), tuple(warnings)


def _predicted(
    described: RobotDescription,
    views: Sequence[ArmView],
    optics: Sequence[Intrinsics],
    config: ZerosConfig,
    start: Solution | None,
) -> Predicted:
    """Return the errors of poses that are left out in turn."""
    by_name: dict[str, tuple[float, float]] = {}
    for fold in range(min(_FOLDS, len(views))):
        kept = [view for k, view in enumerate(views) if k % _FOLDS != fold]
        found = solve_zeros(described, kept, optics, config, start)
        estimate = found.solution.estimate
        left = [view for k, view in enumerate(views) if k % _FOLDS == fold]
        problem = arm_problem(described, left, optics, found.names).posed(estimate.zeros)
        T, _ = chain(problem, estimate.X, estimate.Z)
        rows = problem.camera_rows(estimate.optics)
        space = in_space_squares(problem, T)
        for k, view in enumerate(problem.views):
            away = project(view.points, view.radius, T[k], rows[k]) - view.pixels
            by_name[view.name] = float(np.sqrt(np.mean(np.sum(away**2, axis=1)))), float(np.sqrt(space[k]))
    px, metres = np.median(list(by_name.values()), axis=0).tolist()
    return Predicted(px, metres, by_name)
