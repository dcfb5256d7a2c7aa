# SPDX-License-Identifier: Apache-2.0
"""What services and action of the node `calibration` share: one camera, its samples, the solver and the store."""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openarm_calibration.board.board import read_board
from openarm_calibration.board.detect import Detection, detect
from openarm_calibration.config import CalibrationConfig
from openarm_calibration.handeye.offline import Result, calibrate, checked_algorithm
from openarm_calibration.ros.photo_client import Photographer, grey
from openarm_calibration.sampling.gate import Matched, match
from openarm_calibration.sampling.samples import Sample, SampleSet, SessionHead, setup_of
from openarm_calibration.store.store import CalibrationStore, default_folder
from openarm_common.camera.cameras import CameraConfig, Intrinsics, load_cameras
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import intrinsics_from_info
from openarm_common.ros.node import BaseNode
from openarm_common.ros.tf import RobotStateListener


@dataclass(frozen=True, eq=False)
class View:
    """The board in an image, and the robot at its stamp."""

    t_ns: int
    matched: Matched
    detection: Detection
    pixels: NDArray[np.uint8]


class SessionNode(BaseNode[CalibrationConfig]):
    """Takes samples of one camera, solves and stores."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("calibration", CalibrationConfig, **kwargs)
        self._cameras = load_cameras(Path(self.config.cameras) if self.config.cameras else None)
        self._store = CalibrationStore(Path(self.config.store) if self.config.store else default_folder())
        self._states = RobotStateListener(
            self, self.description, joints=False, depth=100, wait=self.config.state_timeout
        )
        self._busy = ""
        self.algorithm = self.config.algorithm
        self.use(self.config.camera)

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
        self.load(SampleSet(self._head(self._camera.intrinsics), self.description))

    def load(self, samples: SampleSet) -> None:
        """Go on with these samples."""
        self._samples: SampleSet = samples
        self._result: Result | None = None
        self.tell()

    async def look(self, *, moving: bool = False) -> View:
        """One image of the board with the robot at its stamp.

        Args:
            moving: Whether the robot may move meanwhile.

        Raises:
            OpenArmError: NOT_READY, STALE_DATA, MOVING, NOTHING_DETECTED, BAD_IMAGE.
        """
        frame = await self.photographer.take(self.config.gate.track if moving else 0.0)
        pixels, t_ns = grey(frame.items["image"]), frame.t_ns
        self._check_optics(intrinsics_from_info(frame.items["camera_info"]))
        matched = match(self._states.buffer, t_ns, self._samples.joint_names, self.config.gate, moving=moving)
        return View(t_ns, matched, await self.in_thread(detect, self._samples.board, pixels), pixels)

    async def take(self) -> Sample:
        """Take a sample; errors as `look`."""
        view = await self.look()
        sample = self._samples.take(view.t_ns, view.matched, view.detection, view.pixels)
        self.changed()
        return sample

    async def solve(self, algorithm: str = "") -> Result:
        """Solve the samples and judge the result.

        Raises:
            OpenArmError: DEGENERATE, INVALID_ARGUMENT.
        """
        name = checked_algorithm(algorithm or self.algorithm)
        found = self._store.find(self._camera.name)
        stored = found.calibration if found is not None else None
        if stored is not None and stored.mount_seed != self._samples.head.mount_seed:
            stored = None  # of other mounts: its distance says nothing
        result: Result = await self.in_thread(
            calibrate, self._samples, algorithm=name, limits=self.config.limits, created=_now(), stored=stored
        )
        self._result = result
        self.tell()
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

    def free(self) -> None:
        """Make sure that the node is not at work.

        Raises:
            OpenArmError: BUSY, with what it is at.
        """
        if self._busy:
            raise OpenArmError(Code.BUSY, f"the node is {self._busy}; wait for its answer")

    def work(self, what: str) -> _Work:
        """Be busy with something while the returned context is open.

        Raises:
            OpenArmError: BUSY, when the node is already.
        """
        self.free()
        return _Work(self, what)

    def set_busy(self, what: str) -> None:
        """Say what takes time now; empty is nothing."""
        self._busy = what

    def changed(self) -> None:
        """The samples are others than those that were solved."""
        self._result = None
        self.tell()

    def tell(self) -> None:
        """Say on /diagnostics how far it is."""
        grade = self._result.verdict.grade if self._result is not None else "not computed"
        self.diagnose(True, f"{len(self._samples)} samples of {self._camera.name!r}", result=grade)

    def _head(self, optics: Intrinsics) -> SessionHead:
        board = read_board(self.config.board, "parameter board")
        setup = setup_of(self.description, self._camera.parent)
        return SessionHead(
            camera=self._camera.name, setup=setup, parent=self._camera.parent,
            carrier=self.config.carrier if setup == "to_hand" else self._camera.parent,
            intrinsics=(optics.width, optics.height, optics.fx, optics.fy, optics.cx, optics.cy),
            board=board.model_dump(), created=_now(),
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


class _Work:
    """The node is busy while this is open."""

    def __init__(self, node: SessionNode, what: str) -> None:
        self._node, self._what = node, what

    def __enter__(self) -> None:
        self._node.set_busy(self._what)

    def __exit__(self, *_: object) -> None:
        self._node.set_busy("")


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
