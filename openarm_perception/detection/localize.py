# SPDX-License-Identifier: Apache-2.0
"""From a detection in the image to an object in the base frame: position, yaw, size. Usable without ROS.

The base frame has z up; the table is a horizontal plane at a known height, and other level surfaces over it are found
by depth. The object is modelled as a prism on the one under it (a box, an upright cylinder or can): its top gives the
height, the outline of the top centre, yaw and footprint.

The outline is found where neighbouring pixels part. Where the far pixel lies lower, the edge is the ray between the
two, cut with the plane of the top. Points on the sides of the object are on its outline already. So edges are known
to a fraction of a pixel and nothing is eroded. Where the far pixel is nearer to the camera, something hides the object;
such places are left out of the fit. What is no prism (a lying cylinder) gets the smallest rectangle around its points,
and is marked so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from pydantic import Field, model_validator

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.config import Config, metres_by_name
from openarm_common.detection import Detection, kind_of
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_perception.detection.detector import Detection2D, Mask
from openarm_perception.geometry import footprint, plane
from openarm_perception.geometry.depth import Deprojector, DepthLimits, View
from openarm_perception.geometry.levels import find_levels
from openarm_perception.geometry.patch import Patch, cut, denoise

if TYPE_CHECKING:
    from openarm_perception.segmentation.clusters import Cluster

#: As many points of the sides as this are enough; tall objects show thousands.
_SIDE_POINTS = 150
#: What is robot to a larger share is no object on the table.
_MOSTLY = 0.5
#: Fewer pixels, without their border, are the fringe of the robot or of what it holds.
_STICKS_OUT = 6


class LocalizerConfig(Config):
    """What counts as the object in the depth image."""

    min_points: int = Field(default=40, ge=12, description="fewest pixels with depth on the object")
    table_margin: float = Field(default=0.008, gt=0.0, le=0.05, description="what is lower above the table is table, m")
    top_band: float = Field(default=0.003, gt=0.0, le=0.02, description="what lies within this of the top is top, m")
    depth_gate: float = Field(default=0.15, gt=0.0, description="points farther from the median depth are strays, m")
    hidden_step: float = Field(default=0.010, gt=0.0, description="a neighbour nearer by this hides the object, m")
    side_step: float = Field(default=0.015, gt=0.0, description="a lower neighbour within this is a side, m")
    prism_rms: float = Field(
        default=0.0025, gt=0.0, description="an outline farther from its shape (rms) is no prism's, m"
    )
    std_floor: float = Field(default=0.0005, gt=0.0, description="smallest standard deviation of the position, m")
    heights: tuple[str, ...] = Field(
        default=(), description="known heights, as `label=metres`: such objects are located without depth too"
    )
    height_std: float = Field(default=0.002, gt=0.0, le=0.1, description="standard deviation of those heights, m")

    @model_validator(mode="after")
    def _pairs(self) -> LocalizerConfig:
        self.known_heights()
        return self

    def known_heights(self) -> dict[str, float]:
        """Return the known heights by label, m."""
        return metres_by_name(self.heights, "heights", "red=0.05", 0.005, 0.5)


@dataclass(frozen=True, eq=False, kw_only=True)
class LocatedObject(Detection):
    """A detection and how it was located; x along the smaller horizontal edge.

    Attributes:
        source: The detection in the image.
        covariance: (6, 6) of x, y, z, roll, pitch, yaw in the base frame, m and rad.
        points: Pixels with depth that were used.
        visible: Share of the outline of the top that was in view, 0 to 1.
        method: `rectangle` or `circle` through the outline of the top; `bound`: rectangle around all points.
        from_depth: Whether the height was measured by depth; else it is what the configuration says.
    """

    source: Detection2D
    covariance: Array
    points: int
    visible: float
    method: footprint.Kind
    from_depth: bool = True


class Localizer:
    """Finds where detections are.

    Args:
        config: Thresholds of what counts as the object.
        limits: Depths that the camera can be trusted with.
        table_height: Height of the table in the base frame, m.
    """

    def __init__(self, config: LocalizerConfig, limits: DepthLimits, table_height: float) -> None:
        self.config = config
        self.limits = limits
        self.table_height = table_height
        self._heights = config.known_heights()

    def levelled(self, view: View) -> View:
        """Return a view with the surfaces over its table that things stand on."""
        lens, T = view.intrinsics, view.T_base_camera
        smooth, _ = denoise(view.metres(self.limits), 2.0 / (lens.fx + lens.fy))
        points = Deprojector(self.limits).organised(smooth.astype(np.float32), lens) @ T[:3, :3].T.astype(np.float32)
        points += (T[:3, 3] - (0.0, 0.0, self.table_height)).astype(np.float32)
        apart = np.zeros(view.depth.shape, np.bool_) if view.robot is None else view.robot
        return replace(view, levels=find_levels(points, apart, self.config.table_margin))

    def cut(self, found: Detection2D, view: View) -> Patch:
        """Cut out the neighbourhood of a detection, for the methods below; errors as `patch.cut`."""
        return cut(found, view, self.limits, self.config.top_band, self.table_height)

    def locate(self, patch: Patch) -> LocatedObject:
        """Locate the object of a detection.

        Raises:
            OpenArmError: BAD_IMAGE, when the image border cuts the object or depths are missing; NOTHING_DETECTED, when
                nothing rises above the table there, too much of it is hidden, or most of it is the robot.
        """
        found = patch.found
        if found.truncated:
            raise _refusal(found, Code.BAD_IMAGE, " is cut by the border of the image; its size is unknown")
        if found.cluster is not None:
            return self._of_cluster(patch, found.cluster)
        height = next((self._heights[each] for each in found.attributes if each in self._heights), None)
        if height is not None and self._valid(patch).sum() < self.config.min_points:
            return self.locate_on_plane(found, height, patch.intrinsics, patch.T_base_camera)
        if (share := _share_of_robot(patch)) > _MOSTLY:
            raise _robot(found, share)
        solid = self._solid(patch)
        top = self._top_height(patch.points[..., 2][solid], patch.band)
        face = self._top_face(patch, top)
        pixel = float(np.median(patch.z[solid])) / patch.intrinsics.fx
        # not at its borders: where depth jumps, a real sensor reports any value between both sides
        flank = solid & (patch.points[..., 2] < top - patch.band)
        sides = patch.points[cv2.erode(flank.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0, :2]
        sides = sides[:: max(1, len(sides) // _SIDE_POINTS)]
        edges, visible = self._edges(patch, face, flank, top)
        try:
            shape = footprint.fit(np.concatenate([edges, sides]), pixel)
            if shape.rms > self.config.prism_rms:
                shape = footprint.bound(patch.points[solid][:, :2], pixel, pixel)
        except OpenArmError as error:
            raise _refusal(found, error.code, f": {error.message}") from error
        return self._detection(found, shape, (patch.floor, top), int(np.count_nonzero(solid)), visible)

    def _of_cluster(self, patch: Patch, cluster: Cluster) -> LocatedObject:
        """Return what the segmentation has found out already: of a prism its shape, else the box around its points."""
        found, outline, shape = patch.found, cluster.outline, cluster.shape.footprint
        if (share := _share_of_robot(patch)) > _MOSTLY:
            raise _robot(found, share)
        if outline.cut:
            raise _refusal(found, Code.NOTHING_DETECTED, f": its outline is cut by {outline.cut}")
        T = cluster.T_frame_box
        level = replace(shape, centre=T[:2, 3], yaw=math.atan2(T[1, 0], T[0, 0]) if shape.kind != "circle" else 0.0)
        top = float((T @ (0.0, 0.0, 0.5 * cluster.size[2], 1.0))[2])
        return self._detection(found, level, (patch.floor, top), cluster.pixels, 1.0)

    def enclose(self, patch: Patch, withheld: OpenArmError | None = None) -> LocatedObject:
        """Enclose what is visible of a detection that cannot be measured, an obstacle. It is marked as not measured.

        Errors as for `locate`, but what sticks out of the robot and of what it holds is enclosed: an object that has
        slipped in the hand does. What is hidden or beyond the border of the image is not in the box.

        Args:
            patch: Patch of the detection.
            withheld: Why nothing of the frame may be measured: where table and objects seem to be says nothing then.
        """
        solid = self._solid(patch) if withheld is None else self._on_object(patch)
        # at its borders a real sensor reports any depth
        inner = cv2.erode(solid.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        share = _share_of_robot(patch)
        if share > _MOSTLY and (withheld is not None or np.count_nonzero(inner) < _STICKS_OUT):
            raise _robot(patch.found, share)
        points = patch.points[inner if inner.any() else solid]
        top = self._top_height(points[:, 2], patch.band)
        pixel = float(np.median(patch.z[solid])) / patch.intrinsics.fx
        shape = footprint.bound(points[:, :2], pixel, 3.0 * pixel)
        around = self._detection(patch.found, shape, (patch.floor, top), len(points), 0.0)
        kind, code = kind_of(patch.found.kind, around.size), withheld.code if withheld else around.code
        return replace(around, score=patch.found.score, kind=kind, measured=False, code=code)

    def locate_on_plane(
        self, found: Detection2D, height: float, intrinsics: Intrinsics, T_base_camera: Array
    ) -> LocatedObject:
        """Locate the object of a detection without depth: an upright convex prism of known height on the table.

        Args:
            found: Detection in the colour image.
            height: Height of the object, m.
            intrinsics: Intrinsics of the camera.
            T_base_camera: (4, 4) optical frame in the base frame, at the stamp of the image; any attitude.

        Raises:
            OpenArmError: NOTHING_DETECTED, when no such prism has this silhouette.
        """
        camera, top = T_base_camera[:3, 3], self.table_height + height
        middle = plane.intersect(found.centre, intrinsics, T_base_camera, (0.0, 0.0, 1.0), top)
        distance = float(np.linalg.norm(middle - camera))
        pixel = distance / intrinsics.fx
        try:
            points = plane.outline(found, intrinsics, T_base_camera, self.table_height, top, 0.5 * pixel)
            shape = footprint.fit(points, pixel)
            if shape.rms > self.config.prism_rms:
                shape = footprint.bound(points, pixel, 0.0)
        except OpenArmError as error:
            raise _refusal(found, error.code, f": {error.message}") from error
        # a wrong height moves the object along the view: half of it, as its bottom stays where it is
        lean = 0.5 * self.config.height_std * float(np.linalg.norm(middle[:2] - camera[:2])) / (camera[2] - top)
        stds = (math.hypot(shape.centre_std[0], lean), math.hypot(shape.centre_std[1], lean))
        located = self._detection(found, replace(shape, centre_std=stds), (self.table_height, top), 0, 1.0)
        located.covariance[2, 2] = (0.5 * self.config.height_std) ** 2
        return replace(located, from_depth=False)

    @staticmethod
    def _valid(patch: Patch) -> Mask:
        return np.asarray(patch.mask & np.isfinite(patch.z))

    def _on_object(self, patch: Patch) -> Mask:
        """Return points of the object, or of what it stands on around it."""
        found, valid = patch.found, self._valid(patch)
        count = int(np.count_nonzero(valid))
        if count < self.config.min_points:
            text = f" has {count} of {found.area} pixels with a depth of {self.limits.near} to {self.limits.far} m"
            raise _refusal(found, Code.BAD_IMAGE, f"{text}, expected at least {self.config.min_points}")
        gate = np.abs(patch.z - np.median(patch.z[valid])) <= self.config.depth_gate
        return valid & gate

    def _solid(self, patch: Patch) -> Mask:
        """Return points of the object above the surface that it stands on."""
        solid = self._on_object(patch) & (patch.points[..., 2] > patch.floor + self.config.table_margin)
        count = int(np.count_nonzero(solid))
        if count < self.config.min_points:
            text = f" has {count} points above the table (or what is under it) at {patch.floor:.3f} m, expected"
            text += f" at least {self.config.min_points}; is it flat, or is the table height wrong?"
            raise _refusal(patch.found, Code.NOTHING_DETECTED, text)
        return solid

    @staticmethod
    def _top_height(heights: Array, band: float) -> float:
        # the quantile lies on the top as long as the top is a tenth of what is seen; the median takes the noise off
        near_top = np.quantile(heights, 0.95, method="lower")  # of the points: between two there may be none
        return float(np.median(heights[np.abs(heights - near_top) <= band]))

    @staticmethod
    def _top_face(patch: Patch, top: float) -> Mask:
        """Return the largest patch at the height of the top; it is bounded by depth, not colour."""
        grown = cv2.dilate(patch.mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        level = grown & ~patch.robot & (np.abs(patch.points[..., 2] - top) <= patch.band)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(level.astype(np.uint8), connectivity=4)
        return labels == 1 + int(np.argmax(stats[1:count, cv2.CC_STAT_AREA]))

    def _edges(self, patch: Patch, face: Mask, flank: Mask, top: float) -> tuple[Array, float]:
        """Return points (n, 2) on the edges of the top, base frame, m, and the share of its outline that is in view.

        An edge lies between the face and what is far from it, or what belongs to the `flank`.
        """
        h, w = face.shape
        camera = patch.T_base_camera[:3, 3]
        found: list[Array] = []
        seen = hidden = 0
        margin = self.config.table_margin
        for dv, du in ((0, -1), (0, 1), (-1, 0), (1, 0)):
            v, u = np.nonzero(face)
            inside = (v + dv >= 0) & (v + dv < h) & (u + du >= 0) & (u + du < w)
            hidden += int(np.count_nonzero(~inside))
            v, u = v[inside], u[inside]
            parted = ~face[v + dv, u + du]
            v, u = v[parted], u[parted]
            near, far = (v, u), (v + dv, u + du)
            step = patch.z[far] - patch.z[near]
            hides = (step < -self.config.hidden_step) | patch.robot[far]
            hidden += int(np.count_nonzero(hides))
            distance = np.linalg.norm(patch.points[far] - patch.points[near], axis=1)
            # a near neighbour is a hole in the mask, another colour or a side of the object: no silhouette
            close = (distance <= self.config.side_step) & (patch.points[far][:, 2] > patch.floor + margin)
            seen += int(np.count_nonzero(~hides))
            ridge = flank[far] & close & ~hides
            edge = ~(close | hides) | ridge
            ray = 0.5 * (patch.rays[near] + patch.rays[far])[edge]
            # the face goes on down the flank as far as heights count as top
            height = np.where(ridge[edge], top - patch.band, top)
            found.append(camera[:2] + ray[:, :2] * ((height - camera[2]) / ray[:, 2])[:, None])
        return np.concatenate(found), seen / max(seen + hidden, 1)

    def _detection(
        self, found: Detection2D, shape: footprint.Footprint, ends: tuple[float, float], count: int, visible: float
    ) -> LocatedObject:
        floor, top = ends
        # lower only where heights say nothing
        height = max(top - floor, self.config.table_margin)
        R = se3.rot_z(shape.yaw)
        T = se3.make(R, (*shape.centre, floor + height / 2.0))
        std = np.maximum([*shape.centre_std, 0.5 * self.config.std_floor], self.config.std_floor)
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = R @ np.diag(std**2) @ R.T
        covariance[5, 5] = shape.yaw_std**2
        size = np.array([*shape.size, height])
        kind = kind_of(_shape(found, shape.kind), size)
        return LocatedObject(
            found.name, found.score * visible, T, size, shape.kind == "circle", kind, color=found.color,
            source=found, covariance=covariance, points=count, visible=visible, method=shape.kind,
        )  # fmt: skip


def _shape(found: Detection2D, method: footprint.Kind) -> str:
    """Name the shape: by the network, else by the outline."""
    outline = {"rectangle": "box", "circle": "cylinder"}.get(method, "")
    # no box has a round outline; that of a cylinder that lies is a rectangle
    return outline if found.kind == "" or (found.kind, outline) == ("box", "cylinder") else found.kind


def _share_of_robot(patch: Patch) -> float:
    return float(np.count_nonzero(patch.robot & patch.coloured)) / patch.found.area


def _robot(found: Detection2D, share: float) -> OpenArmError:
    text = f" is to {share:.0%} the robot or what it holds; it does not stand on the table"
    return _refusal(found, Code.NOTHING_DETECTED, text)


def _refusal(found: Detection2D, code: Code, text: str) -> OpenArmError:
    return OpenArmError(code, f"{found.label} at pixel ({found.centre[0]:.0f}, {found.centre[1]:.0f}){text}")
