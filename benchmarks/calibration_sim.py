# SPDX-License-Identifier: Apache-2.0
"""Hand-eye calibration on rendered images of the simulated robot, for true mounts of many seeds.

    python benchmarks/calibration_sim.py [--quick] [--seeds N] [--json PATH]

The robot is set to random postures in which the nominal mounts promise a view of the board and nothing touches; images
are rendered from the true mounts, detected and solved. No nodes, no dynamics: what is measured is detection and solver.
The postures are random, not chosen for what they tell.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("LP_NUM_THREADS", "1")

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Row, write_report
from openarm_calibration.board import CircleGrid
from openarm_calibration.board_files import write_board
from openarm_calibration.detect import Detection, detect
from openarm_calibration.gate import Matched
from openarm_calibration.offline import calibrate
from openarm_calibration.poses import visible
from openarm_calibration.problem import difference
from openarm_calibration.refine import mount_error
from openarm_calibration.samples import SampleSet, SessionHead
from openarm_common import se3
from openarm_common.cameras import T_LINK_OPTICAL, CameraConfig, load_cameras, true_mount
from openarm_common.description import RobotDescription
from openarm_common.errors import OpenArmError
from openarm_common.scene import load_scene
from openarm_sim_bridge.model import build_spec

Array = NDArray[np.float64]
_MIDDLE: dict[str, Array] = {}
BOARD = CircleGrid()
#: Of each joint around the middle of the postures, rad.
SPREAD = 0.4
HAND = "openarm_right_link7"
#: The board held flat between the fingers, and lying on the table, in the hand's frame and the base frame.
HELD = se3.make(se3.rotation_from_z_y((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.37))
PLACED = se3.make(se3.rotation_from_z_y((0.0, 0.0, -1.0), (-1.0, 0.0, 0.0)), (0.33, -0.2, 0.405))


class Bench:
    """One camera of the simulated robot with a board in front of it, at true mounts of one seed."""

    def __init__(self, camera: CameraConfig, seed: int, folder: Path) -> None:
        self.camera, self.description = camera, RobotDescription.load()
        self.standing = camera.parent != HAND
        posture = self.description.group_state
        self.home = {**posture("right_arm", "home"), **posture("left_arm", "home")}
        self.T_carrier_board, carrier = (HELD if self.standing else PLACED), (HAND if self.standing else "")
        spec = build_spec(self.description, load_scene("empty"), {camera.name: camera}, seed)
        child = mujoco.MjSpec.from_file(str(folder / "board.xml"))
        parent = spec.body(carrier) if carrier else spec.worldbody
        quat = np.roll(se3.quat_xyzw_from_matrix(self.T_carrier_board[:3, :3]), 1)
        frame = parent.add_frame(pos=self.T_carrier_board[:3, 3], quat=quat)
        frame.attach_body(child.body("calibration_board"), "board_", "")
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.renderer = mujoco.Renderer(self.model, camera.height, camera.width)
        optics = camera.intrinsics
        head = SessionHead(
            camera=camera.name, setup="to_hand" if self.standing else "in_hand", parent=camera.parent, carrier=HAND,
            intrinsics=(optics.width, optics.height, optics.fx, optics.fy, optics.cx, optics.cy),
            board=BOARD.model_dump(), mount_seed=seed,
        )  # fmt: skip
        self.samples = SampleSet(head, self.description)
        self.true = true_mount(camera, seed)
        optics_row = np.array([optics.fx, optics.fy, optics.cx, optics.cy])
        # a board farther from the overhead camera is below the table
        self._seen = lambda T: T[2, 3] < 0.62 and visible(BOARD, T, optics_row, (optics.width, optics.height))

    def view(self, joints: dict[str, float]) -> Array:
        """T_camera_board (4, 4) as the nominal mount promises."""
        hand = self.description.link_pose(HAND, joints)
        if self.standing:
            return se3.inverse(self.camera.T_parent_optical) @ hand @ self.T_carrier_board
        return se3.inverse(hand @ self.camera.T_parent_optical) @ self.T_carrier_board

    def middle(self) -> Array:
        """Joint positions around which most postures show the board; looked for once, with the board in sight."""
        if self.camera.name not in _MIDDLE:
            rng = np.random.default_rng(0)
            counts: list[int] = []
            promising = self._promising(rng)
            for q in promising:
                near = (self.near(q, rng) for _ in range(200))
                seen = [j for j in near if self._seen(self.view(j))][:12]
                counts.append(sum(self.free(j) and self.photograph() is not None for j in seen))
            _MIDDLE[self.camera.name] = promising[int(np.argmax(counts))]
        return _MIDDLE[self.camera.name]

    def _promising(self, rng: np.random.Generator, tries: int = 6000, kept: int = 6) -> list[Array]:
        """Postures around which the nominal mount promises the board, as if nothing could hide it."""
        lower, upper = self.description.limits(self.samples.joint_names)
        found: list[tuple[int, Array]] = []
        for _ in range(tries):
            q = rng.uniform(lower + 0.1, upper - 0.1)
            if self._seen(self.view(self.joints(q))) and self.free(self.joints(q)):
                found.append((sum(self._seen(self.view(self.near(q, rng))) for _ in range(20)), q))
        found.sort(key=lambda item: -item[0])
        return [q for _, q in found[:kept]]

    def near(self, q: Array, rng: np.random.Generator) -> dict[str, float]:
        """A random posture around one, within the limits."""
        lower, upper = self.description.limits(self.samples.joint_names)
        return self.joints(np.clip(q + rng.uniform(-SPREAD, SPREAD, len(q)), lower + 0.02, upper - 0.02))

    def joints(self, q: Array) -> dict[str, float]:
        """All joints, those of the right arm as given."""
        return {**self.home, **dict(zip(self.samples.joint_names, q.tolist(), strict=True))}

    def free(self, joints: dict[str, float]) -> bool:
        """Set the robot there; whether nothing touches."""
        for name, value in joints.items():
            self.data.qpos[self.model.joint(name).qposadr[0]] = value
        mujoco.mj_forward(self.model, self.data)
        return self.data.ncon == 0

    def photograph(self) -> Detection | None:
        """The marks in an image of the posture that `free` set last; None where the board is hidden or cut off."""
        self.renderer.update_scene(self.data, self.camera.name)
        try:
            return detect(BOARD, cv2.cvtColor(self.renderer.render(), cv2.COLOR_RGB2GRAY).astype(np.uint8))
        except OpenArmError:
            return None

    def fill(self, count: int, rng: np.random.Generator) -> int:
        """Take `count` samples; returns how many images showed no board."""
        middle = self.middle()
        missed = 0
        while len(self.samples) < count:
            joints = self.near(middle, rng)
            if not self._seen(self.view(joints)) or not self.free(joints):
                continue
            found = self.photograph()
            if found is not None:
                self.samples.take(0, Matched(joints, 0, 0.0), found)
                continue
            missed += 1
            if missed > 400:
                raise SystemExit(f"{self.camera.name}: 400 images without a board; {len(self.samples)} with one")
        return missed

    def close(self) -> None:
        """Free the renderer."""
        self.renderer.close()


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="4 seeds")
    parser.add_argument("--seeds", type=int, help="how many; 20, with --quick 4")
    parser.add_argument("--json", type=Path, help="where to write the metrics")
    arguments = parser.parse_args()
    cameras = load_cameras()
    errors: dict[tuple[str, int], list[tuple[float, float, float]]] = {}
    with tempfile.TemporaryDirectory() as name:
        write_board(BOARD, Path(name) / "board.xml")
        for seed in range(1, 1 + (arguments.seeds or (4 if arguments.quick else 20))):
            for camera in ("wrist", "overhead"):
                begin = time.perf_counter()
                bench = Bench(cameras[camera], seed, Path(name))
                missed = bench.fill(15, np.random.default_rng(seed))
                text = []
                for count in (15, 10):
                    while len(bench.samples) > count:
                        bench.samples.remove("")
                    result = calibrate(bench.samples)
                    offset, angle = mount_error(result.calibration.T_parent_link, bench.true)
                    away = difference(result.solution.estimate.X[0], bench.true @ T_LINK_OPTICAL)
                    square = float(away @ np.linalg.solve(result.solution.mount_covariance(), away))
                    errors.setdefault((camera, count), []).append((offset, angle, square))
                    text.append(f"{count}: {offset * 1e3:.4f} mm {math.degrees(angle):.4f} deg {result.verdict.grade}")
                before = mount_error(cameras[camera].T_parent_link, bench.true)[0]
                px = result.solution.estimate.noise.px
                seconds = time.perf_counter() - begin
                print(
                    f"seed {seed:2d} {camera:9s} nominal {before * 1e3:5.2f} mm  {'  '.join(text)}  marks {px:.3f} px"
                    f"  {missed} not seen  {seconds:.1f} s",
                    flush=True,
                )
                bench.close()
    rows: list[Row] = []
    for (camera, count), values in errors.items():
        t, r, squares = np.array(values).T
        for kind, figure, unit, target in (("mm", t * 1e3, "mm", 0.3), ("deg", np.degrees(r), "deg", 0.03)):
            stem = f"rendered_{camera}_{count}_{kind}"
            rows.append(Row(f"{stem}_p50", float(np.median(figure)), unit, "lower", target, n=len(values)))
            rows.append(Row(f"{stem}_max", float(np.max(figure)), unit, "lower", target, n=len(values)))
        stem = f"rendered_{camera}_{count}_nees"
        rows.append(Row(f"{stem}_mean", float(np.mean(squares)), "", "in 5..7", 6.0, n=len(values)))
    write_report(rows, arguments.json)


if __name__ == "__main__":
    main()
