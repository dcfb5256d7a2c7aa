# SPDX-License-Identifier: Apache-2.0
"""Nodes take `use_sim_time`: their clock is /clock then, and what they do by the wall clock goes on."""

from __future__ import annotations

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Clock

from openarm_common.ros.convert import ns_to_stamp, stamp_to_ns
from openarm_common.ros.node import QOS_CLOCK, QOS_COMMAND, BaseNode
from openarm_motion.ros.node import MotionNode
from openarm_perception.ros.detector_node import DetectNode

pytestmark = pytest.mark.requirement("P-30")

NOW = 123_000_000_000


@pytest.mark.parametrize("kind", [MotionNode, DetectNode])
def test_a_node_takes_simulated_time(ros, kind: type[BaseNode]) -> None:
    node = ros.start(kind, use_sim_time=True)
    stamps: list[int] = []
    publisher = ros.node.create_publisher(Clock, "/clock", QOS_CLOCK)
    ros.node.create_subscription(
        DiagnosticArray, "/diagnostics", lambda m: stamps.append(stamp_to_ns(m.header.stamp)), QOS_COMMAND
    )

    def at_now() -> bool:
        publisher.publish(Clock(clock=ns_to_stamp(NOW)))
        return node.get_clock().now().nanoseconds == NOW

    ros.spin_until(at_now, what="the clock of the node to be /clock")
    # Once a second of the wall clock, though simulated time stands still.
    ros.spin_until(lambda: stamps.count(NOW) >= 2, what="diagnostics with simulated stamps")


def test_the_bridge_stamps_with_the_time_it_makes(bridge) -> None:
    bench = bridge(images=False, use_sim_time=True)
    reports = bench.collect(DiagnosticArray, "/diagnostics", QOS_COMMAND)
    bench.ros.spin_until(lambda: len(reports) > 1, what="diagnostics")
    assert 0 < stamp_to_ns(reports[-1].header.stamp) < 60_000_000_000  # seconds since the world began, not since 1970
    assert abs(stamp_to_ns(reports[-1].header.stamp) - bench.t_ns) < 2_000_000_000
