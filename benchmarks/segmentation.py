# SPDX-License-Identifier: Apache-2.0
"""Segmentation of labelled organised clouds, compared with Euclidean clustering over the plane, in the same run.

    python benchmarks/segmentation.py FOLDER [--support LABELS] [--repeats N] [--pictures OUT] [--perturb] [--json PATH]

FOLDER holds organised PCD files with the fields `label`, x, y, z and, if they have it, rgb or rgba. Every found segment
is matched to one label by the Hungarian method on F (Dave, Tokmakov, Ramanan 2019; Xie et al., UOIS 2021); pixels in
common, found and labelled are summed over all scenes. Nothing of a label goes into the segmentation, which finds the
plane itself. Label 0 is no object; --support says which others are none (comma-separated). Without it that is the label
of more than half of the labelled points, if they lie in one plane: the table.

    precision, recall, f_measure   in percent, of pixels
    over_075                       share of labelled objects whose segment has F >= 0.75, percent
    frame_ms                       CPU time of one frame, median: from points to clusters with outline and shape

    f_measure_NAME, over_075_NAME  with --perturb: of the same clouds with more noise, mirrored, cropped, at half the
                                   resolution, seen by a camera that is turned by 5 to 15 deg, with patches missing

The peer is what PCL's tutorial does: plane by RANSAC, voxels of 5 mm, points within 20 mm joined, at least 100.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from benchmarks.report import Row, write_report
from openarm_common import se3
from openarm_common.types import Array
from openarm_perception.frames.cloud_fields import Cloud
from openarm_perception.frames.clouds import intrinsics_of
from openarm_perception.frames.pcd import read_pcd
from openarm_perception.segmentation.clusters import segment
from openarm_perception.segmentation.draw import overlay

Label = NDArray[np.int64]
_VOXEL, _TOLERANCE, _LEAST, _PLANE = 0.005, 0.02, 100, 0.01


@dataclass(frozen=True)
class Score:
    """Pixels in common, found and labelled; objects with F of at least 0.75, and all."""

    common: float
    found: float
    labelled: float
    good: int
    objects: int

    def __add__(self, other: Score) -> Score:
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Score(*(a + b for a, b in pairs))

    @property
    def precision(self) -> float:
        """Percent."""
        return 100.0 * self.common / max(self.found, 1.0)

    @property
    def recall(self) -> float:
        """Percent."""
        return 100.0 * self.common / max(self.labelled, 1.0)

    @property
    def f(self) -> float:
        """Percent."""
        return 200.0 * self.common / max(self.found + self.labelled, 1.0)

    @property
    def share(self) -> float:
        """Of objects with F of at least 0.75, percent."""
        return 100.0 * self.good / max(self.objects, 1)


def score(found: Label, true: Label) -> Score:
    """Compare two label images (h, w), 0: nothing."""
    ours, a = np.unique(found, return_inverse=True)
    labels, b = np.unique(true, return_inverse=True)
    table = np.bincount(a.ravel() * len(labels) + b.ravel(), minlength=len(ours) * len(labels))
    table = table.reshape(len(ours), len(labels)).astype(np.float64)
    n_found, n_true = table.sum(axis=1)[ours != 0], table.sum(axis=0)[labels != 0]
    common = table[ours != 0][:, labels != 0]
    F = 2.0 * common / np.maximum(n_found[:, None] + n_true[None], 1.0)
    rows, columns = linear_sum_assignment(-F)
    best = F[rows, columns]
    return Score(common[rows, columns].sum(), n_found.sum(), n_true.sum(), int((best >= 0.75).sum()), len(n_true))


def objects_of(cloud: Cloud, support: tuple[int, ...] | None) -> Label:
    """Return the labels (h, w) of objects, 0 elsewhere."""
    if cloud.label is None:
        raise SystemExit("a cloud has no field `label`")
    label = cloud.label.copy()
    seen = np.isfinite(cloud.points[..., 2])
    label[~seen] = 0
    if support is None:
        names, counts = np.unique(label[label != 0], return_counts=True)
        support = ()
        if len(names) and counts.max() > 0.5 * np.count_nonzero(seen):
            points = cloud.points[label == names[counts.argmax()]].astype(np.float64)
            if np.sqrt(np.linalg.eigvalsh(np.cov(points.T))[0]) < 0.015:
                support = (int(names[counts.argmax()]),)
    label[np.isin(label, support)] = 0
    return label


def ours(cloud: Cloud) -> Label:
    """The suite's."""
    return segment(cloud.points, intrinsics_of(cloud.points), rgb=cloud.rgb).label.astype(np.int64)


def euclidean(cloud: Cloud) -> Label:
    """PCL's tutorial on Euclidean cluster extraction."""
    seen = np.isfinite(cloud.points[..., 2])
    points = cloud.points[seen].astype(np.float64)
    normal, offset = _ransac(points[:: max(1, len(points) // 20_000)])
    height = points @ normal + offset
    over = np.nonzero(height > _PLANE)[0]
    _, voxel = np.unique(np.floor(points[over] / _VOXEL).astype(np.int64), axis=0, return_inverse=True)
    voxel = voxel.ravel()
    count = int(voxel.max()) + 1 if len(voxel) else 0
    if not count:
        return np.zeros(seen.shape, np.int64)
    size = np.bincount(voxel)
    middle = np.stack([np.bincount(voxel, weights=points[over, i]) / size for i in range(3)], axis=-1)
    a, b = cKDTree(middle).query_pairs(_TOLERANCE, output_type="ndarray").T
    part = connected_components(coo_matrix((np.ones(len(a)), (a, b)), (count, count)), directed=False)[1][voxel]
    part = np.where(np.bincount(part)[part] >= _LEAST, part + 1, 0)
    flat = np.zeros(len(points), np.int64)
    flat[over] = part
    out = np.zeros(seen.shape, np.int64)
    out[seen] = flat
    return out


def _ransac(points: Array) -> tuple[Array, float]:
    random = np.random.default_rng(0)
    a, b, c = points[random.integers(0, len(points), (3, 300))]
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    offsets = -np.sum(normals * a, axis=1)
    votes = np.count_nonzero(np.abs(points @ normals.T + offsets) < _PLANE, axis=0)
    best = int(votes.argmax())
    sign = 1.0 if offsets[best] > 0.0 else -1.0
    return sign * normals[best], sign * float(offsets[best])


def _only(cloud: Cloud, keep: object) -> Cloud:
    """Return rows and columns of a cloud."""
    parts = (None if v is None else np.ascontiguousarray(v[keep]) for v in (cloud.points, cloud.rgb, cloud.label))
    return Cloud(*parts)  # type: ignore[arg-type]


def _mirrored(cloud: Cloud) -> Cloud:
    out = _only(cloud, np.s_[:, ::-1])
    return replace(out, points=out.points * np.array([-1.0, 1.0, 1.0], np.float32))


def _noisy(cloud: Cloud, rng: np.random.Generator) -> Cloud:
    """Add noise along the rays, deviation 1.5 mm at 1 m and growing with the square, equal over 2 x 2 pixels."""
    z = cloud.points[..., 2]
    coarse = rng.standard_normal(((z.shape[0] + 1) // 2, (z.shape[1] + 1) // 2)).astype(np.float32)
    noise = coarse.repeat(2, axis=0).repeat(2, axis=1)[: z.shape[0], : z.shape[1]]
    return replace(cloud, points=cloud.points * (1.0 + 0.0015 * z * noise)[..., None])


def _turned(cloud: Cloud, axis: int, degrees: float) -> Cloud:
    """Turn the camera in its place: of a pinhole camera a homography, whatever the depth."""
    lens = intrinsics_of(cloud.points)
    K = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
    rotation = (se3.rot_x, se3.rot_y, se3.rot_z)[axis](np.radians(degrees))
    H = K @ rotation.T @ np.linalg.inv(K)  # from the new image to the old one
    v, u = np.indices(cloud.points.shape[:2])
    x, y, w = np.tensordot(H, np.stack([u, v, np.ones_like(u)]), axes=1)
    i, j = np.round(y / w).astype(np.int64), np.round(x / w).astype(np.int64)
    inside = (i >= 0) & (j >= 0) & (i < u.shape[0]) & (j < u.shape[1])
    out = _only(cloud, (np.where(inside, i, 0), np.where(inside, j, 0)))
    # each pixel keeps its distance along its own ray
    p = out.points @ rotation.T.astype(np.float32)
    rays = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(u.shape)], axis=-1)
    return replace(out, points=np.where(inside[..., None], p[..., 2:] * rays, np.nan).astype(np.float32))


def _holed(cloud: Cloud, rng: np.random.Generator) -> Cloud:
    """Take 40 patches of up to 30 x 30 pixels and a twentieth of all pixels away."""
    points = cloud.points.copy()
    height, width = points.shape[:2]
    for _ in range(40):
        v, u, h, w = rng.integers(0, (height, width, 30, 30))
        points[v : v + h, u : u + w] = np.nan
    points[rng.random((height, width)) < 0.05] = np.nan
    return replace(cloud, points=points)


def _cropped(cloud: Cloud) -> Cloud:
    height, width = cloud.points.shape[:2]
    return _only(cloud, np.s_[height // 8 : -height // 8, width // 8 : -width // 8])


#: By name; what is drawn is the same for every cloud.
PERTURBATIONS: Mapping[str, Callable[[Cloud], Cloud]] = {
    "noise": lambda cloud: _noisy(cloud, np.random.default_rng(1)),
    "mirrored": _mirrored,
    "cropped": _cropped,
    "half": lambda cloud: _only(cloud, np.s_[::2, ::2]),
    **{
        f"turned_{'xyz'[axis]}{degrees:+d}": partial(_turned, axis=axis, degrees=degrees)
        for axis, degrees in ((0, -15), (0, 10), (1, 5), (1, -15), (2, 15))
    },
    "holes": lambda cloud: _holed(cloud, np.random.default_rng(2)),
    "noise_half_holes": lambda cloud: _holed(
        _only(_noisy(cloud, np.random.default_rng(3)), np.s_[::2, ::2]), np.random.default_rng(4)
    ),
}


def perturbed(files: Sequence[Path], support: tuple[int, ...] | None) -> list[Row]:
    """Measure on the clouds of files, changed in every way."""
    rows: list[Row] = []
    for name, change in PERTURBATIONS.items():
        total = Score(0, 0, 0, 0, 0)
        for file in files:
            cloud = read_pcd(file)
            true = objects_of(cloud, support)  # the table is known by all of its points
            changed = change(replace(cloud, label=true.astype(np.uint32)))
            total += score(ours(changed), objects_of(changed, ()))
        rows.append(Row(f"f_measure_{name}", total.f, "%", "higher", 80.0, n=len(files)))
        rows.append(Row(f"over_075_{name}", total.share, "%", "higher", None, n=total.objects))
    return rows


def timed(work: Callable[[Cloud], Label], cloud: Cloud, repeats: int) -> tuple[Label, float]:
    """Return the labels and the shortest CPU time, ms."""
    label, best = np.zeros((0, 0), np.int64), np.inf
    for _ in range(repeats):
        begin = time.thread_time()
        label = work(cloud)
        best = min(best, time.thread_time() - begin)
    return label, best * 1e3


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--support", default=None, help="labels that are no objects, comma-separated; 0 is none anyway")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--pictures", type=Path, default=None, help="folder for what was found and what is labelled")
    parser.add_argument("--perturb", action="store_true", help="also on changed clouds")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args()
    files = sorted(args.folder.glob("*.pcd"))
    if not files:
        raise SystemExit(f"no PCD files in {args.folder}")
    support = None if args.support is None else tuple(int(v) for v in args.support.split(",") if v)
    ours(read_pcd(files[0]))  # compiled
    total = {"ours": Score(0, 0, 0, 0, 0), "peer": Score(0, 0, 0, 0, 0)}
    times: dict[str, list[float]] = {"ours": [], "peer": []}
    for file in files:
        cloud = read_pcd(file)
        true = objects_of(cloud, support)
        line = f"{file.name:16s}"
        for name, work in (("ours", ours), ("peer", euclidean)):
            found, ms = timed(work, cloud, args.repeats)
            one = score(found, true)
            total[name] += one
            times[name].append(ms)
            line += f"  {name}: P {one.precision:5.1f} R {one.recall:5.1f} F {one.f:5.1f} good {one.good}/{one.objects}"
            line += f" found {len(np.unique(found)) - 1} {ms:4.0f} ms"
            if name == "ours" and args.pictures is not None:
                args.pictures.mkdir(parents=True, exist_ok=True)
                rgb = cloud.rgb if cloud.rgb is not None else np.zeros((*true.shape, 3), np.uint8)
                pair = np.hstack([overlay(rgb, found), overlay(rgb, true)])
                cv2.imwrite(str(args.pictures / f"{file.stem}.png"), np.ascontiguousarray(pair[..., ::-1]))
        print(line)
    a, b = total["ours"], total["peer"]
    peer, n = "Euclidean clustering", len(files)
    write_report(
        [
            Row("precision", a.precision, "%", "higher", None, peer, b.precision, n),
            Row("recall", a.recall, "%", "higher", None, peer, b.recall, n),
            Row("f_measure", a.f, "%", "higher", 80.0, peer, b.f, n),
            Row("over_075", a.share, "%", "higher", None, peer, b.share, a.objects),
            Row(
                "frame_ms",
                float(np.median(times["ours"])),
                "ms",
                "lower",
                None,
                peer,
                float(np.median(times["peer"])),
                n,
            ),
            *(perturbed(files, support) if args.perturb else ()),
        ],
        args.json,
    )


if __name__ == "__main__":
    main()
