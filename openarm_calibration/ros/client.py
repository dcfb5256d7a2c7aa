# SPDX-License-Identifier: Apache-2.0
"""Client of the calibration node: samples one by one, or an automatic calibration.

Example:
    ``with CalibrationClient() as calibration: print(calibration.auto("wrist").message)``
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from openarm_interfaces.action import AutoCalibrate
from openarm_interfaces.srv import GetSampleList, RemoveSample, SampleFile, TakeSample

from openarm_common.errors import Code
from openarm_common.ros.client import BackgroundNode
from openarm_common.ros.convert import pose_to_matrix

OnFeedback = Callable[[AutoCalibrate.Feedback], None]


@dataclass(frozen=True, eq=False)
class AutoResult:
    """How a calibration went.

    Args:
        success: Whether it was solved, and stored if that was asked for.
        code: OK, or why not.
        message: One sentence.
        grade: pass, warn, fail; empty when it was not solved.
        T_parent_link: (4, 4) mount of the camera; None when it was not solved.
        sigma_translation: Predicted error, m.
        sigma_rotation: Predicted error, rad.
        samples: That were taken.
        missed: Poses without a sample, and why.
        delay: Age of the images at their stamps and its predicted error, s; None when it was not measured.
        path: Of the stored calibration; empty when it was not stored.
        duration: s of wall clock.
        report: All figures.
    """

    success: bool
    code: Code
    message: str
    grade: str
    T_parent_link: NDArray[np.float64] | None
    sigma_translation: float
    sigma_rotation: float
    samples: int
    missed: tuple[str, ...]
    delay: tuple[float, float] | None
    path: str
    duration: float
    report: dict[str, Any] = field(default_factory=dict[str, Any])


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
        poses: int = 0,
        sigma: tuple[float, float] = (0.0, 0.0),
        measure_delay: bool = False,
        save: bool = False,
        session: str = "",
        timeout: float = 1200.0,
        on_feedback: OnFeedback | None = None,
        stop: threading.Event | None = None,
    ) -> AutoResult:
        """Calibrate a camera; returns when that has ended, well or not.

        Args:
            camera: Its name; empty is the one the node was started for.
            poses: Samples at most; 0 is the node's parameter.
            sigma: Predicted errors that are enough, m and rad; 0 is the node's parameter.
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
        goal.sigma_translation, goal.sigma_rotation = sigma
        answer: AutoCalibrate.Result = self.do(
            AutoCalibrate, "/calibration/auto", goal, timeout=timeout, on_feedback=on_feedback, stop=stop
        )
        return AutoResult(
            success=answer.success,
            code=Code(answer.code) if answer.code in Code.__members__ else Code.INTERNAL,
            message=answer.message or "the node ended the action without an answer; its log says why",
            grade=answer.grade,
            T_parent_link=pose_to_matrix(answer.mount) if answer.grade else None,
            sigma_translation=answer.sigma_translation,
            sigma_rotation=answer.sigma_rotation,
            samples=answer.samples,
            missed=tuple(answer.missed),
            delay=(answer.delay, answer.delay_sigma) if answer.delay_sigma > 0.0 else None,
            path=answer.path,
            duration=answer.duration,
            report=json.loads(answer.report) if answer.report else {},
        )

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
