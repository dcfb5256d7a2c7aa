# SPDX-License-Identifier: Apache-2.0
"""Two objects at once: one look at both, an arm for each, then two machines side by side, each with its own arm.

An arm is given to each object by planning: both grasps must be possible. Where they are not, or the places lie so near
to each other that the arms would only wait, the objects are picked one after the other. Base frame, m.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from openarm_common.description import Side
from openarm_common.errors import Code, OpenArmError
from openarm_grasp.beside import BesideLink, Company
from openarm_grasp.config import GraspConfig
from openarm_grasp.effects import Frames, GoHome, GraspOutcome, GraspRequest, Observe, ToBase
from openarm_grasp.legs import run_task
from openarm_grasp.machine import GraspMachine
from openarm_grasp.observation import Sighting, find, on_table
from openarm_grasp.performer import Link, Performer, run_request
from openarm_grasp.rehearsal import NO_WAY, Rehearsal
from openarm_grasp.routing import ARMS

#: Places nearer to each other than this are served one after the other, m.
_APART = 0.20


@dataclass(frozen=True)
class Pair:
    """How two requests are carried out.

    Attributes:
        arms: Of the first and the second request; empty: one after the other.
        reason: Why so.
    """

    arms: tuple[Side, ...]
    reason: str


class PairRunner:
    """Carries two requests out at the same time.

    Args:
        machines: Of the first and the second request; the first also serves those that are carried out alone.
        links: Of each arm.
        alone: Link and performer for requests that are carried out alone.
        config: Parameters.
        tell: Called after each transition, with the machine.
    """

    def __init__(
        self,
        machines: tuple[GraspMachine, GraspMachine],
        links: Mapping[Side, Link],
        alone: tuple[Link, Performer],
        config: GraspConfig,
        tell: Callable[[GraspMachine], None],
    ) -> None:
        self._machines, self._alone, self._config, self._tell = machines, alone, config, tell
        self._company = Company()
        self._links = {arm: BesideLink(arm, link, self._company, config) for arm, link in links.items()}
        self._performers = {arm: Performer(link, config, arms=(arm,)) for arm, link in self._links.items()}

    async def run(self, requests: tuple[GraspRequest, GraspRequest]) -> tuple[GraspOutcome, GraspOutcome]:
        """Carry both out.

        Raises:
            OpenArmError: BUSY, INVALID_ARGUMENT or NOT_READY, when a request is not taken.
        """
        if requests[0].label == requests[1].label or not all(request.label for request in requests):
            labels = ", ".join(repr(request.label) for request in requests)
            raise OpenArmError(Code.INVALID_ARGUMENT, f"two different labels are needed for two arms, got {labels}")
        for machine in self._machines:
            for request in requests:
                self._alone[1].check_hands(machine, request)
        began_ns = self._alone[0].now_ns
        how = await self._shared_out(requests)
        self._machines[0].note(how.reason)
        self._tell(self._machines[0])
        if not how.arms:
            return await self._in_turn(requests, began_ns)
        outcomes = await self._at_once(requests, how)
        # What was not touched beside the other arm may go when that is home.
        return (
            await self._again(requests[0], outcomes[0], began_ns),
            await self._again(requests[1], outcomes[1], began_ns),
        )

    # --- which arm
    async def _shared_out(self, requests: tuple[GraspRequest, GraspRequest]) -> Pair:
        """Look once, and give an arm to each object."""
        places = [request.place for request in requests if request.place is not None]
        if len(places) == 2 and float(np.hypot(*(np.subtract(places[0][:2], places[1][:2])))) < _APART:
            return Pair((), "the places are close to each other: one after the other")
        try:
            seen = [await self._see(request) for request in requests]
        except OpenArmError as error:
            if error.code in (Code.CANCELLED, Code.ROBOT_LOST, Code.TIMEOUT):
                raise
            return Pair((), f"{error.message}: one after the other")
        straight: tuple[Side, Side] = ("left", "right")
        crossed: tuple[Side, Side] = ("right", "left")
        further_left = seen[0].target.p_base[1] >= seen[1].target.p_base[1]
        faults: list[str] = []
        for arms in (straight, crossed) if further_left else (crossed, straight):
            asked = [request.arm in ("", "auto", arm) for request, arm in zip(requests, arms, strict=True)]
            if not all(asked):
                continue
            fault = await self._cannot(requests, seen, arms)
            if not fault:
                return Pair(arms, f"both at once: {requests[0].label!r} {arms[0]}, {requests[1].label!r} {arms[1]}")
            faults.append(fault)
        return Pair((), f"not both at once ({'; '.join(faults) or 'the same arm is asked for'}): one after the other")

    async def _see(self, request: GraspRequest) -> Sighting:
        config, performer = self._config, self._alone[1]
        low = self._machines[0].around.table.top_z + 2.0 * config.approach.lift_height
        outcome = await performer.perform((GoHome(ARMS, back_off_below=low), Observe(config.detect.frames)))
        if outcome.ok:
            frames = outcome.last(Frames)
            outcome = await performer.perform((ToBase(frames.frames, frames.frame_id),))
        if not outcome.ok:
            raise OpenArmError(outcome.code, outcome.message)
        limits = config.detect
        sighting = find(
            outcome.last(Frames).frames,
            request.label,
            match_radius=limits.match_radius,
            agree_within=limits.agree_within,
        )
        return replace(sighting, target=on_table(sighting.target, self._machines[0].around.table.top_z))

    async def _cannot(
        self, requests: tuple[GraspRequest, GraspRequest], seen: list[Sighting], arms: tuple[Side, Side]
    ) -> str:
        """Why the arms cannot do this; "" when they can."""
        rehearsal = Rehearsal(self._alone[0], self._machines[0].around)
        for request, sighting, arm in zip(requests, seen, arms, strict=True):
            try:
                if request.place is None:
                    await rehearsal.pick(arm, sighting.target, sighting.others)
                else:
                    place = np.array(request.place[:2], dtype=np.float64)
                    await rehearsal.pick_and_place(
                        arm, sighting.target, sighting.others, (place,), yaw=request.place_yaw
                    )
            except OpenArmError as error:
                if error.code not in NO_WAY:
                    raise
                return error.message
        return ""

    # --- doing
    async def _at_once(
        self, requests: tuple[GraspRequest, GraspRequest], how: Pair
    ) -> tuple[GraspOutcome, GraspOutcome]:
        outcomes: dict[int, GraspOutcome] = {}
        self._company.done.clear()

        async def work(i: int) -> None:
            arm, machine = how.arms[i], self._machines[i]
            link, performer = self._links[arm], self._performers[arm]
            asked = replace(requests[i], arm=arm, why=how.reason)
            try:
                outcomes[i] = await run_request(machine, performer, link, asked, lambda: self._tell(machine))
            finally:
                self._company.done.add(arm)

        await self._alone[0].together([lambda: work(0), lambda: work(1)])
        first, second = (
            replace(outcomes[i], route="direct" if outcomes[i].success else "") for i in range(len(requests))
        )
        return first, second

    async def _in_turn(
        self, requests: tuple[GraspRequest, GraspRequest], began_ns: int
    ) -> tuple[GraspOutcome, GraspOutcome]:
        first = await self._one(requests[0], began_ns)
        if first.code in (Code.CANCELLED, Code.ROBOT_LOST, Code.TIMEOUT) or first.held:
            text = f"not begun: {first.label!r} ended with {first.code}: {first.message}"
            return first, GraspOutcome(first.code, text, requests[1].label)
        return first, await self._one(requests[1], began_ns)

    async def _again(self, request: GraspRequest, outcome: GraspOutcome, began_ns: int) -> GraspOutcome:
        held = any(machine.kept is not None for machine in self._machines)
        return await self._one(request, began_ns) if outcome.kind == "REFUSED" and not held else outcome

    async def _one(self, request: GraspRequest, began_ns: int) -> GraspOutcome:
        """A request alone, by whatever way, in what is left of the time."""
        link, performer = self._alone
        if request.timeout > 0.0:
            left = request.timeout - (link.now_ns - began_ns) * 1e-9
            if left <= 0.0:
                return GraspOutcome(Code.TIMEOUT, f"the {request.timeout:g} s were over before it began", request.label)
            request = replace(request, timeout=left)
        machine = self._machines[0]
        return await run_task(machine, performer, link, request, lambda: self._tell(machine))
