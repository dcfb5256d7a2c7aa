# SPDX-License-Identifier: Apache-2.0
"""The suite's errors as MoveIt's error codes."""

from __future__ import annotations

from moveit_msgs.msg import MoveItErrorCodes

from openarm_common.errors import Code, OpenArmError
from openarm_motion.planning.failure import PlanFailedError

_Codes = MoveItErrorCodes
_OF_CODE = {
    Code.OK: _Codes.SUCCESS,
    Code.INVALID_ARGUMENT: _Codes.FAILURE,
    Code.NOT_READY: _Codes.ROBOT_STATE_STALE,
    Code.BUSY: _Codes.CONTROL_FAILED,
    Code.CANCELLED: _Codes.PREEMPTED,
    Code.TIMEOUT: _Codes.TIMED_OUT,
    Code.UNKNOWN_OBJECT: _Codes.INVALID_OBJECT_NAME,
    Code.STALE_DATA: _Codes.SENSOR_INFO_STALE,
    Code.NO_TRANSFORM: _Codes.FRAME_TRANSFORM_FAILURE,
    Code.UNREACHABLE: _Codes.NO_IK_SOLUTION,
    Code.IN_COLLISION: _Codes.INVALID_MOTION_PLAN,
    Code.LIMITS: _Codes.INVALID_MOTION_PLAN,
    Code.NO_PLAN: _Codes.PLANNING_FAILED,
    Code.EXECUTION_FAILED: _Codes.CONTROL_FAILED,
    Code.ROBOT_LOST: _Codes.CONTROL_FAILED,
    Code.STOPPED: _Codes.CONTROL_FAILED,
    Code.VIOLATION: _Codes.INVALID_MOTION_PLAN,
    Code.INTERNAL: _Codes.CRASH,
}
_OF_STAGE = {
    ("start", Code.IN_COLLISION): _Codes.START_STATE_IN_COLLISION,
    ("goal", Code.IN_COLLISION): _Codes.GOAL_IN_COLLISION,
    ("start", Code.VIOLATION): _Codes.START_STATE_VIOLATES_PATH_CONSTRAINTS,
    ("goal", Code.VIOLATION): _Codes.GOAL_VIOLATES_PATH_CONSTRAINTS,
}


class MoveItError(OpenArmError):
    """An error with a code of MoveIt of its own."""

    def __init__(self, val: int, message: str, code: Code = Code.INVALID_ARGUMENT) -> None:
        super().__init__(code, message)
        self.val = val


def error_code(error: OpenArmError | None, said: str = "") -> MoveItErrorCodes:
    """Return the message of an error, or of success."""
    source = "openarm_motion"
    if error is None:
        return MoveItErrorCodes(val=_Codes.SUCCESS, message=said, source=source)
    val = _OF_CODE.get(error.code, _Codes.FAILURE)
    if isinstance(error, PlanFailedError):
        val = _OF_STAGE.get((error.stage, error.code), val)
    elif isinstance(error, MoveItError):
        val = error.val
    return MoveItErrorCodes(val=val, message=error.message, source=source)
