# SPDX-License-Identifier: Apache-2.0
"""What a camera says of a thing of any shape: whether its cluster has left its place, and stands where it should.

A box that is fitted to a shape that is none changes with the view. So a cluster is judged by its centroid, its height
and its extent. What the border of the image or the robot cuts off proves nothing: neither that a thing is there, nor
that it has gone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.objects.resting import least_box_middles
from openarm_common.types import Array
from openarm_grasp.config import HeldConfig
from openarm_grasp.evidence.verdicts import CameraVerdict
from openarm_grasp.perception.detections import Frame
from openarm_world.shares import explain, view_of

#: A thing that rests as it rested is as high as before, m, or to this share of its height.
_HEIGHT, _HEIGHT_SHARE = 0.008, 0.08
#: Its largest horizontal extent is as before, m, or to this share of it: another view sees other sides.
_EXTENT, _EXTENT_SHARE = 0.015, 0.15
#: A cluster with a smaller share of the points of the thing is a remainder of something else.
_SAME_THING = 0.3
#: Of the points of a thing that has not moved so many lie where it was, %: the rest may be the edge of the hand.
_MOST = 85.0
#: Fewer points of what hangs in a hand may be of its edge, or of something else.
_FEW = 30
#: Least horizontal part of a closing axis about which an end goes down, least turn, rad, and points that show it.
_LEVEL, _TURNED, _LEAST_POINTS = 0.5, 0.12, 10
#: What a camera over the table sees of a thing wherever it stands: the highest point in each cell of this edge, m.
_CELL = 0.005


@dataclass(frozen=True, eq=False)
class Cluster:
    """What one image shows of one thing; base frame, m.

    Attributes:
        centroid: (3,) middle of its points.
        top: Height of its upper end.
        extent: Largest horizontal distance between two of its points, about.
        points: How many.
        cut: Whether the border of the image, the robot or another thing cuts it.
        upper: (n, 3) its highest points, seen from above; None: they are not known.
    """

    centroid: Array
    top: float
    extent: float
    points: int
    cut: bool = False
    upper: Array | None = None

    @classmethod
    def of(cls, points: Array, *, cut: bool = False) -> Cluster:
        """Measure points (n, 3) or (h, w, 3); those that are not finite are left out.

        Raises:
            OpenArmError: NOTHING_DETECTED, when there is none.
        """
        flat = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        flat = flat[np.isfinite(flat).all(axis=1)]
        if not len(flat):
            raise OpenArmError(Code.NOTHING_DETECTED, "a cluster without finite points, expected at least one")
        turns = np.linspace(0.0, np.pi, 12, endpoint=False)
        along = flat[:, :2] @ np.stack([np.cos(turns), np.sin(turns)])
        # a few points that fly make neither the top nor the extent
        top = float(np.percentile(flat[:, 2], 98.0))
        extent = float(np.ptp(np.percentile(along, (1.0, 99.0), axis=0), axis=0).max())
        return cls(flat.mean(axis=0), top, extent, len(flat), cut, _upper(flat))

    def away_from(self, p: Array) -> float:
        """How far its middle is from (2,) or (3,) a point, seen from above, m.

        The centroid of its points is another one where more of it is seen, or a camera is nearer to a part of it.
        """
        middles = np.empty((0, 2)) if self.upper is None else least_box_middles(self.upper[:, :2])
        middles = middles if len(middles) else self.centroid[None, :2]
        return float(np.linalg.norm(middles - p[:2], axis=1).min())


def judge_gone(before: Array, frames: Sequence[Frame], config: HeldConfig) -> CameraVerdict:
    """Whether an object has left its place: GRASP_MISSED, when it is still there; STALE_DATA, when nothing shows it.

    Args:
        before: (n, 3) points of it as it was before the grasp.
        frames: Taken after the lift; each that shows its place counts.
        config: Thresholds.
    """
    left = _left(before, frames, config)
    if not left:
        what = "no camera frame after the lift" if not frames else "the robot or the border hides where the object was"
        return CameraVerdict(Code.STALE_DATA, f"{what}: nothing shows whether it has gone")
    if min(left) < config.gone:
        text = f"{1.0 - min(left):.0%} of it are still seen at its place, expected less than {1.0 - config.gone:.0%}"
        return CameraVerdict(Code.GRASP_MISSED, text)
    return CameraVerdict(Code.OK, "it has gone from its place")


def stays(before: Array, frames: Sequence[Frame], config: HeldConfig) -> bool:
    """Whether something with such points (n, 3) is still where it was; taken for so, where no frame shows its place."""
    return not any(left >= config.gone for left in _left(before, frames, config))


def _left(before: Array, frames: Sequence[Frame], config: HeldConfig) -> list[float]:
    """Share of the points (n, 3) in view that is seen through, of each frame that shows enough of them."""
    clouds = (frame.cloud for frame in frames if frame.cloud is not None)
    shares = (explain(before, np.eye(4), view_of(cloud.points, cloud.camera)) for cloud in clouds)
    return [one.left for one in shares if one.in_view >= config.in_view]


def judge_held(standing: Array, points: Array, T_now_before: Array, config: HeldConfig) -> CameraVerdict:
    """Whether what hangs in the hand is where it was taken hold of: GRASP_LOST, when it has turned or slipped.

    Moved back to where the hand took hold of it, it is where something was seen, or below that.

    Args:
        standing: (n, 3) voxels of what was seen before, down to the table.
        points: (n, 3) of what is seen of it; few prove nothing.
        T_now_before: (4, 4) how the hand has moved since it took hold.
        config: Thresholds.
    """
    if len(points) < _FEW or not len(standing):
        return CameraVerdict(Code.OK, "the hand hides what it holds")
    out, _ = KDTree(standing).query(se3.apply(se3.inverse(T_now_before), points))
    off, limit = 1e3 * float(np.percentile(out, _MOST)), 1e3 * config.askew
    if off > limit:
        text = f"it reaches {off:.0f} mm out of where the hand should hold it, expected at most {limit:.0f} mm"
        return CameraVerdict(Code.GRASP_LOST, f"it has turned or slipped in the hand: {text}")
    return CameraVerdict(Code.OK, "it is where the hand should hold it")


def heavier_end(before: Array, now: Array, T_base_tcp: Array) -> Array | None:
    """Direction of the end of a thing that hangs lower in the hand than it should: its centre of mass is there.

    What is held away from its centre of mass turns about the closing axis. Kanoulas et al. ("Center-of-mass-based grasp
    pose adaptation using 3D range and force/torque sensing", IJHR 2018) feel that at the wrist; here it is seen.

    Args:
        before: (n, 3) points of it as it lay, base frame.
        now: (n, 3) points of it in the hand, which has been lifted without a turn.
        T_base_tcp: (4, 4) of the hand, whose y axis is the closing axis.

    Returns:
        (2,) unit vector at right angles to the closing axis; None where it has not turned, or the hand closes upright.
    """
    along = np.array([-T_base_tcp[1, 1], T_base_tcp[0, 1]])
    level = float(np.linalg.norm(along))
    if level < _LEVEL or min(len(before), len(now)) < _LEAST_POINTS:
        return None
    along /= level
    turned = _slope(now, along) - _slope(before, along)
    return None if abs(turned) < _TURNED else -np.sign(turned) * along


def _slope(points: Array, along: Array) -> float:
    """Angle of the line through points along a horizontal direction, rad."""
    x, z = points[:, :2] @ along, points[:, 2]
    x = x - x.mean()
    return float(np.arctan2(x @ z, max(float(x @ x), 1e-12)))


def judge_unmoved(before: Array, now: Array, config: HeldConfig, around: Array) -> tuple[bool, str]:
    """Whether a thing still stands where it was seen, as far as the hand above it lets the camera see.

    Args:
        before: (n, 3) points of it as it was seen before.
        now: (n, 3) points of what is seen there now.
        config: Thresholds.
        around: (n, 3) points of what stood around it, which may be seen as one with it now.
    """
    if len(now) < _SAME_THING * len(before) or not len(before):
        return True, "the hand hides the object"
    away, _ = KDTree(np.concatenate([before, around])).query(now)
    off, limit = 1e3 * float(np.percentile(away, _MOST)), 1e3 * config.moved
    if off > limit:
        return False, f"the object has moved: it reaches {off:.0f} mm out of where it stood, expected {limit:.0f}"
    return True, "the object still stands there"


def judge_moved(before: Array, T_after_before: Array, now: Array, tolerance: float) -> CameraVerdict:
    """Whether what was seen of a thing is seen where the hand has moved it to; the thing may have been seen in part.

    The upper side is compared: of other sides a camera over the table sees more or less from place to place.

    Args:
        before: (n, 3) points of it before the grasp.
        T_after_before: (4, 4) how the hand has moved it.
        now: (n, 3) points of what is seen there now.
        tolerance: Greatest distance, m.
    """
    there = _upper(se3.apply(T_after_before, before))
    if not len(now) or not len(there):
        return CameraVerdict(Code.PLACE_FAILED, "nothing is seen where it was put down")
    away, _ = KDTree(now).query(there)
    off, limit = 1e3 * float(np.percentile(away, _MOST)), 1e3 * tolerance
    if off > limit:
        text = f"what was seen of it is {off:.0f} mm from where it was put down, expected at most {limit:.0f} mm"
        return CameraVerdict(Code.PLACE_FAILED, text)
    return CameraVerdict(Code.OK, f"what was seen of it is within {off:.0f} mm of where it was put down")


def is_more(now: Array, before: Array, T_after_before: Array, tolerance: float) -> bool:
    """Whether more of a thing is seen than before, from above; arguments as `judge_moved`."""
    there = _upper(se3.apply(T_after_before, before))
    if not len(now) or not len(there):
        return False
    away, _ = KDTree(there[:, :2]).query(_upper(now)[:, :2])
    return bool(np.percentile(away, _MOST) > tolerance)


def _upper(points: Array) -> Array:
    """Return the highest of the points (n, 3) in each cell, seen from above."""
    order = points[np.argsort(-points[:, 2], kind="stable")]
    _, first = np.unique(np.floor(order[:, :2] / _CELL), axis=0, return_index=True)
    return order[first]


def judge_rests(
    before: Cluster, p_expected: Array, clusters: Sequence[Cluster], tolerance: float, *, leaned: bool = False
) -> CameraVerdict:
    """Whether a thing rests at its target as it rested before the grasp.

    Args:
        before: The thing as it was; one that was cut off proves nothing.
        p_expected: (2,) or (3,) where its middle should be, base frame, m; z is not read.
        clusters: What an image shows that was taken after the arm has left.
        tolerance: Largest horizontal distance, m.
        leaned: It may have lain on something else: it may be lower now, and look longer.
    """
    if before.cut:
        return CameraVerdict(
            Code.PLACE_FAILED, "the object was cut off when it was first seen: its middle is not known"
        )
    reach = tolerance + 0.5 * before.extent
    near = [c for c in clusters if c.points >= _SAME_THING * before.points and c.away_from(p_expected) <= reach]
    whole = [c for c in near if not c.cut]
    if whole:
        nearest = min(whole, key=lambda c: c.away_from(p_expected))
        return _compare(before, nearest, p_expected, tolerance, leaned=leaned)
    why = "is cut off by the border, the robot or another thing" if near else "is not in view"
    return CameraVerdict(Code.PLACE_FAILED, f"the object {why} after the place: nothing shows that it stands there")


def _compare(before: Cluster, now: Cluster, p_expected: Array, tolerance: float, *, leaned: bool) -> CameraVerdict:
    away = now.away_from(p_expected)
    text = f"the cluster is {away * 1e3:.0f} mm from its target"
    if away > tolerance:
        return CameraVerdict(Code.PLACE_FAILED, f"{text}, expected at most {tolerance * 1e3:.0f} mm")
    stood = before.top - _floor(before)
    higher = now.top - before.top
    if abs(higher) > max(_HEIGHT, _HEIGHT_SHARE * stood) and not (leaned and higher < 0.0):
        was = f"it is {abs(higher) * 1e3:.0f} mm {'higher' if higher > 0.0 else 'lower'} than it was"
        return CameraVerdict(Code.PLACE_FAILED, f"the object does not rest as it did: {was}", final=True)
    wider = now.extent - before.extent
    if abs(wider) > max(_EXTENT, _EXTENT_SHARE * before.extent) and not (leaned and wider > 0.0):
        was = f"seen from above it is {abs(wider) * 1e3:.0f} mm {'longer' if wider > 0.0 else 'shorter'} than it was"
        return CameraVerdict(Code.PLACE_FAILED, f"the object does not rest as it did: {was}", final=True)
    return CameraVerdict(Code.OK, text)


def _floor(c: Cluster) -> float:
    """About the height of what it stands on: its points are above that, half of them below their middle, m."""
    return 2.0 * float(c.centroid[2]) - c.top
