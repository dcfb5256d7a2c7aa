# SPDX-License-Identifier: Apache-2.0
"""Servers that show that they live, and clients that notice when they do not.

A node of this machine shows it by a lifeline (`openarm_common.lifeline`), which its executor keeps beating: its end is
noticed at once, and that it hangs within seconds. One of another machine is gone when discovery has forgotten it, at
the end of its participant's lease. Servers without a lifeline (another vendor's) are watched as those.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import partial
from typing import Any
from weakref import WeakSet

from action_msgs.msg import GoalStatus
from rclpy import action
from rclpy.clock import Clock, ClockType
from rclpy.executors import await_or_execute
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.topic_endpoint_info import TopicEndpointInfo

from openarm_common.errors import Code, OpenArmError
from openarm_common.lifeline import Lifeline, Watched, watch

#: What the middleware could not do.
RCLError: type[Exception] = rclpy_implementation.RCLError

#: A process of this machine that lives and is silent for so long counts as gone, s: it is stopped, or hangs.
_SILENT_S = 5.0
#: Between two signs of life of a node, s.
_BEAT_S = 0.5
#: An answer that could not be sent is sent again after this, s: a try holds the node up for 0.1 s.
_ANSWER_S = 0.5
#: So often; DDS discovers a client that exists within some of them.
_ANSWERS = 40
#: Longest wait for a server, for its answer to a goal, and for the end of one that is cancelled, s.
_GOAL_S = 5.0
#: On which every node publishes, so that its participant can be looked up.
_OF_ALL_NODES = "/parameter_events"
#: Lifelines of the participants of this process, and the nodes that keep them beating.
_LIFELINES: dict[str, Lifeline] = {}
_BEATING: WeakSet[Node] = WeakSet()


def latest() -> QoSProfile:
    """Return the profile of a status that late subscribers receive; rcl_action's, and that of owners."""
    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def owner_topic(action_name: str) -> str:
    """Return the topic on which the client of a trajectory controller publishes the id of the goal that it sends."""
    return f"{action_name.rpartition('/')[0]}/owner"


def fastest_topic(action_name: str) -> str:
    """Return the topic on which a trajectory controller publishes the largest speed that it follows now, rad/s."""
    return f"{action_name.rpartition('/')[0]}/fastest"


def show_life(node: Node) -> None:
    """Let clients of this machine notice at once when the process of a node ends, and soon when its executor hangs."""
    if node in _BEATING:
        return
    _BEATING.add(node)
    line: Lifeline | None = None

    def beat() -> None:
        nonlocal line
        line = line or _own_lifeline(node)
        if line is not None:
            line.beat()

    beat()
    node.create_timer(_BEAT_S, beat, clock=Clock(clock_type=ClockType.STEADY_TIME))


def _own_lifeline(node: Node) -> Lifeline | None:
    """Return the lifeline of a node's participant; None while that is not known, or where there can't be one."""
    own = node.get_fully_qualified_name()
    for info in node.get_publishers_info_by_topic(_OF_ALL_NODES):
        if full_name(info) == own:
            participant = _participant(info)
            if participant not in _LIFELINES:
                with suppress(OSError):  # without it, it is watched as one of another machine
                    _LIFELINES[participant] = Lifeline(participant)
                    node.context.on_shutdown(partial(_end, participant))
            return _LIFELINES.get(participant)
    return None


def _end(participant: str) -> None:
    if (line := _LIFELINES.pop(participant, None)) is not None:
        line.close()


def full_name(info: TopicEndpointInfo) -> str:
    """Return the fully qualified name of the node of an endpoint."""
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def _participant(info: TopicEndpointInfo) -> str:
    """Return the name of an endpoint's participant: the prefix of its GUID."""
    return bytes(info.endpoint_gid[:12]).hex()


class ServerWatch:
    """Notices when a server dies, which discovery says seconds later.

    Args:
        node: Node that asks.
        topic: Topic on which the server publishes; empty: any.
        what: Names the server where its node is not known.
        server: Full name of its node; empty: any that publishes on the topic.
    """

    def __init__(self, node: Node, topic: str, what: str, server: str = "") -> None:
        self._node, self._topic, self._what, self._server = node, topic or _OF_ALL_NODES, what, server
        #: Participants of servers that were seen; None: of another machine.
        self._seen = dict[str, Watched | None]()
        #: Those that discovery knows, and the name of the last one.
        self._present = set[str]()
        self._who = ""
        self._looking = threading.Lock()

    def destroy(self) -> None:
        """End it."""
        for watched in self._seen.values():
            if watched is not None:
                watched.close()

    def begin(self) -> Callable[[], str]:
        """Return a function that says who has died since this call: the node's name; "" while it lives."""
        served = self._alive()
        dead = False

        def died() -> str:
            nonlocal served, dead
            alive = self._alive()
            served = served or alive  # it may not have been discovered yet
            dead = dead or not served <= alive
            return (self._who or self._what) if dead else ""

        return died

    @property
    def silence(self) -> float:
        """For how long a process of this machine that lives has shown no sign of life, s."""
        with self._looking:
            self._look()
            return max((watched.silence for _, watched in self._lives()), default=0.0)

    @property
    def dead(self) -> bool:
        """Whether there was a server, and there is none that lives."""
        return not self._alive() and bool(self._seen)

    def _alive(self) -> set[str]:
        """Return the servers that live, and do not hang."""
        with self._looking:
            self._look()
            there = {name for name, watched in self._seen.items() if watched is None} & self._present
            return there | {name for name, watched in self._lives() if watched.silence < _SILENT_S}

    def _lives(self) -> list[tuple[str, Watched]]:
        """Return the processes of this machine that live."""
        return [(name, watched) for name, watched in self._seen.items() if watched is not None and not watched.ended]

    def _look(self) -> None:
        """Keep the name of the node: the graph may have lost it when it is asked for."""
        self._present.clear()
        for info in self._node.get_publishers_info_by_topic(self._topic):
            if self._server not in ("", full_name(info)):
                continue
            if not info.node_name.startswith("_"):  # one that has just appeared may not have said its name yet
                self._who = f"the node {info.node_name}"
            participant = _participant(info)
            self._present.add(participant)
            if self._seen.get(participant) is None:
                self._seen[participant] = watch(participant)


class ActionServer(action.ActionServer):
    """An action server whose clients notice its death; arguments as `rclpy.action.ActionServer`.

    The middleware cannot answer a client that it has not discovered yet (ros2/rmw_fastrtps#842), and rclpy never
    executes a goal whose answer was not sent. This one does, and sends the answer until the client is there.
    """

    def __init__(self, node: Node, kind: Any, name: str, execute: Callable[..., Any], **kwargs: Any) -> None:
        super().__init__(node, kind, name, execute, **kwargs)
        show_life(node)

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
        name: Name of the action.
    """

    def __init__(self, node: Node, kind: Any, name: str) -> None:
        super().__init__(node, kind, name)
        self.name = name
        topic = f"{node.resolve_topic_name(name)}/_action/status"
        self._watch = ServerWatch(node, topic, f"the server of {name}")

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
        died: Result of `ActionClient.watch`.
        what: Was asked of it.
        code: Code of the error.

    Raises:
        OpenArmError: Naming the node.
    """
    if who := died():
        raise OpenArmError(code, f"{what}: {who} is gone; ask again when it is back (openarm ps)")


async def run_goal(
    client: ActionClient,
    goal: Any,
    until: Callable[[Callable[[], bool], float], Awaitable[bool]],
    *,
    stopped: Callable[[], bool] = lambda: False,
    limit: float = math.inf,
) -> Any:
    """Send a goal and return its result, also that of a failure; it is cancelled when it takes too long or is stopped.

    Args:
        client: Client of the action.
        goal: Goal to send.
        until: Awaits a condition for a time, s, and returns whether it holds.
        stopped: Whether the goal is to be cancelled.
        limit: Longest wait for its end, s.

    Returns:
        The result; None of a goal that was stopped and has not ended in time.

    Raises:
        OpenArmError: NOT_READY, without a server, or when it dies; BUSY, when it refuses the goal; TIMEOUT.
    """
    name = client.name
    if not await until(client.server_is_ready, _GOAL_S):
        raise OpenArmError(Code.NOT_READY, f"no action server {name}; is its node running (openarm ps)?")
    died = client.watch()
    sent = client.send_goal_async(goal)
    answered = await until(lambda: sent.done() or bool(died()), _GOAL_S)
    check_alive(died, name)
    if not answered:
        raise OpenArmError(Code.TIMEOUT, f"{name} did not answer within {_GOAL_S:g} s")
    handle: Any = sent.result()
    if handle is None or not handle.accepted:
        raise OpenArmError(Code.BUSY, f"{name} refused the goal")
    ended = handle.get_result_async()
    in_time = await until(lambda: ended.done() or stopped() or bool(died()), limit)
    check_alive(died, name)
    if not ended.done():
        handle.cancel_goal_async()
        await until(ended.done, _GOAL_S)
        if not in_time:
            raise OpenArmError(Code.TIMEOUT, f"{name} took longer than {limit:g} s")
    return ended.result().result if ended.done() else None
