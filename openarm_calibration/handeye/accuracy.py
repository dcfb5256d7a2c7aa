# SPDX-License-Identifier: Apache-2.0
"""How wrong a mount may be where the zeros of the joints may be wrong, too, and how far the hand then misses.

Zeros that are off move a mount, which is solved with the joints as they are reported, and the arm with it. Two figures
tell that apart: the mount in the frame of its parent as it is, and where the hand goes against where the camera sees
the place, which is what a grasp depends on. Both are averaged over the deviations that zeros may have, each weighed by
its evidence; so robots whose zeros are right are sure of their mounts. m, rad.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from openarm_calibration.handeye.kinematics import Kinematics
from openarm_calibration.handeye.problem import Setup, layout
from openarm_calibration.handeye.refine import refine
from openarm_calibration.handeye.transforms import difference, moved
from openarm_calibration.handeye.unknowns import Estimate, Priors, Solution
from openarm_calibration.sampling.samples import SampleSet
from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array

#: Deviations that zeros may have, rad; up to the usual one they are taken for equally likely, larger ones for less.
_SCALES: Array = np.radians([0.001, 0.03, 0.06, 0.1, 0.2, 0.4, 1.0, 2.0, 4.0])
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
        zeros: Deviation of a joint's zero, rad.
    """

    translation: float
    rotation: float
    hand: float
    zeros: float


def accuracy_of(samples: SampleSet, solution: Solution) -> Accuracy:
    """Return how wrong a mount may be.

    Args:
        samples: Samples of one camera, on a robot whose joints are known.
        solution: Mount by the joints as they are reported.
    """
    part, now = solution.problem.subset(solution.used), solution.estimate
    X, noise, zeros = now.X[0], replace(now.noise, misfit=0.0), np.zeros(part.joints)
    answers: list[Estimate] = []
    for scale in _SCALES:
        before = answers[-1] if answers else now
        answers.append(
            refine(
                part, before.X, before.Z, noise, zeros=zeros, extras=("zeros",),
                priors=Priors(zeros=np.full(part.joints, scale)), estimate_robot=True, estimate_px=True,
                estimate_misfit=False,
            )
        )  # fmt: skip
        noise, zeros = answers[-1].noise, answers[-1].zeros
    evidence = np.array([answer.evidence for answer in answers])
    weights = np.exp(-0.5 * (evidence - evidence.min())) / (1.0 + (_SCALES / _USUAL) ** 2)
    hand = _Hand.of(samples, X)
    mount, miss = np.zeros((6, 6)), 0.0
    for weight, answer in zip(weights / weights.sum(), answers, strict=True):
        if weight < _UNLIKELY:
            continue
        covariance = answer.covariance()
        columns = layout(part, answer.extras)["zeros"]
        both = np.r_[0:6, np.arange(columns.start, columns.stop)]
        away = difference(X, answer.X[0])
        mount += weight * (covariance[:6, :6] + np.outer(away, away))
        miss += weight * hand.square(answer.X[0], answer.zeros, covariance[np.ix_(both, both)])
    variance, off = np.diag(mount), math.sqrt(float(weights @ _SCALES**2 / weights.sum()))
    return Accuracy(math.sqrt(variance[:3].sum()), math.sqrt(variance[3:].sum()), math.sqrt(miss), off)


@dataclass(frozen=True, eq=False)
class _Hand:
    """The tool centre point at some postures, as the robot believes it and as it is.

    Args:
        setup: in_hand or to_hand.
        X: (4, 4) the mount in use.
        tip: Chain from the base to the tool centre point.
        carrier: Chain from the base to the link that carries the camera.
        postures: Positions that the encoders report.
    """

    setup: Setup
    X: Array
    tip: Kinematics
    carrier: Kinematics
    postures: tuple[dict[str, float], ...]

    @classmethod
    def of(cls, samples: SampleSet, X: Array) -> _Hand:
        """Make one of the postures of samples."""
        chain = samples.kinematics(samples.joint_names)
        tip = Kinematics(chain.description, chain.base, _tcp(chain.description, chain.tip), chain.parameters)
        some = np.unique(np.linspace(0, len(samples) - 1, min(len(samples), _POSTURES)).astype(int))
        postures = tuple(dict(samples.samples[k].joints) for k in some)
        return cls(samples.head.setup, X, tip, chain, postures)

    def square(self, X: Array, zeros: Array, covariance: Array) -> float:
        """Return the mean square of how far the hand misses, m².

        Args:
            X: (4, 4) the mount as it is.
            zeros: (joints,) as they are, rad.
            covariance: (6 + joints, 6 + joints) of both.
        """
        at = self._missed(X, zeros)
        columns = [(self._missed(moved(X, step), zeros) - at) / _STEP for step in _STEP * np.eye(6)]
        columns += [(self._missed(X, zeros + step) - at) / _STEP for step in _STEP * np.eye(len(zeros))]
        J = np.stack(columns, axis=-1)  # (n, 3, parameters)
        spread = float(np.einsum("nia,ab,nib->", J, covariance, J)) / len(at)
        return float(np.mean(np.sum(at**2, axis=1))) + spread

    def _missed(self, X: Array, zeros: Array) -> Array:
        """Return (n, 3) from where an object is to where the hand goes for it, in base axes."""
        none = np.zeros_like(zeros)
        believed = np.array([self.tip.evaluate(q, none)[0][:3, 3] for q in self.postures])
        real = np.array([self.tip.evaluate(q, zeros)[0][:3, 3] for q in self.postures])
        if self.setup == "to_hand":
            return _through(se3.inverse(self.X), believed, X) - real
        # seen from one posture, and gone to in the next
        seen = [self.carrier.evaluate(q, none)[0] @ self.X for q in self.postures]
        true = [self.carrier.evaluate(q, zeros)[0] @ X for q in self.postures]
        order = np.roll(np.arange(len(believed)), 1)
        there = np.array([
            (T @ se3.inverse(S) @ np.append(believed[k], 1.0))[:3] for k, S, T in zip(order, seen, true, strict=True)
        ])  # fmt: skip
        return there - real[order]


def _through(to_camera: Array, points: Array, X: Array) -> Array:
    """Return points (n, 3) that a camera sees there, as they are with the mount X."""
    whole = np.column_stack([points, np.ones(len(points))])
    return (whole @ (X @ to_camera).T)[:, :3]


def _tcp(description: RobotDescription, tip: str) -> str:
    """Return the tool centre point of the arm that moves a link; the link itself where there is none."""
    side = description.arm_of(tip)
    return description.tcp_link(side) if side else tip
