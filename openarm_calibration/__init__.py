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
    from openarm_calibration.board.board import Charuco as Charuco
    from openarm_calibration.board.board import CircleGrid as CircleGrid
    from openarm_calibration.handeye.limits import Limits as Limits
    from openarm_calibration.handeye.offline import Result as Result
    from openarm_calibration.handeye.offline import calibrate as calibrate
    from openarm_calibration.handeye.offline import calibrate_together as calibrate_together
    from openarm_calibration.ros.client import CalibrationClient as CalibrationClient
    from openarm_calibration.sampling.next_pose import PoseSearch as PoseSearch
    from openarm_calibration.sampling.samples import SampleSet as SampleSet
    from openarm_calibration.sampling.samples import load_session as load_session
    from openarm_calibration.store.store import CalibrationStore as CalibrationStore
    from openarm_calibration.store.store import StoredCalibration as StoredCalibration

__getattr__, __dir__ = attach(__name__, __file__)
