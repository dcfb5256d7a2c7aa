# SPDX-License-Identifier: Apache-2.0
"""The map deactivated and activated by the lifecycle of ROS 2, as `ros2 lifecycle` or nav2's manager does it."""

from __future__ import annotations

from pathlib import Path

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from octomap_msgs.srv import GetOctomap

from tests.nodes.octomap_bench import Bench, sheet

ON_TABLE = (0.45, 0.25, 0.41)
CAMERA = "/overhead/depth/image_raw"


def change(bench: Bench, label: str) -> bool:
    request = ChangeState.Request(transition=Transition(label=label))
    return bench.call(ChangeState, "/octomap/change_state", request).success


def state(bench: Bench) -> str:
    return bench.call(GetState, "/octomap/get_state").current_state.label


def at(bench: Bench, point: tuple[float, float, float]) -> str:
    return bench.state(point, bench.call(GetOctomap, "/octomap_binary").map)


@pytest.mark.requirement("P-31")
def test_a_map_at_rest_listens_to_nothing_and_goes_on_where_it_was(ros, tmp_path: Path) -> None:
    bench = Bench(ros, tmp_path)
    assert state(bench) == "active", "whoever knows of no lifecycle has a map"
    bench.show(sheet(0.41), lambda: bench.state(ON_TABLE) == "occupied", "the table is in the map")
    assert change(bench, "deactivate")
    assert state(bench) == "inactive"
    for topic in (CAMERA, "/joint_states"):
        ros.spin_until(lambda topic=topic: not ros.node.count_subscribers(topic), what=f"{topic} has no subscriber")
    assert at(bench, ON_TABLE) == "occupied", "what was seen is kept, and services answer"
    assert change(bench, "activate")
    higher = (0.45, 0.25, 0.51)
    bench.show(sheet(0.51), lambda: bench.state(higher) == "occupied", "it looks again")


@pytest.mark.requirement("P-31")
def test_a_manager_may_bring_it_up_and_clean_it(ros, tmp_path: Path) -> None:
    bench = Bench(ros, tmp_path, autostart=False)
    assert state(bench) == "unconfigured"
    assert not ros.node.count_subscribers(CAMERA)
    assert change(bench, "configure")
    assert change(bench, "activate")
    bench.show(sheet(0.41), lambda: bench.state(ON_TABLE) == "occupied", "the table is in the map")
    assert change(bench, "deactivate")
    assert change(bench, "cleanup")
    assert (state(bench), at(bench, ON_TABLE)) == ("unconfigured", "unknown")


def test_a_transition_that_does_not_fit_is_refused_and_the_node_goes_on(ros, tmp_path: Path) -> None:
    bench = Bench(ros, tmp_path)
    for wrong in (Transition(label="activate"), Transition(label="fly"), Transition(id=3), Transition(id=77)):
        answer = bench.call(ChangeState, "/octomap/change_state", ChangeState.Request(transition=wrong))
        assert (answer.success, state(bench)) == (False, "active"), wrong
