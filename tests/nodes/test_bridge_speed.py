# SPDX-License-Identifier: Apache-2.0
"""Simulated time slower and faster than the wall clock, as the bridge publishes it (A-19, A-20)."""

from __future__ import annotations

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import Float64

from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.node import QOS_COMMAND, reliable


@pytest.mark.alone
@pytest.mark.parametrize("speed", [0.5, 3.0])
@pytest.mark.requirement("A-20")
def test_the_speed_that_was_asked_for_shows_on_the_wire_or_it_says_why_not(bridge, speed: float) -> None:
    bench = bridge(images=False, speed=speed)
    factors = bench.collect(Float64, "/sim/real_time_factor", reliable(5))
    reports = bench.collect(DiagnosticArray, "/diagnostics", QOS_COMMAND)
    bench.ros.spin_until(lambda: len(factors) >= 3 and len(reports) >= 3, 10.0, "three reports")
    # After a hiccup of the machine time is made up, so for a moment it may go faster than asked.
    assert np.median([factor.data for factor in factors]) < 1.5 * speed
    reached = min(factor.data for factor in factors[-2:]) > 0.8 * speed
    assert reached or "slower than requested" in " ".join(report.status[0].message for report in reports)
    values = {item.key: item.value for item in reports[-1].status[0].values}
    assert values["real_time_factor"] in {f"{factor.data:.3f}" for factor in factors}
    # Heard from the stamps themselves, at no more than 100 Hz of wall clock however fast time is.
    sim_s = (stamp_to_ns(bench.joints[-1].header.stamp) - stamp_to_ns(bench.joints[0].header.stamp)) * 1e-9
    wall_s = bench.joint_arrivals[-1] - bench.joint_arrivals[0]
    assert sim_s / wall_s < 1.2 * speed
    assert sim_s / wall_s > 0.7 * speed or not reached
    assert len(bench.joints) / wall_s < 115.0
