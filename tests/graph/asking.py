# SPDX-License-Identifier: Apache-2.0
"""A user's node next to a running graph, and a request that runs while a test watches what it does."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Generic, TypeVar

import rclpy
from rclpy.node import Node

from openarm_evaluation.judging.ros.observer import Observer
from tests.conftest import DEADLINE_S

T = TypeVar("T")


@contextmanager
def user(domain: int) -> Iterator[Node]:
    """A node of rclpy alone, which the test spins."""
    rclpy.init(domain_id=domain)
    node = rclpy.create_node("plain_user")
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def until(node: Node, look: Callable[[], T], good: Callable[[T], object], seconds: float = DEADLINE_S) -> T:
    """Spin until what is seen is good; return it, or what was seen last."""
    deadline = time.monotonic() + seconds
    while not good(seen := look()) and time.monotonic() < deadline:
        rclpy.spin_once(node, timeout_sec=0.1)
    return seen


class Asked(Generic[T]):
    """A request in a thread of its own that does not block the test.

    Args:
        observer: Of the graph; it keeps what is entered from now on.
        ask: The request; what it raises is raised where the result is read.
    """

    def __init__(self, observer: Observer, ask: Callable[[], T]) -> None:
        assert observer.truth() is not None, "wait for ground truth first"
        observer.forget()
        self._observer = observer
        self._future: Future[T] = Future()
        threading.Thread(target=self._work, args=(ask,), name="asking", daemon=True).start()

    def _work(self, ask: Callable[[], T]) -> None:
        try:
            self._future.set_result(ask())
        except BaseException as error:
            self._future.set_exception(error)

    def done(self) -> bool:
        """Return whether there is an answer."""
        return self._future.done()

    def result(self, timeout: float) -> T:
        """Return the answer."""
        return self._future.result(timeout)

    def wait_state(self, state: str, seconds: float = 60.0) -> None:
        """Wait until the grasp has entered a state; fail at once, with the answer, when the request ends before."""

        def entered() -> bool:
            return any(step.state == state for step in self._observer.steps())

        self._observer.wait(lambda: entered() or self._future.done(), seconds, f"the state {state}")
        assert entered(), f"the request ended before {state}: {self._future.result()}"
