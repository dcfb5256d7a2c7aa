# SPDX-License-Identifier: Apache-2.0
"""Grasps from depth images of things of any shape: how long they take, and whether the true shape confirms them.

    python benchmarks/grasp_sampling.py [--quick] [--objects N] [--first-seed S] [--meshes DIR] [--robot NAME]
                                        [--verbose] [--json PATH]

Every object is of a seed of its own: a shape of the list below with random measures, or a random superquadric, dropped
on the table from a random orientation and seen by the overhead camera in 5 images with the noise of a D435. `--meshes`
takes folders with a `collision.obj` instead, whose groups are convex parts. A grasp is judged on the true shape,
without images and voxels: rays between the pads say where they close. It holds when the aperture suffices and two
points of the patches lie in each other's friction cones, coefficient 0.5 (where an edge or a corner meets a pad, the
normal is that of the pad); it is free when no point of the true surface is in the open hand.

    cloud_to_grasps_p50_ms, ..._p95_ms    from points to ranked candidates; peer: every random pair in all ways (dense
                                          checks, no coarse stage), in the same run
    top1_holds_share, top1_free_share     of objects with a candidate: the first is force closure on the true shape, its
                                          hand is free of it; peer as above
    top1_good_share                       both
    aperture_inside_share                 the true aperture lies in the expected interval
    aperture_error_p50_mm                 expected less true aperture
    none_share                            objects without a candidate
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import cv2
import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from benchmarks.report import Row, write_report
from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.camera.depth_view import DepthView
from openarm_common.camera.flying_pixels import FlyingConfig, label_flying
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array, Floats
from openarm_grasp.config import ApproachConfig, CloudConfig
from openarm_grasp.sampling.antipodal import Antipodal, Search
from openarm_grasp.sampling.hand_shape import HandShape
from openarm_grasp.sampling.surface import View, fuse
from openarm_sim_bridge.cameras.noise import DepthNoiseConfig, add_depth_noise

Shape = list[Array]  # corners (n, 3) of convex parts, m

#: Friction of the judge, images that the median is of, height that tells an object from the table, m.
_FRICTION, _FRAMES, _ABOVE = 0.5, 5, 0.005
#: What touches a pad that gives, and what touches it first, m.
_SOFT, _EDGE = 0.0015, 0.0003


def _prism(points: Array, height: float) -> Array:
    return np.concatenate([np.column_stack([points, np.full(len(points), z)]) for z in (0.0, height)])


def _ring(radius: float, n: int = 28) -> Array:
    turn = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    return radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def _box(low: list[float], high: list[float]) -> Array:
    least, edges = np.array(low, dtype=np.float64), np.array(high, dtype=np.float64) - np.array(low)
    return least + np.indices((2, 2, 2)).reshape(3, -1).T * edges


def _superquadric(a: Array, e1: float, e2: float) -> Array:
    """Points of |x/a|^(2/e2) + |y/b|^(2/e2))^(e2/e1) + |z/c|^(2/e1) = 1, by angles."""
    u, v = np.meshgrid(np.linspace(-np.pi, np.pi, 33), np.linspace(-np.pi / 2, np.pi / 2, 17))

    def power(x: Array, e: float) -> Array:
        return np.asarray(np.sign(x) * np.abs(x) ** e)

    x = power(np.cos(v), e1) * power(np.cos(u), e2)
    y = power(np.cos(v), e1) * power(np.sin(u), e2)
    return np.stack([a[0] * x, a[1] * y, a[2] * power(np.sin(v), e1)], axis=-1).reshape(-1, 3)


def make_shape(seed: int) -> tuple[str, Shape]:
    """A shape by its seed."""
    rng = np.random.default_rng(seed)
    u = rng.uniform
    kinds = ("box", "cylinder", "sphere", "cone", "L", "T", "cross", "hammer", *["superquadric"] * 4)
    kind = kinds[seed % len(kinds)]
    w, h = float(u(0.015, 0.04)), float(u(0.02, 0.05))
    arm = float(u(0.07, 0.13))
    if kind == "box":
        return kind, [_box([0, 0, 0], [*map(float, u(0.02, 0.07, 2)), float(u(0.02, 0.15))])]
    if kind == "cylinder":
        return kind, [_prism(_ring(float(u(0.012, 0.035))), float(u(0.03, 0.15)))]
    if kind == "sphere":
        return kind, [_superquadric(np.full(3, float(u(0.02, 0.036))), 1.0, 1.0)]
    if kind == "cone":
        r = float(u(0.02, 0.035))
        top = np.column_stack([_ring(r * float(u(0.1, 0.5))), np.full(28, float(u(0.05, 0.12)))])
        return kind, [np.concatenate([np.column_stack([_ring(r), np.zeros(28)]), top])]
    if kind == "L":
        return kind, [_box([0, 0, 0], [arm, w, h]), _box([0, 0, 0], [w, float(u(0.06, 0.12)), h])]
    if kind == "T":
        return kind, [_box([-arm / 2, 0, 0], [arm / 2, w, h]), _box([-w / 2, 0, 0], [w / 2, float(u(0.06, 0.12)), h])]
    if kind == "cross":
        b = float(u(0.07, 0.13))
        return kind, [
            _box([-arm / 2, -w / 2, 0], [arm / 2, w / 2, h]), _box([-w / 2, -b / 2, 0], [w / 2, b / 2, h])
        ]  # fmt: skip
    if kind == "hammer":
        length, r = float(u(0.15, 0.28)), float(u(0.008, 0.016))
        handle = _prism(_ring(r), length)
        return kind, [handle, _box([-0.05, -0.015, length - 0.03], [0.05, 0.015, length])]
    e = u(0.3, 1.9, 2)
    return kind, [_superquadric(np.sort(u(0.015, 0.06, 3)), float(e[0]), float(e[1]))]


def load_shape(path: Path) -> Shape:
    """Convex parts of an OBJ file: its groups."""
    vertices, groups = list[list[float]](), [list[int]()]
    for line in path.read_text(encoding="utf-8").splitlines():
        word, *rest = line.split() or [""]
        if word == "v":
            vertices.append([float(v) for v in rest[:3]])
        elif word in ("o", "g"):
            groups.append([])
        elif word == "f":
            numbers = [int(v.split("/")[0]) for v in rest]
            groups[-1] += [n - 1 if n > 0 else len(vertices) + n for n in numbers]
    points = np.array(vertices)
    return [points[np.unique(group)] for group in groups if group]


class Studio:
    """A table, the overhead camera of the robot, and one object that has come to rest."""

    def __init__(self, robot: str) -> None:
        self.robot = RobotDescription.load(robot)
        self.cameras = load_cameras()
        self.camera = self.cameras["overhead"]
        self.T_base_camera = self.robot.link_pose(self.camera.parent, {}) @ self.camera.T_parent_optical
        self.table_z = 0.40

    def settle(self, shape: Shape, rng: np.random.Generator) -> tuple[Shape, Floats] | None:
        """Drop an object; its parts where they came to rest, and the depth that the camera sees of them, m."""
        spec = mujoco.MjSpec()
        spec.option.timestep = 0.004
        spec.visual.global_.offwidth, spec.visual.global_.offheight = self.camera.width, self.camera.height
        spec.visual.map.znear, spec.visual.map.zfar = 0.01, 5.0
        world = spec.worldbody
        world.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[1.0, 1.0, 0.1], pos=[0.3, 0.0, self.table_z - 0.1])
        T = self.T_base_camera @ se3.make(se3.rot_x(np.pi))
        camera = world.add_camera(name="eye", pos=T[:3, 3], fovy=self.camera.fovy_deg)
        quaternion = se3.quat_xyzw_from_matrix(T[:3, :3])
        camera.quat = np.roll(quaternion, 1)
        points = np.concatenate(shape)
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = float(np.linalg.norm(points - middle, axis=1).max())
        body = world.add_body(name="object", pos=[float(rng.uniform(0.2, 0.34)), float(rng.uniform(0.12, 0.32)),
                                                  self.table_z + radius + 0.01])  # fmt: skip
        q = rng.standard_normal(4)
        body.quat = q / np.linalg.norm(q)
        body.add_freejoint()
        for n, corners in enumerate(shape):
            spec.add_mesh(name=f"part{n}", uservert=(corners - middle).ravel())
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"part{n}", condim=6, friction=[1.0, 0.02, 0.005])
        model = spec.compile()
        data = mujoco.MjData(model)
        for _ in range(750):
            mujoco.mj_step(model, data)
        if np.abs(data.qvel).max() > 0.05:
            return None
        T_base_object = se3.make(data.xmat[1].reshape(3, 3), data.xpos[1])
        with mujoco.Renderer(model, self.camera.height, self.camera.width) as renderer:
            renderer.enable_depth_rendering()
            renderer.update_scene(data, "eye")
            depth = np.asarray(renderer.render(), dtype=np.float32).copy()
        return [se3.apply(T_base_object, corners - middle) for corners in shape], depth

    def look(self, depth: Floats, rng: np.random.Generator) -> View:
        """What the camera measures of the object and of the table around it."""
        focal = self.camera.intrinsics.fy
        noisy = [add_depth_noise(depth, focal, DepthNoiseConfig(), rng) for _ in range(_FRAMES)]
        seen = np.array(noisy)
        missing = np.isnan(seen).all(axis=0)
        seen[:, missing] = 0.0
        z = np.nanmedian(seen, axis=0).astype(np.float32)
        view = DepthView(z, self.camera.intrinsics, self.T_base_camera, self.camera.near, self.camera.far)
        label = np.zeros(z.shape, np.uint8)
        label_flying(view, FlyingConfig(), label)
        x, y = view.rays
        optical = np.stack([x[None, :] * z, y[:, None] * z, z], axis=-1).astype(np.float64)
        points = optical @ self.T_base_camera[:3, :3].T + self.T_base_camera[:3, 3]
        above = (z > 0.0) & (label == 0) & (points[..., 2] > self.table_z + _ABOVE)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(above.astype(np.uint8), connectivity=8)
        largest = int(stats[1:, cv2.CC_STAT_AREA].argmax()) + 1 if len(stats) > 1 else 0
        target = points[labels == largest] if largest else np.empty((0, 3))
        return View(self.T_base_camera[:3, 3], target)


class Truth:
    """Judges a grasp on the true shape."""

    def __init__(self, parts: Shape, shape: HandShape) -> None:
        self._hulls = [ConvexHull(part).equations for part in parts]
        self._shape = shape
        self._surface = np.concatenate([_on_surface(part) for part in parts])

    def holds(self, grasp: Antipodal) -> tuple[bool, float]:
        """Whether the closing pads are in force closure, and the aperture then, m; NaN when they meet nothing."""
        T, shape = grasp.T_base_tcp, self._shape
        pad = shape.pads[int(np.abs(shape.fingers - 0.5 * grasp.width).argmin())]
        x, z = np.meshgrid(np.linspace(pad[0], pad[1], 25), np.linspace(pad[2], pad[3], 30))
        n = x.size
        begin = np.column_stack([x.ravel(), np.full(n, -shape.opening), z.ravel()])
        start, along = se3.apply(T, begin), T[:3, 1]
        low, low_n = self._cast(start, along)
        high, high_n = self._cast(start + 2.0 * shape.opening * along, -along)
        hit = np.isfinite(low)
        if not hit.any():
            return False, float("nan")
        first, last = low[hit].min(), 2.0 * shape.opening - high[hit].min()
        a = hit & (low <= first + _SOFT)
        b = hit & (high <= 2.0 * shape.opening - last + _SOFT)
        # an edge that meets the middle of a pad: the pad is the face of the contact, and has its normal
        rim = (np.abs(begin[:, 0] - 0.5 * (pad[0] + pad[1])) > 0.499 * (pad[1] - pad[0])) | (
            np.abs(begin[:, 2] - 0.5 * (pad[2] + pad[3])) > 0.499 * (pad[3] - pad[2])
        )
        low_n[~rim & (low <= first + _EDGE)] = -along
        high_n[~rim & (high <= 2.0 * shape.opening - last + _EDGE)] = along
        pa, pb = start[a] + low[a, None] * along, start[b] + (2.0 * shape.opening - high[b, None]) * along
        line = pb[None] - pa[:, None]
        line /= np.maximum(np.linalg.norm(line, axis=-1, keepdims=True), 1e-9)
        cone = np.cos(np.arctan(_FRICTION))
        pairs = ((line * -low_n[a][:, None]).sum(-1) >= cone) & ((line * high_n[b][None]).sum(-1) >= cone)
        gap = float(last - first)
        return bool(pairs.any()) and gap <= 2.0 * shape.opening - 0.002 and first > 0.0, gap

    def free(self, grasp: Antipodal) -> bool:
        """Whether no point of the true surface is in the open hand, or it in the table."""
        inside = self._shape.holds(se3.apply(se3.inverse(grasp.T_base_tcp), self._surface))
        return bool(inside.max() <= 0.0)

    def _cast(self, start: Array, along: Array) -> tuple[Array, Array]:
        """Distance (n,) to the shape along rays (inf: none), and outward normal (n, 3) there."""
        best, normal = np.full(len(start), np.inf), np.zeros((len(start), 3))
        for e in self._hulls:
            rate, value = e[:, :3] @ along, start @ e[:, :3].T + e[:, 3]
            with np.errstate(divide="ignore", invalid="ignore"):
                at = -value / rate
            into = np.where(rate < -1e-12, at, -np.inf)
            enter, leave = into.max(axis=1), np.where(rate > 1e-12, at, np.inf).min(axis=1)
            ok = (enter <= leave) & ~((np.abs(rate) <= 1e-12) & (value > 0.0)).any(axis=1) & (enter < best)
            best[ok], normal[ok] = enter[ok], e[into.argmax(axis=1)[ok], :3]
        return best, normal


def _on_surface(corners: Array, step: float = 0.002) -> Array:
    """Points (n, 3) of the surface of a convex part, about `step` apart."""
    hull = ConvexHull(corners)
    found: list[Array] = [corners]
    for a, b, c in corners[hull.simplices]:
        n = max(1, int(np.ceil(max(np.linalg.norm(b - a), np.linalg.norm(c - a)) / step)))
        i, j = (v.ravel() for v in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
        keep = i + j <= n
        found.append(a + (i[keep, None] * (b - a) + j[keep, None] * (c - a)) / n)
    return np.concatenate(found)


class Naive(Search):
    """Random pairs, each in all ways: no order, no coarse stage, no limit."""

    def best(self) -> tuple[Antipodal, ...]:
        """As of `Search`."""
        return self.exhaustive()


def objects(args: argparse.Namespace) -> Iterator[tuple[int, str, Shape]]:
    """Seed, name and parts of each object."""
    files = sorted(Path(args.meshes).glob("*/collision.obj")) if args.meshes else []
    for n in range(args.objects):
        seed = args.first_seed + n
        if files:
            file = files[n % len(files)]
            yield seed, file.parent.name, load_shape(file)
        else:
            yield seed, *make_shape(seed)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--objects", type=int, default=240)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--meshes", default="", help="folder of folders with a collision.obj")
    parser.add_argument("--robot", default="openarm_v1")
    parser.add_argument("--verbose", action="store_true", help="a line for each object whose first grasp is not good")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if args.quick:
        args.objects = min(args.objects, 24)
    studio = Studio(args.robot)
    arm = studio.robot.arm_names[-1]
    hand = HandShape.of(studio.robot, arm, studio.cameras.values())
    times: dict[str, list[float]] = {"ours": [], "naive": []}
    good: dict[str, list[tuple[bool, bool]]] = {"ours": [], "naive": []}
    inside, errors, none, total, stages = list[bool](), list[float](), 0, 0, list[float]()
    warm = True
    for seed, name, shape in objects(args):
        rng = np.random.default_rng([seed, 1])
        rest = studio.settle(shape, rng)
        if rest is None:
            continue
        parts, depth = rest
        view = studio.look(depth, rng)
        if len(view.target) < 60:
            continue
        total += 1
        truth = Truth(parts, hand)
        for kind, search in (("ours", Search), ("naive", Naive)):
            if warm:
                search(fuse([view], studio.table_z), hand, CloudConfig(), ApproachConfig()).best()
            began = time.thread_time()
            surface = fuse([view], studio.table_z)
            fused = time.thread_time()
            engine = search(surface, hand, CloudConfig(), ApproachConfig())
            found = engine.best()
            took = time.thread_time() - began
            times[kind].append(took * 1e3)
            if not found:
                none += kind == "ours"
                if args.verbose and kind == "ours":
                    size = np.ptp(np.concatenate(parts), axis=0) * 1e3
                    print(f"seed {seed} {name} {size.round()} mm: none; {engine.tried}")
                continue
            holds, gap = truth.holds(found[0])
            free = truth.free(found[0])
            good[kind].append((holds, free))
            if kind == "ours":
                stages.append((fused - began) * 1e3)
                low, high = found[0].apertures
                inside.append(low <= gap <= high)
                errors.append((found[0].width - gap) * 1e3)
                if args.verbose and not (holds and free and inside[-1]):
                    print(f"seed {seed} {name}: holds {holds} free {free} gap {gap * 1e3:.1f} width"
                          f" {found[0].width * 1e3:.1f} in {low * 1e3:.1f}..{high * 1e3:.1f}; {took * 1e3:.0f} ms"
                          f" { {k: round(v, 2) for k, v in found[0].parts.items()} }")  # fmt: skip
        warm = False
    ours, naive = np.array(good["ours"]), np.array(good["naive"])
    t, t_naive = np.array(times["ours"]), np.array(times["naive"])
    peer = "random pairs, all ways"
    rows = [
        Row(f"cloud_to_grasps_p{q}_ms", float(np.percentile(t, q)), "ms", "lower", target, peer,
            float(np.percentile(t_naive, q)), total)
        for q, target in ((50, 150.0), (95, 400.0))
    ]  # fmt: skip
    rows.append(Row("of_it_fusing_p50_ms", float(np.median(stages)), "ms", "lower", None, n=total))
    for name, one, other, target in (
        ("top1_holds_share", ours[:, 0].mean(), naive[:, 0].mean(), 0.95),
        ("top1_free_share", ours[:, 1].mean(), naive[:, 1].mean(), 0.95),
        ("top1_good_share", ours.all(axis=1).mean(), naive.all(axis=1).mean(), 0.95),
    ):
        rows.append(Row(name, float(one), "", "higher", target, peer, float(other), len(ours)))
    rows.append(Row("aperture_inside_share", float(np.mean(inside)), "", "higher", 0.95, n=len(inside)))
    rows.append(Row("aperture_error_p50_mm", float(np.nanmedian(errors)), "mm", "near 0", None, n=len(errors)))
    rows.append(Row("none_share", none / total, "", "lower", None, n=total))
    write_report(rows, args.json)


if __name__ == "__main__":
    main()
