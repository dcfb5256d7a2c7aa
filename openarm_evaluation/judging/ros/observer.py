# SPDX-License-Identifier: Apache-2.0
"""Observer of a run: ground truth for the judge, states of the grasp, pictures; resets the world."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from openarm_interfaces.msg import GraspStatus, ObjectState, ObjectStateArray
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image, JointState

from openarm_bringup.ros.simulation import reset_world
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.client import BackgroundNode
from openarm_common.ros.convert import stamp_to_ns, xyz
from openarm_common.ros.images import rgb_image
from openarm_common.ros.node import reliable
from openarm_evaluation.judging.film import Picture
from openarm_evaluation.judging.judge import Sample
from openarm_evaluation.judging.trial import Step

T = TypeVar("T")
Frame = tuple[int, Picture]

_RELIABLE, _NEWEST = reliable(20), QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
_LATCHED = QoSProfile(depth=20, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@dataclass(frozen=True)
class Truth:
    """All objects at one time, by name."""

    t_ns: int
    objects: Mapping[str, Sample]


class Observer(BackgroundNode):
    """Watches a running graph in a thread of its own; a context manager.

    Args:
        domain: ROS_DOMAIN_ID of the graph.
        on_step: Called (in the observer's thread) for every state that the grasp enters.
    """

    def __init__(self, domain: int, on_step: Callable[[Step], None] | None = None) -> None:
        self._changed = threading.Condition()
        self._on_step = on_step
        self._truth: Truth | None = None
        self._tracks: dict[str, list[Sample]] = {}
        self._steps: list[Step] = []
        #: /grasp/status is latched: a new observer hears states of earlier requests too, at any time after its start.
        self._since_ns = 0
        self._joints: list[tuple[int, dict[str, float]]] = []
        self._joint_states: Subscription | None = None
        self._cameras: dict[str, Subscription] = {}
        self._frames: dict[str, Frame] = {}
        super().__init__("openarm_observer", domain=domain)
        self._node.create_subscription(ObjectStateArray, "/sim/ground_truth/objects", self._on_truth, _RELIABLE)
        self._node.create_subscription(GraspStatus, "/grasp/status", self._on_status, _LATCHED)

    def wait(self, condition: Callable[[], T | None], seconds: float, what: str) -> T:
        """Wait until `condition` gives something.

        Raises:
            OpenArmError: TIMEOUT, saying what was waited for.
        """
        deadline = time.monotonic() + seconds
        with self._changed:
            while True:
                value = condition()
                if value is not None and value is not False:
                    return value
                left = deadline - time.monotonic()
                if left <= 0.0:
                    raise OpenArmError(Code.TIMEOUT, f"{what} was not there within {seconds:g} s")
                self._changed.wait(timeout=min(0.2, left))

    def truth(self) -> Truth | None:
        """Return the newest ground truth, or None before the first."""
        return self._truth

    def steps(self) -> list[Step]:
        """Return the states since `forget`."""
        return list(self._steps)

    def track(self, name: str) -> list[Sample]:
        """Return the samples of an object since `forget`."""
        return list(self._tracks.get(name, []))

    def joints(self) -> list[tuple[int, dict[str, float]]]:
        """Return the joint states since `forget`: simulated time in ns, position by name; the first call begins."""
        if self._joint_states is None:
            self._joint_states = self._node.create_subscription(JointState, "/joint_states", self._on_joints, _RELIABLE)
        return list(self._joints)

    def subscribers(self, topic: str) -> set[str]:
        """Return the names of the nodes that subscribe to a topic, this one included."""
        return {endpoint.node_name for endpoint in self._node.get_subscriptions_info_by_topic(topic)}

    def forget(self) -> None:
        """Begin new tracks and a new list of states: of those that are entered after the newest ground truth."""
        with self._changed:
            self._since_ns = self._truth.t_ns if self._truth is not None else 0
            self._tracks.clear()
            self._steps.clear()
            self._joints.clear()

    def watch_camera(self, topic: str, on_frame: Callable[[int, Picture], None] | None = None) -> None:
        """Subscribe to a colour image topic; its newest frame is kept, `on_frame` gets every one."""

        def receive(message: Image) -> None:
            try:
                picture = rgb_image(message).copy()
            except OpenArmError as error:
                self._node.get_logger().warning(str(error), throttle_duration_sec=5.0)
                return
            frame = (stamp_to_ns(message.header.stamp), picture)
            if on_frame is not None:
                on_frame(*frame)
            with self._changed:
                self._frames[topic] = frame
                self._changed.notify_all()

        if topic not in self._cameras:
            self._cameras[topic] = self._node.create_subscription(Image, topic, receive, _NEWEST)

    def unwatch_camera(self, topic: str) -> None:
        """Unsubscribe from a topic, so that nothing is rendered for it."""
        if topic in self._cameras:
            self._node.destroy_subscription(self._cameras.pop(topic))

    def frame(self, topic: str) -> Frame | None:
        """Return the newest frame of a topic, or None."""
        return self._frames.get(topic)

    def reset_world(self, scene: str, seed: int, timeout_s: float = 30.0) -> int:
        """Load a scene and return the simulated time after which ground truth shows it, ns.

        Raises:
            OpenArmError: SCENE_INVALID, when the bridge refused it; TIMEOUT, when it did not answer.
        """
        reset_world(self, scene, seed, timeout_s)
        return self._truth.t_ns if self._truth is not None else 0

    def _on_truth(self, message: ObjectStateArray) -> None:
        t_ns = stamp_to_ns(message.header.stamp)
        samples = {state.name: _sample(t_ns, state) for state in message.objects}
        with self._changed:
            if t_ns < self._since_ns:  # the bridge was started again
                self._since_ns = 0
            self._truth = Truth(t_ns, samples)
            for name, sample in samples.items():
                self._tracks.setdefault(name, []).append(sample)
            self._changed.notify_all()

    def _on_joints(self, message: JointState) -> None:
        with self._changed:
            self._joints.append(
                (stamp_to_ns(message.header.stamp), dict(zip(message.name, message.position, strict=True)))
            )
            self._changed.notify_all()

    def _on_status(self, message: GraspStatus) -> None:
        step = Step(
            stamp_to_ns(message.header.stamp),
            message.state,
            message.previous_state,
            message.reason,
            message.attempt,
            message.label,
            message.arm,
        )
        with self._changed:
            if 0 < step.t_ns < self._since_ns:
                return
            self._steps.append(step)
            self._changed.notify_all()
        if self._on_step is not None:
            self._on_step(step)


def _sample(t_ns: int, state: ObjectState) -> Sample:
    q, twist = state.pose.orientation, state.twist
    return Sample(t_ns, xyz(state.pose.position), np.array([q.x, q.y, q.z, q.w]), xyz(twist.linear), xyz(twist.angular))
