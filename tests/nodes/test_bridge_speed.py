# SPDX-License-Identifier: Apache-2.0
"""Simulated time slower and faster than the wall clock, as the bridge publishes it (A-19, A-20)."""

from __future__ import annotations

import re
import time

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from openarm_interfaces.msg import ObjectStateArray
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64
from tf2_msgs.msg import TFMessage

from openarm_common.robot.folder import robot_folder
from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.node import QOS_CLOCK, QOS_COMMAND, QOS_SENSOR, QOS_TF, reliable

#: Hz of wall time from real time on, below of simulated time.
RATES = {
    "/joint_states": (JointState, QOS_COMMAND, 100.0),
    "/clock": (Clock, QOS_CLOCK, 100.0),
    "/tf": (TFMessage, QOS_TF, 50.0),
    "/sim/ground_truth/objects": (ObjectStateArray, reliable(5), 20.0),
}
WINDOW_S = 2.0


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.parametrize("speed", [0.5, 5.0])
@pytest.mark.requirement("A-20")
def test_topics_keep_their_rates_at_the_speed_that_was_asked_for_or_it_says_why_not(bridge, speed: float) -> None:
    bench = bridge(images=False, speed=speed)
    arrivals: dict[str, list[float]] = {topic: [] for topic in RATES}
    for topic, (kind, qos, _) in RATES.items():
        heard = arrivals[topic]
        bench.ros.node.create_subscription(kind, topic, lambda _, heard=heard: heard.append(time.monotonic()), qos)
    factors = bench.collect(Float64, "/sim/real_time_factor", reliable(5))
    reports = bench.collect(DiagnosticArray, "/diagnostics", QOS_COMMAND)

    def rates() -> dict[str, float]:
        """Over the last two seconds, Hz."""
        since = time.monotonic() - WINDOW_S
        return {topic: sum(at > since for at in times) / WINDOW_S for topic, times in arrivals.items()}

    def kept() -> bool:
        """Within 2 %, or by the one message that a window has more or less."""
        wanted = {topic: min(speed, 1.0) * rate for topic, (_, _, rate) in RATES.items()}
        return rates() == pytest.approx(wanted, rel=0.02, abs=1.0 / WINDOW_S)

    def told_slow() -> bool:
        return any("slower than requested" in report.status[0].message for report in reports[-2:])

    bench.ros.spin_until(lambda: len(factors) >= 3 and (kept() or told_slow()), what="the rates")
    # After a hiccup of the machine time is made up, so for a moment it may go faster than asked.
    assert np.median([factor.data for factor in factors]) < 1.5 * speed
    values = {item.key: item.value for item in reports[-1].status[0].values}
    assert values["real_time_factor"] in {f"{factor.data:.3f}" for factor in factors}
    # Heard from the stamps themselves.
    sim_s = (stamp_to_ns(bench.joints[-1].header.stamp) - stamp_to_ns(bench.joints[0].header.stamp)) * 1e-9
    wall_s = bench.joint_arrivals[-1] - bench.joint_arrivals[0]
    assert sim_s / wall_s < 1.2 * speed
    assert sim_s / wall_s > 0.7 * speed or told_slow()


@pytest.mark.long
def test_fewer_images_are_drawn_where_the_machine_is_too_slow_and_time_goes_on(bridge, tmp_path) -> None:
    data = yaml.safe_load((robot_folder() / "cameras.yaml").read_text())
    overhead = next(camera for camera in data["cameras"] if camera["name"] == "overhead")
    data["cameras"] = [overhead | {"width": 1600, "height": 1200, "rate": 100.0}]
    (tmp_path / "cameras.yaml").write_text(yaml.safe_dump(data))
    bench = bridge(cameras=str(tmp_path / "cameras.yaml"))
    bench.ros.node.create_subscription(Image, "/overhead/depth/image_raw", lambda _: None, QOS_SENSOR)
    factors = bench.collect(Float64, "/sim/real_time_factor", reliable(5))
    reports = bench.collect(DiagnosticArray, "/diagnostics", QOS_COMMAND)

    def rate() -> float:
        values = {item.key: item.value for report in reports[-1:] for item in report.status[0].values}
        return float(values.get("rate_overhead", "inf"))

    bench.ros.spin_until(lambda: 0.0 < rate() < 60.0, what="fewer images")
    text = r"this machine draws no faster: overhead at \d+ of 100 Hz"
    assert re.search(text, reports[-1].status[0].message)
    assert reports[-1].status[0].level != DiagnosticStatus.OK
    factors.clear()
    bench.ros.spin_until(lambda: len(factors) > 3, what="the real-time factor")
    assert np.median([factor.data for factor in factors]) > 0.95
