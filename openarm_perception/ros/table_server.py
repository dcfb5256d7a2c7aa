# SPDX-License-Identifier: Apache-2.0
"""Service `measure_table` of the detector: the height of the table in the newest frame, m in the base frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from openarm_interfaces.srv import MeasureTable

from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_perception.detection.detector import Mask
from openarm_perception.detection.pipeline import Pipeline
from openarm_perception.geometry.depth import DepthImage
from openarm_perception.geometry.table import TableMeasurement, measure_table, of_block


@dataclass(frozen=True)
class Frame:
    """A frame whose images fit together, waiting for the pose of its camera."""

    t_ns: int
    rgb: NDArray[np.uint8]
    depth: DepthImage
    intrinsics: Intrinsics
    since: float  # when it came, on the node's clock of deadlines, s


@dataclass(frozen=True)
class Placed:
    """A frame, where its camera was, where the robot is in it (None: not known), and when it was there."""

    frame: Frame
    T_base_camera: NDArray[np.float64]
    robot: Mask | None
    at: float


def answer(
    request: MeasureTable.Request,
    response: MeasureTable.Response,
    newest: Placed | None,
    pipeline: Pipeline,
    camera: str,
) -> MeasureTable.Response:
    """Fill the response; `newest` is None when there is no fresh frame of the camera."""
    localizer = pipeline.localizer
    try:
        result = _measure(request, newest, pipeline, camera)
    except OpenArmError as error:
        response.code, response.message = error.code.value, error.message
        return response
    response.success, response.code = True, Code.OK.value
    response.height, response.std, response.tilt = result.height, result.std, result.tilt
    response.points = result.points
    before = localizer.table_height
    response.message = f"the table is {result.height:.4f} m high; the detector took it for {before:.4f} m"
    if request.apply:
        localizer.table_height = result.height
        response.message += ", and takes what was measured now"
    return response


def _measure(request: MeasureTable.Request, newest: Placed | None, pipeline: Pipeline, camera: str) -> TableMeasurement:
    if newest is None:
        raise OpenArmError(Code.NOT_READY, f"no image of {camera} yet; it is listened to now: ask again in a second")
    frame, T_base_camera, robot = newest.frame, newest.T_base_camera, newest.robot
    localizer = pipeline.localizer
    if request.block_height == 0.0:
        depth = frame.depth if robot is None else np.where(robot, frame.depth.dtype.type(0), frame.depth)
        return measure_table(depth, frame.intrinsics, T_base_camera, localizer.limits, localizer.table_height)
    found = pipeline.run(frame.rgb, frame.depth, frame.intrinsics, T_base_camera, robot).located
    blocks = [place for place in found if request.label in ("", place.label) and place.measured]
    if len(blocks) != 1:
        view = ", ".join(place.label for place in found) or "nothing"
        raise OpenArmError(
            Code.NOTHING_DETECTED, f"expected one block {request.label!r} in view, which shows {view}; give its label"
        )
    return of_block(blocks[0], request.block_height)
