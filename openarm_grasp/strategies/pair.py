# SPDX-License-Identifier: Apache-2.0
"""Two objects at once: both are observed, and each is a request of its own for the arm on its side.

What cannot be told apart beforehand, or is refused next to the other arm, is asked for again when that has ended, with
any arm. Base frame, m.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import permutations

from openarm_common.errors import Code, OpenArmError
from openarm_grasp.config import DetectConfig
from openarm_grasp.perception.detections import Frame, Sighting
from openarm_grasp.requests.request import ENDS, GraspOutcome, GraspRequest, PairOutcome
from openarm_grasp.requests.task import GraspSession
from openarm_grasp.robot.skills import Skills
from openarm_grasp.strategies.in_hand import take_up

Requests = tuple[GraspRequest, GraspRequest]
#: Carries out work that needs all arms.
WithAllArms = Callable[[Callable[[], Awaitable[Requests]]], Awaitable[Requests]]
#: Carries out a request, by its number, with the arm that it names, or with all; what goes wrong is in the answer.
CarryOut = Callable[[int, GraspRequest], Awaitable[GraspOutcome]]


async def pick_two(
    session: GraspSession,
    robot: Skills,
    asked: Requests,
    with_all_arms: WithAllArms,
    carry_out: CarryOut,
    note: Callable[[str], None],
) -> PairOutcome:
    """Pick two objects, with both arms at the same time where each has one of its own, else one after the other.

    Args:
        session: Session that outlives the requests.
        robot: Observes both objects.
        asked: Requests of a user.
        with_all_arms: Carries out that observation.
        carry_out: Carries out each request.
        note: Called with what is done before either is begun.

    Raises:
        OpenArmError: INVALID_ARGUMENT or NOT_READY, when they are not taken; one of `ENDS`, when they ended before an
            object was touched.
    """
    began_ns, why = 0, ""

    async def divide() -> Requests:
        nonlocal began_ns, why
        began_ns = robot.now_ns
        for request in asked:
            request.check(robot.description.arm_names)
        await take_up(session, robot, *asked)
        for request in asked:
            session.check_hands(robot, request)
        note(f"asked for {asked[0].label!r} and {asked[1].label!r} at once: observing both")
        requests, why = await _an_arm_for_each(session, robot, asked)
        note(why)
        return requests

    def seconds() -> float:
        return (robot.now_ns - began_ns) * 1e-9

    requests = await with_all_arms(divide)
    answers = dict[int, GraspOutcome]()

    async def work(i: int) -> None:
        answers[i] = await carry_out(i, requests[i])

    simultaneous = requests is not asked
    if simultaneous:
        await robot.robot.together([partial(work, 0), partial(work, 1)])
    for i, request in enumerate(asked):
        mine, other = answers.get(i), answers.get(1 - i)
        if mine is not None and (mine.kind != "REFUSED" or mine.code in ENDS):
            continue
        if other is not None and (other.code in ENDS or other.held):
            text = f"not begun: {other.label!r} ended with {other.code}: {other.message}"
            answers[i] = mine or GraspOutcome(other.code, text, request.label)
        elif 0.0 < request.timeout <= seconds():
            text = f"the {request.timeout:g} s were over before it began"
            answers[i] = GraspOutcome(Code.TIMEOUT, text, request.label)
        else:
            left = max(request.timeout - seconds(), 0.0)
            again = replace(requests[i], arm=request.arm, timeout=left)
            # words that fit both are not for what was placed
            spots = [other.place_position[:2]] if other is not None and other.success else []
            answers[i] = await carry_out(i, again.without(*spots))
    return PairOutcome.of((answers[0], answers[1]), why, seconds(), simultaneous=simultaneous)


async def _an_arm_for_each(session: GraspSession, robot: Skills, asked: Requests) -> tuple[Requests, str]:
    """Observe both objects, and give an arm to each; the requests as they are, and why, when they take turns."""
    shoulders, (first, second), began_ns = session.context.shoulders, asked, robot.now_ns
    free = [
        arms
        for arms in permutations(shoulders, 2)
        if all(request.arm in ("", "auto", arm) for request, arm in zip(asked, arms, strict=True))
    ]
    if not free:
        one = "the robot has one arm" if len(shoulders) < 2 else "the same arm is asked for"
        return asked, f"{one}: one after the other"
    try:
        found = _both(asked, await _observe(session, robot, first), session.context.config.detect)
    except OpenArmError as error:
        late = error.code is Code.CANCELLED and 0.0 < first.timeout <= (robot.now_ns - began_ns) * 1e-9
        if error.code in ENDS and not late:
            raise
        return asked, f"{error.message}: one after the other"

    def on_their_sides(arms: Sequence[str]) -> float:
        return sum(shoulders[arm][1] * float(one.target.p_base[1]) for arm, one in zip(arms, found, strict=True))

    left, right = max(free, key=on_their_sides)
    why = f"both at once: {found[0].target.label!r} {left}, {found[1].target.label!r} {right}"
    return (
        replace(first.about(found[0]), arm=left, why=why),
        replace(second.about(found[1]), arm=right, why=why),
    ), why


async def _observe(session: GraspSession, robot: Skills, request: GraspRequest) -> tuple[Frame, ...]:
    """Frames of both objects, with the arms at home; a dry run moves nothing."""
    robot.set_deadline(request.timeout)
    robot.set_speed(request.velocity_scale)
    if not request.dry_run:
        await robot.go_home(robot.description.arm_names, back_off_below=session.context.clear_of_objects)
    return await robot.look(session.context.config.detect.frames)


def _both(requests: Requests, frames: Sequence[Frame], limits: DetectConfig) -> tuple[Sighting, Sighting]:
    """Two objects, the best for each request.

    Raises:
        OpenArmError: Same as `GraspRequest.find`; UNKNOWN_OBJECT, when both requests fit one object alone.
    """
    first, second = (request.find(frames, limits) for request in requests)
    if first.target.id != second.target.id:
        return first, second
    x, y, _ = (float(v) for v in first.target.p_base)
    for_others = [request.without((x, y)) for request in requests]
    try:
        return first, for_others[1].find(frames, limits)
    except OpenArmError:
        return for_others[0].find(frames, limits), first
