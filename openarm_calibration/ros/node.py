# SPDX-License-Identifier: Apache-2.0
"""Node `calibration`: samples of one camera, solved and stored, by services under /calibration.

The verbs are those of easy_handeye2: take_sample, remove_sample, get_sample_list, compute_calibration,
save_calibration, list_algorithms, set_algorithm, save_samples, load_samples. A camera on a moving link is calibrated
with a fixed board (eye in hand), a camera on the base with the board on `carrier` (eye to hand). Images and joint
states are subscribed to only while a sample is taken. The action /calibration/auto takes all samples automatically.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
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

from openarm_calibration.board.board import read_board
from openarm_calibration.board.detect import BoardDetection, detect_undistorted
from openarm_calibration.config import CalibrationConfig
from openarm_calibration.handeye.closed_form import ALGORITHMS, checked_algorithm
from openarm_calibration.handeye.offline import Result, calibrate
from openarm_calibration.ros.auto_server import AutoCalibrateServer, fill
from openarm_calibration.ros.image_capture import ImageCapture
from openarm_calibration.sampling.gate import Matched, match
from openarm_calibration.sampling.next_pose import advice
from openarm_calibration.sampling.samples import SESSION_SUFFIXES, Sample, SampleSet, SessionHead, head_of, load_session
from openarm_calibration.store.store import CalibrationStore
from openarm_common.asked_files import file_to_read, file_to_write
from openarm_common.camera.cameras import CameraConfig, Intrinsics, load_cameras
from openarm_common.errors import Code, OpenArmError
from openarm_common.records import default_folder, now
from openarm_common.ros.answers import answer_async
from openarm_common.ros.images import grey_image, lens_from_info
from openarm_common.ros.node import BaseNode, run
from openarm_common.ros.tf import RobotStateListener


class CalibrationNode(BaseNode[CalibrationConfig]):
    """Takes samples of one camera, solves and stores, behind services and an action.

    Attributes:
        camera: The camera that is calibrated.
        samples: Samples of this camera, so far.
        algorithm: Algorithm of `compute_calibration`.
        capture: Takes images of this camera.
    """

    camera: CameraConfig
    samples: SampleSet
    capture: ImageCapture

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("calibration", CalibrationConfig, **kwargs)
        config = self.config
        self._cameras = load_cameras(Path(config.cameras) if config.cameras else None)
        self._store = CalibrationStore(Path(config.store) if config.store else default_folder())
        self._states = RobotStateListener(self, self.description, joints=False, depth=100, wait=config.state_timeout)
        self._busy = ""
        self._result: Result | None = None
        self.algorithm = config.algorithm
        self.use(config.camera)
        for name, kind, work in (
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
            self.create_service(kind, f"/calibration/{name}", self._handler(work))
        self._auto = AutoCalibrateServer(self)

    # --- the session
    def use(self, name: str, carrier: str = "") -> None:
        """Start over with a camera, without samples.

        Args:
            name: Name of the camera.
            carrier: Link that holds the board of a fixed camera; "": the parameter.

        Raises:
            OpenArmError: CONFIG_INVALID, listing the cameras or the links.
        """
        if name not in self._cameras:
            raise OpenArmError(Code.CONFIG_INVALID, f"no camera {name!r}; cameras: {', '.join(self._cameras)}")
        self.camera, self._carrier = self._cameras[name], carrier or self.config.carrier
        self.capture = ImageCapture(self, self._states, name, self.config)
        self._change(SampleSet(self._head(self.camera.intrinsics), self.description))

    def _change(self, samples: SampleSet) -> None:
        """Go on with these samples, of which nothing is computed yet."""
        self.samples, self._result = samples, None
        self._report()

    async def observe(self, *, moving: bool = False) -> tuple[int, Matched, BoardDetection, NDArray[np.uint8]]:
        """Detect the board in the next image: its stamp (ns), the robot there, the marks, and the pixels (h, w).

        Args:
            moving: Whether the robot may move meanwhile.

        Raises:
            OpenArmError: NOT_READY, STALE_DATA, MOVING, NOTHING_DETECTED, BAD_IMAGE.
        """
        frame = await self.capture.take(self.config.gate.track if moving else 0.0)
        pixels, t_ns = grey_image(frame.items["image"]), frame.t_ns
        lens = lens_from_info(frame.items["camera_info"])
        self._check_optics(lens.intrinsics)
        matched = match(self._states.buffer, t_ns, self.samples.joint_names, self.config.gate, moving=moving)
        return t_ns, matched, *await self.in_thread(detect_undistorted, self.samples.board, pixels, lens)

    async def take(self) -> Sample:
        """Take a sample; errors as `observe`."""
        sample = self.samples.take(*await self.observe())
        self._change(self.samples)
        return sample

    async def solve(self, algorithm: str = "") -> Result:
        """Solve the samples and judge the result.

        Raises:
            OpenArmError: DEGENERATE, INVALID_ARGUMENT.
        """
        name = checked_algorithm(algorithm or self.algorithm)
        stored = self._store.in_use(self.camera.name, self.samples.head.mount_seed)
        result: Result = await self.in_thread(
            calibrate, self.samples, algorithm=name, limits=self.config.limits, created=now(), stored=stored
        )
        self._result = result
        self._report()
        return result

    def save(self, *, force: bool = False) -> Path:
        """Store the last result.

        Raises:
            OpenArmError: NOT_READY, when there is none; DEGENERATE, when it fails the limits.
        """
        if self._result is None:
            raise OpenArmError(
                Code.NOT_READY, "nothing was computed since the samples changed; call compute_calibration first"
            )
        if self._result.verdict.grade == "fail" and not force:
            reasons = "; ".join(self._result.verdict.reasons)
            raise OpenArmError(Code.DEGENERATE, f"not stored, the calibration fails: {reasons}; `force` stores it")
        return self._store.save(self._result.calibration)

    @contextmanager
    def work(self, what: str) -> Iterator[None]:
        """Be busy with something while the context is open.

        Raises:
            OpenArmError: BUSY, when the node is already.
        """
        self._require_idle()
        self._busy = what
        try:
            yield
        finally:
            self._busy = ""

    def _require_idle(self) -> None:
        if self._busy:
            raise OpenArmError(Code.BUSY, f"the node is {self._busy}; wait for its answer")

    def _report(self) -> None:
        grade = self._result.verdict.grade if self._result is not None else "not computed"
        self.diagnose(True, f"{len(self.samples)} samples of {self.camera.name!r}", result=grade)

    def _head(self, optics: Intrinsics) -> SessionHead:
        seed = self.config.seed if self.camera.mount_error else None
        return head_of(
            self.camera.name, self.camera.parent, self.description, optics,
            read_board(self.config.board, "parameter board"), self._carrier, mount_seed=seed, created=now(),
        )  # fmt: skip

    def _check_optics(self, optics: Intrinsics) -> None:
        """Take the intrinsics of the first image; refuse others after it."""
        if optics == self.samples.head.optics:
            return
        if len(self.samples):
            raise OpenArmError(
                Code.BAD_IMAGE,
                f"the intrinsics of {self.camera.name!r} changed: fx {optics.fx:.2f} at"
                f" {optics.width}x{optics.height}, the samples have fx {self.samples.head.optics.fx:.2f};"
                " remove the samples or restore the camera",
            )
        self.samples = SampleSet(self._head(optics), self.description)

    # --- services
    def _handler(self, work: Callable[[Any, Any], Awaitable[str]]) -> Callable[[Any, Any], Awaitable[Any]]:
        """Return the callback of a service whose work fills a response and returns its message."""

        async def serve(request: Any, response: Any) -> Any:
            await answer_async(response, lambda: work(request, response))
            if hasattr(response, "samples"):
                response.samples = [sample.name for sample in self.samples.samples]
            return response

        return serve

    async def _on_take(self, _: TakeSample.Request, response: TakeSample.Response) -> str:
        with self.work("taking a sample"):
            sample = await self.take()
        response.sample = sample.name
        return (
            f"{sample.name}: {len(sample.detection.ids)} marks, residual {sample.detection.residual:.2f} px, stamps"
            f" {(sample.t_joints_ns - sample.t_image_ns) / 1e6:+.1f} ms apart"
        )

    async def _on_remove(self, request: RemoveSample.Request, _: RemoveSample.Response) -> str:
        self._require_idle()
        removed = self.samples.remove(request.sample)
        self._change(self.samples)
        return f"removed {removed.name}"

    async def _on_list(self, _: GetSampleList.Request, response: GetSampleList.Response) -> str:
        response.camera = self.camera.name
        response.advice = advice([self.samples.pose(sample.joints) for sample in self.samples.samples])
        return f"{len(self.samples)} samples of {self.camera.name!r} and {self.samples.board.label}"

    async def _on_save_samples(self, request: SampleFile.Request, _: SampleFile.Response) -> str:
        digest = self.samples.save(file_to_write(request.path, SESSION_SUFFIXES))
        return f"{len(self.samples)} samples in {request.path}, hash {digest[:12]}"

    async def _on_load_samples(self, request: SampleFile.Request, _: SampleFile.Response) -> str:
        self._require_idle()
        samples, digest = load_session(file_to_read(request.path, SESSION_SUFFIXES), self.description)
        if samples.head.camera != self.camera.name or samples.head.parent != self.camera.parent:
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"{request.path} is of camera {samples.head.camera!r} on {samples.head.parent!r}, this node"
                f" calibrates {self.camera.name!r} on {self.camera.parent!r}",
            )
        self._change(samples)
        return f"{len(samples)} samples from {request.path}, hash {digest[:12]}"

    async def _on_compute(self, request: ComputeCalibration.Request, response: ComputeCalibration.Response) -> str:
        checked_algorithm(request.algorithm or self.algorithm)
        with self.work("solving"):
            result = await self.solve(request.algorithm)
        fill(response, result, self.camera.link_frame)
        response.held_out_px = result.verdict.figures["leave_one_out_px"]
        response.held_out = result.verdict.figures["leave_one_out"]
        return str(response.message)

    async def _on_save(self, request: SaveCalibration.Request, response: SaveCalibration.Response) -> str:
        response.path = str(self.save(force=request.force))
        return f"stored in {response.path}"

    async def _on_algorithms(self, _: ListAlgorithms.Request, response: ListAlgorithms.Response) -> str:
        response.algorithms, response.current = list(ALGORITHMS), self.algorithm
        return f"{self.algorithm} is set"

    async def _on_set(self, request: SetAlgorithm.Request, _: SetAlgorithm.Response) -> str:
        self.algorithm = checked_algorithm(request.algorithm)
        return f"{self.algorithm} is set"


def main() -> None:
    """Run the node."""
    run(CalibrationNode)


if __name__ == "__main__":
    main()
