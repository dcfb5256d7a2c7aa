# SPDX-License-Identifier: Apache-2.0
"""What finds grasps: a sampler is given what is known of an object and of the hand, and returns candidates.

`grasp.sampler` names one: `boxes`, `cloud`, `auto`, or `package.module:Class` of another one, for example of a network.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import degrees, hypot, radians, sin
from typing import Any, Protocol

import numpy as np

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.octree.distance_field import DistanceField
from openarm_common.robot.hand import HandParts
from openarm_common.types import Array
from openarm_grasp.config import GraspConfig
from openarm_grasp.planning.candidates import UP, GraspCandidate
from openarm_grasp.planning.retries import FailedGrasp, centre_of_mass, has_met, proposed
from openarm_grasp.sampling.antipodal import Antipodal, Search
from openarm_grasp.sampling.hand_shape import HandShape
from openarm_grasp.sampling.slabs import eased, slabs
from openarm_grasp.sampling.surface import Surface

#: Leaning away from the shoulder reaches furthest; as of the grasps of boxes.
_SIDE_WEIGHT = 0.15
#: A grasp that is searched at the second look is this near to the one before it, m, rad.
_AROUND, _TURNED = 0.03, radians(30.0)


@dataclass(frozen=True, eq=False)
class Sampling:
    """What a sampler is given.

    Attributes:
        target: The object.
        config: Parameters.
        hand: Measures of the gripper.
        others: Objects around it.
        shoulder_xy: (2,) of the arm's shoulder in the base frame, m.
        surface: The object and what is around it, as cameras saw it; None: only the boxes are known.
        shape: Shape of the open hand with the cameras that it carries; needed with a surface.
        field: Distances to obstacles, base frame; read where the surface knows nothing.
        failed: Grasps of it that have failed.
    """

    target: Detection
    config: GraspConfig
    hand: HandParts
    others: Sequence[Detection] = ()
    shoulder_xy: Sequence[float] = (0.0, 0.0)
    surface: Surface | None = None
    shape: HandShape | None = None
    field: DistanceField | None = None
    failed: Sequence[FailedGrasp] = ()


class GraspSampler(Protocol):
    """Finds grasps; made without arguments, the first time that one is needed.

    A learned sampler reads `asked.surface` (voxels, normals, points of the target; base frame, m) and returns what it
    believes in: the suite plans, executes and judges it like its own. What a candidate must have: an id that no other
    one has and that ends in "/tilt" and the tilt in degrees; a pose whose z axis is the approach and whose y axis is
    the opening direction; `width`, and for what is no box `apertures`, without which the aperture must be the width.
    """

    def candidates(self, asked: Sampling) -> tuple[GraspCandidate, ...]:
        """Return every grasp worth planning, best first.

        Args:
            asked: The object, what is around it, and the hand.

        Raises:
            OpenArmError: TOO_WIDE, when the hand does not fit around the object anywhere; UNREACHABLE or IN_COLLISION,
                when it fits, but has no room.
        """
        ...


class Boxes:
    """Across the faces of an upright box, around what is round; see `openarm_grasp.planning.candidates`."""

    def candidates(self, asked: Sampling) -> tuple[GraspCandidate, ...]:
        """As of `GraspSampler`."""
        return proposed(
            asked.target,
            asked.config,
            asked.hand,
            asked.failed,
            shoulder_xy=asked.shoulder_xy,
            others=asked.others,
        )


class Cloud:
    """Antipodal grasps on the cloud of what has any shape; see `openarm_grasp.sampling.antipodal`."""

    def candidates(self, asked: Sampling) -> tuple[GraspCandidate, ...]:
        """As of `GraspSampler`; also raises NOT_READY without a cloud."""
        search, surface = _search(asked)
        found = search.best()
        if not found:
            raise _none(search, asked, surface)
        return _candidates(found, asked, surface)


class Auto:
    """Across the faces of what was measured as a box or a cylinder that fits into the hand; else on its cloud.

    So is what a hand has met beside its faces: it is wider below its top.
    """

    def candidates(self, asked: Sampling) -> tuple[GraspCandidate, ...]:
        """As of `GraspSampler`."""
        if asked.surface is None:
            return Boxes().candidates(asked)
        if asked.target.kind and not has_met(asked.failed):  # the shape of a prism that fits its outline
            try:
                return Boxes().candidates(asked)
            except OpenArmError as error:
                if error.code is not Code.TOO_WIDE:
                    raise
        return Cloud().candidates(asked)


SAMPLERS: dict[str, Callable[[], GraspSampler]] = {"boxes": Boxes, "cloud": Cloud, "auto": Auto}


def make_sampler(name: str) -> GraspSampler:
    """The sampler of a name: boxes, cloud, auto, or `package.module:Class`, whose class is made without arguments.

    Raises:
        OpenArmError: CONFIG_INVALID, when there is no such class, or it finds no candidates.
    """
    if name in SAMPLERS:
        return SAMPLERS[name]()
    valid = f"valid: {', '.join(SAMPLERS)}, or package.module:Class with a method candidates(asked)"
    module, _, attribute = name.partition(":")
    try:
        found: Any = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"grasp.sampler {name!r}: {error}; {valid}") from error
    if not callable(getattr(found, "candidates", None)):
        raise OpenArmError(Code.CONFIG_INVALID, f"grasp.sampler {name!r} has no method candidates; {valid}")
    return found()


def refine(candidate: GraspCandidate, asked: Sampling) -> tuple[GraspCandidate, ...]:
    """Correct a candidate on a surface that has seen more: a second look by the camera on the hand.

    It is moved to where the surface now is between the fingers; where the hand has no room for that, others near it
    are searched.

    Args:
        candidate: Grasp that the hand is before now.
        asked: Input with the surface that all views were fused into.

    Returns:
        Candidates near it, best first; empty when the hand has no room.

    Raises:
        OpenArmError: NOT_READY, without a surface or a shape of the hand.
    """
    search, surface = _search(asked)
    found = search.near(candidate.T_base_tcp, candidate.width, candidate.opened)
    return _candidates(found or _around(candidate, search.best()), asked, surface)


def _around(candidate: GraspCandidate, found: Sequence[Antipodal]) -> tuple[Antipodal, ...]:
    """Those that a hand before the candidate reaches by a small motion."""
    T = candidate.T_base_tcp
    return tuple(
        one
        for one in found
        if float(np.linalg.norm(one.T_base_tcp[:3, 3] - T[:3, 3])) <= _AROUND
        and se3.angle_between(one.T_base_tcp[:3, :3], T[:3, :3]) <= _TURNED
    )


def _search(asked: Sampling) -> tuple[Search, Surface]:
    if asked.surface is None or asked.shape is None:
        what = "the cloud of the object" if asked.surface is None else "the shape of the hand"
        text = f"{what} is not known; expected it for grasp.sampler cloud: is the detector's segmentation on?"
        raise OpenArmError(Code.NOT_READY, text)
    config = asked.config
    centre = centre_of_mass(asked.surface.solid, asked.target, asked.failed)
    search = Search(asked.surface, asked.shape, config.cloud, config.approach, asked.field, centre)
    return search, asked.surface


def _none(search: Search, asked: Sampling, surface: Surface) -> OpenArmError:
    """Why there is no grasp: no two sides that the hand fits around, or no room for it."""
    label, tried = asked.target.label, search.tried
    widest = search.widest * 1e3
    size = " × ".join(f"{v * 1e3:.0f}" for v in np.ptp(surface.solid, axis=0) + surface.step)
    if not tried.pairs:
        return OpenArmError(
            Code.TOO_WIDE,
            f"{label!r} ({size} mm) has no two opposite sides that the hand fits around: it grasps up to"
            f" {widest:.0f} mm, sides within {asked.config.cloud.cone_deg:g}° of facing each other",
        )
    why = max(tried.why, key=lambda name: tried.why[name])
    counts = ", ".join(f"{name} {count}" for name, count in tried.why.items() if count)
    code = Code.TOO_WIDE if why.startswith("too wide") else Code.IN_COLLISION
    return OpenArmError(code, f"{label!r} ({size} mm): none of {tried.poses} poses of the hand is possible: {counts}")


def _candidates(found: Sequence[Antipodal], asked: Sampling, surface: Surface) -> tuple[GraspCandidate, ...]:
    config, label = asked.config, asked.target.label
    made = slabs(label, surface.solid, surface.step, gap=config.approach.table_gap) if found else ()
    held = tuple(eased(box) for box in made)
    ranked: list[GraspCandidate] = []
    for n, one in enumerate(found):
        side = _SIDE_WEIGHT * sin(one.tilt) * _outward(one.T_base_tcp, asked.shoulder_xy)
        ranked.append(
            GraspCandidate(
                id=f"{label}/cloud{n}/tilt{degrees(one.tilt):.0f}",
                T_base_tcp=one.T_base_tcp,
                approach_offset=-config.approach.pregrasp_distance * one.T_base_tcp[:3, 2],
                retreat_offset=config.approach.lift_height * UP,
                width=one.width,
                tilt=one.tilt,
                score=one.score + side,
                parts={**one.parts, "side": side},
                apertures=one.apertures,
                patch_area=one.patch_area,
                held=held,
                opened=one.opened,
            )
        )
    ranked.sort(key=lambda c: -c.score)
    return tuple(ranked)


def _outward(T_base_tcp: Array, shoulder_xy: Sequence[float]) -> float:
    """Cosine between the lean and the direction from the shoulder to the hand, -1 to 1."""
    lean = T_base_tcp[:2, 2]
    away = T_base_tcp[:2, 3] - np.asarray(shoulder_xy)
    size = hypot(*lean) * hypot(*away)
    return float(lean @ away) / size if size > 1e-9 else 0.0
