# SPDX-License-Identifier: Apache-2.0
"""Eight streams and a last one, published when stdin says so: a process of its own, as Fast DDS reads profiles once."""

from __future__ import annotations

import time

import rclpy
from rclpy.duration import Duration
from std_msgs.msg import String

from openarm_common.ros.node import QOS_COMMAND, QOS_SENSOR

STREAMS, ROUNDS = 8, 150

if __name__ == "__main__":
    rclpy.init()
    node = rclpy.create_node("streams")
    streams = [node.create_publisher(String, f"/stream_{i}", QOS_SENSOR) for i in range(STREAMS)]
    last = node.create_publisher(String, "/stream_last", QOS_COMMAND)  # met last, and that is acknowledged
    deadline = time.monotonic() + 30.0
    while not all(stream.get_subscription_count() for stream in (*streams, last)):
        assert time.monotonic() < deadline, "no subscriber"
        rclpy.spin_once(node, timeout_sec=0.05)
    last.publish(String())
    print("met" if last.wait_for_all_acked(Duration(seconds=60)) else "not met", flush=True)  # noqa: T201
    input()
    for k in range(ROUNDS):
        for stream in streams:
            stream.publish(String(data=str(k)))
    print("sent", flush=True)  # noqa: T201
    input()
    last.publish(String())  # behind all of them in the queue
    print("taken" if last.wait_for_all_acked(Duration(seconds=60)) else "not taken", flush=True)  # noqa: T201
    input()
