# SPDX-License-Identifier: Apache-2.0
"""How wrong a mount may be where the zeros of the joints may be wrong, too, and how far the hand then misses.

Zeros that are off move a mount, which is solved with the joints as they are reported, and the arm with it. Two figures
state that: the error of the mount in the true frame of its parent, and the distance from where the camera sees a place
to where the hand goes for it, which is what a grasp depends on. Of one session both are averaged over the deviations
that zeros may have, each weighed by its evidence; of a solve of zeros they follow from its covariance. m, rad.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from openarm_calibration.handeye.kinematics import Kinematics
from openarm_calibration.handeye.problem import Setup, layout
from openarm_calibration.handeye.refine import refine
from openarm_calibration.handeye.transforms import difference, moved
from openarm_calibration.handeye.unknowns import ZERO_SCALES, Estimate, Priors, Solution
from openarm_calibration.sampling.samples import SampleSet
from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array

if TYPE_CHECKING:
    from openarm_calibration.handeye.zeros import ZerosResult

#: Up to this deviation those of zeros are taken for equally likely, larger ones for less, rad.
_USUAL = math.radians(1.0)
#: Answers that are less probable are not looked at.
_UNLIKELY = 1e-3
#: Most postures at which the hand is looked at.
_POSTURES = 12
#: Steps of derivatives, m and rad.
_STEP = 1e-5


@dataclass(frozen=True)
class Accuracy:
    """Deviations of vectors.

    Args:
        translation: Deviation of the mount's position, m.
        rotation: Deviation of its rotation, rad.
        hand: Distance of the tool centre point from where the camera sees it, rms, m.
        zeros: Deviation of each joint's zero, rad.
    """

    translation: float
    rotation: float
    hand: float
    zeros: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class PossibleTruth:
    """A mount and zeros as they may really be.

    Args:
        weight: Probability.
        X: (4, 4) mount.
        zeros: (joints,) offsets, rad.
        covariance: (6 + joints, 6 + joints) of both.
    """

    weight: float
    X: Array
    zeros: Array
    covariance: Array


def accuracy_of(samples: SampleSet, solution: Solution) -> Accuracy:
    """Return how wrong a mount may be that was solved with the joints as they are reported.

    Args:
        samples: Samples of one camera, on a robot whose joints are known.
        solution: Mount.

    Raises:
        OpenArmError: Same as `refine`.
    """
    part, now = solution.problem.subset(solution.used), solution.estimate
    noise, zeros = replace(now.noise, misfit=0.0), np.zeros(part.joints)
    answers: list[Estimate] = []
    for scale in ZERO_SCALES:
        before = answers[-1] if answers else now
        answers.append(
            refine(
                part, before.X, before.Z, noise, zeros=zeros, extras=("zeros",),
                priors=Priors(zeros=np.full(part.joints, scale)), estimate_robot=True, estimate_px=True,
                estimate_misfit=False,
            )
        )  # fmt: skip
        noise, zeros = answers[-1].noise, answers[-1].zeros
    evidence, scales = np.array([answer.evidence for answer in answers]), np.array(ZERO_SCALES)
    weights = np.exp(-0.5 * (evidence - evidence.min())) / (1.0 + (scales / _USUAL) ** 2)
    weights /= weights.sum()
    columns = layout(part, answers[0].extras)["zeros"]
    both = np.r_[0:6, np.arange(columns.start, columns.stop)]
    truths = [
        PossibleTruth(float(weight), answer.X[0], answer.zeros, answer.covariance()[np.ix_(both, both)])
        for weight, answer in zip(weights, answers, strict=True)
        if weight >= _UNLIKELY
    ]
    return _averaged(samples, now.X[0], np.zeros(part.joints), truths)


def accuracies(sessions: Sequence[SampleSet], result: ZerosResult) -> tuple[Accuracy, ...]:
    """Return how wrong the mount and the hand of each session may be, with the zeros that were found in use.

    Args:
        sessions: Sessions whose views were solved, in the order of the boards.
        result: Zeros and mounts.
    """
    problem, estimate, covariance = result.solution.problem, result.solution.estimate, result.mounts_covariance()
    first = layout(problem, estimate.extras)["zeros"].start
    out: list[Accuracy] = []
    for board, samples in enumerate(sessions):
        camera = int(problem.camera[problem.board == board][0])
        mine = [result.names.index(name) for name in samples.joint_names]
        both = np.r_[6 * camera : 6 * camera + 6, first + np.array(mine)]
        X, zeros = estimate.X[camera], estimate.zeros[mine]
        spread = covariance[np.ix_(both, both)]
        out.append(_averaged(samples.with_zeros({}), X, zeros, [PossibleTruth(1.0, X, zeros, spread)]))
    return tuple(out)


def _averaged(samples: SampleSet, X: Array, zeros: Array, truths: Sequence[PossibleTruth]) -> Accuracy:
    """Return the accuracy of a mount (4, 4) and zeros (joints,) in use, averaged over what may be true."""
    hand = _Hand.of(samples, X, zeros)
    variance, miss = np.zeros(6 + len(zeros)), 0.0
    for truth in truths:
        away = np.concatenate([difference(X, truth.X), truth.zeros - zeros])
        variance += truth.weight * (np.diag(truth.covariance) + away**2)
        miss += truth.weight * hand.square(truth)
    off = dict(zip(samples.joint_names, np.sqrt(variance[6:]).tolist(), strict=True))
    return Accuracy(math.sqrt(variance[:3].sum()), math.sqrt(variance[3:6].sum()), math.sqrt(miss), off)


@dataclass(frozen=True, eq=False)
class _Hand:
    """The tool centre point at some postures, as the robot believes it and as it is.

    Args:
        setup: in_hand or to_hand.
        X: (4, 4) the mount in use.
        tip: Chain from the base to the tool centre point.
        carrier: Chain from the base to the link that carries the camera.
        postures: Positions that the encoders report.
        believed: (n, 3) the point by the zeros in use, base frame.
        seen: (n, 4, 4) the pose of a camera in the hand by mount and zeros in use, base frame.
    """

    setup: Setup
    X: Array
    tip: Kinematics
    carrier: Kinematics
    postures: tuple[dict[str, float], ...]
    believed: Array
    seen: Array

    @classmethod
    def of(cls, samples: SampleSet, X: Array, zeros: Array) -> _Hand:
        """Make one of the postures of samples, with the mount (4, 4) and the zeros (joints,) in use."""
        carrier = samples.kinematics(samples.joint_names)
        tip = replace(carrier, tip=_tcp(carrier.description, carrier.tip))
        some = np.unique(np.linspace(0, len(samples) - 1, min(len(samples), _POSTURES)).astype(int))
        postures = tuple(dict(samples.samples[k].joints) for k in some)
        believed = np.array([tip.evaluate(q, zeros)[0][:3, 3] for q in postures])
        seen = np.array([carrier.evaluate(q, zeros)[0] @ X for q in postures])
        return cls(samples.head.setup, X, tip, carrier, postures, believed, seen)

    def square(self, truth: PossibleTruth) -> float:
        """Return the mean square of how far the hand misses, m²."""
        X, zeros = truth.X, truth.zeros
        at = self._missed(X, zeros)
        columns = [(self._missed(moved(X, step), zeros) - at) / _STEP for step in _STEP * np.eye(6)]
        columns += [(self._missed(X, zeros + step) - at) / _STEP for step in _STEP * np.eye(len(zeros))]
        J = np.stack(columns, axis=-1)  # (n, 3, parameters)
        spread = float(np.einsum("nia,ab,nib->", J, truth.covariance, J)) / len(at)
        return float(np.mean(np.sum(at**2, axis=1))) + spread

    def _missed(self, X: Array, zeros: Array) -> Array:
        """Return (n, 3) from where an object is to where the hand goes for it, in base axes."""
        real = np.array([self.tip.evaluate(q, zeros)[0][:3, 3] for q in self.postures])
        if self.setup == "to_hand":
            return _through(se3.inverse(self.X), self.believed, X) - real
        # seen from one posture, and gone to in the next
        order = np.roll(np.arange(len(real)), 1)
        true = np.array([self.carrier.evaluate(self.postures[k], zeros)[0] @ X for k in order])
        seen = np.array([se3.inverse(pose) for pose in self.seen[order]])
        points = np.column_stack([self.believed, np.ones(len(real))])
        return np.einsum("nij,njk,nk->ni", true, seen, points)[:, :3] - real


def _through(to_camera: Array, points: Array, X: Array) -> Array:
    """Return points (n, 3) that a camera sees there, as they are with the mount X."""
    whole = np.column_stack([points, np.ones(len(points))])
    return (whole @ (X @ to_camera).T)[:, :3]


def _tcp(description: RobotDescription, tip: str) -> str:
    """Return the tool centre point of the arm that moves a link; the link itself where there is none."""
    side = description.arm_of(tip)
    return description.tcp_link(side) if side else tip
