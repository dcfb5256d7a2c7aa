# SPDX-License-Identifier: Apache-2.0
"""Things dropped on a table and seen by a depth camera: labelled organised clouds for `benchmarks/segmentation.py`.

    python benchmarks/segmentation_scenes.py FOLDER [--scenes N] [--first-seed S] [--sensor d435|coarse|clean]

Every scene has 3 to 9 things of ten kinds (boxes, cans that stand and lie, balls, eggs, mugs, bowls, bottles, hammers,
angles) dropped by physics, so that some lie on others, and a camera 0.5 to 1.1 m away, tilted by 0 to 60 deg. All of a
thing has one label, the inside of a mug too; 0 is the table. Noise is that of a D435 or of a coarse sensor with
structured light (`openarm_sim_bridge.cameras.noise`).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from openarm_common.camera.cameras import Intrinsics
from openarm_perception.frames.cloud_fields import Cloud
from openarm_perception.frames.pcd import write_pcd
from openarm_perception.geometry.depth import Deprojector, DepthLimits
from openarm_sim_bridge.cameras.noise import DepthNoiseConfig, add_depth_noise

SENSORS = {
    "d435": DepthNoiseConfig(enabled=True),
    "coarse": DepthNoiseConfig(enabled=True, baseline=0.075, subpixel=0.1, step=0.125, edge_dropout=0.5),
    "clean": DepthNoiseConfig(enabled=False),
}
_SIZE = (640, 480)
_FOVY = 45.0
#: Simulated time until things lie still, s.
_REST = 2.0

Random = np.random.Generator


def _geom(kind: str, size: tuple[float, ...], pos: tuple[float, float, float] = (0, 0, 0), turn: str = "") -> str:
    numbers = " ".join(f"{v:.4f}" for v in size)
    place = " ".join(f"{v:.4f}" for v in pos)
    return f'<geom type="{kind}" size="{numbers}" pos="{place}" {turn} density="400" rgba="RGBA"/>'


def _box(r: Random) -> str:
    return _geom("box", tuple(r.uniform(0.012, 0.06, 3)))


def _can(r: Random) -> str:
    return _geom("cylinder", (r.uniform(0.02, 0.045), r.uniform(0.015, 0.08)))


def _ball(r: Random) -> str:
    return _geom("sphere", (r.uniform(0.018, 0.045),))


def _egg(r: Random) -> str:
    return _geom("ellipsoid", tuple(r.uniform(0.018, 0.05, 3)))


def _sausage(r: Random) -> str:
    return _geom("capsule", (r.uniform(0.012, 0.025), r.uniform(0.02, 0.08)))


def _ring(radius: float, top: float, height: float) -> list[str]:
    """Return the wall of a vessel, wider or narrower at its top, as planks."""
    planks = 24
    lean = math.degrees(math.atan2(top - radius, height))
    middle, slope = 0.5 * (radius + top), math.hypot(height, top - radius)
    half = math.pi * max(radius, top) / planks * 1.05
    return [
        _geom(
            "box", (0.0015, half, slope / 2.0), (middle * math.cos(a), middle * math.sin(a), height / 2.0),
            f'euler="{math.degrees(a):.3f} {lean:.3f} 0"',
        )
        for a in np.arange(planks) * 2.0 * math.pi / planks
    ]  # fmt: skip


def _mug(r: Random) -> str:
    radius, height = r.uniform(0.032, 0.045), r.uniform(0.07, 0.11)
    handle = _geom("box", (0.004, 0.006, height * 0.3), (radius + 0.025, 0.0, height / 2.0))
    arms = [_geom("box", (0.013, 0.006, 0.004), (radius + 0.012, 0.0, height * s)) for s in (0.24, 0.76)]
    return "".join([_geom("cylinder", (radius, 0.002)), handle, *arms, *_ring(radius, radius, height)])


def _bowl(r: Random) -> str:
    radius, top, height = r.uniform(0.03, 0.05), r.uniform(0.06, 0.085), r.uniform(0.04, 0.06)
    return "".join([_geom("cylinder", (radius, 0.002)), *_ring(radius, top, height)])


def _bottle(r: Random) -> str:
    radius, body = r.uniform(0.025, 0.04), r.uniform(0.05, 0.08)
    neck = _geom("cylinder", (radius * 0.4, 0.03), (0.0, 0.0, body + 0.03))
    shoulder = _geom("ellipsoid", (radius, radius, radius * 0.8), (0.0, 0.0, body))
    return _geom("cylinder", (radius, body)) + shoulder + neck


def _hammer(r: Random) -> str:
    length = r.uniform(0.08, 0.13)
    return _geom("box", (length, 0.012, 0.011)) + _geom("box", (0.016, 0.045, 0.016), (length, 0.0, 0.0))


def _angle(r: Random) -> str:
    a, b, width = r.uniform(0.03, 0.06), r.uniform(0.03, 0.06), r.uniform(0.015, 0.04)
    return _geom("box", (a, width, 0.008)) + _geom("box", (0.008, width, b), (a - 0.008, 0.0, b))


KINDS: tuple[Callable[[Random], str], ...] = (
    _box, _box, _can, _can, _ball, _egg, _sausage, _mug, _bowl, _bottle, _hammer, _angle,
)  # fmt: skip


def scene(seed: int, sensor: DepthNoiseConfig) -> tuple[Cloud, Intrinsics]:
    """Return a labelled cloud and the intrinsics of its camera.

    Args:
        seed: Seed of everything that is drawn.
        sensor: Noise of its depth.
    """
    r = np.random.default_rng(seed)
    model, count = _model(r)
    data = mujoco.MjData(model)
    while data.time < _REST:
        mujoco.mj_step(model, data)
    data.qvel[:] = 0.0
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, _SIZE[1], _SIZE[0]) as renderer:
        renderer.update_scene(data, "camera")
        rgb = renderer.render().copy()
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, "camera")
        ids = renderer.render()[..., 0].copy()
        renderer.disable_segmentation_rendering()
        renderer.enable_depth_rendering()
        renderer.update_scene(data, "camera")
        z = renderer.render().copy().astype(np.float32)
    lens = Intrinsics.from_fovy(*_SIZE, _FOVY)
    body = np.where(ids >= 0, model.geom_bodyid[ids], 0)
    label = np.where((body > 0) & (body <= count), body, 0).astype(np.int64)
    z[(z > 3.0) | (ids < 0)] = np.nan
    if sensor.enabled:
        z = add_depth_noise(z, lens.fy, sensor, r)
    points = Deprojector(DepthLimits(near=0.1, far=3.0)).organised(z, lens)
    label[np.isnan(points[..., 2])] = 0
    return Cloud(points, rgb, label), lens


def _model(r: Random) -> tuple[mujoco.MjModel, int]:
    count = int(r.integers(3, 10))
    spread = r.uniform(0.06, 0.2)
    bodies: list[str] = []
    for i in range(count):
        x, y = r.uniform(-spread, spread, 2)
        upright = r.random() < 0.6
        q = np.array([1.0, 0.0, 0.0, r.uniform(-1.0, 1.0)]) if upright else r.standard_normal(4)
        q /= np.linalg.norm(q)
        rgba = " ".join(f"{v:.2f}" for v in (*r.uniform(0.1, 0.95, 3), 1.0))
        shape = KINDS[int(r.integers(len(KINDS)))](r).replace("RGBA", rgba)
        turn = " ".join(f"{v:.4f}" for v in q)
        bodies.append(f'<body pos="{x:.4f} {y:.4f} {0.1 + 0.12 * i:.3f}" quat="{turn}"><freejoint/>{shape}</body>')
    tilt, distance, side = r.uniform(0.0, math.radians(60.0)), r.uniform(0.5, 1.1), r.uniform(0.0, 2.0 * math.pi)
    eye = distance * np.array([math.sin(tilt) * math.cos(side), math.sin(tilt) * math.sin(side), math.cos(tilt)])
    right = np.array([-math.sin(side), math.cos(side), 0.0])
    up = np.cross(eye / distance, right)
    axes = " ".join(f"{v:.5f}" for v in (*right, *up))
    where = " ".join(f"{v:.4f}" for v in eye)
    text = f"""<mujoco><compiler angle="degree" eulerseq="zyx"/>
      <option timestep="0.004" integrator="implicitfast"/>
      <default><geom friction="0.9 0.02 0.002" solref="0.01 1" condim="6"/></default>
      <visual><global offwidth="{_SIZE[0]}" offheight="{_SIZE[1]}"/><map znear="0.02" zfar="8"/></visual>
      <worldbody><light pos="0.5 0.5 2" dir="-0.2 -0.2 -1" directional="true"/>
        <geom type="box" size="0.6 0.6 0.02" pos="0 0 -0.02" rgba="0.7 0.68 0.65 1"/>
        <geom type="plane" size="4 4 0.1" pos="0 0 -0.7" rgba="0.4 0.4 0.42 1"/>
        <camera name="camera" pos="{where}" xyaxes="{axes}" fovy="{_FOVY}"/>{"".join(bodies)}
      </worldbody></mujoco>"""
    return mujoco.MjModel.from_xml_string(text), count


def main() -> None:
    """Render scenes into a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", type=int, default=30)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--sensor", choices=SENSORS, default="d435")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    for seed in range(args.first_seed, args.first_seed + args.scenes):
        cloud, _ = scene(seed, SENSORS[args.sensor])
        write_pcd(args.folder / f"{args.sensor}{seed:04d}.pcd", cloud)
        print(f"{args.sensor}{seed:04d}.pcd: {len(np.unique(cloud.label)) - 1} things in view")


if __name__ == "__main__":
    main()
