# SPDX-License-Identifier: Apache-2.0
"""The executor that keeps its wait set does what rclpy's own does, and makes no wait set for a message."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import rclpy
from action_msgs.msg import GoalStatus
from control_msgs.action import GripperCommand
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger

from openarm_common.ros import executor as module
from openarm_common.ros.executor import WaitSetExecutor
from tests.conftest import DEADLINE_S


@pytest.fixture(params=[SingleThreadedExecutor, WaitSetExecutor])
def executor(request: pytest.FixtureRequest, ros_domain: int) -> Iterator[Executor]:
    made = request.param()
    yield made
    made.shutdown(2.0)


@pytest.fixture
def node(executor: Executor) -> Iterator[Node]:
    made = Node("spun")
    executor.add_node(made)
    yield made
    executor.shutdown(2.0)
    made.destroy_node()


def until(executor: Executor, condition: Callable[[], object]) -> None:
    end = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < end, "nothing came"
        executor.spin_once(timeout_sec=0.2)


def stay(executor: Executor) -> None:
    """Run whatever is ready."""
    for _ in range(20):
        executor.spin_once(timeout_sec=0.01)


def test_timers_messages_services_and_actions_are_served(executor: Executor, node: Node) -> None:
    heard, fed = list[str](), list[object]()
    publisher = node.create_publisher(String, "/said", 10)
    node.create_subscription(String, "/said", lambda message: heard.append(message.data), 10)
    timer = node.create_timer(0.01, lambda: publisher.publish(String(data="hello")))
    until(executor, lambda: len(heard) > 2)
    node.destroy_timer(timer)

    def serve(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = "served"
        return response

    node.create_service(Trigger, "/serve", serve)
    client = node.create_client(Trigger, "/serve")
    until(executor, client.service_is_ready)
    answer = client.call_async(Trigger.Request())
    until(executor, answer.done)
    assert answer.result().message == "served"

    async def act(goal):
        goal.publish_feedback(GripperCommand.Feedback())
        await once(node)
        goal.succeed()
        return GripperCommand.Result()

    server = ActionServer(node, GripperCommand, "/act", act)
    asker = ActionClient(node, GripperCommand, "/act")
    until(executor, asker.server_is_ready)
    sent = asker.send_goal_async(GripperCommand.Goal(), fed.append)
    until(executor, sent.done)
    until(executor, lambda: fed)
    result = sent.result().get_result_async()
    until(executor, result.done)
    assert result.result().status == GoalStatus.STATUS_SUCCEEDED
    asker.destroy()
    server.destroy()


def once(node: Node) -> Future:
    """A future that is done by a timer of the node."""
    future = Future()
    timer = node.create_timer(0.01, lambda: (timer.cancel(), future.set_result(None)))
    return future


@pytest.mark.parametrize("group", [ReentrantCallbackGroup, MutuallyExclusiveCallbackGroup])
def test_a_coroutine_that_waits_lets_others_run_as_their_group_allows(
    executor: Executor, node: Node, group: type
) -> None:
    mine, future, calls = group(), Future(), list[str]()

    async def wait() -> None:
        calls.append("begun")
        first.cancel()
        await future
        calls.append("ended")

    first = node.create_timer(0.0, wait, callback_group=mine)
    until(executor, lambda: calls)
    guard = node.create_guard_condition(lambda: calls.append("guard"), callback_group=mine)
    guard.trigger()
    stay(executor)
    assert calls == (["begun", "guard"] if group is ReentrantCallbackGroup else ["begun"])
    future.set_result(None)
    executor.wake()
    until(executor, lambda: len(calls) == 3)
    assert sorted(calls) == ["begun", "ended", "guard"]


def test_what_is_made_destroyed_or_asked_by_another_thread_wakes_the_executor(executor: Executor, node: Node) -> None:
    heard = list[String]()
    spinning = threading.Thread(target=executor.spin)
    spinning.start()
    with ThreadPoolExecutor(1) as pool:
        done = threading.Event()
        node.create_timer(0.01, done.set)
        assert done.wait(DEADLINE_S)
        other, added = Node("other"), threading.Event()
        other.create_timer(0.01, added.set)
        assert executor.add_node(other)
        assert added.wait(DEADLINE_S)
        asked = executor.create_task(lambda: "done")
        end = time.monotonic() + DEADLINE_S
        while not asked.done():
            assert time.monotonic() < end
            time.sleep(0.01)
        subscription = pool.submit(
            node.create_subscription, String, "/seen", lambda m: heard.append(m.data), 10
        ).result()
        publisher = node.create_publisher(String, "/seen", 10)
        while not heard:
            assert time.monotonic() < end
            publisher.publish(String(data="x"))
            time.sleep(0.01)
        pool.submit(node.destroy_subscription, subscription).result()
        while publisher.get_subscription_count():  # what is being waited for is destroyed, too
            assert time.monotonic() < end
            time.sleep(0.01)
    executor.shutdown(2.0)
    spinning.join(DEADLINE_S)
    other.destroy_node()
    assert not spinning.is_alive()


def test_an_entity_that_is_destroyed_before_its_turn_is_not_called(executor: Executor, node: Node) -> None:
    called, timers = list[int](), []

    def fire(number: int) -> None:
        called.append(number)
        for timer in timers:
            node.destroy_timer(timer)

    timers += [node.create_timer(0.0, lambda n=n: fire(n)) for n in range(3)]
    stay(executor)
    assert len(called) == 1


def test_an_error_of_a_callback_is_raised_and_the_rest_goes_on(executor: Executor, node: Node) -> None:
    called = list[str]()

    def fail() -> None:
        bad.cancel()
        raise ValueError("no")

    async def fail_later() -> None:
        late.cancel()
        await once(node)
        raise ValueError("late")

    bad = node.create_timer(0.0, fail)
    with pytest.raises(ValueError, match="no"):
        stay(executor)
    late = node.create_timer(0.0, fail_later, callback_group=ReentrantCallbackGroup())
    with pytest.raises(ValueError, match="late"):
        until(executor, lambda: False)
    node.create_timer(0.0, lambda: called.append("x"))
    until(executor, lambda: called)


def test_the_end_of_one_task_resumes_another_and_futures_end_a_spin(executor: Executor, node: Node) -> None:
    first = executor.create_task(lambda: 1)

    async def second() -> int:
        return await first + 1

    async def third() -> int:
        return await executor.create_task(second) + 1

    last = executor.create_task(third)
    executor.spin_until_future_complete(last, timeout_sec=DEADLINE_S)
    assert last.result() == 3
    executor.spin_until_future_complete(Future(), timeout_sec=0.01)  # never done
    with ThreadPoolExecutor(1) as pool:
        future = Future(executor=executor)
        pool.submit(future.set_result, 7)
        executor.spin_until_future_complete(future, timeout_sec=DEADLINE_S)
    assert future.result() == 7
    executor.spin_once(timeout_sec=0)


def test_a_node_that_was_taken_out_is_left_alone_and_the_end_of_the_context_ends_the_spin(ros_domain: int) -> None:
    context, called = Context(), list[str]()
    rclpy.init(context=context, domain_id=ros_domain)
    node, executor = Node("own", context=context), WaitSetExecutor(context=context)
    executor.add_node(node)
    node.create_timer(0.0, lambda: called.append("x"))
    until(executor, lambda: called)
    executor.remove_node(node)
    stay(executor)
    had = len(called)
    stay(executor)
    assert len(called) == had
    with ThreadPoolExecutor(1) as pool:
        spinning = pool.submit(executor.spin)
        executor.create_task(context.try_shutdown)
        assert isinstance(spinning.exception(DEADLINE_S), ExternalShutdownException) or spinning.exception() is None
    executor.shutdown()
    node.destroy_node()


def test_no_wait_set_is_made_for_a_message(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    made, heard = list[object](), list[str]()
    monkeypatch.setattr(module, "_Kept", lambda *args, kind=module._Kept: made.append(None) or kind(*args))
    node, executor = Node("spun"), WaitSetExecutor()
    executor.add_node(node)
    publisher = node.create_publisher(String, "/said", 10)
    node.create_subscription(String, "/said", lambda message: heard.append(message.data), 10)
    node.create_timer(0.001, lambda: publisher.publish(String(data="hello")))
    until(executor, lambda: len(heard) > 50)
    assert len(made) == 1
    executor.shutdown()
    node.destroy_node()
