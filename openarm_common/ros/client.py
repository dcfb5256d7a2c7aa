# SPDX-License-Identifier: Apache-2.0
"""Nodes of programs that ask something of the graph: in a context of their own, spun by the caller or by a thread."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from types import TracebackType
from typing import Any, NamedTuple, Self

import rclpy
from action_msgs.msg import GoalStatus
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from openarm_common.errors import Code, OpenArmError
from openarm_common.fields import check_message
from openarm_common.ros.actions import ActionClient, ServerWatch, check_alive
from openarm_common.ros.executor import WaitSetExecutor

#: Period of checks that the server is still there, s.
_CHECK_S = 0.25
#: Checks without a server before it counts as gone: discovery may lose it for a moment.
_GONE = 20
#: Longest wait for the end of a goal that was cancelled, s: a robot ramps down, and a plan may have to be dropped.
_HALT_S = 5.0
#: A cancel is sent again after this, s: a server that has not discovered this client yet misses the request.
_AGAIN_S = 0.5
_UP = "is the graph up, with the same ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE?"


def new_context(domain: int | None = None) -> Context:
    """Return a ROS context that leaves signals to the program, in a domain or in that of the environment."""
    context = Context()
    rclpy.init(args=[], context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    return context


class ContextNode:
    """A node in a ROS context of its own, so that it works next to an rclpy program; a context manager.

    Nothing spins it but `spin_until`. Ctrl-C stays the caller's.

    Args:
        name: Name of the node; names that begin with _ are hidden.
        domain: ROS_DOMAIN_ID; None takes the environment's.
        bare: Without parameter services and /rosout.
        context: Context from `new_context`, where several nodes share one; it stays when this node is closed.
    """

    def __init__(
        self, name: str, *, domain: int | None = None, bare: bool = False, context: Context | None = None
    ) -> None:
        self._owns = context is None
        self._context = new_context(domain) if context is None else context
        self._node: Any = Node(
            name,
            context=self._context,
            use_global_arguments=False,
            start_parameter_services=not bare,
            enable_rosout=not bare,
        )
        self._executor = WaitSetExecutor(context=self._context)
        self._executor.add_node(self._node)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Leave the graph."""
        if self._context.ok():
            self._executor.shutdown(timeout_sec=2.0)
            self._node.destroy_node()
            if self._owns:
                self._context.try_shutdown()

    def spin_until(self, condition: Callable[[], Any], seconds: float) -> bool:
        """Handle what arrives until a condition holds; return whether it did in time."""
        deadline = time.monotonic() + seconds
        while not condition():
            left = deadline - time.monotonic()
            if left <= 0.0:
                return False
            self._executor.spin_once(timeout_sec=min(left, 0.1))
        return True

    def result(self, future: Any, seconds: float, what: str, died: Callable[[], str] = str) -> Any:
        """Spin until a future is done and return its result.

        Args:
            future: Awaited.
            seconds: Longest wait.
            what: Does answer, for the error.
            died: Result of `ActionClient.watch`, where that is an action.

        Raises:
            OpenArmError: TIMEOUT, naming `what` did not answer; NOT_READY, when its server has died.
        """
        in_time = self.spin_until(lambda: future.done() or died(), seconds)
        if not future.done():
            check_alive(died, what)
        if not in_time:
            raise OpenArmError(Code.TIMEOUT, f"{what}: no answer within {seconds:g} s")
        return future.result()


class BackgroundNode(ContextNode):
    """A node that spins in a thread of its own: its methods block, and answers are awaited with deadlines.

    Args:
        name: Name of the node.
        domain: ROS_DOMAIN_ID; None takes the environment's.
        timeout: Longest wait for a server to be there, s of wall clock.
    """

    def __init__(self, name: str, *, domain: int | None = None, timeout: float = 10.0) -> None:
        super().__init__(name, domain=domain)
        self._timeout = timeout
        self._clients: dict[str, Any] = {}
        self._watches: dict[str, ServerWatch] = {}
        self._making = threading.Lock()
        self._closing = threading.Event()
        self._ended = ""
        self._thread = threading.Thread(target=self._spin, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread and leave the graph."""
        self._closing.set()
        self._executor.shutdown(timeout_sec=2.0)
        self._thread.join(timeout=5.0)
        for client in self._clients.values():
            if isinstance(client, ActionClient):  # which its node does not destroy; it would keep the participant
                client.destroy()
        self._clients.clear()
        super().close()

    def call(self, kind: Any, name: str, request: Any, timeout: float = 60.0) -> Any:
        """Call a service and return its response.

        Raises:
            OpenArmError: NOT_READY, when there is no server, or a node of the suite that is the server dies;
                INVALID_ARGUMENT, when no message can hold the request; TIMEOUT.
        """
        _check(name, request)
        client = self._client(name, lambda: self._node.create_client(kind, name))
        if not client.wait_for_service(timeout_sec=self._timeout):
            raise OpenArmError(Code.NOT_READY, f"no service {name} within {self._timeout:g} s: {_UP}")
        died = self._watch_service(self._node.resolve_service_name(name))
        sent: list[Future] = []

        def ask() -> Future:
            sent.append(client.call_async(request))
            return sent[0]

        try:
            return self._wait(self._begin(ask), timeout, name, client.service_is_ready, died=died)
        finally:
            for future in sent:  # one that has no answer is no longer waited for
                client.remove_pending_request(future)
                future.cancel()

    def do(
        self,
        kind: Any,
        name: str,
        goal: Any,
        *,
        timeout: float,
        on_feedback: Callable[[Any], None] | None = None,
        stop: threading.Event | None = None,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> Any:
        """Send a goal to an action and return its result, also that of a failure.

        Args:
            kind: Type of the action.
            name: Name of the action.
            goal: Goal to send.
            timeout: Longest wait for the end, s of wall clock; then, and at any exception, the goal is cancelled, and
                its end is waited for.
            on_feedback: Called with each feedback, in the background thread; what it raises is raised here.
            stop: When it is set the goal is cancelled, and its result waited for.
            meanwhile: Called again and again in the thread of the caller while the goal is active.

        Raises:
            OpenArmError: NOT_READY, when there is no server, or it dies; BUSY, when the goal is refused;
                INVALID_ARGUMENT, when no message can hold the goal; TIMEOUT.
            KeyboardInterrupt: The goal has ended; a second one, raised in the handling of the first, says that it may
                not have.
        """
        _check(name, goal)
        client: ActionClient = self._client(name, lambda: ActionClient(self._node, kind, name))
        if not client.wait_for_server(timeout_sec=self._timeout):
            raise OpenArmError(Code.NOT_READY, f"no action {name} within {self._timeout:g} s: {_UP}")
        trouble: list[Exception] = []
        deliver = None if on_feedback is None else _guarded(on_feedback, trouble)
        there, died = client.server_is_ready, client.watch()
        sent = self._begin(client.send_goal_async, goal, deliver)
        try:
            handle = self._wait(sent, self._timeout, name, there, died=died)
            if not handle.accepted:
                raise OpenArmError(Code.BUSY, f"{name} refused the goal")
            ended = self._begin(handle.get_result_async)
            cancel = partial(self._begin, handle.cancel_goal_async)
            answer = self._wait(ended, timeout, name, there, stop, cancel, trouble, meanwhile, died)
        except BaseException as error:
            # Whatever keeps the caller from waiting (a deadline, Ctrl-C): the robot would continue unattended.
            halted = self._halted(sent, _HALT_S if there() and not died() else 0.1)
            if not halted and isinstance(error, KeyboardInterrupt):
                text = f"{name} was cancelled by Ctrl-C and has not ended within {_HALT_S:g} s"
                raise OpenArmError(Code.TIMEOUT, f"{text}; the emergency stop is `openarm stop`") from error
            raise
        if answer.status == GoalStatus.STATUS_UNKNOWN:
            raise OpenArmError(Code.NOT_READY, f"{name} no longer knows the goal: its node was restarted")
        return answer.result

    def _halted(self, sent: Future, limit: float) -> bool:
        """Cancel a goal, also one that is still being accepted; return whether it has ended within `limit`, s."""
        ended, end = threading.Event(), time.monotonic() + limit

        async def cancel() -> None:
            handle: Any = await sent
            if not isinstance(handle, _Unsent) and handle.accepted:
                await handle.cancel_goal_async()
                await handle.get_result_async()
            ended.set()

        while (left := end - time.monotonic()) > 0.0:
            self._executor.create_task(cancel)
            if ended.wait(min(left, _AGAIN_S)):
                return True
        return False

    def servers(self, service: str) -> list[str]:
        """Return the nodes that offer a service, as far as they are discovered: their fully qualified names."""
        found: list[str] = []
        for name, namespace in self._node.get_node_names_and_namespaces():
            with suppress(NodeNameNonExistentError):  # it has gone meanwhile
                if any(service == one for one, _ in self._node.get_service_names_and_types_by_node(name, namespace)):
                    found.append(f"{namespace.rstrip('/')}/{name}")
        return found

    def _watch_service(self, service: str) -> Callable[[], str]:
        """Return a function that says when a node has died that offers a service, as `ServerWatch.begin`."""
        begun: list[Callable[[], str]] = []

        def died() -> str:
            if not begun:  # a service may be discovered before the name of its node
                begun.extend(self._watch_node(server).begin() for server in self.servers(service))
            return next((who for one in begun if (who := one())), "")

        died()
        return died

    def _watch_node(self, name: str) -> ServerWatch:
        with self._making:
            if name not in self._watches:
                self._watches[name] = ServerWatch(self._node, "", f"the node {name.rpartition('/')[2]}", name)
            return self._watches[name]

    def _client(self, name: str, make: Callable[[], Any]) -> Any:
        with self._making:
            if name not in self._clients:
                self._clients[name] = make()
            return self._clients[name]

    def _begin(self, ask: Callable[..., Future], *args: Any) -> Future:
        """Send a request from the background thread; the returned future is done when the answer is there.

        rclpy files a request only after it has sent it: sent from another thread, a fast answer would be lost.
        """

        async def exchange() -> Any:
            try:
                return await ask(*args)
            except Exception as error:  # raised here it would end the thread
                return _Unsent(error.__cause__ or error)

        return self._executor.create_task(exchange)

    def _wait(
        self,
        future: Future,
        timeout: float,
        name: str,
        there: Callable[[], bool],
        stop: threading.Event | None = None,
        cancel: Callable[[], object] = lambda: None,
        trouble: Sequence[Exception] = (),
        meanwhile: Callable[[], None] = lambda: None,
        died: Callable[[], str] = str,
    ) -> Any:
        done = _event(future)
        deadline = time.monotonic() + timeout
        missed, asked = 0, -math.inf
        while not done.wait(_CHECK_S):
            meanwhile()
            if not self._thread.is_alive():
                why = self._ended or ("it was closed" if self._closing.is_set() else "its context was shut down")
                raise OpenArmError(Code.NOT_READY, f"the client ended while waiting for {name}: {why}")
            check_alive(died, name)
            missed = 0 if there() else missed + 1
            if missed > _GONE:
                raise OpenArmError(Code.NOT_READY, f"the server of {name} is gone")
            if trouble:
                raise trouble[0]
            if time.monotonic() > deadline:
                raise OpenArmError(Code.TIMEOUT, f"no answer of {name} within {timeout:g} s")
            now = time.monotonic()
            if stop is not None and stop.is_set() and now - asked >= _AGAIN_S:
                if asked < 0.0:
                    deadline = min(deadline, now + self._timeout)
                cancel()
                asked = now
        answer = future.result()
        if isinstance(answer, _Unsent):
            reason = str(answer.error).partition("\n")[0] or type(answer.error).__name__
            text = (
                f"{name} can't be asked that: {reason}; expected values that its type can hold (`ros2 interface show`)"
            )
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        return answer

    def _spin(self) -> None:
        """Handle what arrives until the end; one message that can't be handled does not keep others from it."""
        while not self._closing.is_set():
            try:
                self._executor.spin()
                return
            except ExternalShutdownException:
                self._node.get_logger().debug("the context was shut down")
                return
            except Exception as error:
                if self._closing.is_set():  # what is waited for is being destroyed
                    return
                self._node.get_logger().error(f"what arrived could not be handled, the rest goes on: {error!r}")
                self._closing.wait(_CHECK_S)  # of an error that stays, a few lines a second
            except BaseException as error:  # it is to end, as by sys.exit
                self._ended = repr(error)
                self._node.get_logger().error(f"the thread of the client ends: {error!r}")
                return


def _check(name: str, message: Any) -> None:
    try:
        check_message(message)
    except OpenArmError as error:
        raise OpenArmError(error.code, f"{name} can't be asked that: {error.message}") from None


class _Unsent(NamedTuple):
    """In place of an answer: why a request was not sent, or its answer not read."""

    error: BaseException


def _guarded(on_feedback: Callable[[Any], None], trouble: list[Exception]) -> Callable[[Any], None]:
    """A callback that files what it raises: raised in the background it would stop the thread."""

    def deliver(message: Any) -> None:
        try:
            on_feedback(message.feedback)
        except Exception as error:
            trouble.append(error)

    return deliver


def _event(future: Future) -> threading.Event:
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    return done
