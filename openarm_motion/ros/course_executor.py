# SPDX-License-Identifier: Apache-2.0
"""Carries out a trajectory of one arm: checks it, finds room beside another arm under way, knows what is held on it.

Two arms that are sent out at the same time go one after the other through the part that looks for room; from then on
each knows when the other began. An arm that stops on its way makes the other one look again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from rclpy.task import Future
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import ns_to_stamp, trajectory_from_msg
from openarm_common.ros.node import QOS_LATCHED
from openarm_motion.collision.solids import Box
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.beside import Course, least_wait
from openarm_motion.ros import convert
from openarm_motion.ros.follower import Robot
from openarm_motion.timing.checks import Motion, check_against_others, check_trajectory
from openarm_motion.timing.trajectory import Trajectory

#: An arm begins so long after the newest joint state, s: time to look for room and to tell its controller. When that
#: was not enough, the next.
_HEAD_STARTS = (0.1, 0.4, 1.5, 5.0)
#: What of it must be left to tell the controller, s.
_TELL = 0.03


class CourseExecutor:
    """See the module's head.

    Args:
        robot: The robot and its node.
    """

    def __init__(self, robot: Robot) -> None:
        self._node, self._states, self._held = robot.node, robot.states, robot.held
        self._followers, self._arms = robot.followers, robot.arms
        self._stops = dict.fromkeys(robot.arms, 0)
        self._turn: Future | None = None
        self._attached = robot.node.create_publisher(MarkerArray, "/motion/attached_objects", QOS_LATCHED)
        self._publish()

    def hold(self, name: str, boxes: Sequence[Box]) -> None:
        """Note and tell what an arm holds from now on."""
        if self._held.hold(name, boxes):
            self._publish()

    async def follow(
        self,
        arm: Arm,
        message: JointTrajectory,
        stopped: Callable[[], bool],
        progress: Callable[[float], None],
        max_wait: float = 0.0,
    ) -> float:
        """Carry out a trajectory; returns how long the arm rested first, s.

        Args:
            arm: The arm.
            message: What it is to do; its stamp is set where another arm is to be kept clear of.
            stopped: Whether to hold.
            progress: Called with 0 to 1.
            max_wait: It may rest so long first until an arm under way leaves room, s; more than 0 also proves that it
                keeps 20 mm from an arm that stands.

        Raises:
            OpenArmError: INVALID_ARGUMENT or LIMITS, for what is no trajectory of the arm; IN_COLLISION, when there is
                no room, or no longer because another arm stopped on its way; as `Follower.follow`.
        """
        if not 0.0 <= max_wait < float("inf"):
            raise OpenArmError(Code.INVALID_ARGUMENT, f"max_wait is {max_wait:g} s, expected 0 or more")
        turn = await self._take_turn()
        try:
            names, t, q, v, a = trajectory_from_msg(message)
            motion = check_trajectory(arm, names, t, q, v, self._states.buffer.latest()[1], a)
            held = self._held.expected(arm.name, motion)
            begin_ns, wait = await self._room(arm, motion, held, stopped, max_wait)
            if begin_ns:
                message.header.stamp = ns_to_stamp(begin_ns)
            if held is not None:
                self.hold(arm.name, held)
            watch = _Others(self, arm, stopped)
            follower = self._followers[arm.name]
            follower.set_out(motion, begin_ns)
        finally:
            turn.set_result(None)
        try:
            await follower.follow(message, motion, watch, progress)
        except OpenArmError as error:
            self._stops[arm.name] += 1
            if watch.fault is not None:
                raise watch.fault from error
            raise
        return wait

    async def _room(
        self, arm: Arm, motion: Motion, held: Sequence[Box] | None, stopped: Callable[[], bool], max_wait: float
    ) -> tuple[int, float]:
        """When to begin, robot time in ns (0: at once), and how much of that is waiting for another arm, s."""
        latest = self._states.buffer.latest
        mine = self._held.held.get(arm.name, ()) if held is None else held
        for head in _HEAD_STARTS:
            now_ns, state = latest()
            begin_ns = now_ns + round(head * 1e9)
            under_way, stops = self._under_way(arm), dict(self._stops)
            if not under_way and max_wait == 0.0:
                check_against_others(arm, motion, state, [])
                return 0, 0.0
            wide = self._hands_open(state)
            others, course = self._courses(arm, begin_ns, wide), Course(arm, motion, mine)
            wait: float = await self._node.in_thread(least_wait, course, others, wide, max_wait, stopped)
            begin_ns += round(wait * 1e9)
            if stops == self._stops and latest()[0] + round(_TELL * 1e9) <= begin_ns:
                return begin_ns, wait
        raise OpenArmError(
            Code.TIMEOUT,
            f"{arm.name} arm: {_HEAD_STARTS[-1]:g} s were not enough to find room beside the other arm; try again",
        )

    async def wait_for(
        self, arm: Arm, trajectory: Trajectory, held: Sequence[Box], stopped: Callable[[], bool]
    ) -> float:
        """How long a planned trajectory would have to rest first for an arm under way, as things stand, s.

        Raises:
            OpenArmError: IN_COLLISION, when no rest helps; CANCELLED.
        """
        if not self._under_way(arm):
            return 0.0
        now_ns, state = self._states.buffer.latest()
        wide = self._hands_open(state)
        others = self._courses(arm, now_ns, wide)
        mine = Course(arm, Motion.of(trajectory), held)
        wait: float = await self._node.in_thread(lambda: least_wait(mine, others, wide, stopped=stopped))
        return wait

    def look_again(self, arm: Arm, name: str) -> OpenArmError | None:
        """Another arm has stopped on its way: what this one would meet now, or None."""
        running = self._followers[arm.name].running
        if running is None:
            return None
        now_ns, state = self._states.buffer.latest()
        try:
            check_against_others(arm, running.rest(now_ns), state, [])
        except OpenArmError as error:
            text = f"the {name} arm stopped on its way, and the {arm.name} arm holds before it: {error.message}"
            return OpenArmError(error.code, text)
        return None

    @property
    def stops(self) -> Mapping[str, int]:
        """How often each arm has stopped on its way."""
        return self._stops

    def _hands_open(self, state: Mapping[str, float]) -> Mapping[str, float]:
        """The joints with all hands open: they may open on the way."""
        for arm in self._arms.values():
            state = arm.with_gripper(state, arm.config.planning.gripper_open)
        return state

    def _courses(self, arm: Arm, now_ns: int, state: Mapping[str, float]) -> list[Course]:
        """What the other arms have before them, from a moment on."""
        courses: list[Course] = []
        for name, follower in self._followers.items():
            other, held = self._arms[name], self._held.held.get(name, ())
            if other is not arm and follower.running is not None:
                courses.append(Course(other, follower.running.rest(now_ns), held))
            elif other is not arm and all(joint in state for joint in other.names):
                courses.append(Course.standing(other, state, held))
        return courses

    def _under_way(self, arm: Arm) -> bool:
        return any(f.running is not None for name, f in self._followers.items() if name != arm.name)

    async def _take_turn(self) -> Future:
        before, mine = self._turn, Future(executor=self._node.executor)
        self._turn = mine
        if before is not None:
            await before
        return mine

    def _publish(self) -> None:
        held = {name: (self._arms[name].kinematics.tool_link, boxes) for name, boxes in self._held.held.items()}
        self._attached.publish(convert.markers_msg(held))


class _Others:
    """Called while an arm moves: whether it is to hold, by request or because another arm stopped in its way."""

    def __init__(self, courses: CourseExecutor, arm: Arm, stopped: Callable[[], bool]) -> None:
        self._courses, self._arm, self._stopped = courses, arm, stopped
        self._seen = dict(courses.stops)
        self.fault: OpenArmError | None = None

    def __call__(self) -> bool:
        for name, count in self._courses.stops.items():
            if name != self._arm.name and count != self._seen[name] and self.fault is None:
                self._seen[name] = count
                self.fault = self._courses.look_again(self._arm, name)
        return self.fault is not None or self._stopped()
