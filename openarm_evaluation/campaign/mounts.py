# SPDX-License-Identifier: Apache-2.0
"""Camera mounts of a campaign: true ones that no configuration knows, each calibrated once by the suite itself.

The robot takes random postures in which the board is visible by the nominal mounts; images are rendered from the true
mounts, the marks are detected in them and the calibration is solved as on a real robot, from joint positions that are
as wrong as its joint zeros. World = base frame, m.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import mujoco
import numpy as np

from openarm_calibration.board.board import CircleGrid
from openarm_calibration.board.detect import BoardDetection, detect
from openarm_calibration.handeye.offline import Result, calibrate
from openarm_calibration.sampling.gate import Matched
from openarm_calibration.sampling.next_pose import visible
from openarm_calibration.sampling.samples import SampleSet, SessionHead
from openarm_calibration.store.store import CalibrationStore
from openarm_common import se3
from openarm_common.camera.cameras import CameraConfig, load_cameras, uncertain_cameras
from openarm_common.draws import first_fit
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.boards import Place
from openarm_common.scene.scene import load_scene
from openarm_common.types import Array
from openarm_evaluation.campaign.robot import shared_renderer
from openarm_evaluation.campaign.tasks.task import Task
from openarm_sim_bridge.world.hardware import IDEAL, HardwareConfig, drawn
from openarm_sim_bridge.world.model import build_spec
from openarm_sim_bridge.world.world import Snapshot, start_qpos

_SAMPLES = 15
_SPREAD = 0.4  # rad, of each joint around the middle of the postures
_MAX_MISSED = 200


def with_mounts(
    task: Task, mount_seeds: Sequence[int], folder: Path, hardware: HardwareConfig = IDEAL
) -> tuple[Task, Mapping[str, Array]]:
    """The task with true mounts of one of the seeds (each in turn), and T_parent_link by camera as calibrated.

    Args:
        task: The task.
        mount_seeds: Mount seeds to go through.
        folder: Folder of calibrations; those that it lacks are made.
        hardware: Hardware of the robot that calibrates.
    """
    seed = mount_seeds[task.seed % len(mount_seeds)]
    robot = f"_zeros_{hardware.zero_seed}" if hardware.zero_rms else ""
    store = CalibrationStore(folder / f"{seed}{robot}")
    zeros = drawn(hardware, RobotDescription.load()).zero
    mounts: dict[str, Array] = {}
    cameras = load_cameras()
    for camera in (cameras[name] for name in uncertain_cameras()):
        if store.find(camera.name) is None:
            store.save(calibrated(camera, seed, zeros).calibration)
        found = store.find(camera.name)
        if found is None:
            raise OpenArmError(Code.INTERNAL, f"the calibration of {camera.name!r} was saved and is not there")
        mounts[camera.name] = found.record.T_parent_link
    return replace(task, mount_seed=seed), mounts


def calibrated(camera: CameraConfig, mount_seed: int, zeros: Mapping[str, float] | None = None) -> Result:
    """Calibrate a camera at true mounts of a seed; `zeros` as for `Bench`."""
    bench = Bench(camera, mount_seed, zeros)
    bench.fill(np.random.default_rng(mount_seed))
    return calibrate(bench.samples)


class Bench:
    """One camera of the simulated robot with a board in front of it, without dynamics.

    Args:
        camera: Name of the camera.
        seed: Seed of the true mounts.
        zeros: Offsets that are added to true joint positions, rad by name.
        arm: Arm that holds the board of a fixed camera; "": the last one.
    """

    def __init__(
        self, camera: CameraConfig, seed: int, zeros: Mapping[str, float] | None = None, arm: str = ""
    ) -> None:
        self._zeros = zeros or {}
        self._camera, self._board, self._description = camera, CircleGrid(), RobotDescription.load().described
        scene = load_scene(Place(camera, arm).scene)
        board = scene.fixtures[0]
        self._fixed = bool(board.link)
        self._carrier = board.link or camera.parent
        self._T_carrier_board = board.T_link_fixture
        self._home: dict[str, float] = {}
        for arm in self._description.arm_names:
            hand = self._description.hand(arm)  # fingers that are open hide less from a camera behind them
            self._home |= self._description.group_state(f"{arm}_arm", "home") | {hand.joint: hand.opened}
        spec = build_spec(self._description, scene, load_cameras(), seed)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._picture = np.empty((camera.height, camera.width, 3), np.uint8)
        optics = camera.intrinsics
        numbers = (optics.width, optics.height, optics.fx, optics.fy, optics.cx, optics.cy)
        head = SessionHead(
            camera=camera.name,
            setup="to_hand" if self._fixed else "in_hand",
            parent=camera.parent,
            carrier=self._carrier,
            intrinsics=numbers,
            board=self._board.model_dump(),
            mount_seed=seed,
        )
        self.samples = SampleSet(head, self._description)

    def fill(self, rng: np.random.Generator, count: int = _SAMPLES) -> None:
        """Take `count` samples.

        Raises:
            OpenArmError: Error of the detector, or INVALID_ARGUMENT, when the board is hardly ever visible.
        """
        lower, upper = self._description.limits(self.samples.joint_names, np.pi)
        middle, missed = self._middle(), list[OpenArmError]()

        def draw() -> tuple[Matched, BoardDetection] | None:
            joints = self._joints(np.clip(middle + rng.uniform(-_SPREAD, _SPREAD, len(middle)), lower, upper))
            if not self._visible(joints) or not self._free(joints):
                return None
            try:
                found = self._look()
            except OpenArmError as error:
                missed.append(error)
                if len(missed) > _MAX_MISSED:
                    raise
                return None
            reported = {name: q + self._zeros.get(name, 0.0) for name, q in joints.items()}
            return Matched(reported, 0, 0.0), found

        what = f"a posture that shows the board to camera {self._camera.name!r}"
        for _ in range(count - len(self.samples)):
            self.samples.take(0, *first_fit(what, "move that camera in cameras.yaml", draw, 10_000))

    def _look(self) -> BoardDetection:
        """What the camera finds in the posture that was last tried; raises as `detect`."""
        renderer = shared_renderer()
        renderer.load(Snapshot(self._model, 0, self._data.qpos.copy()))
        renderer.draw(self._camera.name, self._picture)
        grey = np.asarray(cv2.cvtColor(self._picture, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        return detect(self._board, grey)

    def _middle(self, tries: int = 30_000, enough: int = 40) -> Array:
        """Joint positions around which most postures show the board, itself one where nothing hides it.

        Raises:
            OpenArmError: NOTHING_DETECTED, when there is none.
        """
        rng = np.random.default_rng(0)
        lower, upper = self._description.limits(self.samples.joint_names, np.pi)
        found = list[tuple[int, Array]]()
        for _ in range(tries):
            q = rng.uniform(lower + 0.1, upper - 0.1)
            if len(found) == enough:
                break
            if not self._visible(self._joints(q)) or not self._free(self._joints(q)):
                continue
            near = np.clip(q + rng.uniform(-_SPREAD, _SPREAD, (20, len(q))), lower, upper)
            found.append((sum(self._visible(self._joints(k)) for k in near), q))
        for _, q in sorted(found, key=lambda one: -one[0]):
            self._free(self._joints(q))
            try:
                self._look()
            except OpenArmError:
                continue
            return q
        text = f"none of {tries} postures shows the board to camera {self._camera.name!r}"
        raise OpenArmError(Code.NOTHING_DETECTED, text)

    def _visible(self, joints: dict[str, float]) -> bool:
        hand = self._description.link_pose(self._carrier, joints)
        if self._fixed:
            T = se3.inverse(self._camera.T_parent_optical) @ hand @ self._T_carrier_board
        else:
            T = se3.inverse(hand @ self._camera.T_parent_optical) @ self._T_carrier_board
        # a board farther from the fixed camera is below the table
        return bool(T[2, 3] < 0.62) and visible(self._board, T, self._camera.intrinsics, 0.0)

    def _joints(self, q: Array) -> dict[str, float]:
        return {**self._home, **dict(zip(self.samples.joint_names, q.tolist(), strict=True))}

    def _free(self, joints: dict[str, float]) -> bool:
        self._data.qpos[:] = start_qpos(self._model, joints)
        mujoco.mj_forward(self._model, self._data)
        return self._data.ncon == 0
