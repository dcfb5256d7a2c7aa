# SPDX-License-Identifier: Apache-2.0
"""Node `calibration`: samples of one camera, solved and stored, by services under /calibration.

The verbs are those of easy_handeye2: take_sample, remove_sample, get_sample_list, compute_calibration,
save_calibration, list_algorithms, set_algorithm, save_samples, load_samples. A camera on a moving link is calibrated
with the board standing (eye in hand), a camera on the base with the board on `carrier` (eye to hand). Images and joint
states are subscribed to only while a sample is taken. The action /calibration/auto takes all samples by itself.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
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

from openarm_calibration.auto_executor import AutoCalibrator
from openarm_calibration.board import parse_board
from openarm_calibration.config import CalibrationConfig
from openarm_calibration.convert import fill
from openarm_calibration.detect import Detection, detect
from openarm_calibration.gate import Matched, match
from openarm_calibration.offline import ALGORITHMS, Result, calibrate, checked_algorithm
from openarm_calibration.photo_client import Photographer, grey
from openarm_calibration.poses import advice
from openarm_calibration.samples import Sample, SampleSet, SessionHead, load_session, session_path
from openarm_calibration.store import CalibrationStore, default_folder
from openarm_common.cameras import CameraConfig, Intrinsics, load_cameras
from openarm_common.convert import intrinsics_from_info, stamp_to_ns
from openarm_common.errors import Code, OpenArmError
from openarm_common.node import BASE_FRAME, BaseNode, run
from openarm_common.tf import RobotStateListener


@dataclass(frozen=True, eq=False)
class View:
    """The board in an image, and the robot at its stamp."""

    t_ns: int
    matched: Matched
    detection: Detection
    pixels: NDArray[np.uint8]


class CalibrationNode(BaseNode[CalibrationConfig]):
    """Samples, solver and store behind services."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("calibration", CalibrationConfig, **kwargs)
        self._cameras = load_cameras(Path(self.config.cameras) if self.config.cameras else None)
        self._algorithm = self.config.algorithm
        self._store = CalibrationStore(Path(self.config.store) if self.config.store else default_folder())
        self._states = RobotStateListener(self, self.description, joints=False)
        self._busy = ""
        self._result: Result | None = None
        self.use(self.config.camera)
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

    # --- what the services and the action share
    @property
    def camera(self) -> CameraConfig:
        """The camera that is calibrated."""
        return self._camera

    @property
    def samples(self) -> SampleSet:
        """Of this camera, so far."""
        return self._samples

    def use(self, name: str) -> None:
        """Begin anew with a camera, without samples.

        Raises:
            OpenArmError: CONFIG_INVALID, listing the cameras.
        """
        if name not in self._cameras:
            raise OpenArmError(Code.CONFIG_INVALID, f"no camera {name!r}; cameras: {', '.join(self._cameras)}")
        self._camera = self._cameras[name]
        self.photographer = Photographer(self, self._states, name, self.config)
        self._samples = SampleSet(self._head(self._camera.intrinsics), self.description)
        self._result = None
        self._tell()

    async def look(self, *, moving: bool = False) -> View:
        """One image of the board with the robot at its stamp.

        Args:
            moving: Whether the robot may move meanwhile.

        Raises:
            OpenArmError: NOT_READY, STALE_DATA, MOVING, NOTHING_DETECTED, BAD_IMAGE.
        """
        image, info = await self.photographer.take(self.config.gate.track if moving else 0.0)
        pixels, intrinsics = grey(image), intrinsics_from_info(info)
        self._check_optics(intrinsics)
        t_ns = stamp_to_ns(image.header.stamp)
        matched = match(self._states.buffer, t_ns, self._samples.joint_names, self.config.gate, moving=moving)
        return View(t_ns, matched, await self.in_thread(detect, self._samples.board, pixels), pixels)

    async def take(self) -> Sample:
        """Take a sample; errors as `look`."""
        view = await self.look()
        sample = self._samples.take(view.t_ns, view.matched, view.detection, view.pixels)
        self._result = None
        self._tell()
        return sample

    async def solve(self, algorithm: str = "") -> Result:
        """Solve the samples and judge the result.

        Raises:
            OpenArmError: DEGENERATE, INVALID_ARGUMENT.
        """
        name = checked_algorithm(algorithm or self._algorithm)
        found = self._store.find(self._camera.name)
        stored = found.calibration if found is not None else None
        if stored is not None and stored.mount_seed != self._samples.head.mount_seed:
            stored = None  # of other mounts: its distance says nothing
        result: Result = await self.in_thread(
            calibrate, self._samples, algorithm=name, limits=self.config.limits, created=_now(), stored=stored
        )
        self._result = result
        self._tell()
        return result

    def save(self, *, force: bool = False) -> Path:
        """Store what was solved last.

        Raises:
            OpenArmError: NOT_READY, when nothing was; DEGENERATE, when it fails the limits.
        """
        if self._result is None:
            raise OpenArmError(
                Code.NOT_READY, "nothing was computed since the samples changed; call compute_calibration first"
            )
        if self._result.verdict.grade == "fail" and not force:
            reasons = "; ".join(self._result.verdict.reasons)
            raise OpenArmError(Code.DEGENERATE, f"not stored, the calibration fails: {reasons}; `force` stores it")
        return self._store.save(self._result.calibration)

    # --- samples
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
        self._tell()
        return response

    def _on_remove(self, request: RemoveSample.Request, response: RemoveSample.Response) -> RemoveSample.Response:
        try:
            self._free()
            removed = self._samples.remove(request.sample)
            self._result = None
            response.success, response.code, response.message = True, Code.OK.value, f"removed {removed.name}"
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        response.samples = self._names()
        self._tell()
        return response

    def _on_list(self, _: GetSampleList.Request, response: GetSampleList.Response) -> GetSampleList.Response:
        response.success, response.code = True, Code.OK.value
        response.camera, response.samples = self._camera.name, self._names()
        response.advice = advice([self._samples.pose(sample.joints) for sample in self._samples.samples])
        response.message = f"{len(self._samples)} samples of {self._camera.name!r} and {self._samples.board.label}"
        return response

    def _on_save_samples(self, request: SampleFile.Request, response: SampleFile.Response) -> SampleFile.Response:
        try:
            digest = self._samples.save(session_path(request.path))
            response.success, response.code = True, Code.OK.value
            response.message = f"{len(self._samples)} samples in {request.path}, hash {digest[:12]}"
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        response.samples = self._names()
        return response

    def _on_load_samples(self, request: SampleFile.Request, response: SampleFile.Response) -> SampleFile.Response:
        try:
            self._free()
            samples, digest = load_session(session_path(request.path), self.description)
            if samples.head.camera != self._camera.name or samples.head.parent != self._camera.parent:
                raise OpenArmError(
                    Code.INVALID_ARGUMENT,
                    f"{request.path} is of camera {samples.head.camera!r} on {samples.head.parent!r}, this node"
                    f" calibrates {self._camera.name!r} on {self._camera.parent!r}",
                )
            self._samples, self._result = samples, None
            response.success, response.code = True, Code.OK.value
            response.message = f"{len(samples)} samples from {request.path}, hash {digest[:12]}"
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        response.samples = self._names()
        self._tell()
        return response

    # --- solving
    async def _on_compute(
        self, request: ComputeCalibration.Request, response: ComputeCalibration.Response
    ) -> ComputeCalibration.Response:
        try:
            checked_algorithm(request.algorithm or self._algorithm)
            with self.work("solving"):
                result = await self.solve(request.algorithm)
            fill(response, result, self._camera.link_frame)
            response.held_out_px = result.verdict.figures["leave_one_out_px"]
            response.held_out = result.verdict.figures["leave_one_out"]
            response.success, response.code = True, Code.OK.value
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        self._tell()
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
        response.algorithms, response.current = list(ALGORITHMS), self._algorithm
        return response

    def _on_set(self, request: SetAlgorithm.Request, response: SetAlgorithm.Response) -> SetAlgorithm.Response:
        try:
            self._algorithm = checked_algorithm(request.algorithm)
            response.success, response.code, response.message = True, Code.OK.value, f"{self._algorithm} is set"
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        return response

    # --- parts
    def _head(self, optics: Intrinsics) -> SessionHead:
        try:
            keys = yaml.safe_load(self.config.board) if self.config.board else {}
        except yaml.YAMLError as error:
            raise OpenArmError(Code.CONFIG_INVALID, f"parameter board is not YAML: {error}") from error
        if not isinstance(keys, dict):
            raise OpenArmError(
                Code.CONFIG_INVALID, f"parameter board is {self.config.board!r}, expected keys and values"
            )
        standing = self._camera.parent == BASE_FRAME
        return SessionHead(
            camera=self._camera.name, setup="to_hand" if standing else "in_hand", parent=self._camera.parent,
            carrier=self.config.carrier if standing else self._camera.parent,
            intrinsics=(optics.width, optics.height, optics.fx, optics.fy, optics.cx, optics.cy),
            board=parse_board(keys, "parameter board").model_dump(), created=_now(),  # pyright: ignore[reportUnknownArgumentType]
            mount_seed=self.config.seed if self._camera.mount_error else None,
        )  # fmt: skip

    def _check_optics(self, optics: Intrinsics) -> None:
        """Take the intrinsics of the first image; refuse others after it."""
        if optics == self._samples.head.optics:
            return
        if len(self._samples):
            raise OpenArmError(
                Code.BAD_IMAGE,
                f"the intrinsics of {self._camera.name!r} changed: fx {optics.fx:.2f} at"
                f" {optics.width}x{optics.height}, the samples have fx {self._samples.head.optics.fx:.2f};"
                " remove the samples or restore the camera",
            )
        self._samples = SampleSet(self._head(optics), self.description)

    def _names(self) -> list[str]:
        return [sample.name for sample in self._samples.samples]

    def _free(self) -> None:
        if self._busy:
            raise OpenArmError(Code.BUSY, f"the node is {self._busy}; wait for its answer")

    def work(self, what: str) -> _Work:
        """Be busy with something while the returned context is open.

        Raises:
            OpenArmError: BUSY, when the node is already.
        """
        self._free()
        return _Work(self, what)

    def set_busy(self, what: str) -> None:
        """Say what takes time now; empty is nothing."""
        self._busy = what

    def _tell(self) -> None:
        grade = self._result.verdict.grade if self._result is not None else "not computed"
        self.diagnose(True, f"{len(self._samples)} samples of {self._camera.name!r}", result=grade)


class _Work:
    """The node is busy while this is open."""

    def __init__(self, node: CalibrationNode, what: str) -> None:
        self._node, self._what = node, what

    def __enter__(self) -> None:
        self._node.set_busy(self._what)

    def __exit__(self, *_: object) -> None:
        self._node.set_busy("")


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def main() -> None:
    """Run the node."""
    run(CalibrationNode)


if __name__ == "__main__":
    main()
