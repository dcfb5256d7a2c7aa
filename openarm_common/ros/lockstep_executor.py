# SPDX-License-Identifier: Apache-2.0
"""Executors for lock-step: what comes is kept until a tick, and then handled in an order that is always the same.

`LockstepExecutor` takes messages off the wire into an `Inbox` at any time, and handles those of one tick when it is
told to. `ParticipantExecutor` spins a node that takes part: it waits for /sim/tick, handles the tick, and answers
/sim/ack. What a node does not share with other participants (its parameters, timers of the steady clock) goes on at any
time.
"""
# An executor of its own reaches into rclpy's entities; rclpy has no public way to take a message without handling it.
# pyright: reportPrivateUsage=false

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Coroutine, Mapping
from functools import partial
from typing import Any

from openarm_interfaces.msg import SimAck, SimChannel, SimTick
from rclpy.action import ActionClient, ActionServer
from rclpy.client import Client
from rclpy.clock import Clock
from rclpy.executors import SingleThreadedExecutor, await_or_execute
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.task import Future, Task
from rclpy.timer import Timer
from rclpy.waitable import Waitable

from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.lockstep import Inbox, Run
from openarm_common.ros.lockstep_node import (
    ACK_TOPIC,
    ACTION_ANSWERS,
    ACTION_REQUESTS,
    QOS_TICK,
    TICK_TOPIC,
    Books,
    LockstepNode,
)

#: A tick that is not complete after this long is told in the log, wall clock s.
_SLOW_S = 5.0


class LockstepExecutor(SingleThreadedExecutor):
    """Handles what a node receives tick by tick.

    Args:
        node: A node in lock-step; added here.
    """

    def __init__(self, node: LockstepNode) -> None:
        super().__init__(context=node.context)
        if node.books is None:
            raise ValueError(f"{node.get_name()} does not take part in a lock-step")
        self.node = node
        self.books: Books = node.books
        self.inbox = Inbox()
        self._pending: list[Task] = []
        self.add_node(node)

    # --- a tick
    def handle(self, t_ns: int, due: Mapping[str, int]) -> None:
        """Let time come to `t_ns`, handle what is due of the inbox, then the timers; return when nothing is left to do.

        Raises:
            OpenArmError: INTERNAL, as `Inbox.take`.
            Exception: What a callback raised.
        """
        self.node.pass_time(t_ns)
        for item in self.inbox.take(due):
            self._start(item.run)
        for timer in list(self.node.timers):
            if not _goes_on(timer) and timer.is_ready():
                with timer.handle:
                    timer.handle.call_timer()
                self._start(partial(_call, timer.callback))
        self.inbox.close_tick()

    def settle(self) -> None:
        """Run every coroutine until each of them waits for something that has not happened."""
        ran = True
        while ran:
            ran = False
            for task in list(self._pending):
                if _can_go_on(task):
                    ran = True
                    task()
                    error = task.exception() if task.done() else None
                    if error is not None:
                        raise error
            self._pending = [task for task in self._pending if not task.done() and not task.cancelled()]

    def _start(self, run: Run) -> None:
        self._pending.append(Task(run, executor=self))
        self.settle()

    # --- what rclpy asks an executor for
    def create_task(self, callback: Callable[..., Any] | Coroutine[Any, Any, Any], *args: Any, **kwargs: Any) -> Task:
        """As `Executor`; the task runs when the tick settles."""
        task = Task(callback, args, kwargs, executor=self)
        self._pending.append(task)
        return task

    def can_execute(self, entity: Any) -> bool:
        """As `Executor`; timers of simulated time belong to ticks."""
        return (not isinstance(entity, Timer) or _goes_on(entity)) and super().can_execute(entity)

    def _take_subscription(self, sub: Subscription) -> Run | None:
        channel = self.books.channel(sub)
        if channel is None:
            return super()._take_subscription(sub)
        with sub.handle:
            taken = sub.handle.take_message(sub.msg_type, sub.raw)
        if taken is None:
            return None
        message, info = taken
        wants_info = sub._callback_type is Subscription.CallbackType.WithMessageInfo

        async def deliver() -> None:
            if not self.books.parked(sub):
                await await_or_execute(sub.callback, *((message, info) if wants_info else (message,)))

        self.inbox.add(channel, deliver, info["publication_sequence_number"], _stamp_ns(message))
        return None

    def _take_client(self, client: Client) -> Run | None:
        channel = self.books.channel(client)
        if channel is None:
            return super()._take_client(client)
        with client.handle:
            header, response = client.handle.take_response(_parts(client).Response)
        if header is None:
            return None

        async def deliver() -> None:
            try:
                future = client.get_pending_request(header.request_id.sequence_number)
            except KeyError:  # nobody waits for it any more
                return
            future._set_executor(self)
            future.set_result(response)

        self.inbox.add(channel, deliver)
        return None

    def _take_service(self, srv: Service) -> Run | None:
        channel = self.books.channel(srv)
        if channel is None:
            return super()._take_service(srv)
        with srv.handle:
            request, header = srv.handle.service_take_request(_parts(srv).Request)
        if header is None:
            return None

        async def deliver() -> None:
            srv.send_response(await await_or_execute(srv.callback, request, _parts(srv).Response()), header)

        self.inbox.add(channel, deliver)
        return None

    def _take_waitable(self, waitable: Waitable) -> Run:
        name = self.books.channel(waitable)
        if name is None:
            return super()._take_waitable(waitable)
        kinds = ACTION_REQUESTS if isinstance(waitable, ActionServer) else ACTION_ANSWERS
        data: dict[str, Any] = waitable.take_data()
        for key in kinds:
            if key in data:
                self.inbox.add(f"{name}/{kinds[key]}", partial(self._execute, waitable, {key: data.pop(key)}))
        # What is left (a status, an expired goal) is book-keeping of rclpy.
        return partial(self._execute, waitable, data)

    async def _execute(self, waitable: Waitable, data: dict[str, Any]) -> None:
        for future in waitable._futures:
            future._set_executor(self)
        await waitable.execute(data)


class ParticipantExecutor(LockstepExecutor):
    """Spins a node that takes part in a lock-step.

    Args:
        node: The node.
    """

    def __init__(self, node: LockstepNode) -> None:
        super().__init__(node)
        self._ticks: deque[SimTick] = deque()
        self._due: dict[str, int] = {}
        self._told: dict[str, int] = {}
        self._name = node.get_name()
        self._ack = node.create_publisher(SimAck, ACK_TOPIC, QOS_TICK)
        node.create_subscription(SimTick, TICK_TOPIC, self._on_tick, QOS_TICK)

    def spin(self) -> None:
        """Handle ticks until shutdown."""
        while self._context.ok() and not self._is_shutdown:
            if self._ticks:
                self._handle(self._ticks.popleft())
            else:
                self.spin_once()

    def _on_tick(self, tick: SimTick) -> None:
        self._ticks.append(tick)

    def _handle(self, tick: SimTick) -> None:
        channels = {item.name: item for item in tick.channels}
        if tick.sequence == 0:
            missing = missing_of(self, channels) if channels else "the other participants"
            receives = sorted(receives_of(self.node))
            sends = channels_msg(self.books.sent)
            self._ack.publish(SimAck(node=self._name, sends=sends, receives=receives, missing=missing))
            return
        self._due |= {name: item.sent for name, item in channels.items()}
        if tick.sequence == 1:
            self.inbox.begin(self._due, self.books.latched.__contains__)
        self._await_due(tick.sequence)
        self.handle(stamp_to_ns(tick.stamp), self._due)
        fresh = {name: sent for name, sent in self.books.sent.items() if sent != self._told.get(name, 0)}
        self._told |= fresh
        self._ack.publish(SimAck(sequence=tick.sequence, node=self._name, sends=channels_msg(fresh)))

    def _await_due(self, sequence: int) -> None:
        mine = receives_of(self.node)
        due = {channel: number for channel, number in self._due.items() if channel in mine}
        tell_at = time.monotonic() + _SLOW_S
        while missing := self.inbox.missing(due):
            self.spin_once(timeout_sec=1.0)
            if time.monotonic() > tell_at:
                tell_at += _SLOW_S
                lacks = ", ".join(f"{c} number {n} (has {self.inbox.heard(c)})" for c, n in missing.items())
                self.node.get_logger().warning(f"tick {sequence} still waits for {lacks}")


def receives_of(node: LockstepNode) -> set[str]:
    """The channels that a node in lock-step takes from."""
    books = node.books
    if books is None:
        return set()
    single = (*node.subscriptions, *node.clients, *node.services)
    found = {channel for entity in single if (channel := books.channel(entity)) is not None}
    for waitable in node.waitables:
        name = books.channel(waitable)
        if name is not None:
            kinds = ACTION_REQUESTS if isinstance(waitable, ActionServer) else ACTION_ANSWERS
            found |= {f"{name}/{kind}" for kind in kinds.values()}
    return found


def missing_of(executor: LockstepExecutor, channels: Mapping[str, SimChannel]) -> str:
    """What a node still waits for before a lock-step can begin, in words; empty when it is connected.

    Args:
        executor: Of the node.
        channels: All channels of the lock-step.
    """
    node, lacks = executor.node, [executor.node.lockstep_missing()]
    for publisher in node.publishers:
        wanted = channels[publisher.topic_name].receivers if publisher.topic_name in channels else 0
        if publisher.get_subscription_count() < wanted:
            lacks.append(f"listeners of {publisher.topic_name}")
    for subscription in node.subscriptions:
        if subscription.topic_name in channels and not subscription.get_publisher_count():
            lacks.append(f"the sender of {subscription.topic_name}")
    for client in node.clients:
        name = f"{client.service_name}/request"
        if name in channels and channels[name].receivers and not client.service_is_ready():
            lacks.append(f"service {client.service_name}")
    for waitable in node.waitables:
        if isinstance(waitable, ActionClient):
            name = f"{waitable._action_name}/goal_request"
            if name in channels and channels[name].receivers and not waitable.server_is_ready():
                lacks.append(f"action {waitable._action_name}")
    return ", ".join(filter(None, lacks))


def channels_msg(sent: Mapping[str, int], receivers: Mapping[str, int] | None = None) -> list[SimChannel]:
    """Channels as messages, by name."""
    return [
        SimChannel(name=name, sent=sent[name], receivers=receivers.get(name, 0) if receivers else 0)
        for name in sorted(sent)
    ]


def _goes_on(timer: Timer) -> bool:
    """Whether a timer goes on between ticks."""
    clock: Clock = timer.clock
    return clock.clock_type != clock.clock_type.ROS_TIME


async def _call(callback: Callable[[], Any]) -> None:
    await await_or_execute(callback)


def _can_go_on(task: Task) -> bool:
    """Whether running a task would do anything: it has not begun, or what it waits for has happened."""
    if task.done() or task.cancelled() or task.executing():
        return False
    inner: Any = task._handler
    while (awaited := getattr(inner, "cr_await", None) or getattr(inner, "gi_yieldfrom", None)) is not None:
        inner = awaited
    frame = getattr(inner, "gi_frame", None)  # that of Future.__await__
    future = frame.f_locals.get("self") if frame is not None else None
    return not isinstance(future, Future) or future.done() or future.cancelled()


def _parts(entity: Client | Service) -> Any:
    """The type of a service, which rclpy's own annotations call an object."""
    return entity.srv_type


def _stamp_ns(message: Any) -> int | None:
    header = getattr(message, "header", None)
    return stamp_to_ns(header.stamp) if header is not None else None
