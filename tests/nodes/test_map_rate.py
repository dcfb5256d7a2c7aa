# SPDX-License-Identifier: Apache-2.0
"""Rates of the simulated cameras, and of the map that is made of their images."""

from __future__ import annotations

import time

import numpy as np
import pytest

from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.images import array_to_image
from tests.nodes.octomap_bench import FRAME, Bench, sheet

PERIOD, FRAME_PERIOD = 0.5, 1.0 / 30.0


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.requirement("A-58")
def test_a_map_of_2_hz_is_made_of_the_newest_frame_of_a_30_hz_camera(ros, tmp_path) -> None:
    """Every update uses one frame, the newest that has come; none of those that it waits for is lost."""
    bench = Bench(ros, tmp_path, period=PERIOD)
    image = array_to_image(sheet(0.4), "16UC1", FRAME, 0)
    sent: list[tuple[float, int]] = []
    begin = due = time.monotonic()

    def camera_runs() -> None:
        nonlocal due
        now = time.monotonic()
        if now >= due:
            due += FRAME_PERIOD
            bench.t_ns = round((1.0 + now - begin) * 1e9)
            image.header.stamp.sec, image.header.stamp.nanosec = divmod(bench.t_ns, 10**9)
            bench.send(image)
            sent.append((now, bench.t_ns))

    came: list[float] = []

    def until(condition, what: str) -> None:
        def step() -> bool:
            camera_runs()
            came.extend([time.monotonic()] * (len(bench.maps) - len(came)))
            return bool(condition())

        ros.spin_until(step, what=what)

    until(lambda: len(bench.maps) >= 3, "the first maps")
    first = len(bench.maps) - 1
    until(lambda: len(bench.maps) > first + 8, "eight more maps")
    until(lambda: int(bench.value("updates") or 0) >= len(bench.maps) - 1, "a report of them")

    assert (came[first + 8] - came[first]) / 8 == pytest.approx(PERIOD, rel=0.1)
    stamps = [stamp_to_ns(message.header.stamp) for message in bench.maps[first : first + 9]]
    assert set(stamps) <= {t_ns for _, t_ns in sent}
    assert len(set(stamps)) == len(stamps)
    lag = [max(t for now, t in sent if now <= at) - t_ns for at, t_ns in zip(came[first:], stamps, strict=False)]
    assert np.median(lag) * 1e-9 < PERIOD / 2, "the newest frame, not one that was queued since the last update"
    assert bench.value("overhead_used") == bench.value("updates")
    assert (bench.value("overhead_refused"), bench.value("overhead_late")) == ("0", "0")
