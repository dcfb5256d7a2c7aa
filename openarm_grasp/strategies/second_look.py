# SPDX-License-Identifier: Apache-2.0
"""The second look: the camera on the hand observes the object from the pre-grasp, and says how far the grasp is off."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from openarm_common.detection import Detection
from openarm_common.errors import OpenArmError
from openarm_grasp.perception.detections import Frame, apart, find, on_table
from openarm_grasp.planning import retries
from openarm_grasp.planning.candidates import GraspCandidate
from openarm_grasp.robot.interface import Frames
from openarm_grasp.robot.skills import reraise_stop

if TYPE_CHECKING:
    from openarm_grasp.requests.task import Grasp
    from openarm_grasp.strategies.run import Run


async def second_look(run: Run, grasp: Grasp, camera: str, least: float) -> tuple[Grasp | None, str]:
    """Observe from the pre-grasp.

    Args:
        run: The request.
        grasp: That is planned.
        camera: On the hand.
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
        target, candidate = _seen_again(run, grasp, seen)
    except OpenArmError as error:
        return None, f"the second observation does not help: {error.message}"
    dx, dy, _ = target.p_base - grasp.sighting.target.p_base
    size = float(np.hypot(dx, dy))
    text = f"the {camera} camera sees it {size * 1e3:.1f} mm off ({dx * 1e3:+.1f}, {dy * 1e3:+.1f})"
    if size < least:
        return None, text
    return replace(grasp, sighting=replace(grasp.sighting, target=target), candidate=candidate), text


def _seen_again(run: Run, grasp: Grasp, seen: Frames) -> tuple[Detection, GraspCandidate]:
    """The object as the camera on the hand sees it, and the grasp whose hand is turned most like the chosen one's.

    Raises:
        OpenArmError: When the object is not among the detections, or cannot be trusted.
    """
    before, config = grasp.sighting.target, run.config
    frames: list[Frame] = []
    for frame in seen.frames:
        near = (d for d in frame.detections if d.label == before.label and apart(d, before) <= config.near.largest)
        frames.append(Frame(frame.t_ns, tuple(near)))
    target = on_table(find(frames, before.label, config.detect).target, run.context.table.top_z)
    # A box that is observed again may have its edges swapped.
    found = run.ways(grasp.arm, replace(grasp.sighting, target=target))
    if any(past.repeated_by(grasp.candidate, before) for past in run.failed):
        return target, retries.most_like(grasp.candidate, (*found.repeats, *found.fresh))
    return target, retries.most_like(grasp.candidate, found.fresh or found.repeats)
