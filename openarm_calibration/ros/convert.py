# SPDX-License-Identifier: Apache-2.0
"""Solved calibrations to messages."""

from __future__ import annotations

import json

from openarm_interfaces.action import AutoCalibrate
from openarm_interfaces.srv import ComputeCalibration

from openarm_calibration.handeye.offline import Result
from openarm_common.ros.convert import matrix_to_pose


def fill(message: AutoCalibrate.Result | ComputeCalibration.Response, solved: Result, child: str) -> None:
    """Write a solved calibration into an answer.

    Args:
        message: Of the action, or of compute_calibration.
        solved: The result.
        child: Frame whose mount it is.
    """
    calibration, verdict = solved.calibration, solved.verdict
    message.grade, message.reasons = verdict.grade, list(verdict.reasons)
    message.message = f"{verdict.grade}: {'; '.join(verdict.reasons) or 'within all limits'}"
    message.parent, message.child = calibration.parent, child
    message.mount = matrix_to_pose(calibration.T_parent_link)
    message.sigma_translation, message.sigma_rotation = calibration.sigma_translation, calibration.sigma_rotation
    message.outliers = [outlier.name for outlier in solved.solution.outliers]
    message.report = json.dumps(solved.as_json())
