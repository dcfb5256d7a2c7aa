# SPDX-License-Identifier: Apache-2.0
"""What a camera says of an object: whether it has left its place, hangs in the hand, and stands where it should.

Its points are judged, whatever its shape: how many of them are seen, seen through, or hidden, where it stood or where
the hand has moved it. What the border of the image or the robot hides proves nothing: neither that an object is there,
nor that it has gone.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from scipy.spatial import KDTree

from openarm_common import se3
from openarm_common.errors import Code
from openarm_common.labelled_cloud import LabelledCloud
from openarm_common.types import Array
from openarm_grasp.config import HeldConfig
from openarm_grasp.evidence.verdicts import CameraVerdict
from openarm_grasp.perception.detections import Frame
from openarm_world.config import WorldConfig
from openarm_world.shares import Shares, explain, fit, view_of

#: From which shares on an object is judged, and has left its place.
_WORLD = WorldConfig()
#: What rests as it rested is as high as before, m.
AS_HIGH = 0.005
#: What has moved by 8 mm, or rests otherwise, is seen through by more than this share; what stands under a hand is not.
_MOVED = 0.1
#: What is less in view is not judged: from another side, a third may be.
_SHOWN = 0.3
#: A motion is fitted to so much, horizontally, m (95 %): a face that the camera looks along is seen through by less.
_FITTED = 0.003
#: Of the points of a thing that has not moved so many lie where it was, %: the rest may be the edge of the hand.
_MOST = 85.0
#: Fewer points of what hangs in a hand may be of its edge, or of something else.
_FEW = 30
#: Least horizontal part of a closing axis about which an end goes down, least turn, rad, and points that show it.
_LEVEL, _TURNED, _LEAST_POINTS = 0.5, 0.12, 10


def judge_gone(before: Array, frames: Sequence[Frame], lift: Array) -> CameraVerdict:
    """Whether an object has left its place: GRASP_MISSED, when it is still there; STALE_DATA, when nothing shows it.

    Args:
        before: (n, 3) points of it as it was before the grasp.
        frames: Taken after the lift; each that shows its place counts, and where the hand has it, that.
        lift: (3,) how far the hand has come since it took hold, m.
    """
    left = _left(before, frames, se3.make(p=lift))
    if not left:
        what = "no camera frame after the lift" if not frames else "the robot or the border hides where the object was"
        return CameraVerdict(Code.STALE_DATA, f"{what}: nothing shows whether it has gone")
    if min(left) < _WORLD.gone:
        text = f"{1.0 - min(left):.0%} of it are still seen at its place, expected less than {1.0 - _WORLD.gone:.0%}"
        return CameraVerdict(Code.GRASP_MISSED, text)
    return CameraVerdict(Code.OK, "it has gone from its place")


def stays(before: Array, frames: Sequence[Frame]) -> bool:
    """Whether something with such points (n, 3) is still where it was; taken for so, where no frame shows its place."""
    return not any(left >= _WORLD.gone for left in _left(before, frames))


def _left(before: Array, frames: Sequence[Frame], T_carried: Array | None = None) -> list[float]:
    """Share of the points (n, 3) in view that is seen through, of each frame that shows enough of them.

    What is seen where a hand has carried it (4, 4) has left its place, whatever is seen there: some detectors take what
    hangs in the air for something that stands on the table.
    """
    views = (view_of(frame.cloud.points, frame.cloud.camera) for frame in frames if frame.cloud is not None)
    found: list[float] = []
    for view in views:
        carried = Shares(0.0, 0.0, 1.0) if T_carried is None else explain(before, T_carried, view)
        there = explain(before, np.eye(4), view)
        if carried.seen >= _WORLD.same and carried.left <= _MOVED:
            found.append(1.0)
        elif there.in_view >= _WORLD.in_view:
            found.append(there.left)
    return found


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


def judge_unmoved(before: Array, frames: Sequence[Frame]) -> tuple[bool, str]:
    """Whether an object still stands where it was seen, as far as the hand above it lets the camera see.

    Args:
        before: (n, 3) points of it as it was seen before.
        frames: Taken since; the newest counts.
    """
    left = _left(before, frames[-1:])
    if not left:
        return True, "the hand hides the object"
    if left[0] > _MOVED:
        return False, f"the object has moved: {left[0]:.0%} of it is not where it stood, expected at most {_MOVED:.0%}"
    return True, "the object still stands there"


def judge_moved(
    before: Array, T_motion: Array, frame: Frame, within: float, *, in_part: bool
) -> tuple[Array, CameraVerdict]:
    """Whether an object is seen where the hand has moved it, and rests as it did.

    Args:
        before: (n, 3) points of it before the grasp, of one camera.
        T_motion: (4, 4) how the hand has moved it.
        frame: Taken after the hand has left it.
        within: Greatest horizontal distance, m.
        in_part: There may be more of it, that has moved otherwise where it has turned: it may not.

    Returns:
        How it has moved as it is seen (4, 4), and the verdict; final where it has fallen over, or is another shape.
        What is not there at all may be elsewhere.
    """
    if frame.cloud is None or not len(before):
        return T_motion, CameraVerdict(Code.STALE_DATA, "no points of what stands where it was put down")
    view = view_of(frame.cloud.points, frame.cloud.camera)
    T, fitted = fit(before, T_motion, view, turns=not in_part)
    near = (se3.make(p=(_FITTED * x, _FITTED * y, 0.0)) @ T for x, y in product((-1.0, 0.0, 1.0), repeat=2))
    shares = min((fitted, *(explain(before, each, view) for each in near)), key=lambda each: each.left)
    shift = (se3.apply(T, before) - se3.apply(T_motion, before)).mean(axis=0)
    off, higher = float(np.linalg.norm(shift[:2])), float(shift[2])
    text, final = f"what was seen of it is {off * 1e3:.0f} mm from where it was put down", False
    if shares.in_view < _SHOWN:
        text = f"{shares.in_view:.0%} of what was seen of it is in view after the place, expected at least {_SHOWN:.0%}"
    elif shares.left > _MOVED:
        final, limit = not in_part and bool(shares.left < _WORLD.gone), f"expected at most {_MOVED:.0%}"
        text = f"the object does not rest as it did: {shares.left:.0%} of what was seen of it is not there, {limit}"
    elif abs(higher) > AS_HIGH:
        final, way = not in_part, "higher" if higher > 0.0 else "lower"
        text = f"the object does not rest as it did: it is {abs(higher) * 1e3:.0f} mm {way} than it was"
    elif off > within:
        text = f"{text}, expected at most {within * 1e3:.0f} mm"
    else:
        return T, CameraVerdict(Code.OK, text)
    return T, CameraVerdict(Code.PLACE_FAILED, text, final=final)


def judge_same(seen: Array, T_motion: Array, before: LabelledCloud) -> CameraVerdict:
    """Whether what is seen of an object at its place was seen of it before: what leans or lies reaches elsewhere.

    Args:
        seen: (n, 3) points of it at its place.
        T_motion: (4, 4) how it has moved there.
        before: The image of it before the grasp; what that saw through was free.
    """
    shares = explain(seen, se3.inverse(T_motion), view_of(before.points, before.camera))
    if shares.left > _MOVED:
        what = f"{shares.left:.0%} of what is seen of it was free before, expected at most {_MOVED:.0%}"
        return CameraVerdict(Code.PLACE_FAILED, f"the object does not rest as it did: {what}", final=True)
    return CameraVerdict(Code.OK, "it rests as it did")
