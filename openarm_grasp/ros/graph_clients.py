# SPDX-License-Identifier: Apache-2.0
"""The other nodes while a grasp runs: joint states, detections, action goals, and waits that always end.

A wait ends by its condition, by a deadline of the wall clock, by a cancel, or because the robot went silent; checked 40
times a second. Robot time is the stamp of the joint states, so the node needs no /clock. /joint_states is subscribed
only while a grasp runs, detections only in states that observe.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.subscription import Subscription
from rclpy.task import Future
from sensor_msgs.msg import PointCloud2
from unique_identifier_msgs.msg import UUID
from vision_msgs.msg import Detection3DArray

from openarm_common.camera.cameras import load_cameras
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.self_filter import SelfFilter, SelfFilterConfig
from openarm_common.ros.actions import ActionClient, check_alive
from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.detections import detections_from_msg
from openarm_common.ros.labelled_clouds import labelled_cloud_from_msg
from openarm_common.ros.node import QOS_SENSOR, BaseNode, reliable
from openarm_common.ros.tf import RobotStateListener
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence.hand import Silence
from openarm_grasp.perception.boxes import with_points
from openarm_grasp.perception.detections import Frame, Ids, in_base
from openarm_grasp.ros.pad_listener import Pads

#: What the detector of the camera over the table finds.
DETECTIONS = "/detections_3d"
#: The points of the same, in the same namespace.
POINTS = "detection_points"
_TICK_S = 0.025
#: A longer pause between two ticks is this process being starved, not the robot being silent.
_STARVED_S = 0.2
_STOP_LIMIT_S = 2.0
#: An action server that is not in the graph at so many checks in a row is gone (1.5 s; a lost robot is noticed sooner).
_GONE = 60
#: Clouds that wait for their detections.
_CLOUDS = 8


class GraphClients:
    """Subscribes to the robot and the detector, and sends goals.

    Args:
        node: The node that owns subscriptions, clients and the timer.
        config: Parameters.
        table_z: Height of the table top, base frame, m, until it is published.
    """

    def __init__(self, node: BaseNode[Any], config: GraspConfig, table_z: float) -> None:
        self._node = node
        self._config = config
        self.table_z = table_z
        self._outline, self._cameras = SelfFilter(node.description, SelfFilterConfig()), load_cameras()
        self.robot = RobotStateListener(node, node.description, joints=False, held_topic="/motion/attached_objects")
        self.pads = Pads(node)
        self._subscriptions: dict[str, tuple[Subscription, ...]] = {}
        #: Newest clouds of the topic by stamp.
        self._clouds: dict[int, PointCloud2] = {}
        self._topic = DETECTIONS
        self._frames: list[Frame] = []
        #: Ids for detections that have none, by topic.
        self._ids = defaultdict[str, Ids](Ids)
        self._frame_id = node.description.base
        self._observing_since_ns = 0
        self._next_tick = Future()
        self._timer = node.create_timer(_TICK_S, self._on_tick, clock=node.steady_clock)
        self._timer.cancel()
        self._silence = Silence(_STARVED_S)
        self._active = False

    # --- begin, end, cancel
    async def begin(self, missing: Callable[[], list[str]]) -> None:
        """Listen to the robot and wait until nothing is missing any more.

        Raises:
            OpenArmError: NOT_READY, naming what is missing; ROBOT_LOST; as `missing`.
        """
        if not self._active:
            self._silence = Silence(_STARVED_S)
            self._active = True
            self.robot.enable(True)
            self.pads.enable(self._config.held.use_finger_force)
            self._timer.reset()
        deadline = time.monotonic() + self._config.limits.ready_timeout
        while faults := missing():
            self.check()
            if time.monotonic() > deadline:
                raise OpenArmError(Code.NOT_READY, f"not ready: no {'; no '.join(faults)}")
            await self.tick()

    def end(self) -> None:
        """Stop listening."""
        if not self._active:
            return
        self._active = False
        self.stop_observing()
        self._timer.cancel()
        self.robot.enable(False)
        self.pads.enable(False)

    @property
    def now_ns(self) -> int:
        """Robot time; 0 before the first joint state."""
        return self.robot.buffer.latest()[0] if self.has_joint_states else 0

    @property
    def has_joint_states(self) -> bool:
        """Whether a joint state has come since `begin`."""
        return self.robot.age_s() < float("inf")

    def sees(self, topic: str) -> bool:
        """Whether a node publishes detections there."""
        return self._node.count_publishers(self._node.resolve_topic_name(topic)) > 0

    # --- waiting
    def _on_tick(self) -> None:
        self._silence.update(time.monotonic(), self.now_ns if self.has_joint_states else -1)
        done, self._next_tick = self._next_tick, Future()
        done.set_result(None)

    async def tick(self) -> None:
        """Sleep until the next check."""
        await self._next_tick

    def check(self) -> None:
        """Raise when the grasp may not go on.

        Raises:
            OpenArmError: ROBOT_LOST.
        """
        self._silence.check(self._config.limits.joint_state_timeout)

    async def until(
        self, done: Callable[[], bool], limit: float, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        """Wait for a condition.

        Args:
            done: The condition.
            limit: s of wall clock.
            what: Description of the condition, for the error.
            guard: Called at each check; may raise.

        Raises:
            OpenArmError: TIMEOUT, ROBOT_LOST, or from `guard`.
        """
        deadline = time.monotonic() + limit
        while not done():
            self.check()
            if guard is not None:
                guard()
            if time.monotonic() > deadline:
                raise OpenArmError(Code.TIMEOUT, f"{what}: not done within {limit:g} s")
            await self.tick()

    async def goal(
        self,
        client: ActionClient,
        goal: object,
        limit: float,
        what: str,
        guard: Callable[[], None] | None = None,
        goal_id: UUID | None = None,
    ) -> Any:
        """Send a goal and return its result message; whatever ends the wait early cancels the goal.

        Raises:
            OpenArmError: NOT_READY, without a server; ROBOT_LOST, when it dies; EXECUTION_FAILED, when it rejects the
                goal; as `until`.
        """
        limits = self._config.limits
        try:
            await self.until(client.server_is_ready, limits.ready_timeout, what)
        except OpenArmError as error:
            if error.code is Code.TIMEOUT:
                raise OpenArmError(Code.NOT_READY, f"{what}: its action server is not there") from error
            raise
        died = client.watch()

        def watch() -> None:
            nonlocal missed
            check_alive(died, what, Code.ROBOT_LOST)
            missed = 0 if client.server_is_ready() else missed + 1
            if missed > _GONE:
                raise OpenArmError(Code.ROBOT_LOST, f"{what}: its action server is gone")
            if guard is not None:
                guard()

        missed = 0
        sent = client.send_goal_async(goal, goal_uuid=goal_id)
        try:
            await self.until(sent.done, limits.answer_timeout, f"{what}: acceptance of the goal", watch)
        except OpenArmError:
            # Should it be accepted yet, it is withdrawn.
            sent.add_done_callback(lambda f: f.result().cancel_goal_async() if f.result().accepted else None)
            raise
        handle: Any = sent.result()
        if not handle.accepted:
            raise OpenArmError(Code.EXECUTION_FAILED, f"{what}: the goal was rejected")
        result = handle.get_result_async()
        try:
            await self.until(result.done, limit, what, watch)
        except OpenArmError as error:
            handle.cancel_goal_async()
            deadline = time.monotonic() + (0.0 if error.code is Code.ROBOT_LOST else _STOP_LIMIT_S)
            while not result.done() and time.monotonic() < deadline:
                await self.tick()
            raise
        answer = result.result()
        if answer.status == GoalStatus.STATUS_UNKNOWN:
            raise OpenArmError(
                Code.ROBOT_LOST, f"{what}: {client.name} no longer knows the goal: its node was restarted"
            )
        return answer.result

    # --- observing
    async def observe(
        self, count: int, topic: str, camera: str, limit: float, guard: Callable[[], None]
    ) -> tuple[Frame, ...]:
        """Collect frames of detections that are taken from now on, in the base frame.

        Args:
            count: Number of frames.
            topic: Topic of the detector.
            camera: Name of its camera.
            limit: Longest wait, s of wall clock.
            guard: Same as for `until`.

        Raises:
            OpenArmError: STALE_DATA, when they do not come; ROBOT_LOST, or from `guard`; NO_TRANSFORM, when the pose of
                their frame is not known.
        """
        self._frames = []
        self._observing_since_ns, self._topic = self.now_ns, topic
        self.listen(topic)
        try:
            await self.until(lambda: len(self._frames) >= count, limit, "observing", guard)
        except OpenArmError as error:
            if error.code is not Code.TIMEOUT:
                raise
            seen = f"{len(self._frames)} of {count} frames came from {topic} within {limit:g} s"
            raise OpenArmError(Code.STALE_DATA, f"{seen}; are camera and detector running?") from error
        base = self._node.description.base
        frames = in_base(self._frames[-count:], lambda t_ns: self.robot.buffer.lookup(base, self._frame_id, t_ns))
        return tuple(self._with_cloud(self._ids[topic].given(frame), camera) for frame in frames)

    def listen(self, topic: str) -> None:
        """Let a detector begin: the first frame comes up to 1.5 s later, as its camera rests without a subscriber."""
        if topic not in self._subscriptions:
            points = _points_of(topic)
            self._subscriptions[topic] = (
                self._node.create_subscription(
                    Detection3DArray, topic, partial(self._on_detections, topic), reliable(5)
                ),
                self._node.create_subscription(PointCloud2, points, partial(self._on_cloud, topic), QOS_SENSOR),
            )

    def _on_detections(self, topic: str, message: Detection3DArray) -> None:
        # What the camera took before this observation began shows another state of the world.
        t_ns = stamp_to_ns(message.header.stamp)
        if topic != self._topic or t_ns < self._observing_since_ns:
            return
        try:
            self._frames.append(Frame(t_ns, detections_from_msg(message)))
        except OpenArmError as error:
            self._node.get_logger().warning(f"dropped a frame of detections: {error.message}")
            return
        self._frame_id = message.header.frame_id

    def _on_cloud(self, topic: str, message: PointCloud2) -> None:
        if topic == self._topic:
            self._clouds[stamp_to_ns(message.header.stamp)] = message
            while len(self._clouds) > _CLOUDS:
                del self._clouds[next(iter(self._clouds))]

    def _with_cloud(self, frame: Frame, camera: str) -> Frame:
        """Return a frame with its points in the base frame, where the pose of their camera is known.

        Where the detector publishes none, they are those that the camera would see of its boxes.
        """
        message, base, buffer = self._clouds.get(frame.t_ns), self._node.description.base, self.robot.buffer
        try:
            if message is not None:
                T = buffer.lookup(base, message.header.frame_id, frame.t_ns)
                return replace(frame, cloud=labelled_cloud_from_msg(message).moved(T))
            mounted = self._cameras.get(camera)
            if mounted is None or self.sees(_points_of(self._topic)):
                return frame
            lens = mounted.intrinsics
            # from a mount that is a little off they are seen alike
            T = buffer.lookup(base, mounted.parent, frame.t_ns) @ mounted.T_parent_optical
            shapes = self._outline.shapes(buffer.latest()[1], self.robot.tracker.held)
            return with_points(frame, lens, T, self.table_z, self._outline.outline(lens, T, shapes))
        except OpenArmError as error:
            self._node.get_logger().warning(f"dropped the points of a frame: {error.message}")
            return frame

    def stop_observing(self) -> None:
        """Leave all detections, so that the detectors may rest."""
        while self._subscriptions:
            for subscription in self._subscriptions.popitem()[1]:
                self._node.destroy_subscription(subscription)
        self._clouds.clear()


def _points_of(topic: str) -> str:
    """Topic of the points of detections."""
    return f"{topic.rpartition('/')[0]}/{POINTS}"
