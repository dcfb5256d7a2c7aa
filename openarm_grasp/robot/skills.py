# SPDX-License-Identifier: Apache-2.0
"""What a robot can do as one step of a strategy: observe, plan, move, grip, measure. No ROS, no clock of its own.

Each skill checks first that the work may go on (cancel, deadline, a robot that has gone silent), and raises when it
does not succeed.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from math import inf
from typing import Literal

import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.lift import LIFT
from openarm_common.types import Array
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence.hand import SPEED_WINDOW_NS, HandReader
from openarm_grasp.evidence.verdicts import Evidence, learn_command
from openarm_grasp.perception.detections import Frame, Sighting
from openarm_grasp.planning.candidates import (
    UP,
    Box,
    GraspCandidate,
    PlaceTarget,
    held_boxes,
    target_box,
    target_boxes,
)
from openarm_grasp.planning.neighbours import neighbours, under
from openarm_grasp.planning.options import NO_WAY
from openarm_grasp.robot.interface import PlanGrasp, Planned, PlanPlace, RobotInterface, Trajectory, slowed

#: The map shows an object so much wider than it is, m.
_CELL = 0.01
#: Errors of a robot that end a request at once, with the arm where it is.
STOPS = (Code.CANCELLED, Code.ROBOT_LOST, Code.STOPPED, Code.INTERNAL)


def reraise_stop(error: OpenArmError) -> None:
    """Raise an error again that no strategy may handle, because it ends the request."""
    if error.code in STOPS:
        raise error


class Skills:
    """The skills of a robot.

    Args:
        robot: Interface to it.
        config: Parameters.
    """

    def __init__(self, robot: RobotInterface, config: GraspConfig) -> None:
        self.robot = robot
        self._config = config
        self._hands = {arm: HandReader(robot.description, robot.states, arm) for arm in robot.description.arm_names}

    @property
    def now_ns(self) -> int:
        """Robot time."""
        return self.robot.now_ns

    @property
    def description(self) -> RobotDescription:
        """The robot."""
        return self.robot.description

    def set_deadline(self, timeout: float) -> None:
        """End the work after so many s of robot time; 0: no limit."""
        self.robot.deadline_ns = self.robot.now_ns + round(timeout * 1e9) if timeout > 0.0 else 0

    def set_speed(self, scale: float, failures: int = 0) -> None:
        """Let motions take a share of the limits of the joints, half of it after each failure.

        Args:
            scale: The share; 0: that of the configuration.
            failures: Attempts that have failed.
        """
        self.robot.velocity_scale = slowed(scale or self._config.velocity_scale, 0.5**failures)

    def warn(self, text: str) -> None:
        """Report something that does not stop the work."""
        self.robot.warn(text)

    async def until(self, done: Callable[[], bool], limit: float, what: str) -> None:
        """Wait for a condition, no longer than `limit` s."""
        self.robot.check()
        await self.robot.until(done, limit, what)

    async def wait(self, duration: float) -> None:
        """Let robot time pass, s."""
        robot = self.robot
        robot.check()
        end_ns = robot.now_ns + round(duration * 1e9)
        # Simulated time may be slow; one that does not advance is noticed by the robot's interface.
        limit = 20.0 * duration + 10.0
        await robot.until(lambda: robot.now_ns >= end_ns, limit, f"waiting {duration:g} s of robot time")

    # --- observing
    async def observe(self, count: int, *, near: str = "") -> tuple[Frame, ...]:
        """Frames that are taken from now on, oldest first, by the camera over the table, or by one on a hand."""
        self.robot.check()
        return await self.robot.observe(count, near=near)

    def expect_near(self, camera: str) -> None:
        """Announce an observation by the camera on the hand."""
        self.robot.expect_near(camera)

    def stop_observing(self) -> None:
        """Let the detector rest."""
        self.robot.stop_observing()

    async def look(self, count: int) -> tuple[Frame, ...]:
        """So many frames of the camera over the table; the detector rests afterwards."""
        seen = await self.observe(count)
        self.stop_observing()
        return seen

    async def towards_end(
        self,
        motion: Callable[[], Awaitable[None]],
        near_end: Callable[[], bool],
        work: Callable[[], Awaitable[None]],
    ) -> None:
        """Carry out a motion, and something else from near its end on, unless it fails before.

        Args:
            motion: Motion of the arm.
            near_end: True when it is near enough to its end.
            work: Done then.

        Raises:
            OpenArmError: Same as the motion, then as the work.
        """
        ended = list[bool]()

        async def move() -> None:
            try:
                await motion()
            except BaseException:
                ended.append(False)
                raise
            ended.append(True)

        async def then() -> None:
            await self.robot.until(lambda: bool(ended) or near_end(), self._config.limits.move_timeout, "the motion")
            if ended != [False]:
                await work()

        await self.robot.together([move, then])

    async def observe_towards_end(
        self, motion: Callable[[], Awaitable[None]], near_end: Callable[[], bool], count: int
    ) -> tuple[Frame, ...]:
        """As `towards_end`, the work being so many frames of the camera over the table; errors also as `observe`."""
        frames = list[Frame]()

        async def look() -> None:
            frames.extend(await self.observe(count))

        await self.towards_end(motion, near_end, look)
        return tuple(frames)

    # --- planning
    async def plan(self, request: PlanGrasp | PlanPlace) -> Planned:
        """Plan; raises with the planner's code."""
        self.robot.check()
        return await self.robot.plan(request)

    async def plan_grasp(
        self,
        arm: str,
        ways: Sequence[GraspCandidate],
        found: Sighting,
        now: Sighting | None = None,
        *,
        at_height: float | None = None,
        blend: bool = False,
    ) -> Planned:
        """Plan one of several grasps.

        Args:
            arm: Arm to plan for.
            ways: The candidates.
            found: The object and its neighbours.
            now: The object where it stands until then, when that is elsewhere: the map shows it there.
            at_height: Position that the lift has then, m; None: where it is.
            blend: The transfer goes on to the grasp without a stop.
        """
        config, start = self._config, tuple[float, ...]()
        if at_height is not None:
            _, q = self.robot.states.latest()
            start = (at_height, *(q[name] for name in self.description.arm_joints(arm)))
        target = target_boxes(found.target, ways[0] if ways else None, config)
        obstacles = neighbours(found, target, config)
        gone = () if now is None else (target_box(now.target, config),)
        return await self.plan(PlanGrasp(arm, tuple(ways), obstacles, target, gone, start, blend=blend))

    async def plan_push(
        self,
        arm: str,
        ways: Sequence[GraspCandidate],
        found: Sighting,
        pushed: tuple[Box, ...],
        under: tuple[Box, ...] = (),
    ) -> Planned:
        """Plan a closed hand that pushes one thing, or several, slowly.

        Args:
            arm: Arm to plan for.
            ways: The candidates.
            found: Objects around them.
            pushed: Boxes about them, as far as the hand meets them.
            under: Boxes about all of them: what the map shows there is no obstacle.
        """
        others, speed = neighbours(found, pushed, self._config), self._config.push.velocity_scale
        return await self.plan(PlanGrasp(arm, tuple(ways), others, pushed, under, velocity_scale=speed))

    async def plan_place(
        self,
        arm: str,
        ways: Sequence[PlaceTarget],
        found: Sighting,
        candidate: GraspCandidate,
        after: Trajectory | None = None,
        *,
        turned: bool = False,
        in_part: bool = False,
    ) -> Planned:
        """Plan how to put the object down; the map may still show it where it was, or below the hand that lifted it.

        Args:
            arm: Arm to plan for.
            ways: Ways to put the object down.
            found: The object before the grasp, and its neighbours.
            candidate: Grasp that holds it.
            after: Trajectory whose end is the start; None starts at the present joints.
            turned: It has turned in the hand: the map shows it around the hand, and how it hangs is not known.
            in_part: There may be more of it than was seen: the map shows that around the hand.
        """
        held = held_boxes(found.target, candidate, self._config)
        obstacles = neighbours(found, target_boxes(found.target, candidate, self._config), self._config)
        obstacles = under(obstacles, ways)
        stood, lift = target_box(found.target, self._config), self._config.approach.lift_height
        grown = np.array([2.0 * _CELL, 2.0 * _CELL, lift])
        column = Box(stood.id, se3.make(p=(0.0, 0.0, 0.5 * lift)) @ stood.T_frame_box, stood.size + grown)
        ignored = [column]
        if turned:
            held = ()
        if turned or (in_part and after is None):
            reach = 2.0 * float(np.linalg.norm(found.target.size))
            ignored.append(Box(f"{stood.id}/hanging", se3.make(p=self.T_base_tcp(arm)[:3, 3]), np.full(3, reach)))
        return await self.plan(PlanPlace(arm, tuple(ways), obstacles, held, after, tuple(ignored)))

    async def scene_version(self) -> int:
        """Version of the planning scene."""
        self.robot.check()
        return await self.robot.scene_version()

    async def reach(self, arms: Sequence[str], T_base_tcp: Array) -> dict[str, float]:
        """How far each arm's TCP stays from a point, m by arm; those of which nothing is known are left out."""
        self.robot.check()
        distances: dict[str, float] = {}
        for arm in arms:
            distances |= await self.robot.reach(arm, T_base_tcp)
        return distances

    # --- moving
    async def follow(
        self,
        arm: str,
        trajectory: Trajectory,
        what: str,
        *,
        carrying: bool = False,
        line: tuple[Array, Array] | None = None,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        """Follow a planned trajectory.

        Args:
            arm: Arm to move.
            trajectory: Trajectory of the planner.
            what: Name of the motion for errors, for example "lift".
            carrying: A hand that closes or slips stops it.
            line: Ends (3,) of the straight line that the TCP follows at last, base frame, m; leaving it by more than
                `path_tolerance` stops it.
            check: Called on the way; what it raises stops the arm.

        Raises:
            OpenArmError: GRASP_LOST; HAND_COLLISION; as the robot; as `check`.
        """
        self.robot.check()
        held, at_first, tolerance = self._config.held, self.aperture(arm), self._config.approach.path_tolerance

        def still_held() -> None:
            if not carrying:
                return
            now = self.aperture(arm)
            if self.is_closed(arm):
                raise OpenArmError(Code.GRASP_LOST, f"{what}: the hand closed to {now * 1e3:.1f} mm on the way")
            if abs(now - at_first) > held.slip:
                raise OpenArmError(
                    Code.GRASP_LOST,
                    f"{what}: the object slips: the gap went from {at_first * 1e3:.1f} to {now * 1e3:.1f} mm on the"
                    f" way, expected to stay within {held.slip * 1e3:.0f} mm",
                )

        def on_line() -> None:
            off = 0.0 if line is None else _off_line(self._hands[arm].T_base_tcp()[:3, 3], *line)
            if off > tolerance:
                text = f"{what}: the hand is {off * 1e3:.0f} mm off its straight line, expected at most"
                raise OpenArmError(Code.HAND_COLLISION, f"{text} {tolerance * 1e3:.0f} mm; is something in its way?")

        def guard() -> None:
            still_held()
            on_line()
            check()

        await self.robot.follow(arm, trajectory, f"{arm} arm: {what}", guard)

    async def follow_and_grip(
        self,
        arm: str,
        trajectory: Trajectory,
        what: str,
        how: Literal["open", "close"],
        aperture: float | None = None,
    ) -> None:
        """Follow a trajectory and move the fingers at the same time; arguments and errors as of `follow`, `open`."""
        grip = (lambda: self.open(arm, how, aperture)) if how == "open" else (lambda: self.close(arm, how))
        await self.robot.together([grip, lambda: self.follow(arm, trajectory, what)])

    async def move_linear(self, arm: str, T_base_tcp: Array, what: str) -> None:
        """Move the TCP to a pose on a straight line."""
        self.robot.check()
        await self.robot.move(arm, T_base_tcp, f"{arm} arm: {what}")

    async def move_lift(self, position: float, *, plan_only: bool = False) -> None:
        """Move the lift that carries the arms, while they keep their postures, m; or only plan that."""
        self.robot.check()
        await self.robot.move(LIFT, np.array([position]), "lift", plan_only=plan_only)

    async def stuck(self) -> bool:
        """Whether no arm can move at all, since each starts in collision: nothing but a person frees it."""
        for arm in self.description.arm_names:
            _, q = self.robot.states.latest()
            here = np.array([q[name] for name in self.description.arm_joints(arm)])
            try:
                await self.robot.move(arm, here, f"{arm} arm", plan_only=True)
            except OpenArmError as error:
                if error.code == Code.IN_COLLISION:
                    continue
                reraise_stop(error)
            return False
        return True

    def lift_position(self) -> float:
        """Position of the lift, m; 0 without one."""
        lift = self.description.lift
        return self.robot.states.latest()[1][lift.joint] if lift is not None else 0.0

    async def go_home(
        self, arms: Sequence[str], obstacles: Sequence[Box] = (), *, back_off_below: float = float("-inf")
    ) -> None:
        """Move the arms that are not there to their home posture, one after the other.

        Args:
            arms: Arms to move.
            obstacles: Boxes to keep clear of, base frame.
            back_off_below: A hand lower than this (z, base frame, m) may be among the objects and first backs off along
                its own approach axis.
        """
        config, robot = self._config, self.robot
        robot.check()
        for arm in arms:
            if self.away_from_home(arm) <= config.home_tolerance:
                continue
            T_base_tcp = self._hands[arm].T_base_tcp()
            if T_base_tcp[2, 3] < back_off_below:
                T_back = T_base_tcp @ se3.make(p=(0.0, 0.0, -config.approach.pregrasp_distance))
                try:
                    await robot.move(arm, T_back, f"{arm} arm: back off")
                except OpenArmError as error:
                    reraise_stop(error)
                    robot.warn(error.message)  # the free path home may still be there
            await self._home(arm, obstacles)

    def away_from_home(self, arm: str) -> float:
        """How far the joint that is farthest from the home posture is from it, rad."""
        home = self.description.group_state(f"{arm}_arm", self._config.home_state)
        return self.description.away(home, self.robot.states.latest()[1])

    async def _home(self, arm: str, obstacles: Sequence[Box]) -> None:
        """Move an arm to its home posture; where there is no way, because something leans on the hand, rise first."""
        what = f"{arm} arm: go {self._config.home_state}"
        try:
            await self.robot.move(arm, self._config.home_state, what, obstacles)
            return
        except OpenArmError as error:
            if error.code not in NO_WAY:
                raise
            try:
                await self.move_linear(
                    arm, se3.make(p=self._config.approach.lift_height * UP) @ self.T_base_tcp(arm), "rise"
                )
            except OpenArmError as other:
                reraise_stop(other)
                raise error from other
        await self.robot.move(arm, self._config.home_state, what, obstacles)

    def joints(self) -> dict[str, float]:
        """Positions of the joints of all arms, rad by name."""
        _, q = self.robot.states.latest()
        return {name: q[name] for arm in self.description.arm_names for name in self.description.arm_joints(arm)}

    # --- the hand
    def aperture(self, arm: str) -> float:
        """Distance between the fingers, m.

        Raises:
            OpenArmError: NOT_READY, without a joint state of it.
        """
        return self._hands[arm].gap()

    def T_base_tcp(self, arm: str) -> Array:
        """(4, 4) pose of the tool centre point."""
        return self._hands[arm].T_base_tcp()

    def held_box(self, arm: str) -> Box | None:
        """What the planner carries in a hand, TCP frame; None when it knows of nothing there."""
        return self.robot.held_box(arm)

    def is_closed(self, arm: str) -> bool:
        """Whether a hand is closed on nothing; raises as `aperture`."""
        reader = self._hands[arm]
        hand = reader.hand
        force = 0.0 if hand.reach is None else self.robot.effort(hand.joint) / abs(hand.lever)
        return Evidence(reader.gap(), 0.0, force, 0.0, reach=hand.reach).empty(self._config.held)

    def is_open(self, arm: str) -> bool:
        """Whether a hand is as wide open as for a grasp; raises as `aperture`."""
        reader = self._hands[arm]
        return reader.finger() >= reader.hand.parts.opening - self._config.hand.open_tolerance

    async def open(self, arm: str, what: str, aperture: float | None = None, *, held: float = inf) -> None:
        """Open the hand.

        Args:
            arm: Arm of the hand.
            what: Name of the motion for errors, for example "release".
            aperture: Distance between the fingers, m; None: wide open.
            held: Gap at which it holds something, m: `lets_go` more is enough, as other things may stop the fingers.

        Raises:
            OpenArmError: EXECUTION_FAILED, when the fingers do not get there.
        """
        self.robot.check()
        reader, robot, what = self._hands[arm], self.robot, f"{arm} hand: {what}"
        finger = reader.hand.parts.opening if aperture is None else 0.5 * aperture
        await robot.grip(arm, reader.joint, reader.hand.position(finger), what, 0.0)
        # The result may be here before the joint state that shows it.
        end_ns, limit = robot.now_ns + SPEED_WINDOW_NS, self._config.limits.answer_timeout

        def there() -> bool:
            off = reader.finger() - finger
            return (off if aperture is None else -abs(off)) >= -self._config.hand.open_tolerance

        await robot.until(lambda: there() or robot.now_ns > end_ns, limit, what)
        if not there():
            text = f"{what}: the fingers stopped at {reader.finger() * 1e3:.1f} mm of {finger * 1e3:.0f} mm"
            if reader.gap() < held + self._config.hand.lets_go:
                learned = "" if reader.hand.reach is None else f" ({reader.hand.reach})"
                text += f"; if nothing is in their way, this hand opens no farther{learned}: {learn_command(arm)}"
                raise OpenArmError(Code.EXECUTION_FAILED, text)
            robot.warn(f"{text}, between other things")

    async def close(self, arm: str, what: str, force: float = 0.0) -> None:
        """Close the hand until it presses on something.

        Args:
            arm: Arm of the hand.
            what: Name of the motion for errors, for example "close".
            force: Largest, N; 0: the driver's limit.

        Raises:
            OpenArmError: EXECUTION_FAILED, when it neither closes nor meets anything.
        """
        self.robot.check()
        reader, what = self._hands[arm], f"{arm} hand: {what}"
        hand = reader.hand
        if not await self.robot.grip(arm, reader.joint, hand.closed, what, force * abs(hand.lever)):
            raise OpenArmError(Code.EXECUTION_FAILED, f"{what}: the fingers neither arrived nor met anything")

    async def measure(
        self, arm: str, expected: float, T_base_tcp: Array | None = None, *, settle: float = 0.0
    ) -> Evidence:
        """Read the gripper at rest.

        Args:
            arm: Arm of the hand.
            expected: Width between the fingers, m.
            T_base_tcp: (4, 4) planned pose that the TCP error is measured against; None leaves the error 0.
            settle: Longest wait for the fingers to rest, s.
        """
        hand, robot, limit = self._hands[arm], self.robot, 20.0 * settle + 10.0
        robot.check()
        end_ns = robot.now_ns + round(settle * 1e9)

        def at_rest() -> bool:
            try:
                speed = hand.gap_speed()
            except OpenArmError as error:
                if error.code is not Code.STALE_DATA:
                    raise
                return False  # joint states were missing for a moment; the speed is known again soon
            return abs(speed) < self._config.held.max_speed or robot.now_ns >= end_ns

        await robot.until(at_rest, limit, "waiting for the fingers to rest")
        pads = robot.pads(arm) if self._config.held.use_finger_force else ()
        return hand.evidence(expected, robot.effort(hand.joint), T_base_tcp, pads)


def _off_line(p: Array, begin: Array, end: Array) -> float:
    """Distance of a point from a line segment, m; 0 before its beginning."""
    way = end - begin
    share = min(float((p - begin) @ way / (way @ way)), 1.0)
    return 0.0 if share < 0.0 else float(np.linalg.norm(p - begin - share * way))
