# SPDX-License-Identifier: Apache-2.0
"""Service `measure_table` of the detector: the height of the table in the newest frame, m in the base frame."""

from __future__ import annotations

import numpy as np
from openarm_interfaces.srv import MeasureTable

from openarm_common.errors import Code, OpenArmError
from openarm_perception.detection.pipeline import Pipeline
from openarm_perception.detection.view import View
from openarm_perception.geometry.table import TableMeasurement, measure_table, of_block


def answer(
    request: MeasureTable.Request,
    response: MeasureTable.Response,
    newest: View | None,
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


def _measure(request: MeasureTable.Request, newest: View | None, pipeline: Pipeline, camera: str) -> TableMeasurement:
    if newest is None:
        raise OpenArmError(Code.NOT_READY, f"no image of {camera} yet; it is listened to now: ask again in a second")
    depth, intrinsics, T_base_camera, robot = newest.depth, newest.intrinsics, newest.T_base_camera, newest.robot
    localizer = pipeline.localizer
    if request.block_height == 0.0:
        visible = depth if robot is None else np.where(robot, depth.dtype.type(0), depth)
        return measure_table(visible, intrinsics, T_base_camera, localizer.limits, localizer.table_height)
    found = pipeline.run(newest.rgb, depth, intrinsics, T_base_camera, robot).located
    blocks = [place for place in found if request.label in ("", place.label) and place.from_depth]
    if len(blocks) != 1:
        view = ", ".join(place.label for place in found) or "nothing"
        raise OpenArmError(
            Code.NOTHING_DETECTED, f"expected one block {request.label!r} in view, which shows {view}; give its label"
        )
    return of_block(blocks[0], request.block_height)
