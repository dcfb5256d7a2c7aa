# SPDX-License-Identifier: Apache-2.0
"""Whether a finger tip meets the marks of a board where a calibration sees them: evidence that no image has part in.

A camera in the hand is calibrated with a board that stands still, so where the board is in the base frame is known with
the mount. The tip of a hand is led to some of its marks, and forward kinematics say where it is. m, rad.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from openarm_calibration.handeye.problem import layout
from openarm_calibration.handeye.transforms import skews
from openarm_calibration.handeye.unknowns import Solution
from openarm_calibration.sampling.samples import SampleSet
from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array

#: How well a tip is led to a mark by hand and eye, m by axis.
STEADY = 1e-3
#: Chance that an offset as large as this is found though nothing is wrong.
_CHANCE = 1e-3


@dataclass(frozen=True)
class Touch:
    """A tip on a mark of the board, with the joints of its arm, rad."""

    mark: int
    joints: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class TouchCheck:
    """What touches say of a calibration. Base frame, m.

    Attributes:
        offsets: (n, 3) from each mark, as the camera sees it, to the tip.
        mean: (3,) of the offsets.
        predicted: Standard deviation of the mean as a vector, when nothing is wrong.
        significance: Square of the mean in units of its covariance; of 3 degrees of freedom.
    """

    offsets: Array
    mean: Array
    predicted: float
    significance: float

    @property
    def rms(self) -> float:
        """Of the offsets."""
        return float(np.sqrt((self.offsets**2).sum(axis=1).mean()))

    @property
    def agrees(self) -> bool:
        """Whether the mean offset is no larger than chance makes it."""
        return self.significance <= float(chi2.isf(_CHANCE, 3))


def check_touches(
    samples: SampleSet,
    solution: Solution,
    touches: Sequence[Touch],
    *,
    tip: ArrayLike = (0.0, 0.0, 0.0),
    steady: float = STEADY,
) -> TouchCheck:
    """Compare touches with where a solution has the board.

    Args:
        samples: Samples of a camera in the hand, with the robot at the zeros of its joints that are in use.
        solution: Solution of these samples.
        touches: Touches of the same board in the same place, by any arm.
        tip: (3,) in the frame of the hand's tool centre point.
        steady: Standard deviation of a touch, by axis.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for samples of a board in the hand, no touch, an unknown mark, or joints of no
            arm.
    """
    if samples.head.setup != "in_hand":
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"the samples of {samples.head.camera!r} have the board on {samples.head.carrier!r}; touches need a board"
            " that stands still, before a camera in the hand",
        )
    if not touches:
        raise OpenArmError(Code.INVALID_ARGUMENT, "no touch; expected one at least, three or more are usual")
    estimate, points = solution.estimate, samples.board.points
    for touch in touches:
        if not 0 <= touch.mark < len(points):
            text = f"mark {touch.mark}: {samples.board.label} has marks 0 to {len(points) - 1}"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
    T_base_board = estimate.Z[0]
    marks = points[[touch.mark for touch in touches]]
    seen = marks @ T_base_board[:3, :3].T + T_base_board[:3, 3]
    offsets = np.array([_tip(samples, touch, np.asarray(tip, float)) for touch in touches]) - seen
    first = layout(solution.problem, estimate.extras)["Z"].start
    of_board = estimate.covariance()[first : first + 6, first : first + 6]
    J = np.hstack([np.eye(3), -T_base_board[:3, :3] @ skews(marks.mean(axis=0)[None])[0]])
    single = steady**2 + estimate.noise.translation**2
    covariance = J @ of_board @ J.T + np.eye(3) * single / len(touches)
    mean = offsets.mean(axis=0)
    significance = float(mean @ np.linalg.solve(covariance, mean))
    return TouchCheck(offsets, mean, math.sqrt(np.trace(covariance)), significance)


def _tip(samples: SampleSet, touch: Touch, tip: Array) -> Array:
    description = samples.description
    T = description.link_pose(description.arms[arm_of(description, touch.joints)].tcp, touch.joints)
    T = se3.inverse(description.link_pose(samples.head.base, touch.joints)) @ T
    return T[:3, :3] @ tip + T[:3, 3]


def arm_of(description: RobotDescription, joints: Mapping[str, float]) -> str:
    """Return the arm whose joints these are.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the joints of each arm.
    """
    for name, parts in description.arms.items():
        if set(joints) == set(parts.joints):
            return name
    known = "; ".join(f"{name}: {', '.join(parts.joints)}" for name, parts in description.arms.items())
    raise OpenArmError(Code.INVALID_ARGUMENT, f"joints {', '.join(joints)}: expected all of one arm ({known})")


def read_touches(path: Path) -> list[Touch]:
    """Read a CSV file: a row a touch, with columns `mark` and the joints of an arm, rad.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming file and line.
    """
    touches: list[Touch] = []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for number, row in enumerate(csv.DictReader(file), 2):
                try:
                    mark = int(row.pop("mark"))
                    joints = {name: float(value) for name, value in row.items()}
                except (KeyError, TypeError, ValueError) as error:
                    text = f"{path}:{number}: {error!r}; expected columns mark and the joints of an arm, all numbers"
                    raise OpenArmError(Code.INVALID_ARGUMENT, text) from None
                if not all(map(math.isfinite, joints.values())):
                    raise OpenArmError(Code.INVALID_ARGUMENT, f"{path}:{number}: a joint is not finite")
                touches.append(Touch(mark, joints))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"can't read {path}: {error}") from None
    return touches


def add_touch(path: Path, touch: Touch) -> int:
    """Add a touch to a CSV file, a new one if need be; return how many it has.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when those of the file are of other joints, or it can't be written.
    """
    there = read_touches(path) if path.exists() else []
    if there and set(there[0].joints) != set(touch.joints):
        text = f"{path} has touches of joints {', '.join(there[0].joints)}; write those of another arm to another file"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    names = list(there[0].joints if there else touch.joints)
    try:
        with path.open("a", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            if not there:
                table.writerow(["mark", *names])
            table.writerow([touch.mark, *(repr(float(touch.joints[name])) for name in names)])
    except OSError as error:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"can't write {path}: {error}") from None
    return len(there) + 1
