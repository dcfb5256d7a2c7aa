# SPDX-License-Identifier: Apache-2.0
"""Servers that show that they live, and clients that notice within a lease when they do not.

The status topic of an action, and the topic `~/_alive` of a node for its services, are offered with automatic
liveliness: the middleware asserts it from a thread of its own, so a process that computes is alive, and one that was
killed or stopped is not. On the same machine a lifeline tells the one from the other. A client whose server offers no
liveliness (another vendor's) works as with rclpy's.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

from action_msgs.msg import GoalStatus, GoalStatusArray
from rclpy import action
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import QoSLivelinessChangedInfo, SubscriptionEventCallbacks
from rclpy.executors import await_or_execute
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile
from rclpy.topic_endpoint_info import TopicEndpointInfo

from openarm_common.errors import Code, OpenArmError
from openarm_common.lifeline import Lifeline, lives, watch

#: What the middleware could not do.
RCLError: type[Exception] = rclpy_implementation.RCLError


@dataclass(frozen=True)
class Lease:
    """How fast the death of a publisher is noticed.

    Attributes:
        offered: s; Fast DDS asserts liveliness every two thirds of it.
        accepted: s without an assertion after which the publisher counts as gone.
    """

    offered: float
    accepted: float

    def offer(self, profile: QoSProfile) -> QoSProfile:
        """Let publishers with this profile show that they live."""
        return _automatic(profile, self.offered)

    def watch(self, profile: QoSProfile) -> QoSProfile:
        """Let subscriptions with this profile notice when they do not."""
        return _automatic(profile, self.accepted)


#: Of servers, and owners of goals: three assertions have to be missing, so that a loaded machine raises no alarm. Each
#: is a chance for Fast DDS to lock itself up for ever, while it removes an endpoint of another process (eProsima/
#: Fast-DDS#6502): `openarm up` starts such a node again.
LEASE = Lease(0.6, 1.3)


def _automatic(profile: QoSProfile, seconds: float) -> QoSProfile:
    profile.liveliness = LivelinessPolicy.AUTOMATIC
    profile.liveliness_lease_duration = Duration(seconds=seconds)
    return profile


def latest() -> QoSProfile:
    """Return the profile of a status that late subscribers receive; rcl_action's, and that of owners."""
    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def owner_topic(action_name: str) -> str:
    """Return the topic on which the client of a trajectory controller publishes the id of the goal that it sends."""
    return f"{action_name.rpartition('/')[0]}/owner"


def alive_topic(node_name: str) -> str:
    """Return the hidden topic on which nothing is published: that its publisher is alive shows that the node is.

    Args:
        node_name: Fully qualified.
    """
    return f"{node_name}/_alive"


#: A process of this machine that lives and is silent for so much longer than the lease counts as gone, s: it is
#: stopped, or hangs. Fast DDS halts a process for a second or two when another one that it writes to was killed.
_SILENT_S = 3.0
#: An answer that could not be sent is sent again after this, s: a try holds the node up for 0.1 s.
_ANSWER_S = 0.5
#: So often; DDS discovers a client that exists within some of them.
_ANSWERS = 40
#: Lifelines of this process by participant of the middleware.
_LIFELINES: dict[str, _ParticipantLifeline] = {}


class _ParticipantLifeline(Lifeline):
    """Shows that the process of a participant lives, until its context shuts down."""

    def __init__(self, participant: str, context: Context) -> None:
        super().__init__(participant)
        self._participant = participant
        _LIFELINES[participant] = self
        context.on_shutdown(self.end)

    def end(self) -> None:
        _LIFELINES.pop(self._participant, None)
        self.close()


def show_life(node: Node, topic: str) -> None:
    """Let watchers of this machine tell the death of this process from its silence.

    Args:
        node: Publishes the topic.
        topic: Offered by `LEASE`.
    """
    for info in node.get_publishers_info_by_topic(topic):
        own = (info.node_name, info.node_namespace) == (node.get_name(), node.get_namespace())
        if own and _participant(info) not in _LIFELINES:
            with suppress(OSError):  # without it, silence counts as death
                _ParticipantLifeline(_participant(info), node.context)


def _participant(info: TopicEndpointInfo) -> str:
    """Return the name of an endpoint's participant: the prefix of its GUID."""
    return bytes(info.endpoint_gid[:12]).hex()


class Watch:
    """Notices when the publisher of a topic dies, which discovery says up to 20 s later.

    A process of this machine that ends counts as dead at once. One without a sign of life does, too, unless its process
    is of this machine and lives: then after `_SILENT_S` more of silence.

    Args:
        node: Owner.
        kind: Type of the topic.
        topic: Offered by `LEASE`.
        what: Names its publisher where its node is not known.
    """

    def __init__(self, node: Node, kind: Any, topic: str, what: str) -> None:
        self._node, self._topic, self._what = node, topic, what
        #: Publishers that live, and deaths so far.
        self.alive = self.deaths = 0
        self._who = ""
        self._participants = set[str]()
        self._buried = set[str]()
        #: What ends the watch of a participant's lifeline.
        self._watched = dict[str, Callable[[], None]]()
        #: Deaths that lifelines have said, and liveliness has not.
        self._foretold = 0
        #: Since when there has been no sign of life of a process that lives, monotonic; infinite: there is.
        self._silent_since = math.inf
        events = SubscriptionEventCallbacks(liveliness=self._on_liveliness, use_default_callbacks=False)
        self._subscription = node.create_subscription(
            kind, topic, lambda _: None, LEASE.watch(latest()), event_callbacks=events
        )

    def destroy(self) -> None:
        """End it."""
        for end in self._watched.values():
            end()
        self._node.destroy_subscription(self._subscription)

    def begin(self) -> Callable[[], str]:
        """Return a function that says who has died since this call: the node's name; "" while it lives."""
        self._look()
        known = self._participants - self._buried
        if len(known) >= self.alive:
            self._foretold = 0
        for participant in known:
            self._watch(participant)
        before = self.deaths

        def died() -> str:
            if not self._who:  # who has just appeared may not have said its name yet
                self._look()
            self._judge_silence()
            return (self._who or self._what) if self.deaths != before else ""

        return died

    @property
    def silence(self) -> float:
        """For how long a process of this machine that lives has shown no sign of life, s; 0 while it does."""
        return max(0.0, time.monotonic() - self._silent_since)

    @property
    def dead(self) -> bool:
        """Whether there was a publisher, and there is none that lives."""
        self._judge_silence()
        return self.alive <= self._foretold and bool(self.deaths)

    def _judge_silence(self) -> None:
        """Count one that has been silent for too long as dead."""
        if time.monotonic() - self._silent_since > _SILENT_S:
            self._silent_since = math.inf
            self._buried |= self._participants
            self.deaths += 1

    def _on_liveliness(self, event: QoSLivelinessChangedInfo) -> None:
        self._look()
        lost, self.alive = self.alive - event.alive_count, event.alive_count
        if lost <= 0:
            self._silent_since = math.inf
            return
        foretold = min(lost, self._foretold)
        self._foretold -= foretold
        if lost == foretold:
            return
        known = self._participants - self._buried
        dead = {participant for participant in known if not lives(participant)}
        if known and not dead:
            self._silent_since = time.monotonic()
            for participant in known:
                self._watch(participant)
        else:
            self._buried |= dead
            self.deaths += 1

    def _watch(self, participant: str) -> None:
        if participant not in self._watched and (end := watch(participant, partial(self._bury, participant))):
            self._watched[participant] = end

    def _bury(self, participant: str) -> None:
        """Count the end of a process; in a thread of its own."""
        if participant not in self._buried:
            self._buried.add(participant)
            self._foretold += 1
            self.deaths += 1

    def _look(self) -> None:
        """Keep the name of the node: the graph may have lost it when it is asked for."""
        for info in self._node.get_publishers_info_by_topic(self._topic):
            if not info.node_name.startswith("_"):
                self._who = f"the node {info.node_name}"
            self._participants.add(_participant(info))


class ActionServer(action.ActionServer):
    """An action server whose clients notice its death; arguments as `rclpy.action.ActionServer`.

    The middleware cannot answer a client that it has not discovered yet (ros2/rmw_fastrtps#842), and rclpy never
    executes a goal whose answer was not sent. This one does, and sends the answer until the client is there.
    """

    def __init__(self, node: Node, kind: Any, name: str, execute: Callable[..., Any], **kwargs: Any) -> None:
        status = LEASE.offer(latest())
        super().__init__(node, kind, name, execute, status_pub_qos_profile=status, **kwargs)
        show_life(node, f"{node.resolve_topic_name(name)}/_action/status")

    async def _execute_goal_request(self, request_header_and_message: Any) -> None:
        header, request = request_header_and_message
        key = bytes(request.goal_id.uuid)
        again = key in self._goal_handles
        await super()._execute_goal_request(request_header_and_message)
        goal = self._goal_handles.get(key)
        # not begun: rclpy has given it up
        if goal is not None and not again and goal.status == GoalStatus.STATUS_ACCEPTED:
            self._answer_later(header)
            self._handle.publish_status()
            await await_or_execute(self._handle_accepted_callback, goal)

    def _answer_later(self, header: Any) -> None:
        """Send the answer to an accepted goal until it is sent, or the client counts as gone."""
        answer = self._action_type.Impl.SendGoalService.Response(accepted=True)
        left = _ANSWERS

        def send() -> None:
            nonlocal left
            left -= 1
            with suppress(RCLError):
                self._handle.send_goal_response(header, answer)
                left = 0
            if left == 0:
                self._node.destroy_timer(timer)

        timer = self._node.create_timer(_ANSWER_S, send, clock=Clock(clock_type=ClockType.STEADY_TIME))


class ActionClient(action.ActionClient):
    """An action client that knows when its server has died, and that a goal was accepted whose answer was lost.

    A server answers a client that it has discovered; one that has just appeared it may not have, on a busy machine,
    and its goal would run unattended. The status of the server, which late subscribers receive, says so, too.

    Args:
        node: Owner.
        kind: Type of the action.
        name: Of the action.
    """

    def __init__(self, node: Node, kind: Any, name: str) -> None:
        super().__init__(node, kind, name)
        self.name = name
        topic = f"{node.resolve_topic_name(name)}/_action/status"
        self._watch = Watch(node, GoalStatusArray, topic, f"the server of {name}")

    def destroy(self) -> None:
        """Take the client down."""
        self._watch.destroy()
        super().destroy()

    def server_is_ready(self) -> bool:
        """Whether a server is in the graph that is not known to be dead."""
        return bool(super().server_is_ready()) and not self._watch.dead

    def watch(self) -> Callable[[], str]:
        """Return a function that says who has died since this call: the node's name; "" while its server lives."""
        return self._watch.begin()

    async def execute(self, taken_data: dict[str, Any]) -> None:
        """Handle what has come: a goal in the server's status is accepted, and its answer is not needed any more.

        See `rclpy.action.ActionClient.execute`.
        """
        sent: dict[int, Any] = self._goal_sequence_number_to_goal_id
        answers = dict([taken_data.pop("goal")]) if "goal" in taken_data else {}
        for status in taken_data["status"].status_list if "status" in taken_data else ():
            info = status.goal_info
            accepted = self._action_type.Impl.SendGoalService.Response(accepted=True, stamp=info.stamp)
            for number in (number for number, goal_id in sent.items() if goal_id == info.goal_id):
                answers.setdefault(number, accepted)
        for number, answer in answers.items():
            if number in sent:
                await super().execute({"goal": (number, answer)})
                sent.pop(number, None)
        await super().execute(taken_data)


def check_alive(died: Callable[[], str], what: str, code: Code = Code.NOT_READY) -> None:
    """Raise when a server has died.

    Args:
        died: Of `ActionClient.watch`.
        what: Was asked of it.
        code: Of the error.

    Raises:
        OpenArmError: Naming the node.
    """
    if who := died():
        raise OpenArmError(code, f"{what}: {who} is gone; ask again when it is back (openarm ps)")
