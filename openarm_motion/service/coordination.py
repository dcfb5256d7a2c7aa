# SPDX-License-Identifier: Apache-2.0
"""Arms next to each other: execute a trajectory, starting it late enough to keep clear of an arm under way.

Two arms that are sent out at the same time go one after the other through the search for clearance; from then
on each knows when the other began. An arm that stops on its way makes the other one check again.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence

from openarm_common.errors import Code, OpenArmError
from openarm_motion.collision.solids import Box
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.coordination import ActiveMotion, least_delay
from openarm_motion.scene.held import HeldObjects
from openarm_motion.service.follower import MotionFollower
from openarm_motion.service.robot import RobotInterface
from openarm_motion.timing.checks import check_against_others, check_trajectory
from openarm_motion.timing.trajectory import Motion

#: An arm begins so long after the newest joint state, s: time to search for clearance and to send the trajectory. When
#: that was not enough, the next.
_HEAD_STARTS = (0.1, 0.4, 1.5, 5.0)
#: What of it must be left to send the trajectory, s.
_SEND = 0.03
#: Duration of the search for clearance where time is simulated, s.
_NOMINAL = 0.03


class DelayCoordination:
    """Executes motions of arms that share the workspace.

    Args:
        robot: The robot.
        arms: Arms by name.
        held: Boxes that the hands hold.
        on_held: Called when what a hand holds has changed.
    """

    def __init__(
        self, robot: RobotInterface, arms: Mapping[str, Arm], held: HeldObjects, on_held: Callable[[], None]
    ) -> None:
        self._robot, self._arms, self._held, self._on_held = robot, arms, held, on_held
        self.followers = {name: MotionFollower(robot, arm) for name, arm in arms.items()}
        #: How often each arm has stopped on its way.
        self.stops = dict.fromkeys(arms, 0)
        self._starting = False

    def hold(self, name: str, boxes: Sequence[Box]) -> None:
        """Note what an arm holds from now on."""
        if self._held.hold(name, boxes):
            self._on_held()

    async def follow(
        self,
        arm: Arm,
        given: Motion,
        cancelled: Callable[[], bool],
        progress: Callable[[float], None],
        max_delay: float = 0.0,
    ) -> float:
        """Execute a trajectory; return how long the arm rested first, s.

        Args:
            arm: The arm.
            given: The trajectory.
            cancelled: Whether to hold.
            progress: Called with 0 to 1.
            max_delay: It may rest so long first until an arm under way leaves clearance, s; more than 0 also proves
                that it keeps 20 mm from an arm at rest.

        Raises:
            OpenArmError: INVALID_ARGUMENT or LIMITS, for what is no trajectory of the arm; IN_COLLISION, when there is
                no clearance, or no longer because another arm stopped; as `MotionFollower.follow`.
        """
        if not 0.0 <= max_delay < float("inf"):
            raise OpenArmError(Code.INVALID_ARGUMENT, f"max_start_delay is {max_delay:g} s, expected 0 or more")
        while self._starting or not self._certain(arm):
            await self._robot.pause()
        self._starting = True
        try:
            motion = check_trajectory(arm, given, self._robot.states.latest()[1])
            planned = self._held.expected(arm.name, motion)
            held = None if planned is None else planned.held
            begin_ns, delay = await self._begin(arm, motion, held, cancelled, max_delay)
            if held is not None:
                self.hold(arm.name, held)
            halt = _Halt(self, arm, cancelled)
            self.followers[arm.name].begin(motion, begin_ns)
        finally:
            self._starting = False
        try:
            touches = planned is None or planned.touches
            await self.followers[arm.name].follow(motion, begin_ns, halt, progress, touches=touches)
        except OpenArmError as error:
            self.stops[arm.name] += 1
            if halt.fault is not None:
                raise halt.fault from error
            raise
        return delay

    async def check_together(self, arms: Sequence[Arm], given: Sequence[Motion]) -> None:
        """Refuse trajectories that begin at the same moment and on which the arms would meet.

        Raises:
            OpenArmError: INVALID_ARGUMENT, LIMITS or IN_COLLISION.
        """
        state = self._robot.states.latest()[1]
        pairs = [(arm, check_trajectory(arm, motion, state)) for arm, motion in zip(arms, given, strict=True)]

        def check() -> None:
            for arm, motion in pairs:
                check_against_others(arm, motion, state, [pair for pair in pairs if pair[0] is not arm])

        await self._robot.compute(check, _NOMINAL)

    async def follow_together(
        self,
        arms: Sequence[Arm],
        given: Sequence[Motion],
        cancelled: Callable[[], bool],
        progress: Callable[[float], None],
    ) -> None:
        """Execute trajectories of several arms that begin at the same moment; when one fails the others hold.

        Raises:
            OpenArmError: the first fault; as `MotionFollower.follow`.
        """
        stamp_ns, state = self._robot.states.latest()
        # both controllers begin at the same moment, so that none begins earlier than the other
        begin_ns = stamp_ns + round(_HEAD_STARTS[0] * 1e9)
        motions = [check_trajectory(arm, motion, state) for arm, motion in zip(arms, given, strict=True)]
        faults: list[OpenArmError] = []
        shares = [0.0] * len(motions)

        def part(k: int) -> Callable[[], Awaitable[None]]:
            def one_progress(value: float) -> None:
                shares[k] = value
                progress(min(shares))

            async def run() -> None:
                follower = self.followers[arms[k].name]
                try:
                    await follower.follow(motions[k], begin_ns, lambda: bool(faults) or cancelled(), one_progress)
                except OpenArmError as error:
                    faults.append(error.settled())

            return run

        await self._robot.together([part(k) for k in range(len(motions))])
        if faults:
            raise faults[0]

    async def start_delay(self, arm: Arm, motion: Motion, held: Sequence[Box], cancelled: Callable[[], bool]) -> float:
        """Return how long a planned motion would have to rest first for an arm under way, as things are now, s.

        Raises:
            OpenArmError: IN_COLLISION, when no rest helps; CANCELLED.
        """
        if not self.under_way(arm):
            return 0.0
        while not self._certain(arm):
            await self._robot.pause()
        now_ns, state = self._robot.states.latest()
        opened = self._hands_open(state)
        others, mine = self._others(arm, now_ns, opened), ActiveMotion(arm, motion, held)
        return await self._robot.compute(lambda: least_delay(mine, others, opened, stopped=cancelled), _NOMINAL)

    def under_way(self, arm: Arm) -> bool:
        """Whether another arm is under way."""
        return any(f.active is not None for name, f in self.followers.items() if name != arm.name)

    def _certain(self, arm: Arm) -> bool:
        """Whether it is known when each of the other arms under way began."""
        return all(f.active is None or f.active.certain for name, f in self.followers.items() if name != arm.name)

    def ends(self, arms: Sequence[Arm]) -> dict[str, float]:
        """Return where the joints of the other arms under way will end."""
        names = {arm.name for arm in arms}
        active = [f.active.motion for name, f in self.followers.items() if name not in names and f.active is not None]
        return {joint: x for motion in active for joint, x in motion.joints_at(motion.duration).items()}

    def check_again(self, arm: Arm, name: str) -> OpenArmError | None:
        """Return what this arm would meet now that another one has stopped on its way, or None."""
        active = self.followers[arm.name].active
        if active is None:
            return None
        now_ns, state = self._robot.states.latest()
        try:
            check_against_others(arm, active.rest(now_ns), state)
        except OpenArmError as error:
            text = f"the {name} arm stopped on its way, and the {arm.name} arm holds before it: {error.message}"
            return OpenArmError(error.code, text)
        return None

    async def _begin(
        self, arm: Arm, motion: Motion, held: Sequence[Box] | None, cancelled: Callable[[], bool], max_delay: float
    ) -> tuple[int, float]:
        """When to begin, robot time in ns (0: at once), and how much of that is waiting for another arm, s."""
        latest = self._robot.states.latest
        mine = ActiveMotion(arm, motion, self._held.held.get(arm.name, ()) if held is None else held)
        for head in _HEAD_STARTS:
            now_ns, state = latest()
            begin_ns, stops = now_ns + round(head * 1e9), dict(self.stops)
            at_rest = not self.under_way(arm)
            if at_rest and max_delay == 0.0:
                check_against_others(arm, motion, state)
                return 0, 0.0
            opened = self._hands_open(state)
            others = self._others(arm, begin_ns, opened)
            search = lambda o=others, s=opened: least_delay(mine, o, s, max_delay, cancelled)  # noqa: E731
            delay = await self._robot.compute(search, _NOMINAL)
            if at_rest and delay == 0.0:
                return 0, 0.0  # no other arm starts meanwhile
            begin_ns += round(delay * 1e9)
            if stops == self.stops and latest()[0] + round(_SEND * 1e9) <= begin_ns:
                return begin_ns, delay
        raise OpenArmError(
            Code.TIMEOUT,
            f"{arm.name} arm: {_HEAD_STARTS[-1]:g} s were not enough to find clearance next to the other arm;"
            " try again",
        )

    def _hands_open(self, state: Mapping[str, float]) -> Mapping[str, float]:
        """The joints with all hands open: they may open on the way."""
        for arm in self._arms.values():
            state = arm.with_gripper(state, arm.opened)
        return state

    def _others(self, arm: Arm, now_ns: int, state: Mapping[str, float]) -> list[ActiveMotion]:
        """What the other arms have before them, from a moment on."""
        found: list[ActiveMotion] = []
        for name, follower in self.followers.items():
            other, held = self._arms[name], self._held.held.get(name, ())
            if other is not arm and follower.active is not None:
                found.append(ActiveMotion(other, follower.active.rest(now_ns), held))
            elif other is not arm and all(joint in state for joint in other.names):
                found.append(ActiveMotion.standing(other, state, held))
        return found


class _Halt:
    """Whether an arm under way is to hold: by request, or because another arm stopped in its way."""

    def __init__(self, coordination: DelayCoordination, arm: Arm, cancelled: Callable[[], bool]) -> None:
        self._coordination, self._arm, self._cancelled = coordination, arm, cancelled
        self._known = dict(coordination.stops)
        self.fault: OpenArmError | None = None

    def __call__(self) -> bool:
        for name, count in self._coordination.stops.items():
            if name != self._arm.name and count != self._known[name] and self.fault is None:
                self._known[name] = count
                self.fault = self._coordination.check_again(self._arm, name)
        return self.fault is not None or self._cancelled()
