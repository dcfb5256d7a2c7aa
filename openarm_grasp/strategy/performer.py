# SPDX-License-Identifier: Apache-2.0
"""Carries out what the state machine asks for, over a link to a robot: no ROS, no clock of its own.

The same code drives a robot behind a node graph and a world in this process (a campaign); what differs is the `Link`.
"""

from __future__ import annotations

import traceback
from collections.abc import Awaitable, Callable, Sequence

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence.evidence import Evidence
from openarm_grasp.evidence.hand import SPEED_WINDOW_NS, HandReader
from openarm_grasp.evidence.observation import in_base
from openarm_grasp.planning.options import NoWayError
from openarm_grasp.planning.routing import ARMS
from openarm_grasp.strategy import effects
from openarm_grasp.strategy.effects import (
    Effect,
    Effects,
    Frames,
    GraspOutcome,
    GraspRequest,
    Outcome,
    Reach,
    Result,
)
from openarm_grasp.strategy.link import Link
from openarm_grasp.strategy.machine import GraspMachine


class Performer:
    """Effects in, outcomes out.

    Args:
        link: To the robot; who holds a performer reaches the robot by it, too.
        config: Parameters.
        arms: That it may send home.
    """

    def __init__(self, link: Link, config: GraspConfig, *, arms: Sequence[str] = ARMS) -> None:
        self.link = link
        self._arms = frozenset(arms)
        self._config = config
        self._hands = {arm: HandReader(link.description, link.states, arm) for arm in ARMS}

    def gap(self, arm: str) -> float:
        """Distance between the fingers, m.

        Raises:
            OpenArmError: NOT_READY, when no joint state says so.
        """
        return self._hands[arm].gap()

    def check_hands(self, machine: GraspMachine, request: GraspRequest) -> None:
        """Refuse what would drop an object that an ended request left in the hand, and forget one that is gone.

        Raises:
            OpenArmError: NOT_READY.
        """
        kept, hand = machine.kept, self._config.hand
        if kept is None or request.dry_run:
            return
        gap = self.gap(kept.arm)
        if not self._config.held.closed_below < gap < 2.0 * (hand.opening - hand.open_tolerance):
            machine.kept = None  # taken or dropped meanwhile
        elif request.phase != "place":
            raise OpenArmError(
                Code.NOT_READY,
                f"the {kept.arm} hand still holds {kept.target.label!r} (gap {gap * 1e3:.0f} mm); ask for phase place"
                f" first, or open it with /{kept.arm}_gripper_controller/gripper_cmd where that is safe",
            )

    async def perform(self, recipe: Effects) -> Outcome:
        """Carry out a recipe; the first effect that fails ends it."""
        if not any(isinstance(effect, effects.Observe) for effect in recipe):
            self.link.stop_looking()
        results: list[Result] = []
        for done, effect in enumerate(recipe):
            try:
                self.link.check()
                result = await self._one(effect)
            except OpenArmError as error:
                refusals = error.refusals if isinstance(error, NoWayError) else {}
                return Outcome(error.code, error.message, tuple(results), done, refusals)
            if result is not None:
                results.append(result)
        return Outcome(Code.OK, "", tuple(results), len(recipe))

    async def do(self, recipe: Effects) -> Outcome:
        """Carry out a recipe that must succeed.

        Raises:
            OpenArmError: What the first effect that failed says.
        """
        outcome = await self.perform(recipe)
        if not outcome.ok:
            raise OpenArmError(outcome.code, outcome.message)
        return outcome

    async def look(self, frames: int, *, after: Effects = ()) -> Frames:
        """So many frames of the camera over the table, in the base frame, taken after a recipe.

        Raises:
            OpenArmError: As `do`.
        """
        seen = (await self.do((*after, effects.Observe(frames)))).last(Frames)
        return (await self.do((effects.ToBase(seen.frames, seen.frame_id),))).last(Frames)

    async def _one(self, effect: Effect) -> Result | None:
        link = self.link
        match effect:
            case effects.Together():
                return await link.together([self._part(part) for part in effect.effects])
            case effects.Wait():
                return await self._wait(effect.duration)
            case effects.Observe():
                return await link.observe(effect.frames, near=effect.near)
            case effects.ToBase():
                return self._to_base(effect)
            case effects.PlanGrasp() | effects.PlanPlace():
                return await link.plan(effect)
            case effects.ProbeReach():
                distances: dict[str, float] = {}
                for arm in effect.arms:
                    distances |= await link.reach(arm, effect.T_base_tcp)
                return Reach(distances)
            case effects.Execute():
                return await self._follow(effect)
            case effects.MoveLinear():
                return await link.move_linear(effect, f"{effect.arm} arm: {effect.what}")
            case effects.GoHome():
                return await self._home(effect)
            case effects.MoveGripper():
                return await self._grip(effect)
            case effects.Measure():
                return await self._measure(effect)

    def _part(self, effect: Effect) -> Callable[[], Awaitable[None]]:
        async def carry_out() -> None:
            await self._one(effect)

        return carry_out

    async def _wait(self, duration: float) -> None:
        link = self.link
        end_ns = link.now_ns + round(duration * 1e9)
        # Simulated time may be slow; one that stands still is noticed by the link.
        what = f"waiting {duration:g} s of robot time"
        await link.until(lambda: link.now_ns >= end_ns, 20.0 * duration + 10.0, what)

    def _to_base(self, effect: effects.ToBase) -> Frames:
        base = self.link.base_frame
        if effect.frame_id == base:
            return Frames(effect.frames, base)
        frames = in_base(effect.frames, lambda t_ns: self.link.states.lookup(base, effect.frame_id, t_ns))
        return Frames(frames, base)

    # --- moving
    async def _follow(self, effect: effects.Execute) -> None:
        held, at_first = self._config.held, self.gap(effect.arm)

        def still_held() -> None:
            if not effect.carrying:
                return
            gap = self.gap(effect.arm)
            if gap <= held.closed_below:
                raise OpenArmError(Code.GRASP_LOST, f"{effect.what}: the hand closed to {gap * 1e3:.1f} mm on the way")
            if abs(gap - at_first) > held.slip:
                raise OpenArmError(
                    Code.GRASP_LOST,
                    f"{effect.what}: the object slips: the gap went from {at_first * 1e3:.1f} to {gap * 1e3:.1f} mm on"
                    f" the way, expected to stay within {held.slip * 1e3:.0f} mm",
                )

        await self.link.follow(effect.arm, effect.trajectory, f"{effect.arm} arm: {effect.what}", still_held)

    async def _home(self, effect: effects.GoHome) -> None:
        config, link = self._config, self.link
        for arm in effect.arms:
            if arm not in self._arms:
                continue
            home = link.description.group_state(f"{arm}_arm", config.home_state)
            _, q = link.states.latest()
            if max(abs(q[name] - value) for name, value in home.items()) <= config.home_tolerance:
                continue
            T_base_tcp = self._hands[arm].T_base_tcp()
            if T_base_tcp[2, 3] < effect.back_off_below:
                T_back = T_base_tcp @ se3.make(p=(0.0, 0.0, -config.approach.pregrasp_distance))
                try:
                    await self._one(effects.MoveLinear(arm, T_back, "back off"))
                except OpenArmError as error:
                    if error.code in (Code.CANCELLED, Code.ROBOT_LOST):
                        raise
                    # A kindness to what stands around the hand; the free path home may still be there.
                    link.warn(error.message)
            await link.move_named(arm, config.home_state, effect, f"{arm} arm: go {config.home_state}")

    # --- the hand
    async def _grip(self, effect: effects.MoveGripper) -> None:
        hand, link, what = self._hands[effect.arm], self.link, f"{effect.arm} hand: {effect.what}"
        ended_well = await link.grip(effect.arm, hand.joint, effect.position, what, effect.effort)
        if effect.position > 0.0:
            # The result may be here before the joint state that shows it.
            least, end_ns = effect.position - self._config.hand.open_tolerance, link.now_ns + SPEED_WINDOW_NS
            limit = self._config.limits.answer_timeout
            await link.until(lambda: hand.finger() >= least or link.now_ns > end_ns, limit, what)
            if hand.finger() < least:
                reached = f"{hand.finger() * 1e3:.1f} mm of {effect.position * 1e3:.0f} mm"
                raise OpenArmError(Code.EXECUTION_FAILED, f"{what}: the fingers stopped at {reached}")
        elif not ended_well:
            raise OpenArmError(Code.EXECUTION_FAILED, f"{what}: the fingers neither arrived nor met anything")

    async def _measure(self, effect: effects.Measure) -> Evidence:
        hand, link, limit = self._hands[effect.arm], self.link, 20.0 * effect.settle + 10.0
        ready_ns = link.now_ns + SPEED_WINDOW_NS
        await link.until(lambda: link.now_ns >= ready_ns, limit, "reading the hand")
        end_ns = ready_ns + round(effect.settle * 1e9)
        still = self._config.held.max_speed
        rest = "waiting for the fingers to rest"

        def at_rest() -> bool:
            try:
                speed = hand.gap_speed()
            except OpenArmError as error:
                if error.code is not Code.STALE_DATA:
                    raise
                return False  # joint states were missing for a moment; the speed is known again soon
            return abs(speed) < still or link.now_ns >= end_ns

        await link.until(at_rest, limit, rest)
        pads = link.pads(effect.arm) if self._config.held.use_finger_force else ()
        return hand.evidence(effect.expected, link.effort(hand.joint), effect.T_base_tcp, pads)


async def run_request(
    machine: GraspMachine, performer: Performer, request: GraspRequest, tell: Callable[[], None]
) -> GraspOutcome:
    """Carry out one request from beginning to end; `tell` is called after each transition.

    Raises:
        OpenArmError: BUSY, INVALID_ARGUMENT or NOT_READY, when the request is not taken.
    """
    link = performer.link
    performer.check_hands(machine, request)
    recipe = machine.step(request, link.now_ns)
    link.deadline_ns = link.now_ns + round(request.timeout * 1e9) if request.timeout > 0.0 else 0
    while recipe:
        try:
            tell()
            outcome = await performer.perform(recipe)
        except Exception as error:
            # A fault of this program: the request must still be answered, and the next one served.
            link.warn(traceback.format_exc())
            outcome = Outcome(Code.INTERNAL, f"{type(error).__name__}: {error}; see the log of the grasp node")
        recipe = machine.step(outcome, link.now_ns)
    tell()
    if machine.outcome is None:
        raise OpenArmError(Code.INTERNAL, "the grasp machine ended without an outcome")
    return machine.outcome
