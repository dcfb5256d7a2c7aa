# SPDX-License-Identifier: Apache-2.0
"""Zeros of the joints, estimated with the mounts of cameras and boards in one problem.

An encoder whose zero is off reports `q`, where the joint is at `q + offset`. Views of any number of sets, cameras and
arms share the offsets of the joints that they have in common; each set has the mounts that it has. Lengths of links and
flexure, `compliance × torque` of a joint that gives way under load, may be unknowns too.

A mount takes up the offset of the joint next to it: a camera or board that stands still on the base that of the first
joint, one in the hand that of the last. There the prior decides, and `ZerosResult` says so joint by joint. A board that
lies on a level table determines the first one, where its axis is horizontal, and the tilt of fixed cameras. The forward
kinematics is exact, and linearised again at each step (iterated least squares, as in Hollerbach and Wampler 1996, "The
calibration index and taxonomy for robot kinematic calibration methods"). m, rad, N m.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from pydantic import Field

from openarm_calibration.handeye.kinematics import ArmPosture, Kinematics
from openarm_calibration.handeye.problem import SETUPS, BoardView, Problem, assemble, layout
from openarm_calibration.handeye.solve import SolveConfig, solve
from openarm_calibration.handeye.unknowns import ZERO_SCALES, Priors, Solution
from openarm_common.camera.cameras import Intrinsics
from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.urdf import Joint
from openarm_common.types import Array

#: Twice the logarithm of the likelihood ratio from which the zeros count as wrong: very strong evidence (Kass and
#: Raftery 1995, "Bayes factors").
_EVIDENT = 10.0
#: Posterior over prior deviation up to which the data determine a joint; two that only differ by a mount have 0.71.
_DETERMINED = 0.5
#: Boards that are tilted by less lie on the table, with zeros that are off, rad.
_LYING = math.radians(5.0)


class ZerosConfig(Config):
    """What is known of the zeros beforehand, and what else is estimated."""

    sigma: float | None = Field(
        default=None, gt=0.0, description="of a joint's offset, rad; None: the likeliest one, by all joints together"
    )
    by_joint: dict[str, float] = Field(
        default_factory=dict, description="the same of single joints, rad; 0 takes the reported zero for true"
    )
    lengths: float | None = Field(default=None, gt=0.0, description="of links' lengths, m; None: as described")
    flexure: float | None = Field(default=None, gt=0.0, description="of joints' compliance, rad/(N m); None: stiff")
    level: float | None = Field(
        default=None, gt=0.0, description="of the tilt of the table on which a board lies, rad; None: unknown"
    )
    solver: SolveConfig = Field(
        # a misfit would explain zeros that are off as well
        default=SolveConfig(misfit=False, most_translation=10.0, most_rotation=10.0),
        description="of mounts and noise",
    )


@dataclass(frozen=True, eq=False)
class ArmView:
    """A view with the joint positions that its robot pose comes from.

    Args:
        view: Its A is not read.
        base: Link in whose frame A is.
        tip: Link whose pose A is.
        q: Positions that the encoders report, rad.
        guess: (4, 4) T_camera_board.
        torque: Torque of the joints, N m; for flexure.
    """

    view: BoardView
    base: str
    tip: str
    q: Mapping[str, float]
    guess: Array
    torque: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ZerosResult:
    """Offsets of the joints: where a joint is, minus what its encoder reports; and the rest of the parameters.

    Args:
        names: Names of the parameters: a joint for its offset, `joint length`, `joint flexure`.
        values: (parameters,) rad, m, rad/(N m).
        covariance: (parameters, parameters), the prior included.
        prior: (parameters,) standard deviations before anything was seen.
        solution: Mounts and noise, at these values.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array
    prior: Array
    solution: Solution

    @property
    def sigma(self) -> Array:
        """(parameters,) standard deviations."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def off(self) -> bool:
        """Whether the samples show that zeros are off at all, where that was to be found out."""
        return bool(self.prior.max(initial=0.0) > ZERO_SCALES[0])

    @property
    def observable(self) -> tuple[bool, ...]:
        """Whether the data tell each parameter; where not, the prior decides."""
        return tuple(bool(s < _DETERMINED * p) for s, p in zip(self.sigma, self.prior, strict=True))

    def mounts_covariance(self) -> Array:
        """(parameters, parameters) of everything: mounts of cameras, then of boards, then these parameters."""
        return self.solution.estimate.covariance()

    def sentences(self) -> tuple[str, ...]:
        """Return a line for each parameter, with whether the data tell it."""
        if not self.off:
            return ("the samples show no joint whose zero is off",)
        out: list[str] = []
        for name, value, sigma, prior, observable in zip(
            self.names, self.values, self.sigma, self.prior, self.observable, strict=True
        ):
            if name.endswith(" length"):
                figure = f"{value * 1e3:+.2f} ± {sigma * 1e3:.2f} mm"
            elif name.endswith(" flexure"):
                figure = f"{math.degrees(value):+.3f} ± {math.degrees(sigma):.3f}° per N m"
            else:
                figure = f"{math.degrees(value):+.2f} ± {math.degrees(sigma):.2f}°"
            if prior == 0.0:
                out.append(f"{name}: taken for true")
            elif observable:
                out.append(f"{name}: {figure}")
            else:
                out.append(f"{name}: {figure}; a mount or another joint takes it up: the prior decides")
        return tuple(out)


def joints_of(description: RobotDescription, views: Sequence[ArmView]) -> tuple[str, ...]:
    """Return the joints that move a tip against its base in any of the views, in the order of the chains.

    Args:
        description: The robot.
        views: Views, at least one.
    """
    out: list[str] = []
    for base, tip in dict.fromkeys((view.base, view.tip) for view in views):
        ahead, behind = description.chain(tip), description.chain(base)
        for joint in (*ahead, *behind):
            own = joint.mimic or joint.name
            if joint.type != "fixed" and (joint in ahead) != (joint in behind) and own not in out:
                out.append(own)
    return tuple(out)


def _parameters(
    description: RobotDescription, views: Sequence[ArmView], config: ZerosConfig
) -> tuple[tuple[str, ...], Array]:
    joints = joints_of(description, views)
    for name in config.by_joint:
        if name not in joints:
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"a prior for {name!r}, which moves nothing here; joints: {', '.join(joints)}"
            )
    names, sigma = list(joints), [config.by_joint.get(name, config.sigma or ZERO_SCALES[-1]) for name in joints]
    if config.lengths is not None:
        long = [name for name in joints if _has_length(description.joint(name))]
        names += [f"{name} length" for name in long]
        sigma += [config.lengths] * len(long)
    if config.flexure is not None:
        names += [f"{name} flexure" for name in joints]
        sigma += [config.flexure] * len(joints)
    return tuple(names), np.array(sigma)


def _has_length(joint: Joint) -> bool:
    return bool(np.linalg.norm(joint.T_parent_joint[:3, 3]) > 1e-6)


def arm_problem(
    description: RobotDescription, views: Sequence[ArmView], intrinsics: Sequence[Intrinsics], names: tuple[str, ...]
) -> Problem:
    """Return the problem of views whose robot poses follow from their joints by `Problem.posed`.

    Args:
        description: The robot.
        views: Views, at least one.
        intrinsics: Intrinsics of each camera.
        names: Names of the parameters, as in `ZerosResult`.
    """
    chains = {ends: Kinematics(description, *ends, names) for ends in {(view.base, view.tip) for view in views}}
    armed = [replace(view.view, arm=ArmPosture(chains[view.base, view.tip], view.q, view.torque)) for view in views]
    return assemble(armed, intrinsics, [view.guess for view in views])


def _lying(solution: Solution) -> tuple[int, ...]:
    """Return the boards that stand still on the base and are about level."""
    problem, level = solution.problem, np.abs(solution.estimate.Z[:, 2, 2]) > math.cos(_LYING)
    still = np.unique(problem.board[problem.kind == SETUPS.index("in_hand")])
    return tuple(int(board) for board in still if level[board])


def solve_zeros(
    description: RobotDescription,
    views: Sequence[ArmView],
    intrinsics: Sequence[Intrinsics],
    config: ZerosConfig | None = None,
    start: Solution | None = None,
) -> ZerosResult:
    """Estimate the zeros of the joints with all mounts.

    Args:
        description: The robot, whose forward kinematics the reported positions are put through.
        views: Views of any sets: `camera` and `board` number the mounts, `pose` the robot poses.
        intrinsics: Intrinsics of each camera.
        config: Priors.
        start: A solution of nearly the same views, to start from.

    Raises:
        OpenArmError: DEGENERATE, when the views determine no mount; INVALID_ARGUMENT, for no view, or a prior of a
            joint that moves nothing.
    """
    config = config or ZerosConfig()
    if not views:
        raise OpenArmError(Code.INVALID_ARGUMENT, "no views; take samples of at least one camera and board")
    names, _ = _parameters(description, views, config)
    problem = arm_problem(description, views, intrinsics, names).posed(np.zeros(len(names)))
    solver = config.solver.model_copy(update={"extras": (*config.solver.extras, "zeros")})
    # views that contradict the others may do so by the zeros alone, as long as these are not known
    trusting = solver.model_copy(update={"reject_outliers": False})
    answers: list[tuple[Array, Solution]] = []
    given = () if config.sigma is None else (config.sigma,)
    level: dict[int, float] = {}
    if config.level is not None:
        start = start or solve(problem, trusting, Priors(zeros=np.full(len(names), ZERO_SCALES[0])))
        level = dict.fromkeys(_lying(start), config.level)
    for scale in ZERO_SCALES if not given else given if start is not None else (ZERO_SCALES[0], *given):
        _, sigma = _parameters(description, views, config.model_copy(update={"sigma": scale}))
        start = solve(problem, trusting, Priors(zeros=sigma, level=level), start=start)
        answers.append((sigma, start))
    prior, solution = answers[-1] if given else min(answers, key=lambda answer: answer[1].estimate.evidence)
    if not given and not solution.estimate.evidence < answers[0][1].estimate.evidence - _EVIDENT:
        prior, solution = answers[0]
    if solver.reject_outliers:
        solution = solve(problem, solver, Priors(zeros=prior, level=level), start=solution)
    estimate, covariance = solution.estimate, solution.estimate.covariance()
    columns = layout(solution.problem, estimate.extras)["zeros"]
    return ZerosResult(names, estimate.zeros, covariance[columns, columns], prior, solution)
