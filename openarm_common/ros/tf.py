# SPDX-License-Identifier: Apache-2.0
"""The robot for nodes: /joint_states, /tf_static and what the hands hold, into a `PostureTracker`.

Link poses come from own forward kinematics on /joint_states; a subscription to /tf would cost twice the time and say
the same.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from openarm_common.camera.cameras import CameraConfig, load_cameras
from openarm_common.camera.housings import mounted
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.posture import PostureTracker
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.ros.convert import held_from_msg, joints_from_msg, stamp_to_ns, transform_to_matrix
from openarm_common.ros.node import QOS_LATCHED, QOS_STATIC_TF, BaseNode, reliable
from openarm_common.ros.polled import Polled, Source

#: Its origin is on the table top below the base; where the table is, for every node.
TABLE_FRAME = "table"
_TOPIC = "/joint_states"


def table_height(message: TFMessage) -> float | None:
    """Return the height of the table in fixed transforms, base frame, m; None when they do not say."""
    return next((e.transform.translation.z for e in message.transforms if e.child_frame_id == TABLE_FRAME), None)


class RobotStateListener:
    """Keeps a `PostureTracker` filled.

    Joint states wait in the middleware until they are asked for: a node that woke for each would spend more time on
    waking than on its work. A user that acts on each at once calls `watch`.

    Args:
        node: The node that subscribes.
        description: The robot.
        joints: Whether to subscribe to /joint_states from the start; else `enable` does.
        depth: Joint states that wait: few for a node that acts on the newest; those of the time that an image takes for
            one that asks for the stamp of an image.
        wait: Longest wait for what a posture needs, s.
        held_topic: Topic of what the hands hold, as markers on links; empty: not subscribed to.
    """

    def __init__(
        self,
        node: BaseNode[Any],
        description: RobotDescription,
        *,
        joints: bool = True,
        depth: int = 10,
        wait: float = 0.0,
        held_topic: str = "",
    ) -> None:
        self.tracker = PostureTracker(description, wait)
        self._efforts: dict[str, float] = {}
        self._node = node
        self._depth = depth
        self._users: set[object] = set()
        self._watchers: list[Callable[[], None]] = []
        self._on_table: Callable[[float], None] | None = None
        self._on_mounts: Callable[[dict[str, CameraConfig]], None] | None = None
        self._cameras: dict[str, CameraConfig] = {}
        self._joints: Any = None
        self._waiting: Polled | None = None
        self._polling = threading.Lock()
        node.create_subscription(TFMessage, "/tf_static", self._on_static, QOS_STATIC_TF)
        if held_topic:
            node.create_subscription(MarkerArray, held_topic, self._on_held, QOS_LATCHED)
        self.enable(joints)

    def enable(self, on: bool, user: object = None) -> None:
        """Subscribe to /joint_states while any user wants it; what is old when that begins again is forgotten."""
        (self._users.add if on else self._users.discard)(user)
        self.tracker.listen(bool(self._users), time.monotonic())
        if self._users and self._joints is None:
            qos = reliable(self._depth)
            if self._watchers:
                self._joints = self._node.create_subscription(JointState, _TOPIC, self._on_joints, qos)
            else:
                self._waiting = Polled(self._node, Source(JointState, _TOPIC, qos))
                self._joints = self._waiting.subscription
        elif not self._users and self._joints is not None:
            self._node.destroy_subscription(self._joints)
            self._joints = self._waiting = None

    @property
    def buffer(self) -> RobotStateBuffer:
        """Joint states and frames."""
        self.poll()
        return self.tracker.buffer

    def poll(self) -> None:
        """Take the joint states that wait."""
        with self._polling:
            for message, received_at in self._waiting.take_timed() if self._waiting is not None else ():
                try:
                    self._take(message, received_at)
                except OpenArmError as error:
                    self._node.refuse(_TOPIC, error)

    def watch(self, on_news: Callable[[], None]) -> None:
        """Call a function after each joint state, from the next time that any is wanted, and after each transform."""
        self._watchers.append(on_news)

    def follow_table(self, on_height: Callable[[float], None]) -> None:
        """Call a function with the height of the frame `table`, base frame, m, whenever it is published."""
        self._on_table = on_height

    def follow_mounts(self, on_mounts: Callable[[dict[str, CameraConfig]], None]) -> None:
        """Call a function with the robot's cameras, by name, whenever one with a housing is mounted elsewhere.

        They begin as in the configuration, and follow the transforms from their parents.
        """
        self._on_mounts, self._cameras = on_mounts, load_cameras()

    def age_s(self) -> float:
        """Return the seconds of wall clock since the newest joint state arrived; infinite before the first."""
        self.poll()
        return self.tracker.age_s(time.monotonic())

    @property
    def efforts(self) -> dict[str, float]:
        """Newest efforts by joint name, N·m or N; without those that are not measured."""
        self.poll()
        return self._efforts

    def _on_joints(self, message: JointState) -> None:
        self._take(message, time.monotonic())
        self._notify()

    def _take(self, message: JointState, received_at: float) -> None:
        joints_from_msg(message)
        t_ns = stamp_to_ns(message.header.stamp)
        self.tracker.add(t_ns, message.name, message.position, received_at, message.velocity)
        self._efforts = dict(zip(message.name, message.effort, strict=False))

    def _on_static(self, message: TFMessage) -> None:
        refused: OpenArmError | None = None
        before = self._cameras
        for edge in message.transforms:
            try:
                self._add_edge(edge)
            except OpenArmError as error:
                refused = error
        if self._on_mounts is not None and self._cameras is not before:
            self._on_mounts(self._cameras)
        self._notify()
        if refused is not None:
            raise refused

    def _add_edge(self, edge: TransformStamped) -> None:
        T = transform_to_matrix(edge.transform)
        self.buffer.set_static(edge.header.frame_id, edge.child_frame_id, T)
        if edge.child_frame_id == TABLE_FRAME and self._on_table is not None:
            self._on_table(float(T[2, 3]))
        for name, camera in self._cameras.items():
            if camera.housing is None or camera.link_frame != edge.child_frame_id:
                continue
            if camera.parent == edge.header.frame_id and not np.allclose(camera.T_parent_link, T, atol=1e-5):
                self._cameras = mounted(self._cameras, {name: T})

    def _on_held(self, message: MarkerArray) -> None:
        self.tracker.held = held_from_msg(message)

    def _notify(self) -> None:
        for on_news in self._watchers:
            on_news()
