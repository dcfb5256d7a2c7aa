# SPDX-License-Identifier: Apache-2.0
"""Requests, answers, status and markers as messages. Poses are in the base frame."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from geometry_msgs.msg import Point
from openarm_interfaces.action import Pick, PickTwo
from openarm_interfaces.msg import GraspOption, GraspStatus, PickRequest, PickResult
from openarm_interfaces.srv import Grasp
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common.ros.convert import ns_to_stamp, point, vector
from openarm_common.ros.node import BASE_FRAME
from openarm_grasp.planning.candidates import GraspCandidate
from openarm_grasp.planning.options import Option
from openarm_grasp.strategies.pair import PairOutcome
from openarm_grasp.strategies.request import GraspOutcome, GraspRequest
from openarm_grasp.strategies.task import Status

_CHOSEN = ColorRGBA(r=0.1, g=0.8, b=0.2, a=1.0)
_REFUSED = ColorRGBA(r=0.9, g=0.2, b=0.1, a=0.35)
_OFFERED = ColorRGBA(r=0.4, g=0.5, b=0.9, a=0.35)


# --- requests and answers
def request_from_msg(message: Grasp.Request | Pick.Goal) -> GraspRequest:
    """The request of a user; a service request and an action goal have the same fields."""
    return replace(
        _request(message),
        dry_run=message.dry_run,
        phase=message.phase or "all",
        timeout=message.timeout,
        exclude_near=tuple((p.x, p.y) for p in message.exclude_near),
    )


def requests_from_msg(goal: PickTwo.Goal) -> tuple[GraspRequest, GraspRequest]:
    """Two requests at once."""
    first, second = (replace(_request(item), dry_run=goal.dry_run, timeout=goal.timeout) for item in goal.requests)
    return first, second


def _request(message: Grasp.Request | Pick.Goal | PickRequest) -> GraspRequest:
    """What all of them have in common."""
    p, at = message.place_position, message.object_position
    return GraspRequest(
        label=message.label,
        arm=message.arm or "auto",
        place=(p.x, p.y, p.z) if message.has_place_position else None,
        place_yaw=message.place_yaw if message.has_place_yaw else None,
        object_at=(at.x, at.y) if message.has_object_position else None,
    )


def fill_answer(answer: Grasp.Response | Pick.Result | PickResult, outcome: GraspOutcome) -> None:
    """Write an outcome into a service response, an action result, or one of its answers."""
    answer.success = outcome.success
    answer.outcome = outcome.kind
    answer.code = outcome.code.value
    answer.message = outcome.message
    answer.label = outcome.label
    answer.arm = outcome.arm
    answer.attempts = outcome.attempts
    answer.place_position = point(outcome.place_position)
    answer.duration = outcome.duration
    answer.route = outcome.route
    if not isinstance(answer, PickResult):
        answer.options = [option_to_msg(option) for option in outcome.options]


def option_to_msg(option: Option) -> GraspOption:
    """How one grasp fared."""
    return GraspOption(
        id=option.id,
        arm=option.arm,
        score=option.score,
        parts=list(option.parts),
        values=list(option.parts.values()),
        limit_margin=option.limit_margin,
        code=str(option.code),
        message=option.message,
    )


def option_from_msg(message: GraspOption) -> Option:
    """The same, of an answer."""
    return Option(
        message.id,
        message.arm,
        message.score,
        dict(zip(message.parts, message.values, strict=True)),
        message.limit_margin,
        message.code,
        message.message,
    )


def pair_result(outcome: PairOutcome) -> PickTwo.Result:
    """The answer to two requests."""
    result = PickTwo.Result(
        success=outcome.success,
        outcome=outcome.kind,
        code=outcome.code.value,
        message=outcome.message,
        simultaneous=outcome.simultaneous,
        duration=outcome.duration,
    )
    for one in outcome.answers:
        answer = PickResult()
        fill_answer(answer, one)
        result.results.append(answer)
    return result


def status_msg(status: Status, t_ns: int) -> GraspStatus:
    """A state that was entered."""
    message = GraspStatus(
        state=status.state.value,
        previous_state=status.previous.value,
        reason=status.reason,
        attempt=status.attempt,
        label=status.label,
        arm=status.arm,
    )
    message.header.stamp = ns_to_stamp(t_ns)
    message.header.frame_id = BASE_FRAME
    return message


# --- pictures
def candidate_markers(
    candidates: Sequence[GraspCandidate], chosen: str, refused: Collection[str], t_ns: int
) -> MarkerArray:
    """An arrow along each approach and a bar along its opening axis: the chosen one green, what was refused red."""
    markers = [Marker(action=Marker.DELETEALL)]
    for i, c in enumerate(candidates):
        tip = c.T_base_tcp[:3, 3]
        half = 0.5 * c.width * c.T_base_tcp[:3, 1]
        color = _CHOSEN if c.id == chosen else _REFUSED if c.id in refused else _OFFERED
        shaft = _points(tip + c.approach_offset, tip)
        arrow = Marker(ns="approach", id=i, type=Marker.ARROW, color=color, points=shaft)
        arrow.scale = vector((0.004, 0.008, 0.012))
        bar = Marker(ns="opening", id=i, type=Marker.LINE_STRIP, color=color, points=_points(tip - half, tip + half))
        bar.scale.x = 0.003
        markers += [arrow, bar]
    for marker in markers:
        marker.header.frame_id = BASE_FRAME
        marker.header.stamp = ns_to_stamp(t_ns)
        marker.pose.orientation.w = 1.0
    return MarkerArray(markers=markers)


def _points(*positions: np.ndarray) -> list[Point]:
    return [point(p) for p in positions]
