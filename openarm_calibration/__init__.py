# SPDX-License-Identifier: Apache-2.0
"""Hand-eye calibration of the cameras: boards, samples, solving, a verdict, and the store of mounts.

Example:
    >>> from pathlib import Path
    >>> from openarm_calibration import CalibrationStore, calibrate, load_session
    >>> from openarm_common import RobotDescription
    >>> samples, digest = load_session(Path("wrist.npz"), RobotDescription.load())  # doctest: +SKIP
    >>> result = calibrate(samples, session=digest)  # doctest: +SKIP
    >>> print(result.verdict.grade, result.calibration.T_parent_link)  # doctest: +SKIP
    >>> CalibrationStore(Path("calibrations")).save(result.calibration)  # doctest: +SKIP

The nodes `calibration` and `calibration_publisher`, and a client of the former, are in `ros/`.
"""

from typing import TYPE_CHECKING

from openarm_common.lazy import attach

if TYPE_CHECKING:
    from openarm_calibration.board.board import Charuco, CircleGrid
    from openarm_calibration.handeye.offline import Result, calibrate, calibrate_together
    from openarm_calibration.handeye.verdict import Limits
    from openarm_calibration.ros.client import CalibrationClient
    from openarm_calibration.sampling.next_pose import PoseSearch
    from openarm_calibration.sampling.samples import SampleSet, load_session
    from openarm_calibration.store.store import CalibrationStore, StoredCalibration

__all__ = [
    "CalibrationClient",
    "CalibrationStore",
    "Charuco",
    "CircleGrid",
    "Limits",
    "PoseSearch",
    "Result",
    "SampleSet",
    "StoredCalibration",
    "calibrate",
    "calibrate_together",
    "load_session",
]

__getattr__, __dir__ = attach(__name__, __file__)
