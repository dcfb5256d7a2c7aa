# SPDX-License-Identifier: Apache-2.0
"""Client of the calibration node: samples one by one, or an automatic calibration.

Example:
    ``with CalibrationClient() as calibration: print(calibration.auto("wrist").message)``
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from openarm_interfaces.action import AutoCalibrate
from openarm_interfaces.srv import GetSampleList, MeasureTable, RemoveSample, SampleFile, SaveTable, TakeSample

from openarm_common.camera.cameras import detector_nodes
from openarm_common.errors import Code
from openarm_common.ros.client import BackgroundNode

#: How long the detector that measures the table may need for an image, and the pause between two requests, s.
_IMAGE_S, _AGAIN_S = 10.0, 0.25

OnFeedback = Callable[[AutoCalibrate.Feedback], None]


class CalibrationClient(BackgroundNode):
    """A context manager that asks the calibration node.

    Args:
        timeout: Longest wait for the node to be there, s of wall clock.
    """

    def __init__(self, *, timeout: float = 10.0) -> None:
        super().__init__("calibration_client", timeout=timeout)

    def auto(
        self,
        camera: str = "",
        *,
        carrier: str = "",
        poses: int = 0,
        sigma: tuple[float, float] = (0.0, 0.0),
        measure_delay: bool = False,
        save: bool = False,
        session: str = "",
        timeout: float = 1200.0,
        on_feedback: OnFeedback | None = None,
        stop: threading.Event | None = None,
    ) -> AutoCalibrate.Result:
        """Calibrate a camera; returns when that has ended, well or not.

        Args:
            camera: Its name; empty is the one the node was started for.
            carrier: Link that holds the board of a fixed camera; empty is the node's parameter.
            poses: Samples at most; 0 is the node's parameter.
            sigma: Repeatability that is enough, m and rad; 0 is the node's parameter.
            measure_delay: Also measure the age of the images.
            save: Store the result, unless it fails the limits.
            session: File for the samples (.npz, as the node sees the file system); empty is none.
            timeout: s of wall clock; then it is cancelled.
            on_feedback: Called with each feedback, in the background thread.
            stop: When it is set the calibration is cancelled, with the arm stopped.

        Raises:
            OpenArmError: NOT_READY, when no calibration node answers; TIMEOUT.
        """
        goal = AutoCalibrate.Goal(camera=camera, poses=poses, measure_delay=measure_delay, save=save, session=session)
        goal.carrier, (goal.sigma_translation, goal.sigma_rotation) = carrier, sigma
        answer: AutoCalibrate.Result = self.do(
            AutoCalibrate, "/calibration/auto", goal, timeout=timeout, on_feedback=on_feedback, stop=stop
        )
        if answer.code not in Code.__members__:
            answer.code = Code.INTERNAL.value
        answer.message = answer.message or "the node ended the action without an answer; its log says why"
        return answer

    def take(self) -> TakeSample.Response:
        """Take a sample at the present posture of the arm."""
        return self.call(TakeSample, "/calibration/take_sample", TakeSample.Request())

    def remove(self, sample: str = "") -> RemoveSample.Response:
        """Remove a sample; an empty name is the last."""
        return self.call(RemoveSample, "/calibration/remove_sample", RemoveSample.Request(sample=sample))

    def samples(self) -> GetSampleList.Response:
        """Return the samples, and what to do next in words."""
        return self.call(GetSampleList, "/calibration/get_sample_list", GetSampleList.Request())

    def save_samples(self, path: str) -> SampleFile.Response:
        """Write the samples to a session file."""
        return self.call(SampleFile, "/calibration/save_samples", SampleFile.Request(path=path))

    def measure_table(self, camera: str, block_height: float = 0.0, label: str = "") -> MeasureTable.Response:
        """Measure the height of the table by a camera's detector, which waits for its next image.

        Args:
            camera: One with a detector.
            block_height: Height of a block whose top is measured, m; 0: the surface of the table.
            label: Label of that block.
        """
        request = MeasureTable.Request(block_height=block_height, label=label)
        deadline = time.monotonic() + _IMAGE_S
        while True:
            answer = self.call(MeasureTable, f"/{detector_nodes()[camera]}/measure_table", request)
            if answer.code != Code.NOT_READY or time.monotonic() > deadline:
                return answer
            time.sleep(_AGAIN_S)  # the image was asked for just now

    def save_table(self, measured: MeasureTable.Response, method: str) -> SaveTable.Response:
        """Store a measured height; every node takes it over."""
        request = SaveTable.Request(height=measured.height, std=measured.std, tilt=measured.tilt, method=method)
        return self.call(SaveTable, "/calibration_publisher/save_table", request)
