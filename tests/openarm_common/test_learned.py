# SPDX-License-Identifier: Apache-2.0
"""Hands as they were learned: in the description, in their store, and in the file that a process reads."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from openarm_bringup.supervision.environment import zeros_file
from openarm_bringup.supervision.graph import load_graph
from openarm_common.robot import folder
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.learned import LearnedStore, StoredHands, keep_hand
from openarm_common.robot.zeros import ZEROS, HandReach
from tests.refusals import refused

#: Of a seller's protocol: closed on nothing at -0.038 rad of a motor that takes 1.0472 rad for 44 mm; opens to 86 %.
REACH = HandReach(closed=0.038 / 1.0472 * 0.044, opened=0.038, effort=6.4, learned="2026-11-30T01:00:00+00:00")


def test_a_learned_hand_opens_as_far_as_it_does_and_admits_what_has_room_then() -> None:
    robot = RobotDescription.load("openarm_v1")
    learned = robot.with_hands({"left": REACH})
    hand = learned.hand("left")
    assert (hand.opened, hand.closed, hand.lever) == (0.038, 0.0, 1.0)
    assert 2.0 * REACH.closed == pytest.approx(0.0032, abs=5e-5)
    assert hand.parts.max_width == pytest.approx(0.066)
    assert learned.hand("right") is robot.hand("right")
    assert learned.described is robot
    assert learned.with_hands({"left": REACH}).hand("left").parts == hand.parts
    assert str(REACH) == "3.2 to 76.0 mm, learned 2026-11-30T01:00:00+00:00"
    refused("no arm 'middle'", robot.with_hands, {"middle": REACH})


@pytest.mark.parametrize("wrong", [{"closed": 0.2}, {"opened": 0.0}, {"opened": "nan"}, {"effort": -1.0}])
def test_what_no_hand_reads_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        HandReach.model_validate(REACH.model_dump() | wrong)


def test_hands_are_kept_beside_each_other_with_their_history_and_apart_by_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = LearnedStore(tmp_path, StoredHands)
    assert store.in_use("zeros").hands == {}
    keep_hand(tmp_path, "zeros", "left", REACH)
    other = REACH.model_copy(update={"closed": 0.0})
    keep_hand(tmp_path, "zeros", "right", other)
    assert store.in_use("zeros").hands == {"left": REACH, "right": other}
    assert store.in_use("simulated_openarm").hands == {}
    keep_hand(tmp_path, "zeros", "left", other)
    assert store.rollback("zeros").hands == {"left": REACH, "right": other}
    with monkeypatch.context() as patched:
        patched.setenv(folder.ROBOT, "panda")
        assert store.find("zeros") is None
        assert store.in_use("zeros").hands == {}
        keep_hand(tmp_path, "zeros", "right", other)
    assert store.in_use("zeros").hands == {"left": REACH, "right": other}
    assert store.rollback("zeros").hands == {"left": REACH}
    assert store.rollback("zeros").hands == {}
    refused("going back needs a learned hand", store.rollback, "zeros")


def test_a_damaged_file_is_refused_with_what_to_type_and_learning_replaces_it(tmp_path: Path) -> None:
    store = LearnedStore(tmp_path, StoredHands)
    store.path("zeros").parent.mkdir()
    store.path("zeros").write_text("hands: {left: {closed: 1}}")
    refused("remove it, then `openarm hardware learn-hand` makes a new learned hand", store.in_use, "zeros")
    keep_hand(tmp_path, "zeros", "left", REACH)
    assert store.in_use("zeros").hands == {"left": REACH}


def test_a_graph_starts_with_the_hands_of_its_own_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = f"grasp.calibrations={tmp_path}"
    seeded = load_graph("sim", sets=(kept, "mujoco_bridge.openarm.hand_seed=3"))
    keep_hand(tmp_path, "simulated_openarm_hand_seed_3", "right", REACH)
    for name, graph, opened in (
        ("seeded", seeded, 0.038),
        ("drawn", load_graph("sim", sets=(kept,)), 0.044),
        ("another", load_graph("sim", sets=(kept, "mujoco_bridge.openarm.hand_seed=4")), 0.044),
        ("real", load_graph("real", sets=(kept,)), 0.044),
    ):
        monkeypatch.setenv(ZEROS, str(zeros_file(graph, tmp_path / name)))
        assert RobotDescription.load().hand("right").opened == opened
        assert RobotDescription.load().hand("left").opened == 0.044
