# SPDX-License-Identifier: Apache-2.0
"""A request by the way that leads to its place: directly; by the other arm; from hand to hand; pushed into reach first.

Each part is an ordinary request of the machine, which looks anew; what lies between is planned by `handover` and
`push`. A direct way is always tried first; only an object that was refused without being touched goes another.
Base frame, m, rad.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_grasp.planning.rehearsal import NO_WAY, Rehearsal
from openarm_grasp.planning.routing import ARMS
from openarm_grasp.strategy.effects import GraspOutcome, GraspRequest
from openarm_grasp.strategy.handover import HandOver, plan_hand_over
from openarm_grasp.strategy.machine import GraspMachine
from openarm_grasp.strategy.memory import Known
from openarm_grasp.strategy.performer import Performer, run_request
from openarm_grasp.strategy.push import Pusher

#: These end whatever is under way; no other way is tried.
STOPS = (Code.CANCELLED, Code.TIMEOUT, Code.ROBOT_LOST)


async def run_task(
    machine: GraspMachine, performer: Performer, request: GraspRequest, tell: Callable[[], None]
) -> GraspOutcome:
    """Carry out a request by whatever way leads to its place; `tell` is called after each transition and note.

    Raises:
        OpenArmError: BUSY, INVALID_ARGUMENT or NOT_READY, when the request is not taken.
    """
    return await _Task(machine, performer, request, tell).run()


class _Task:
    """One request of a user, and what became of it so far."""

    def __init__(
        self, machine: GraspMachine, performer: Performer, request: GraspRequest, tell: Callable[[], None]
    ) -> None:
        self._machine, self._performer, self._request, self._tell = machine, performer, request, tell
        self._rehearsal = Rehearsal(performer.link, machine.around)
        self._began_ns = performer.link.now_ns
        self._attempts = 0

    async def run(self) -> GraspOutcome:
        outcome = await self._part(self._request)
        known = self._machine.known
        if outcome.success or known is None or not self._may_go_another_way(outcome, known):
            return self._whole(outcome, "direct")
        try:
            if known.place_refused:
                return await self._by_the_other_arm(outcome, known)
            return await self._pushed(outcome)
        except OpenArmError as error:
            if error.code in STOPS:
                return self._whole(replace(outcome, code=error.code, message=error.message), "")
            if error.code not in (*NO_WAY, Code.PLACE_FAILED):
                raise
            return self._whole(replace(outcome, message=f"{outcome.message}; {error.message}"), "")

    def _may_go_another_way(self, outcome: GraspOutcome, known: Known) -> bool:
        asked = self._request
        free = asked.phase == "all" and asked.arm in ("", "auto")
        return free and outcome.kind == "REFUSED" and outcome.code in NO_WAY and bool(known.refusals)

    # --- ways
    async def _by_the_other_arm(self, outcome: GraspOutcome, known: Known) -> GraspOutcome:
        """It can be grasped, but not put where it shall stand by the arms that were asked."""
        asked, seen = self._request, known.sighting
        if asked.place is None:
            return self._whole(outcome, "")
        place = np.array(asked.place[:2], dtype=np.float64)
        self._note("no arm that was asked can do it alone; looking for another way")
        for arm in ARMS:
            if arm not in known.refusals:
                try:
                    await self._rehearsal.pick_and_place(arm, seen.target, seen.others, (place,), yaw=asked.place_yaw)
                except OpenArmError as error:
                    if error.code not in NO_WAY:
                        raise
                    continue
                why = f"the {arm} arm does it alone, from the other side"
                return self._whole(await self._part(replace(asked, arm=arm, why=why)), "direct")
        way = await plan_hand_over(self._rehearsal, self._machine.around, seen, place, asked.place_yaw)
        if asked.dry_run:
            x, y, _ = seen.target.p_base
            found = replace(outcome, code=Code.OK, message=f"can be done from ({x:.3f}, {y:.3f}) m: {way}")
            return self._whole(replace(found, arm=way.taker), "hand_over")
        return await self._handed_over(way, place)

    async def _handed_over(self, way: HandOver, place: Array) -> GraspOutcome:
        """From hand to hand; when the taker is refused after all, anew from where the object then stands."""
        asked, most = self._request, self._machine.around.config.hand_over.rounds
        number = 0
        while True:
            number += 1
            x, y = (float(v) for v in way.spot)
            brought = await self._part(
                replace(asked, arm=way.giver, place=(x, y), place_yaw=way.yaw, why=f"hand-over, 1 of 2: {way}")
            )
            if not brought.success:
                brought = replace(brought, message=f"on the way to the middle: {brought.message}")
                return self._whole(self._left_behind(brought, "then") if number > 1 else brought, "")
            taken = await self._part(replace(asked, arm=way.taker, why=f"hand-over, 2 of 2: {way}"))
            if taken.success:
                text = f"{taken.message}; the {way.giver} arm had brought it to the middle, ({x:.3f}, {y:.3f}) m"
                return self._whole(replace(taken, message=text + _again(number)), "hand_over")
            taken = replace(taken, arm=way.taker)
            known = self._machine.known
            if number == most or known is None or taken.kind != "REFUSED" or taken.code not in NO_WAY:
                break
            self._note(f"{taken.message}; looking for another way from where it stands now")
            try:
                way = await plan_hand_over(
                    self._rehearsal, self._machine.around, known.sighting, place, asked.place_yaw
                )
            except OpenArmError as error:
                if error.code not in (*NO_WAY, Code.PLACE_FAILED):
                    raise
                taken = replace(taken, message=f"{taken.message}; {error.message}")
                break
        return self._whole(self._left_behind(taken, f"brought to the middle{_again(number)}"), "")

    async def _pushed(self, outcome: GraspOutcome) -> GraspOutcome:
        """No arm can grasp it where it stands."""
        pusher = Pusher(self._machine.around, self._performer, self._rehearsal, self._note)
        for number in range(1, self._machine.around.config.push.most + 1):
            known = self._machine.known
            if known is None:
                break
            try:
                push = await pusher.plan(known.sighting)
            except OpenArmError as error:
                if number == 1 or error.code not in NO_WAY:
                    raise
                text = f"{outcome.message}; after {number - 1} pushes {error.message}"
                return self._whole(self._left_behind(replace(outcome, message=text), "after the pushes"), "")
            if self._request.dry_run:
                return self._whole(replace(outcome, code=Code.OK, message=f"can be done: {push}"), "push")
            self._attempts = max(self._attempts, 1)
            try:
                told = await pusher.carry_out(push, known.sighting.target.label, number)
            except OpenArmError as error:
                return self._whole(replace(outcome, code=error.code, message=error.message), "")
            outcome = await self._part(replace(self._request, why=told))
            if outcome.success:
                return self._whole(replace(outcome, message=f"{outcome.message}; {told}"), "push")
            known = self._machine.known
            again = outcome.kind == "REFUSED" and outcome.code in NO_WAY and known is not None
            if again and known is not None and known.place_refused:
                return await self._by_the_other_arm(outcome, known)
            if not again:
                break
        return self._whole(self._left_behind(outcome, "after the pushes"), "")

    # --- parts and answers
    async def _part(self, request: GraspRequest) -> GraspOutcome:
        """One ordinary request, in what is left of the time."""
        if request.timeout > 0.0:
            left = request.timeout - self._seconds()
            if left <= 0.0:
                raise OpenArmError(Code.TIMEOUT, f"the {request.timeout:g} s for the request are over; the arms hold")
            request = replace(request, timeout=left)
        outcome = await run_request(self._machine, self._performer, request, self._tell)
        self._attempts = max(self._attempts, outcome.attempts)
        return outcome

    def _note(self, reason: str) -> None:
        self._machine.note(reason)
        self._tell()

    def _left_behind(self, outcome: GraspOutcome, how: str) -> GraspOutcome:
        """An object that stands neither where it stood nor where it was asked for: say where."""
        if outcome.held or self._machine.known is None:
            return replace(outcome, moved=True)
        x, y, _ = self._machine.known.sighting.target.p_base
        text = f"{outcome.message}; {how} {outcome.label!r} was seen at ({x:.3f}, {y:.3f}) m"
        return replace(outcome, message=text, moved=True)

    def _whole(self, outcome: GraspOutcome, route: str) -> GraspOutcome:
        """The answer to all of it."""
        route = route if outcome.success else ""
        return replace(outcome, attempts=self._attempts, duration=self._seconds(), route=route)

    def _seconds(self) -> float:
        """Robot time since it was asked for, s."""
        return (self._performer.link.now_ns - self._began_ns) * 1e-9


def _again(number: int) -> str:
    return "" if number == 1 else f", at try number {number}"
