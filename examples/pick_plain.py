# SPDX-License-Identifier: Apache-2.0
"""Ask for a grasp by plain service, with nothing of the suite but its messages.

A client of a service does not notice that the node dies that serves it: it waits for all of its timeout. The client of
the action /grasp/pick does (docs/interfaces.md, When a node dies), has feedback, and can cancel; prefer it.
"""

from __future__ import annotations

import sys

import rclpy
from openarm_interfaces.srv import Grasp


def main() -> int:
    """Call /grasp and print the answer; 0 when the object stands at its place."""
    rclpy.init()
    node = rclpy.create_node("my_node")
    client = node.create_client(Grasp, "/grasp")
    if not client.wait_for_service(timeout_sec=10.0):
        print("no service /grasp: start the graph with ./openarm up", file=sys.stderr)
        return 1
    future = client.call_async(Grasp.Request(label=sys.argv[1] if len(sys.argv) > 1 else "red"))
    rclpy.spin_until_future_complete(node, future, timeout_sec=180.0)
    answer = future.result()
    node.destroy_node()
    rclpy.shutdown()
    if answer is None:
        print("no answer within 180 s", file=sys.stderr)
        return 1
    print(answer.code, answer.message)
    return 0 if answer.success else 1


if __name__ == "__main__":
    sys.exit(main())
