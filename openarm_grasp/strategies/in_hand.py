# SPDX-License-Identifier: Apache-2.0
"""What the hands hold when a request comes that nothing was left by: read from the fingers and from the planner.

A grasp node that was restarted knows of no earlier request, and a hand may have been closed by other means. Fingers
that press on something hold it; what that is, the planner knows when it carried it. Base frame, m.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.labelled_cloud import LabelledCloud
from openarm_common.types import Array
from openarm_grasp.context import GraspContext
from openarm_grasp.evidence.verdicts import Evidence, learn_command
from openarm_grasp.perception.boxes import points_of
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.planning.candidates import UP, Box, GraspCandidate, object_in
from openarm_grasp.requests.request import GraspRequest
from openarm_grasp.requests.task import Grasp, GraspSession, release_command
from openarm_grasp.robot.learn import CLOSED
from openarm_grasp.robot.skills import Skills

#: What no camera has seen is looked at from straight above, m.
_ABOVE = 0.7


async def take_up(session: GraspSession, robot: Skills, *requests: GraspRequest) -> None:
    """Let the session keep what the hands of requests hold that it does not know of; partly open fingers take time.

    Raises:
        OpenArmError: NOT_READY, when a hand holds what nothing is known of: no request may open it.
    """
    if all(request.dry_run and request.phase != "place" for request in requests):
        return
    unknown: list[str] = []
    named = {request.arm or "auto" for request in requests}
    for arm in robot.description.arm_names:
        if not named & {"auto", arm} or arm in session.kept or not session.partly_open(robot, arm):
            continue
        config = session.context.config
        evidence = await robot.measure(arm, 0.0, settle=config.timing.settle_limit)
        box = robot.held_box(arm)
        fits = box is not None and _fits(box, evidence.gap, config.held.width_tolerance)
        # Without an effort, fingers that are half open say nothing: the planner must agree.
        holds = abs(evidence.effort) > config.held.min_effort if config.held.use_effort else fits
        if holds and box is not None and fits:
            session.kept[arm] = _grasp_of(arm, box, evidence, robot.T_base_tcp(arm), session.context)
        elif holds:
            unknown.append(
                f"the {arm} hand presses with {abs(evidence.effort):.0f} N on something {evidence.gap * 1e3:.0f} mm"
                f" wide, and nothing is known of it; {release_command(arm)}{_or_empty(robot, arm, evidence)}"
            )
    if unknown:
        raise OpenArmError(Code.NOT_READY, "; ".join(unknown))


def _or_empty(robot: Skills, arm: str, evidence: Evidence) -> str:
    """What to type when a hand that is nearly closed is empty, and stops there."""
    if evidence.gap > 2.0 * CLOSED * robot.description.described.hand(arm).parts.opening:
        return ""
    learned = "" if evidence.reach is None else f" (it went from {evidence.reach})"
    return f"; if it is empty, it closes no farther{learned}: {learn_command(arm)}"


def _fits(box: Box, gap: float, tolerance: float) -> bool:
    """Whether fingers with that gap can be around a box (what is round is held by any of its diameters), m."""
    return float(min(box.size[:2])) - tolerance <= gap <= float(np.hypot(*box.size[:2])) + tolerance


def _grasp_of(arm: str, box: Box, evidence: Evidence, T_base_tcp: Array, context: GraspContext) -> Grasp:
    """The grasp that holds a box (TCP frame), as if the object had stood on the table below the hand."""
    size, T_tcp_object = object_in(box, context.config)
    x, y, _ = (T_base_tcp @ T_tcp_object)[:3, 3]
    T_base_object = se3.make(p=(x, y, context.table.top_z + float(size[2]) / 2.0))
    target = Detection(box.id.removeprefix("target/"), 1.0, T_base_object, size, kind="box")
    T_grasp = target.T_base_object @ se3.inverse(T_tcp_object)
    approach = context.config.approach
    tilt = float(np.arccos(np.clip(-T_grasp[2, 2], -1.0, 1.0)))
    candidate = GraspCandidate(
        id=f"{target.label}/in hand",
        T_base_tcp=T_grasp,
        approach_offset=-approach.pregrasp_distance * T_grasp[:3, 2],
        retreat_offset=approach.lift_height * UP,
        width=evidence.gap,
        tilt=tilt,
        score=0.0,
        parts={},
    )
    return Grasp(arm, Sighting(target, (), 0, (_seen_from_above(target),)), candidate, ())


def _seen_from_above(target: Detection) -> LabelledCloud:
    """Points of a box as a camera above it would see them; it may have no corners: its points are those within."""
    T_base_camera = se3.make(np.diag([1.0, -1.0, -1.0]), target.foot + _ABOVE * UP)
    cloud = points_of((target,), Intrinsics.from_fovy(640, 480, 60.0), T_base_camera, target.bottom)
    local = (cloud.points[:, :2] - target.p_base[:2]) @ target.T_base_object[:2, :2] / (0.5 * target.size[:2])
    return replace(cloud, labels=np.where(np.linalg.norm(local, axis=1) < 1.0, cloud.labels, 0).astype(np.uint32))
