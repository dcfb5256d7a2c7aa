# SPDX-License-Identifier: Apache-2.0
"""Depth of a stereo pair against true depth, compared with plain StereoSGBM without checks on the same images.

    python -m benchmarks.stereo_depth [--scenes N] [--baseline M] [--fovy DEG] [--json PATH]

Scenes are drawn by the simulation at 640 x 480: a floor, a wall and boxes, cylinders and balls at random places, each
with a random texture, colour noise as of a camera (2 of 255, other for each image). Truth is the depth buffer of the
left camera, 32FC1. Errors are of pixels that have both, by bands of true depth; `valid` is the share of the band's
pixels that have depth, `wrong` the share of those with depth that are off by more than 5 % (a false match, not noise).
Bias and rms are of the others. Times are CPU times of one thread for one pair, median; both matchers take turns.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Row, write_report
from openarm_common import se3
from openarm_common.camera.cameras import CameraConfig, Intrinsics
from openarm_common.camera.lens import Lens
from openarm_common.types import Bytes, Floats
from openarm_perception.geometry.depth import DepthLimits
from openarm_perception.stereo.matching import StereoConfig, StereoMatcher
from openarm_perception.stereo.rectification import Rectification
from openarm_sim_bridge.cameras.noise import ColourNoiseConfig, add_colour_noise
from openarm_sim_bridge.cameras.renderer import SnapshotRenderer
from openarm_sim_bridge.world.scenery import add_cameras, add_environment
from openarm_sim_bridge.world.world import Snapshot

BANDS = ((0.3, 0.5), (0.5, 0.8), (0.8, 1.2), (1.2, 2.0))
LIMITS = DepthLimits(near=0.3, far=2.0)
#: A false match, not noise, as a share of the depth.
_WRONG = 0.05


def cameras(baseline: float, fovy: float) -> dict[str, CameraConfig]:
    """Return a pair that looks down at an angle, 640 x 480."""
    forward, right = np.array([0.80, 0.0, -0.60]), np.array([0.0, -1.0, 0.0])
    made: dict[str, CameraConfig] = {}
    for name, side in (("left", 0.0), ("right", baseline)):
        x, y, z = (np.array([0.0, 0.0, 0.55]) + side * right).tolist()
        made[name] = CameraConfig(
            name=name, parent="world", position=(x, y, z), forward=tuple(forward.tolist()),
            image_right=tuple(right.tolist()), fovy_deg=fovy, near=LIMITS.near, far=LIMITS.far, depth=name == "left",
        )  # fmt: skip
    return made


def textured_scene(seed: int, views: dict[str, CameraConfig]) -> mujoco.MjModel:
    """Return a world of textured bodies in front of the cameras."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    add_environment(spec, {})
    for i in range(6):
        # speckle of several sizes, as wood, cloth or print have
        pixels = sum(
            cv2.resize(rng.normal(0.0, 28.0, (n, n, 3)), (512, 512), interpolation=cv2.INTER_CUBIC)
            for n in (64, 160, 400)
        )
        data = np.clip(128.0 + pixels, 0, 255).astype(np.uint8)
        spec.add_texture(
            name=f"t{i}",
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            width=512,
            height=512,
            nchannel=3,
            data=data.ravel().tolist(),
        )
        material = spec.add_material(name=f"m{i}", texuniform=True, texrepeat=(2.0, 2.0))
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = f"t{i}"
    kinds = (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_ELLIPSOID)
    box = mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(name="ground", type=box, pos=(1.0, 0, 0.0), size=(2, 2, 0.02), material="m0")
    spec.worldbody.add_geom(
        name="wall", type=mujoco.mjtGeom.mjGEOM_PLANE, pos=(1.6, 0, 1.0), size=(1, 2, 0.1),
        quat=(0.5**0.5, 0, -(0.5**0.5), 0), material="m1",
    )  # fmt: skip
    for i in range(14):
        x, y = rng.uniform(0.25, 1.4), rng.uniform(-0.5, 0.5)
        size = rng.uniform(0.03, 0.12, 3)
        spec.worldbody.add_geom(
            name=f"body{i}", type=kinds[i % 3], pos=(x, y, 0.02 + size[2]), size=size,
            quat=se3.quat_xyzw_from_matrix(se3.rot_z(rng.uniform(0, 3.14)))[[3, 0, 1, 2]], material=f"m{2 + i % 4}",
        )  # fmt: skip
    add_cameras(spec, views.values(), None)
    return spec.compile()


def plain(lens: Intrinsics, baseline: float, left: Bytes, right: Bytes) -> Floats:
    """Return the depth by StereoSGBM alone, with the parameters of OpenCV's own example, m."""
    count = int(-(-np.ceil(lens.fx * baseline / LIMITS.near) // 16) * 16)
    sgbm = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=count, blockSize=5, P1=8 * 25, P2=32 * 25, disp12MaxDiff=10**6
    )
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right)]
    disparity = np.asarray(sgbm.compute(*grey), np.float32) / 16.0
    with np.errstate(divide="ignore"):
        z = lens.fx * baseline / disparity
    return np.where((disparity > 0) & (z >= LIMITS.near) & (z <= LIMITS.far), z, np.nan).astype(np.float32)


def draw(model: mujoco.MjModel, views: dict[str, CameraConfig], seed: int) -> tuple[Bytes, Bytes, Floats]:
    """Return both noisy images and the true depth."""
    renderer = SnapshotRenderer(views)
    renderer.load(Snapshot(model, 0, np.zeros(model.nq)))
    rng, images = np.random.default_rng([seed, 1]), dict[str, Bytes]()
    truth = np.empty((480, 640), np.float32)
    for name in views:
        images[name] = np.empty((480, 640, 3), np.uint8)
        renderer.draw(name, images[name], truth if name == "left" else None)
        add_colour_noise(images[name], ColourNoiseConfig(sigma=2.0), rng)
    renderer.close()
    return images["left"], images["right"], truth


def band_rows(name: str, depths: list[Floats], truths: list[Floats]) -> dict[str, float]:
    """Return the figures of each band by their names."""
    z, true = np.concatenate([d.ravel() for d in depths]), np.concatenate([t.ravel() for t in truths])
    out: dict[str, float] = {}
    for low, high in (*BANDS, (LIMITS.near, LIMITS.far)):
        band = (true >= low) & (true < high)
        error = (z - true)[band & np.isfinite(z)]
        good: NDArray[np.float32] = error[np.abs(error) <= _WRONG * true[band & np.isfinite(z)]]
        key = f"{name}_{low:g}_{high:g}"
        out[f"{key}_valid"] = 100.0 * len(error) / max(int(band.sum()), 1)
        out[f"{key}_wrong"] = 100.0 * (1.0 - len(good) / max(len(error), 1))
        out[f"{key}_bias"] = 1e3 * float(good.mean())
        out[f"{key}_rms"] = 1e3 * float(np.sqrt(np.mean(good.astype(np.float64) ** 2)))
        out[f"{key}_p95"] = 1e3 * float(np.percentile(np.abs(error), 95))
    return out


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--baseline", type=float, default=0.063, help="m")
    parser.add_argument("--fovy", type=float, default=52.0, help="degrees")
    parser.add_argument("--json", type=Path, default=None, help="also write the report there")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    views = cameras(args.baseline, args.fovy)
    lens = views["left"].intrinsics
    pose = se3.make(None, (args.baseline, 0.0, 0.0))
    matcher = StereoMatcher(StereoConfig(), Rectification.from_pose(Lens(lens), Lens(lens), pose), LIMITS)
    ours: list[Floats] = []
    peers: list[Floats] = []
    truths: list[Floats] = []
    times: dict[str, list[float]] = {"ours": [], "peer": []}
    for seed in range(args.scenes):
        left, right, truth = draw(textured_scene(seed, views), views, seed)
        z, peer = truth, truth
        for turn in range(4):
            began = time.thread_time()
            z = matcher.depth(left, right)
            between = time.thread_time()
            peer = plain(lens, args.baseline, left, right)
            ended = time.thread_time()
            if turn:  # the first compiles
                times["ours"].append(between - began)
                times["peer"].append(ended - between)
        ours, peers, truths = [*ours, z], [*peers, peer], [*truths, truth]
    mine, theirs = band_rows("stereo", ours, truths), band_rows("stereo", peers, truths)
    rows: list[Row] = []
    for key, value in mine.items():
        unit = "%" if key.endswith(("valid", "wrong")) else "mm"
        rows.append(
            Row(
                key, value, unit, "higher" if key.endswith("valid") else "lower", None, "SGBM", theirs[key], args.scenes
            )
        )
    seconds = {name: 1e3 * float(np.median(values)) for name, values in times.items()}
    rows.append(Row("stereo_ms", seconds["ours"], "ms", "lower", None, "SGBM", seconds["peer"], args.scenes))
    write_report(rows, args.json)


if __name__ == "__main__":
    main()
