# SPDX-License-Identifier: Apache-2.0
"""Node `calibration`: samples of one camera, solved and stored, by services under /calibration.

The verbs are those of easy_handeye2: take_sample, remove_sample, get_sample_list, compute_calibration,
save_calibration, list_algorithms, set_algorithm, save_samples, load_samples. A camera on a moving link is calibrated
with the board standing (eye in hand), a camera on the base with the board on `carrier` (eye to hand). Images and joint
states are subscribed to only while a sample is taken. The action /calibration/auto takes all samples by itself.
"""

from __future__ import annotations

from typing import Any

from openarm_interfaces.srv import (
    ComputeCalibration,
    GetSampleList,
    ListAlgorithms,
    RemoveSample,
    SampleFile,
    SaveCalibration,
    SetAlgorithm,
    TakeSample,
)

from openarm_calibration.handeye.offline import ALGORITHMS, checked_algorithm
from openarm_calibration.ros.auto_server import AutoCalibrator
from openarm_calibration.ros.convert import fill
from openarm_calibration.ros.session_node import SessionNode
from openarm_calibration.sampling.poses import advice
from openarm_calibration.sampling.session_file import load_session, session_path
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import run


class CalibrationNode(SessionNode):
    """The session behind services and an action."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        for name, kind, answer in (
            ("take_sample", TakeSample, self._on_take),
            ("remove_sample", RemoveSample, self._on_remove),
            ("get_sample_list", GetSampleList, self._on_list),
            ("compute_calibration", ComputeCalibration, self._on_compute),
            ("save_calibration", SaveCalibration, self._on_save),
            ("list_algorithms", ListAlgorithms, self._on_algorithms),
            ("set_algorithm", SetAlgorithm, self._on_set),
            ("save_samples", SampleFile, self._on_save_samples),
            ("load_samples", SampleFile, self._on_load_samples),
        ):
            self.create_service(kind, f"/calibration/{name}", answer)
        self._auto = AutoCalibrator(self)

    async def _on_take(self, _: TakeSample.Request, response: TakeSample.Response) -> TakeSample.Response:
        try:
            with self.work("taking a sample"):
                sample = await self.take()
            response.sample = sample.name
            response.success, response.code = True, Code.OK.value
            response.message = (
                f"{sample.name}: {len(sample.detection.ids)} marks, residual {sample.detection.residual:.2f} px, stamps"
                f" {(sample.t_joints_ns - sample.t_image_ns) / 1e6:+.1f} ms apart"
            )
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        response.samples = self._names()
        self.tell()
        return response

    def _on_remove(self, request: RemoveSample.Request, response: RemoveSample.Response) -> RemoveSample.Response:
        try:
            self.free()
            removed = self.samples.remove(request.sample)
            self.changed()
            response.success, response.code, response.message = True, Code.OK.value, f"removed {removed.name}"
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        response.samples = self._names()
        self.tell()
        return response

    def _on_list(self, _: GetSampleList.Request, response: GetSampleList.Response) -> GetSampleList.Response:
        response.success, response.code = True, Code.OK.value
        response.camera, response.samples = self.camera.name, self._names()
        response.advice = advice([self.samples.pose(sample.joints) for sample in self.samples.samples])
        response.message = f"{len(self.samples)} samples of {self.camera.name!r} and {self.samples.board.label}"
        return response

    def _on_save_samples(self, request: SampleFile.Request, response: SampleFile.Response) -> SampleFile.Response:
        try:
            digest = self.samples.save(session_path(request.path))
            response.success, response.code = True, Code.OK.value
            response.message = f"{len(self.samples)} samples in {request.path}, hash {digest[:12]}"
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        response.samples = self._names()
        return response

    def _on_load_samples(self, request: SampleFile.Request, response: SampleFile.Response) -> SampleFile.Response:
        try:
            self.free()
            samples, digest = load_session(session_path(request.path), self.description)
            if samples.head.camera != self.camera.name or samples.head.parent != self.camera.parent:
                raise OpenArmError(
                    Code.INVALID_ARGUMENT,
                    f"{request.path} is of camera {samples.head.camera!r} on {samples.head.parent!r}, this node"
                    f" calibrates {self.camera.name!r} on {self.camera.parent!r}",
                )
            self.load(samples)
            response.success, response.code = True, Code.OK.value
            response.message = f"{len(samples)} samples from {request.path}, hash {digest[:12]}"
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        response.samples = self._names()
        self.tell()
        return response

    async def _on_compute(
        self, request: ComputeCalibration.Request, response: ComputeCalibration.Response
    ) -> ComputeCalibration.Response:
        try:
            checked_algorithm(request.algorithm or self.algorithm)
            with self.work("solving"):
                result = await self.solve(request.algorithm)
            fill(response, result, self.camera.link_frame)
            response.held_out_px = result.verdict.figures["leave_one_out_px"]
            response.held_out = result.verdict.figures["leave_one_out"]
            response.success, response.code = True, Code.OK.value
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        self.tell()
        return response

    def _on_save(
        self, request: SaveCalibration.Request, response: SaveCalibration.Response
    ) -> SaveCalibration.Response:
        try:
            response.path = str(self.save(force=request.force))
            response.success, response.code, response.message = True, Code.OK.value, f"stored in {response.path}"
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        return response

    def _on_algorithms(self, _: ListAlgorithms.Request, response: ListAlgorithms.Response) -> ListAlgorithms.Response:
        response.success, response.code = True, Code.OK.value
        response.algorithms, response.current = list(ALGORITHMS), self.algorithm
        return response

    def _on_set(self, request: SetAlgorithm.Request, response: SetAlgorithm.Response) -> SetAlgorithm.Response:
        try:
            self.algorithm = checked_algorithm(request.algorithm)
            response.success, response.code, response.message = True, Code.OK.value, f"{self.algorithm} is set"
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        return response

    def _names(self) -> list[str]:
        return [sample.name for sample in self.samples.samples]


def main() -> None:
    """Run the node."""
    run(CalibrationNode)


if __name__ == "__main__":
    main()
