# SPDX-License-Identifier: Apache-2.0
"""What is found in a recorded frame: table, pictures, page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.depth_view import DepthView
from openarm_common.errors import Code, OpenArmError
from openarm_common.figures import data_uri, render_page
from openarm_common.labelled_cloud import LabelledCloud
from openarm_common.types import Array
from openarm_perception.detection.detector import ColorDetector, Detection2D
from openarm_perception.frames.images import Frame
from openarm_perception.geometry.depth import UNLIMITED, DepthLimits, Points
from openarm_perception.geometry.patch import smoothed
from openarm_perception.segmentation.clusters import Cluster, Segmentation, segment
from openarm_perception.segmentation.divide import SegmentationConfig
from openarm_perception.segmentation.draw import depth_picture, label_picture, overlay
from openarm_world.objects import Objects

#: Points that are asked whether they lie below the support, and so deep, m.
_ASKED, _BELOW = 20_000, 0.02
#: Metres of a count of depth by other sensors, of integers; and of floats that are no metres.
_UNITS = {0.0001: "D405", 0.0002: "TUM's 5000 a metre", 0.00025: "L515", 0.01: "centimetres"}
_OF_FLOATS = {0.001: "millimetres", 0.01: "centimetres"}
#: Table tops are seen from within these, m.
_NEAR, _FAR = 0.15, 1.5
#: What counts as a thing.
_CONFIG = SegmentationConfig()
#: A thing has a colour when so many of its pixels have it.
_COLORED = 0.5


@dataclass(frozen=True, eq=False)
class Found:
    """A frame and what was found in it.

    Attributes:
        frame: The frame.
        segmentation: Things in depth.
        detections: Things in colour.
        colors: Name of the colour of each cluster; empty where it has none of the palette.
        T_base_camera: (4, 4), where the pose of the camera is known: points are in the base frame then, else in the
            optical one.
        ids: Id of the object of each cluster, by its number; none where only one frame was taken.
    """

    frame: Frame
    segmentation: Segmentation
    detections: tuple[Detection2D, ...]
    colors: tuple[str, ...]
    T_base_camera: Array | None
    ids: Mapping[int, str] = field(default_factory=dict[int, str])

    @property
    def placed(self) -> bool:
        """Whether the pose of the camera is known."""
        return self.T_base_camera is not None

    def cluster_of(self, found: Detection2D) -> int:
        """Return the number of the cluster that has most pixels of a detection; 0: none has half of them."""
        (u, v), (w, h) = found.origin, found.size
        inside = self.segmentation.label[v : v + h, u : u + w][found.mask]
        count = np.bincount(inside, minlength=1)
        best = int(count.argmax())
        return best if 2 * count[best] >= len(inside) else 0

    def hidden(self) -> float:
        """Return the share of the points that the support would hide from a camera, 0 to 1: a sign of other axes."""
        support, points = self.segmentation.support, self.frame.points.reshape(-1, 3)
        points = points[np.isfinite(points[:, 2])]
        points = points[:: max(1, len(points) // _ASKED)].astype(np.float64)
        below = points[points @ support.normal + support.offset < -_BELOW]
        return float(np.count_nonzero(support.outside(below) < -_BELOW)) / max(len(points), 1)

    @property
    def depths(self) -> tuple[float, float]:
        """The 5th and 95th percentile of the depths that count, m."""
        first, last = np.nanpercentile(self.frame.points[..., 2], (5.0, 95.0))
        return float(first), float(last)

    @property
    def spacing(self) -> tuple[float, float]:
        """Distances of neighbouring points at those depths, m."""
        first, last = self.depths
        return first * self._pixel, last * self._pixel

    @property
    def least(self) -> float:
        """What is smaller than this across at the farther of these depths is no thing, m."""
        return max(_CONFIG.least_size, math.sqrt(_CONFIG.least_pixels) * self.spacing[1])

    @property
    def _pixel(self) -> float:
        """Metres across of a pixel at 1 m."""
        return 2.0 / (self.frame.intrinsics.fx + self.frame.intrinsics.fy)

    def known_to(self, one: Cluster) -> float:
        """Return how exactly the size of a cluster is known, m.

        An edge of a prism lies between two rows of points; the box around anything else ends at single ones of them.
        """
        z = float(np.median(self.frame.points[one.window][one.mask, 2]))
        prism = one.shape.kind != "unknown"
        return 1.5 * self._pixel * z if prism else 2.0 * (self._pixel * z + self.segmentation.support.noise * z * z)

    def unit_hint(self) -> str:
        """Say which other unit of depth would fit, where it is far or near for a table top; "" where it is not."""
        return _other_units(self.frame.points[..., 2], self.frame.assumed)

    def as_json(self) -> dict[str, Any]:
        """Return what was found; m, pixels, degrees of the colour wheel as names."""
        support = self.segmentation.support
        lens = self.frame.intrinsics
        return {
            "frame": "base" if self.placed else "camera",
            "depths": [round(v, 4) for v in self.depths],
            "spacing": [round(v, 5) for v in self.spacing],
            "intrinsics": {name: round(float(getattr(lens, name)), 3) for name in ("fx", "fy", "cx", "cy")},
            "support": {
                "normal": [round(float(v), 5) for v in support.normal], "offset": round(support.offset, 5),
                "noise_at_1m": round(support.noise, 6), "share": round(support.share, 4),
            },
            "clusters": self._clusters(),
            "detections": [
                {
                    "label": one.label, "score": round(one.score, 4), "centre": list(one.centre),
                    "size": list(one.size), "cluster": self.cluster_of(one),
                }
                for one in self.detections
            ],
        }  # fmt: skip

    def as_seen(self, t: float) -> dict[str, object]:
        """Return the clusters of the frame of a sequence, t s after its first one."""
        return {"t": round(t, 3), "clusters": self._clusters()}

    def _clusters(self) -> list[dict[str, Any]]:
        named = zip(self.segmentation.clusters, self.colors, strict=True)
        return [self._cluster(one, color) for one, color in named]

    def _cluster(self, one: Cluster, color: str) -> dict[str, Any]:
        return {
            "id": one.id, "object": self.ids.get(one.id, ""), "pixels": one.pixels,
            "centre": [round(float(v), 5) for v in one.T_frame_box[:3, 3]],
            "size": [round(float(v), 5) for v in one.size], "known_to": round(self.known_to(one), 5),
            "shape": one.shape.kind, "why": one.shape.why,
            "color": color, "rgb": None if one.color is None else list(one.color),
            "cut": one.outline.cut, "outline": {name: round(v, 4) for name, v in vars(one.outline).items()},
        }  # fmt: skip

    def rows(self) -> list[tuple[str, ...]]:
        """Return a row of text for each cluster: number, object, colour, shape, edges, to what, place, pixels, why."""
        out: list[tuple[str, ...]] = []
        for one, color in zip(self.segmentation.clusters, self.colors, strict=True):
            edges = " x ".join(f"{edge * 1e3:.0f}" for edge in one.size)
            place = " ".join(f"{v:+.3f}" for v in one.T_frame_box[:3, 3])
            exact, thing = f"{max(1.0, self.known_to(one) * 1e3):.0f}", self.ids.get(one.id, "")
            row = (str(one.id), thing, color, one.shape.kind, edges, exact, place, str(one.pixels), one.shape.why)
            out.append(row)
        return out

    def write(self, folder: Path) -> tuple[Path, ...]:
        """Write pictures, the label image (16 bits, PNG) and a page into a folder; return their paths."""
        label = self.segmentation.label
        rgb = self.frame.rgb
        z = self.frame.points[..., 2]
        depth = depth_picture(z)
        pictures = {
            "overlay": overlay(depth if rgb is None else rgb, label, numbers=True),
            "labels": label_picture(label),
            "depth": depth,
        }
        if rgb is not None:
            pictures["color"] = rgb
        files = {f"{name}.png": _png(picture[..., ::-1]) for name, picture in pictures.items()}
        page = render_page(
            Path(__file__).with_name("found.html"),
            rows=self.rows(),
            detections=[(one.label, f"{one.score:.2f}", self.cluster_of(one) or "") for one in self.detections],
            support=self.segmentation.support,
            frame="base frame" if self.placed else "optical frame of the camera",
            pictures={name: data_uri(files[f"{name}.png"], "image/png") for name in pictures},
        )
        files["label.png"] = _png(label)
        files["index.html"] = page.encode()
        for name, data in files.items():
            (folder / name).write_bytes(data)
        return tuple(folder / name for name in files)


def find(
    frame: Frame,
    limits: DepthLimits,
    colors: ColorDetector,
    T_base_camera: Array | None = None,
    background: Points | None = None,
) -> Found:
    """Segment a frame, and detect what has a colour of the palette.

    Args:
        frame: The frame, with all that was measured.
        limits: Depths that count.
        colors: Finds and names colours.
        T_base_camera: (4, 4) optical frame in a frame whose z points up; None: not known.
        background: (h, w, 3) points of the empty scene; None: not known.

    Raises:
        OpenArmError: NOTHING_DETECTED, when there is no plane that things may stand on, with the depths that there are;
            BAD_IMAGE, for a background of another size.
    """
    measured, frame = frame.points[..., 2], replace(frame, points=_within(frame.points, limits))
    try:
        result = segment(
            frame.points, frame.intrinsics, _CONFIG, rgb=frame.rgb, T_base_camera=T_base_camera,
            background=None if background is None else _within(background, limits),
        )  # fmt: skip
    except OpenArmError as error:
        if error.code is not Code.NOTHING_DETECTED:
            raise
        hints = (_other_units(measured, frame.assumed), _depths(measured, limits))
        raise OpenArmError(error.code, "; ".join([error.message, *filter(None, hints)])) from error
    rgb = frame.rgb
    if rgb is None:
        return Found(frame, result, (), ("",) * len(result.clusters), T_base_camera)
    named = [colors.name(np.ascontiguousarray(rgb[one.window]), one.mask) for one in result.clusters]
    names = tuple(name if share >= _COLORED else "" for name, share in named)
    return Found(frame, result, colors.detect(rgb), names, T_base_camera)


def followed(objects: Objects, found: Found, t_ns: int) -> tuple[Objects, Found]:
    """Return objects after a frame of a camera that stands still, and the frame with their ids.

    Args:
        objects: After the frame before.
        found: Objects of the frame.
        t_ns: Stamp of the frame.
    """
    T = np.eye(4) if found.T_base_camera is None else found.T_base_camera
    z, lens = found.frame.points[..., 2], found.frame.intrinsics
    every = found.segmentation.clusters
    points = np.concatenate([np.empty((0, 3), np.float32), *(one.points for one in every)])
    labels = np.repeat(np.array([one.id for one in every], np.uint32), [len(one.points) for one in every])
    view = DepthView(smoothed(z, lens), lens, T, UNLIMITED.near, UNLIMITED.far)
    objects, sight = objects.update(view, LabelledCloud(points, labels, T[:3, 3]), t_ns)
    return objects, replace(found, ids=sight.ids)


def _within(points: Points, limits: DepthLimits) -> Points:
    """Return points, NaN where their depth does not count."""
    z = points[..., 2]
    return np.where(((z >= limits.near) & (z <= limits.far))[..., None], points, np.float32(np.nan))


def _depths(z: NDArray[np.float32], limits: DepthLimits) -> str:
    """Say which depths were measured, how many of them count, and what to type so that they do."""
    there = z[np.isfinite(z)]
    if not there.size:
        return "no pixel has a depth"
    first, last = (float(v) for v in np.percentile(there, (5.0, 95.0)))
    share = float(np.mean((there >= limits.near) & (there <= limits.far)))
    near = f" --near {max(math.floor(first * 95.0), 1) / 100.0:g}" if first < limits.near else ""
    far = f" --far {math.ceil(last * 10.5) / 10.0:g}" if last > limits.far else ""
    text = f"depths are {first:.3g} to {last:.3g} m (5th to 95th percentile), of which {share:.0%} lie within"
    return f"{text} --near {limits.near:g} and --far {limits.far:g}" + (f": type{near}{far}" if near or far else "")


def _other_units(z: NDArray[np.float32], count: float | None) -> str:
    """Say which units of other sensors would put depths (h, w) on a table top; "" where they are, or the unit is known.

    Args:
        z: Depths by the assumed unit, m.
        count: Metres of a count that were assumed; None where that is known.
    """
    there = z[np.isfinite(z)]
    if count is None or not there.size or _NEAR <= (middle := float(np.median(there))) <= _FAR:
        return ""
    fit = [
        f"--depth-scale {unit:g} ({whose}) makes it {middle * unit / count:.2g} m"
        for unit, whose in (_OF_FLOATS if count == 1.0 else _UNITS).items()
        if _NEAR <= middle * unit / count <= _FAR
    ]
    if not fit:
        return ""
    return f"the median depth is {middle:.3g} m at {count:g} m a count: where that is wrong, {', '.join(fit)}"


def _png(picture: Any) -> bytes:
    done, data = cv2.imencode(".png", np.ascontiguousarray(picture))
    assert done
    return bytes(data)
