# SPDX-License-Identifier: Apache-2.0
"""The second look: the camera on the hand observes the object from the pre-grasp, and says how far the grasp is off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_grasp.perception.detections import Frame, Sighting, apart, find, on_table, picked
from openarm_grasp.planning import retries
from openarm_grasp.robot.skills import reraise_stop
from openarm_grasp.sampling.samplers import refine

if TYPE_CHECKING:
    from openarm_grasp.requests.task import Grasp
    from openarm_grasp.strategies.run import Run


async def second_look(run: Run, grasp: Grasp, camera: str, least: float) -> tuple[Grasp | None, str]:
    """Observe from the pre-grasp.

    Args:
        run: The request.
        grasp: Grasp that is planned.
        camera: Camera on the hand.
        least: Smaller corrections are not made, m.

    Returns:
        The grasp where the object is seen from there, None when the one that is planned stays; and why.
    """
    try:
        seen = await run.robot.observe(run.config.near.frames, near=camera)
    except OpenArmError as error:
        reraise_stop(error)
        return None, f"no second observation: {error.message}"
    try:
        again = _shape_again(run, grasp, seen) if grasp.of_cloud else _seen_again(run, grasp, seen)
    except OpenArmError as error:
        return None, f"the second observation does not help: {error.message}"
    if grasp.of_cloud:  # the box around what is no box is another one from here
        dx, dy, _ = again.candidate.T_base_tcp[:3, 3] - grasp.candidate.T_base_tcp[:3, 3]
    else:
        dx, dy, _ = again.sighting.target.p_base - grasp.sighting.target.p_base
    size = float(np.hypot(dx, dy))
    text = f"the {camera} camera sees it {size * 1e3:.1f} mm off ({dx * 1e3:+.1f}, {dy * 1e3:+.1f})"
    return (None, text) if size < least else (again, text)


def _seen_again(run: Run, grasp: Grasp, seen: Sequence[Frame]) -> Grasp:
    """The grasp of the object as the camera on the hand sees it whose hand is turned most like the chosen one's.

    Raises:
        OpenArmError: When the object is not among the detections, cannot be trusted, or is seen in part.
    """
    found = _found(run, grasp, seen)
    if not found.target.measured:
        raise OpenArmError(Code.NOTHING_DETECTED, "only a part of it is seen from there")
    before = grasp.sighting.target
    # from near, little of what it stands on is in view
    target = replace(on_table(found.target, before.bottom, reach=np.inf), id=before.id)
    # A box that is observed again may have its edges swapped.
    sighting = replace(grasp.sighting, target=target)
    ways = run.ways(grasp.arm, replace(sighting, clouds=()))
    repeats = any(past.repeated_by(grasp.candidate, before) for past in run.failed)
    offered = (*ways.repeats, *ways.fresh) if repeats else ways.fresh or ways.repeats
    return replace(grasp, sighting=sighting, candidate=retries.most_like(grasp.candidate, offered))


def _shape_again(run: Run, grasp: Grasp, seen: Sequence[Frame]) -> Grasp:
    """The grasp next to the chosen one on the surface that the camera over the table and that on the hand have seen.

    Raises:
        OpenArmError: When the object is not among the detections, or the hand has no room for any such grasp.
    """
    near = _found(run, grasp, seen).clouds
    sighting = replace(grasp.sighting, clouds=(*grasp.sighting.clouds, *near))
    refined = refine(grasp.candidate, run.asked(grasp.arm, sighting))
    if not near or not refined:
        what = "has no room for the grasp" if near else "shows too little of it"
        raise OpenArmError(Code.NOTHING_DETECTED, f"the surface seen from there {what}")
    return replace(grasp, candidate=replace(refined[0], id=grasp.candidate.id))


def _found(run: Run, grasp: Grasp, seen: Sequence[Frame]) -> Sighting:
    """The object among the detections of the camera on the hand.

    Raises:
        OpenArmError: When it is not among them, or cannot be trusted.
    """
    before, config = grasp.sighting.target, run.config
    frames: list[Frame] = []
    for frame in seen:
        near = [d for d in frame.detections if d.label == before.label and apart(d, before) <= config.near.largest]
        frames.append(picked(frame, near))
    return find(frames, before.label, config.detect)
