# SPDX-License-Identifier: Apache-2.0
"""Ways to take hold of an upright box: top-down and leaning grasps across its faces, in order of preference.

What is round is taken hold of from any side.

All poses are of the tool centre point (TCP) in the base frame. The tool's z axis is the approach direction (out of the
fingers) and its y axis the opening axis; orientations are built from those two directions, never from Euler angles. The
opening axis is always horizontal, so both fingers close at one height and the object is not tipped.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import acos, cos, degrees, hypot, radians, sin

import numpy as np

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.hand import HandParts
from openarm_common.types import Array
from openarm_grasp.config import ApproachConfig, GraspConfig

UP = np.array([0.0, 0.0, 1.0])
#: A tilt of 15° costs more than width and side together can win back.
_TILT_COST_PER_RAD = 2.0
_WIDTH_WEIGHT = 0.15
_SIDE_WEIGHT = 0.15
_ROOM_WEIGHT = 0.15
#: More clearance of a finger than this is as good as this, m.
_ROOM = 0.04
#: Share of the straight lines that is left of shorter ones.
_SHORT = 0.625
#: A little turn of a hand, rad.
_LITTLE = radians(5.0)
_TURNS: Mapping[str, Callable[[float], Array]] = {"x": se3.rot_x, "y": se3.rot_y, "z": se3.rot_z}
#: Half of a finger's thickness, m.
_FINGER = 0.010


@dataclass(frozen=True)
class Box:
    """A box that motion planning keeps clear of, or that the hand carries.

    Attributes:
        id: Shown in refusals.
        T_frame_box: (4, 4) pose of its centre; the user says in which frame.
        size: (3,) full edges, m.
    """

    id: str
    T_frame_box: Array
    size: Array


@dataclass(frozen=True)
class GraspCandidate:
    """One way to take hold of the object.

    Attributes:
        id: Names edge (of what is round, the direction in degrees), flip, tilt and lean, for example
            "red/x+/tilt15/lean-", "red/x+/tilt0/up10" (10 mm higher) or "red/30+/tilt0".
        T_base_tcp: (4, 4) pose of the TCP at the grasp.
        approach_offset: (3,) from the grasp to the pre-grasp, base frame, m.
        retreat_offset: (3,) from the grasp to the end of the lift, base frame, m.
        width: Extent of the object between the fingers, m.
        tilt: Lean of the approach from straight down, rad.
        score: Higher is tried first; the sum of `parts`.
        parts: Terms of the score.
        apertures: Least and greatest aperture that is expected when the hand has closed on what is no box, m; None: it
            is `width`.
        patch_area: Area of the smaller of both contact patches, m2; 0: not known.
        held: Boxes about what is grasped, base frame; empty: it is the box that was detected.
        opened: Aperture of the hand on the approach and after the release, m; None: wide open.
    """

    id: str
    T_base_tcp: Array
    approach_offset: Array
    retreat_offset: Array
    width: float
    tilt: float
    score: float
    parts: Mapping[str, float]
    apertures: tuple[float, float] | None = None
    patch_area: float = 0.0
    held: tuple[Box, ...] = ()
    opened: float | None = None


@dataclass(frozen=True)
class PlaceTarget:
    """One way to put the object down.

    Attributes:
        id: Names the spot and the turn, for example "spot0/yaw+30".
        T_base_tcp: (4, 4) pose of the TCP at release.
        position: (3,) of the footprint centre on the table, base frame, m.
        yaw_offset: Turn of the object against its yaw at the grasp, rad.
        approach_offset: (3,) from the release to where the straight way down begins, base frame, m.
        retreat_offset: (3,) from the release to the end of the straight way back, base frame, m.
        score: Higher is tried first.
    """

    id: str
    T_base_tcp: Array
    position: Array
    yaw_offset: float
    approach_offset: Array
    retreat_offset: Array
    score: float

    def __str__(self) -> str:
        """Its id, and where it is."""
        return "{} at ({:.3f}, {:.3f}) m".format(self.id, *self.position[:2])


def tips_height(tilt: float, hand: HandParts) -> float:
    """Height of the TCP above a surface at which the finger tips clear it, m; tilt in rad."""
    return hand.tip_clearance + hand.tip_clearance_tilted * sin(tilt)


def tcp_height(height: float, tilt: float, hand: HandParts) -> float:
    """Height of the TCP above the surface the object stands on, m.

    The largest of three: the finger tips clear the surface, the pads meet the object's middle, the palm clears its top.

    Args:
        height: Height of the object, m.
        tilt: Tilt of the approach from straight down, rad.
        hand: Measures of the gripper.
    """
    tips = tips_height(tilt, hand)
    pads = height / 2.0 - hand.pad_centre
    palm = height - hand.palm_depth + hand.palm_depth_tilted * sin(tilt)
    return max(tips, pads, palm)


def graspable_edges(target: Detection, limits: ApproachConfig) -> list[tuple[str, Array, float]]:
    """Footprint directions across which the hand fits: both edges of a box, all around what is round.

    Returns:
        Name, horizontal unit direction (3,) in the base frame, and width in m of each.

    Raises:
        OpenArmError: TOO_WIDE, with the widths and the limit, when there is none.
    """
    fitting = [edge for edge in _edges(target, limits) if _fits(edge[2], limits)]
    if not fitting:
        raise OpenArmError(
            Code.TOO_WIDE,
            f"{target.label!r} is {target.size[0] * 1e3:.0f} mm × {target.size[1] * 1e3:.0f} mm wide;"
            f" the hand grasps sides up to {limits.max_width * 1e3:.0f} mm",
        )
    return fitting


def wide_edges(target: Detection, limits: ApproachConfig) -> list[tuple[str, float]]:
    """Name and width, m, of the edges across which the hand does not fit."""
    return [(name, width) for name, _, width in _edges(target, limits) if not _fits(width, limits)]


def _edges(target: Detection, limits: ApproachConfig) -> list[tuple[str, Array, float]]:
    if target.round:
        turns = np.arange(round(180.0 / limits.round_step_deg)) * limits.round_step_deg
        return [(f"{turn:g}", se3.rot_z(radians(turn))[:, 0], float(target.size[:2].mean())) for turn in turns]
    return [(name, target.T_base_object[:3, axis], float(target.size[axis])) for axis, name in enumerate("xy")]


def _fits(width: float, limits: ApproachConfig) -> bool:
    return width <= limits.max_width + limits.width_noise


def propose(
    target: Detection,
    config: GraspConfig,
    hand: HandParts,
    *,
    shoulder_xy: Sequence[float] = (0.0, 0.0),
    others: Sequence[Detection] = (),
    raised: float = 0.0,
) -> tuple[GraspCandidate, ...]:
    """Every grasp worth planning, best first.

    Args:
        target: The object; its lower face is the surface it stands on.
        config: Parameters.
        hand: Measures of the gripper.
        shoulder_xy: (2,) of the arm's shoulder in the base frame, m; leaning away from it reaches furthest.
        others: Objects around it; hands whose fingers have room come first.
        raised: TCP so much higher than it need be, m; nothing is proposed where the pads would leave the object.

    Raises:
        OpenArmError: TOO_WIDE, when no side fits into the hand.
    """
    found: list[GraspCandidate] = []
    height = float(target.size[2])
    for edge, direction, width in graspable_edges(target, config.approach):
        room = _room(target.p_base, direction, others, hand)
        for flip, tilt_deg, lean in product(("+", "-"), config.approach.tilts_deg, ("+", "-")):
            if tilt_deg == 0.0 and lean == "-":
                continue  # a vertical hand leans nowhere
            tilt = radians(tilt_deg)
            above = tcp_height(height, tilt, hand) + raised
            if raised and above + hand.pad_centre > height:
                continue
            name = f"{target.label}/{edge}{flip}/tilt{tilt_deg:g}" + (f"/lean{lean}" if tilt_deg else "")
            name += f"/up{raised * 1e3:g}" if raised else ""
            y_tool = direction if flip == "+" else -direction
            heading = np.cross(UP, direction) * (1.0 if lean == "+" else -1.0)
            z_tool = sin(tilt) * heading - cos(tilt) * UP
            p = target.p_base.copy()
            p[2] = target.bottom + above
            p -= hand.tcp_shift(0.5 * width) * z_tool
            parts = {
                "tilt": -_TILT_COST_PER_RAD * tilt,
                "width": _WIDTH_WEIGHT * max(0.0, 1.0 - width / config.approach.max_width),
                "side": _SIDE_WEIGHT * sin(tilt) * _outward(target.p_base, heading, shoulder_xy),
                "room": _ROOM_WEIGHT * (min(room, _ROOM) / _ROOM - 1.0),
            }
            found.append(
                GraspCandidate(
                    id=name,
                    T_base_tcp=se3.make(se3.rotation_from_z_y(z_tool, y_tool), p),
                    approach_offset=-config.approach.pregrasp_distance * z_tool,
                    retreat_offset=config.approach.lift_height * UP,
                    width=width,
                    tilt=tilt,
                    score=sum(parts.values()),
                    parts=parts,
                )
            )
    # Stable sort: equal scores keep the order of the edges, so the same scene gives the same plan.
    return tuple(sorted(found, key=lambda c: -c.score))


def shorter(candidate: GraspCandidate, share: float = _SHORT) -> GraspCandidate:
    """The same grasp on shorter straight lines: near the end of an arm's reach longer ones leave it.

    Args:
        candidate: A grasp.
        share: Share of the way to the grasp; the lift is shortened to five eighths at most.
    """
    return replace(
        candidate,
        id=f"{candidate.id}/short" + ("" if share == _SHORT else f"{100.0 * share:g}"),
        approach_offset=share * candidate.approach_offset,
        retreat_offset=_SHORT * candidate.retreat_offset,
    )


def little_turns(candidates: Sequence[GraspCandidate], hand: HandParts) -> tuple[GraspCandidate, ...]:
    """Each grasp with the hand turned a little about each of its axes."""
    ways = product("xyz", (_LITTLE, -_LITTLE))
    return tuple(turned(one, axis, angle, hand) for axis, angle in ways for one in candidates)


def turned(candidate: GraspCandidate, axis: str, angle: float, hand: HandParts) -> GraspCandidate:
    """The same grasp with the hand turned a little, the fingers where they are.

    A wrist that is a little short of its limit in one way has room in another; what is held gives way to the pads.

    Args:
        candidate: A grasp.
        axis: Axis of the hand: x, y (the closing axis) or z (the approach).
        angle: rad.
        hand: Measures of the gripper: the tips stay as high above the table.
    """
    T = candidate.T_base_tcp @ se3.make(_TURNS[axis](angle))
    tilt = acos(min(1.0, max(-1.0, -float(T[2, 2]))))
    T[2, 3] += max(0.0, tips_height(tilt, hand) - tips_height(candidate.tilt, hand))
    T[2, 3] += hand.opening * abs(float(T[2, 1]) - float(candidate.T_base_tcp[2, 1]))  # of the lower finger
    back = float(np.linalg.norm(candidate.approach_offset))
    cost = -_TILT_COST_PER_RAD * abs(angle)
    return replace(
        candidate,
        id=f"{candidate.id}/{axis}{degrees(angle):+g}",
        T_base_tcp=T,
        approach_offset=-back * T[:3, 2],
        tilt=tilt,
        score=candidate.score + cost,
        parts={**candidate.parts, "turned": cost},
    )


def displaced(candidate: GraspCandidate, step: Array) -> GraspCandidate:
    """The same grasp of the same object that stands elsewhere, (3,) away, base frame, m."""
    T = se3.make(p=step)
    held = tuple(replace(box, T_frame_box=T @ box.T_frame_box) for box in candidate.held)
    return replace(candidate, T_base_tcp=T @ candidate.T_base_tcp, held=held)


def hold_of(candidate: GraspCandidate) -> str:
    """The hold of a grasp, whatever its tilt: label and edge."""
    return candidate.id.rpartition("/tilt")[0]  # a label may have strokes of its own


def _outward(p_base: Array, heading: Array, shoulder_xy: Sequence[float]) -> float:
    """Cosine between the lean and the direction from the shoulder to the object, -1 to 1."""
    x, y = float(p_base[0]) - shoulder_xy[0], float(p_base[1]) - shoulder_xy[1]
    distance = hypot(x, y)
    return (float(heading[0]) * x + float(heading[1]) * y) / distance if distance > 1e-6 else 0.0


def _room(p_base: Array, direction: Array, others: Sequence[Detection], hand: HandParts) -> float:
    """Least distance between an open finger and what stands around, seen from above, m; negative: it does not fit."""
    least = np.inf
    for side in (1.0, -1.0):
        finger = p_base[:2] + side * (hand.opening + _FINGER) * direction[:2]
        for d in others:
            local = np.abs((finger - d.p_base[:2]) @ d.T_base_object[:2, :2]) - d.size[:2] / 2.0
            outside = float(np.linalg.norm(np.maximum(local, 0.0)))
            least = min(least, (outside or float(local.max())) - _FINGER)
    return least


def target_box(target: Detection, config: GraspConfig) -> Box:
    """The object itself as an obstacle that the fingers may touch, base frame.

    Its lower face is raised by `table_gap`, so that an object standing on the table is not in collision with it.
    """
    gap = min(config.approach.table_gap, float(target.size[2]) / 2.0)
    T = target.T_base_object.copy()
    T[2, 3] += gap / 2.0
    return Box(f"target/{target.label}", T, target.size - np.array([0.0, 0.0, gap]))


def obstacle_boxes(others: Sequence[Detection], config: GraspConfig) -> tuple[Box, ...]:
    """Other objects in view as obstacles, a little inflated, base frame."""
    margin = config.approach.obstacle_margin
    boxes: list[Box] = []
    for i, d in enumerate(others):
        T = d.T_base_object.copy()
        T[2, 3] += margin / 2.0
        boxes.append(Box(f"detected/{d.label}_{i}", T, d.size + np.array([2.0 * margin, 2.0 * margin, margin])))
    return tuple(boxes)


def target_boxes(target: Detection, candidate: GraspCandidate | None, config: GraspConfig) -> tuple[Box, ...]:
    """As `target_box`; of what is no box, the boxes about its cloud that a grasp has."""
    return candidate.held if candidate is not None and candidate.held else (target_box(target, config),)


def held_boxes(target: Detection, candidate: GraspCandidate, config: GraspConfig) -> tuple[Box, ...]:
    """The object in the closed hand, TCP frame."""
    T_tcp_base = se3.inverse(candidate.T_base_tcp)
    boxes = target_boxes(target, candidate, config)
    return tuple(Box(box.id, T_tcp_base @ box.T_frame_box, box.size) for box in boxes)


def object_in(box: Box, config: GraspConfig) -> tuple[Array, Array]:
    """Edges (3,) of the object whose `held_boxes` is this one, and its pose (4, 4) in the TCP frame."""
    gap = min(config.approach.table_gap, float(box.size[2]))
    return box.size + np.array([0.0, 0.0, gap]), box.T_frame_box @ se3.make(p=(0.0, 0.0, -0.5 * gap))
