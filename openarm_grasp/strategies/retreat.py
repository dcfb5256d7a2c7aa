# SPDX-License-Identifier: Apache-2.0
"""The way back: where the hand is, and how it leaves the object and goes home, after a place and after a failure.

Nobody is asked to confirm it, and an attempt that has failed ends with it. Base frame, m.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_grasp.perception.detections import Frame
from openarm_grasp.planning import candidates
from openarm_grasp.planning.neighbours import neighbours
from openarm_grasp.planning.options import NO_WAY
from openarm_grasp.planning.place import place_targets
from openarm_grasp.requests.states import Hand, State
from openarm_grasp.requests.task import Grasp, Placed
from openarm_grasp.robot.skills import reraise_stop

if TYPE_CHECKING:
    from openarm_grasp.strategies.run import Run

#: An arm whose joints are all so near to home leaves the camera's view free, rad.
_NEARLY_HOME = 0.2


def still_held(run: Run, error: OpenArmError) -> str:
    """Sentence for an object that stays in the hand."""
    return f"{error.message}; the {run.arm} hand still holds {run.label!r}: open it over a safe place"


async def retreat(run: Run, grasp: Grasp, placed: Placed | None) -> tuple[Frame, ...]:
    """Leave the object, putting it down first when it is held, and go home with an open hand.

    An empty hand that finds no way home, also without regard to obstacles, stays where it is.

    Returns:
        Frames of what was placed, taken as the arm came home; none without.

    Raises:
        OpenArmError: When the hand holds the object and finds none, or the arm does not do what was planned.
    """
    run.robot.stop_observing()
    failure, held = run.failure if placed is None else placed.failure, run.robot.aperture(grasp.arm)
    frames: tuple[Frame, ...] = ()
    for last, obstacles in ((False, _obstacles(run, grasp, placed)), (True, ())):
        try:
            await _leave(run, grasp, placed, held)
            frames = await _home(run, grasp.arm, obstacles, run.config.detect.frames if placed else 0)
            break
        except OpenArmError as error:
            reraise_stop(error)
            if last and error.code in NO_WAY and not run.holding:
                run.robot.warn(f"{error.message}; it stays where it is")
                break
            if last or run.holding:
                text = f"the arm could not go home: {still_held(run, error) if run.holding else error.message}"
                code, text = (failure.code, f"{failure.reason}; {text}") if failure else (error.code, text)
                raise OpenArmError(code, text) from error
            run.hand = Hand.FREE if placed is None else Hand.CLEAR
            run.enter(State.RESET, f"{error.message}; trying another way home")
    return frames


async def _home(run: Run, arm: str, obstacles: tuple[candidates.Box, ...], frames: int) -> tuple[Frame, ...]:
    """Go home, and observe so many frames as the arm comes there."""
    robot = run.robot
    if not frames:
        await robot.go_home((arm,), obstacles)
        return ()
    try:
        return await robot.observe_towards_end(
            lambda: robot.go_home((arm,), obstacles), lambda: robot.away_from_home(arm) <= _NEARLY_HOME, frames
        )
    except OpenArmError as error:
        if error.code is not Code.STALE_DATA:
            raise
        return ()  # the arm is home; who needs them observes again


async def _leave(run: Run, grasp: Grasp, placed: Placed | None, held: float) -> None:
    """Free the hand, which may hold the object with that gap, m, and bring it away on a straight line."""
    arm, robot, T_base_tcp = grasp.arm, run.robot, grasp.candidate.T_base_tcp
    if placed is not None:
        if run.hand is Hand.RELEASED:
            T_away = se3.make(p=placed.target.retreat_offset) @ placed.target.T_base_tcp
            await robot.move_linear(arm, T_away, "leave")
        return
    at_object = run.hand is not Hand.FREE
    if run.hand is Hand.HOLDING:
        await _put_back(run, grasp)
        run.hand = Hand.AT_OBJECT
    await robot.open(arm, "open", grasp.candidate.opened, held=held)
    if at_object:
        await robot.move_linear(arm, se3.make(p=grasp.candidate.approach_offset) @ T_base_tcp, "back off")


async def _put_back(run: Run, grasp: Grasp) -> None:
    """Bring what the hand holds straight back; where the map shows what has slipped, by a plan that knows of it."""
    arm, robot, config, candidate = grasp.arm, run.robot, run.config, grasp.candidate
    above, slipped = config.place.release_height, run.failure is not None and run.failure.code is Code.GRASP_LOST
    if slipped:
        above += 2.0 * config.held.askew  # it reaches lower than it did
    T_back = se3.make(p=above * candidates.UP) @ candidate.T_base_tcp
    try:
        try:
            await robot.move_linear(arm, T_back, "put back")
        except OpenArmError as error:
            if error.code not in NO_WAY:
                raise
            target = grasp.sighting.target
            way = place_targets(target, candidate, (target.foot,), config)[0]
            back = robot.T_base_tcp(arm)[:3, 3] - T_back[:3, 3]  # it has come that way
            if back @ candidates.UP > 0.0:
                way = replace(way, approach_offset=back)
            way = replace(way, T_base_tcp=T_back)
            plan = await robot.plan_place(arm, (way,), grasp.sighting, candidate, turned=slipped)
            await robot.follow(arm, plan.transfer, "put back")
    except OpenArmError as error:
        if error.code is not Code.EXECUTION_FAILED:
            raise
        robot.warn(f"{error.message}: what the hand holds meets something below, and is let go there")


def _obstacles(run: Run, grasp: Grasp, placed: Placed | None) -> tuple[candidates.Box, ...]:
    """What the way home keeps clear of; where a lost object lies is not known."""
    target = candidates.target_boxes(grasp.sighting.target, grasp.candidate, run.config)
    others = neighbours(grasp.sighting, target, run.config)
    if placed is None:
        return others
    held = candidates.held_boxes(grasp.sighting.target, grasp.candidate, run.config)
    T = placed.target.T_base_tcp
    stands = (candidates.Box(b.id.replace("target/", "placed/", 1), T @ b.T_frame_box, b.size) for b in held)
    return (*others, *stands)
