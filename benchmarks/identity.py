# SPDX-License-Identifier: Apache-2.0
"""Whether the id of an object lives while a heap is cleared: things are lifted, pushed, hidden for a while.

    python benchmarks/identity.py [--quick] [--heaps N] [--first-seed S] [--json PATH]

Heaps of 5 to 10 household things, seen by the overhead camera with the noise of a D435. At each step the highest thing
is lifted (in 70 % it is seen in the air; how the hand moves is known) and taken away, in half of the steps a neighbour
is pushed, physics moves what loses its hold, and in 40 % a strip as wide as an arm hides a part for one image. The ids
are judged by pixels (`openarm_evaluation.judging.identity`): of things and ids with 100 pixels or more.

    idf1_tracker, switches_tracker, ...       the ids of detections that the detector publishes; peer: the nearest
                                              centre within 5 cm, kept for ever, on the same detections
    idf1_points, ...                          the same where detections are divided among objects, point by point
    idf1_perfect, ...                         perfect ids on the same detections: what segmentation leaves
    merged_..., split_...                     sights of things that share an id with a larger part of another thing, or
                                              of which several ids show a part
    update_p50_ms, update_p95_ms              CPU time of the tracker at an image
    explain_300_us                            CPU time of the question on an object of 300 points, median of the heaps
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from benchmarks.report import Row, write_report
from openarm_common import se3
from openarm_common.camera.depth_view import DepthImage, DepthView
from openarm_common.labelled_cloud import LabelledCloud
from openarm_common.scene.scene import Scene
from openarm_common.types import Array, Ints
from openarm_evaluation.campaign.robot import SimRobot, SimulatedSenses
from openarm_evaluation.campaign.tasks.settle import dropped
from openarm_evaluation.campaign.tasks.things import object_sources
from openarm_evaluation.judging.identity import IdentityScore
from openarm_perception.detection.clouds import smooth_depth
from openarm_perception.geometry.depth import DepthLimits, View
from openarm_world.carried import HeldBoxes
from openarm_world.objects import Objects
from openarm_world.shares import explain

#: Fewest pixels of a thing or an id, and farthest that the nearest centre is looked for, m.
_PIXELS, _NEAR = 100, 0.05
#: Between images, s; of the strip that hides things: width, and height over the table (no thing is so tall), m.
_PERIOD, _STRIP, _OVER = 0.5, 0.10, 0.35
_CAMERA = "overhead"
WAYS = ("tracker", "points", "nearest", "perfect")


@dataclass(frozen=True, eq=False)
class Look:
    """An image of a heap, the true thing of each pixel (h, w), and what a hand holds."""

    view: DepthView
    cloud: LabelledCloud
    body: Ints
    held: Mapping[str, HeldBoxes]


class Lab(SimRobot):
    """A heap in which things can be put anywhere, and what the overhead camera shows of it."""

    def __init__(self, scene: Scene, seed: int) -> None:
        super().__init__(scene, SimulatedSenses(detector="anything"), seed=seed)
        self.model, self.data = self.world.model, self.world.data
        self.bodies = {item.name: self.model.body(item.name).id for item in scene.objects}
        camera = self.cameras[_CAMERA]
        self._renderer = mujoco.Renderer(self.model, camera.height, camera.width)
        self._renderer.enable_segmentation_rendering()
        self._strip: tuple[slice, slice] | None = None

    def draw(self, name: str) -> tuple[NDArray[np.uint8], DepthImage]:
        """As of the robot, with what hides a part."""
        rgb, depth = super().draw(name)
        if self._strip is not None:
            depth = depth.copy()
            depth[self._strip] = round(1e3 * (self.camera_pose(self.cameras[name], self.t_ns)[2, 3] - self._top))
        return rgb, depth

    @property
    def _top(self) -> float:
        return self.table.top_z + _OVER

    def look(self, held: Mapping[str, HeldBoxes], rng: np.random.Generator, hide: bool = False) -> Look:
        """Take an image of how things are."""
        self.images.clear()
        self._strip = None
        if hide:
            camera = self.cameras[_CAMERA]
            width = round(_STRIP * camera.intrinsics.fx / 0.8)
            left = int(rng.integers(camera.width // 4, 3 * camera.width // 4 - width))
            self._strip = slice(0, camera.height), slice(left, left + width)
        frame = self.detect(_CAMERA)
        assert frame is not None
        assert frame.cloud is not None
        one = self.cameras[_CAMERA]
        seen = View(*self.draw(_CAMERA), one.intrinsics, self.camera_pose(one, self.t_ns))
        smooth = smooth_depth(seen, DepthLimits(near=one.near, far=one.far))
        view = DepthView(smooth, one.intrinsics, seen.T_base_camera, one.near, one.far)
        self._renderer.update_scene(self.data, _CAMERA)
        drawn = self._renderer.render()
        geom = np.where(drawn[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM), drawn[..., 0], -1)
        body = np.where(geom >= 0, self.model.geom_bodyid[geom], 0)
        body = np.where(np.isin(body, [*self.bodies.values()]), body, 0)
        if self._strip is not None:
            body[self._strip] = 0
        return Look(view, frame.cloud, body.astype(np.int64), held)

    def pose(self, name: str) -> Array:
        """Pose of a thing (4, 4)."""
        p = self.data.qpos[self.model.joint(name).qposadr[0] :][:7]
        return se3.make(se3.matrix_from_quat_xyzw(np.roll(p[3:], -1)), p[:3])

    def put(self, name: str, T: Array) -> None:
        """Put a thing somewhere, at rest."""
        joint = self.model.joint(name)
        self.data.qpos[joint.qposadr[0] :][:7] = *T[:3, 3], *np.roll(se3.quat_xyzw_from_matrix(T[:3, :3]), 1)
        self.data.qvel[joint.dofadr[0] :][:6] = 0.0
        mujoco.mj_forward(self.model, self.data)

    def carrier(self, name: str) -> dict[str, HeldBoxes]:
        """The box of a thing, as a hand that holds it."""
        body, corners = self.model.body(name), list[Array]()
        for g in range(body.geomadr[0], body.geomadr[0] + body.geomnum[0]):
            middle, half = self.model.geom_aabb[g][:3], self.model.geom_aabb[g][3:]
            box = middle + (np.indices((2, 2, 2)).reshape(3, -1).T * 2.0 - 1.0) * half
            T = se3.make(se3.matrix_from_quat_xyzw(np.roll(self.model.geom_quat[g], -1)), self.model.geom_pos[g])
            corners.append(se3.apply(T, box))
        low, high = np.concatenate(corners).min(axis=0), np.concatenate(corners).max(axis=0)
        size = tuple((high - low).tolist())
        return {name: HeldBoxes(self.pose(name), ((se3.make(None, (low + high) / 2.0), size),))}

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()


def cleared(seed: int) -> Iterator[Look]:
    """Clear a heap, the highest thing first; return the images."""
    rng = np.random.default_rng([seed, 51])
    names, items = object_sources(""), []
    while len(items) < 5:
        chosen = rng.choice(len(names), size=int(rng.integers(5, 11)), replace=False)
        items = dropped([names[k] for k in chosen], Scene().table, (0.27, 0.0), 0.11, rng)
    lab = Lab(Scene(name="heap", objects=tuple(items)), seed)
    here = list(lab.bodies)
    while here:
        name = max(here, key=lambda n: lab.pose(n)[2, 3])
        T0 = lab.pose(name)
        yield lab.look(lab.carrier(name), rng)
        if rng.random() < 0.7:
            lab.put(name, se3.make(None, rng.uniform((-0.05, -0.05, 0.10), (0.05, 0.05, 0.18))) @ T0)
            yield lab.look(lab.carrier(name), rng)
        here.remove(name)
        lab.put(name, se3.make(None, (3.0 + 0.5 * len(here), 4.0, 0.1)))
        if here and rng.random() < 0.5:
            near = min(here, key=lambda n: np.linalg.norm(lab.pose(n)[:3, 3] - T0[:3, 3]))
            angle, speed = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.25, 0.7)
            lab.data.qvel[lab.model.joint(near).dofadr[0] :][:2] = speed * np.cos(angle), speed * np.sin(angle)
        mujoco.mj_step(lab.model, lab.data, nstep=round(0.6 / lab.model.opt.timestep))
        here = [n for n in here if lab.pose(n)[2, 3] > lab.table.top_z - 0.02]
        if rng.random() < 0.4:
            yield lab.look({}, rng, hide=True)
    yield lab.look({}, rng)
    lab.close()


class Nearest:
    """Ids by the nearest centre of a detection, kept for ever."""

    def __init__(self) -> None:
        self._known = dict[int, Array]()

    def ids(self, look: Look) -> Ints:
        """Id of each point of the cloud."""
        cloud, known = look.cloud, list(self._known)
        labels = np.unique(cloud.labels[cloud.labels > 0]).tolist()
        middles = [np.median(cloud.points[cloud.labels == c], axis=0)[:2] for c in labels]
        away = np.array([[np.linalg.norm(self._known[i] - p) for p in middles] for i in known])
        away = away.reshape(len(known), len(labels))
        pairs = zip(*linear_sum_assignment(np.minimum(away, _NEAR)), strict=True)
        found = {labels[b]: known[a] for a, b in pairs if away[a, b] < _NEAR}
        out = np.zeros(len(cloud.labels), np.int64)
        for c, p in zip(labels, middles, strict=True):
            i = found.get(c, len(self._known) + 1)
            self._known[i] = p
            out[cloud.labels == c] = i
        return out


def judge(looks: Sequence[Look], scores: Mapping[str, IdentityScore[int]], times: list[float]) -> None:
    """Give ids in each way to the things of a heap, and judge them."""
    objects, nearest, names = Objects(), Nearest(), dict[str, int]()
    for k, look in enumerate(looks, start=1):
        cloud, lens = look.cloud, look.view.intrinsics
        uv = lens.project(se3.apply(se3.inverse(look.view.T_base_camera), cloud.points))
        u, v = np.rint(uv).astype(np.int64).T
        began = time.process_time()
        objects, sight = objects.update(look.view, cloud, round(k * _PERIOD * 1e9), look.held)
        times.append((time.process_time() - began) * 1e3)
        true = np.zeros(len(cloud.labels), np.int64)
        for c in np.unique(cloud.labels[cloud.labels > 0]).tolist():
            mine = cloud.labels == c
            true[mine] = np.bincount(look.body[v, u][mine]).argmax()
        by_label = {c: names.setdefault(name, len(names) + 1) for c, name in sight.ids.items()}
        of_detection = np.array([by_label.get(c, 0) for c in cloud.labels.tolist()], np.int64)
        on_thing = (look.body > 0) & (np.nan_to_num(look.view.depth) > 0.0)
        for way, ids in zip(WAYS, (of_detection, sight.owner, nearest.ids(look), true), strict=True):
            shown = np.zeros(look.body.shape, np.int64)
            shown[v, u] = ids
            scores[way].add_image(look.body[on_thing], shown[on_thing], _PIXELS)
    for score in scores.values():
        score.close()


def question_us(view: DepthView, points: Array) -> float:
    """CPU time of one question on 300 points, us."""
    some, n = np.resize(points, (300, 3)), 1000
    began = time.process_time()
    for _ in range(n):
        explain(some, np.eye(4), view)
    return (time.process_time() - began) / n * 1e6


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="4 heaps")
    parser.add_argument("--heaps", type=int, default=30)
    parser.add_argument("--first-seed", type=int, default=4000)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    scores = {way: IdentityScore[int]() for way in WAYS}
    times, questions = list[float](), list[float]()
    for seed in range(args.first_seed, args.first_seed + (4 if args.quick else args.heaps)):
        looks = list(cleared(seed))
        judge(looks, scores, times)
        questions.append(question_us(looks[0].view, looks[0].cloud.points[looks[0].cloud.labels > 0]))
    rows = list[Row]()
    n, peer = scores["tracker"].sights, scores["nearest"]
    for way, score in scores.items():
        of_peer = peer if way in ("tracker", "points") else None
        for what, unit, better, target in (
            ("idf1", "", "higher", 0.9), ("switches", "", "lower", None), ("merged", "", "lower", None),
            ("split", "", "lower", None),
        ):  # fmt: skip
            value, other = float(getattr(score, what)), None if of_peer is None else float(getattr(of_peer, what))
            goal = target if of_peer else None
            rows.append(Row(f"{what}_{way}", value, unit, better, goal, "nearest centre" if of_peer else "", other, n))
    for share in (50, 95):
        value = float(np.percentile(times, share))
        rows.append(Row(f"update_p{share}_ms", value, "ms", "lower", 10.0, n=len(times)))
    rows.append(Row("explain_300_us", float(np.median(questions)), "us", "lower", 40.0, n=len(questions)))
    write_report(rows, args.json)


if __name__ == "__main__":
    main()
