# SPDX-License-Identifier: Apache-2.0
"""Fixtures that all tests share.

Nodes are tested in process: the node and its probes run in one executor, in a ROS domain of their own, and wait for
conditions with a deadline, never for a time to pass.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator

import pytest

from openarm_common.domain import release_domain, reserve_domain

# Before any rclpy is imported: a domain of this process, no traffic beyond this machine, software rendering.
os.environ["ROS_DOMAIN_ID"] = str(reserve_domain())
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("MUJOCO_GL", "egl")


class RosProbe:
    """An executor with nodes in it, driven by conditions."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node

        # A domain for each test: what an earlier one left behind in this process is not met.
        self._domain = reserve_domain()
        os.environ["ROS_DOMAIN_ID"] = str(self._domain)
        rclpy.init()
        self.executor = SingleThreadedExecutor()
        self.nodes: list[Node] = []
        #: A node to make publishers, subscriptions and clients of the test with.
        self.node = self.add(Node("probe"))

    def add(self, node):
        """Add a node; it is closed and destroyed at the end of the test."""
        self.executor.add_node(node)
        self.nodes.append(node)
        return node

    def spin_until(self, condition: Callable[[], object], timeout: float = 10.0, what: str = "") -> None:
        """Spin until `condition` holds; fail with `what` after `timeout` seconds."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                pytest.fail(f"not within {timeout:g} s: {what or 'the condition'}")
            self.executor.spin_once(timeout_sec=0.05)

    def result(self, future, timeout: float = 10.0, what: str = "the answer"):
        """Spin until a future is done and return its result."""
        self.spin_until(future.done, timeout, what)
        return future.result()

    def call(self, client, request, timeout: float = 10.0):
        """Call a service and return its answer."""
        self.spin_until(client.service_is_ready, timeout, f"service {client.srv_name} is there")
        return self.result(client.call_async(request), timeout, f"an answer of {client.srv_name}")

    def send_goal(self, client, goal, timeout: float = 10.0, feedback_callback=None):
        """Send an action goal and return (goal handle, result future or, when it was rejected, None)."""
        self.spin_until(client.server_is_ready, timeout, "the action server is there")
        handle = self.result(client.send_goal_async(goal, feedback_callback=feedback_callback), timeout, "goal answer")
        return handle, handle.get_result_async() if handle.accepted else None

    def close(self) -> None:
        """Shut down in order."""
        import rclpy

        self.executor.shutdown(timeout_sec=2.0)
        for node in reversed(self.nodes):
            if hasattr(node, "close"):
                node.close()
            node.destroy_node()
        rclpy.try_shutdown()
        release_domain(self._domain)


@pytest.fixture
def ros() -> Iterator[RosProbe]:
    """A ROS context, an executor and a probe node for one test."""
    probe = RosProbe()
    try:
        yield probe
    finally:
        probe.close()
