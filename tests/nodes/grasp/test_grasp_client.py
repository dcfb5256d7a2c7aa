# SPDX-License-Identifier: Apache-2.0
"""The client of the grasp node, in a thread of its own next to the node."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from rclpy.task import Future
from visualization_msgs.msg import MarkerArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.learned import LearnedStore, StoredHands
from openarm_common.robot.zeros import ZEROS, Zeros, keep_zeros, read_zeros
from openarm_common.ros import client
from openarm_common.ros.node import QOS_LATCHED
from openarm_grasp.ros.client import GraspClient, GraspResult
from openarm_motion.collision.solids import box_from
from openarm_motion.ros.convert import held_markers
from tests.nodes.grasp.conftest import Bench


@pytest.mark.requirement("P-01", "P-02")
def test_a_program_picks_and_places_in_two_requests(bench):
    heard: list[str] = []

    def work(grasp: GraspClient) -> list[GraspResult]:
        return [
            grasp.pick("mug"),
            grasp.pick("red", phase="pick", on_feedback=lambda status: heard.append(status.state)),
            grasp.pick("blue"),
            grasp.pick("red", phase="place", place=(0.3, -0.3)),
        ]

    unknown, picked, other, placed = bench.program(work)
    assert unknown.code is Code.UNKNOWN_OBJECT
    with pytest.raises(OpenArmError, match=r"no 'mug' in view; in view: blue \(box\), red \(box\)"):
        unknown.raise_for_code()
    assert (picked.outcome, picked.code) == ("SUCCESS", Code.OK), picked.message
    assert picked.raise_for_code() is picked
    assert "LIFT" in heard
    assert (other.outcome, other.code) == ("REFUSED", Code.NOT_READY)
    assert "still holds 'red'" in other.message
    assert (placed.outcome, placed.label) == ("SUCCESS", "red"), placed.message
    assert bench.world.objects["red"][:2] == pytest.approx((0.3, -0.3), abs=0.005)


@pytest.mark.long
@pytest.mark.requirement("P-03")
def test_a_program_means_an_object_by_its_position_and_leaves_others(bench):
    def work(grasp: GraspClient) -> list[GraspResult]:
        return [
            grasp.pick(object_at=(0.26, 0.21), dry_run=True),
            grasp.pick("red", exclude_near=((0.26, -0.2),), dry_run=True),
            grasp.pick("easiest thing", place_choices=((0.26, 0.22), (0.3, 0.35)), dry_run=True),
        ]

    intended, left, chosen = bench.program(work)
    assert (intended.success, intended.label) == (True, "blue"), intended.message
    assert intended.object_position[:2] == pytest.approx((0.26, 0.2), abs=0.03)
    assert left.object_position is None
    assert chosen.success, chosen.message
    assert chosen.place_position[:2] == pytest.approx((0.3, 0.35))
    assert left.code is Code.UNKNOWN_OBJECT
    assert "must stay where they are" in left.message


@pytest.mark.long
def test_a_program_cancels_from_its_feedback_and_what_that_raises_reaches_it(bench):
    def fail(_: object) -> None:
        raise ValueError("a fault in the user's code")

    def work(grasp: GraspClient) -> GraspResult:
        cancelled = grasp.pick("red", on_feedback=lambda s: grasp.cancel() if s.state == "PLAN" else None)
        with pytest.raises(ValueError, match="user's code"):
            grasp.pick("red", on_feedback=fail)
        return cancelled

    assert bench.program(work).code is Code.CANCELLED


@pytest.mark.long
def test_the_client_notices_that_the_node_is_gone(bench, monkeypatch):
    monkeypatch.setattr(client, "_CHECK_S", 0.05)
    bench.world.during = lambda what: Future()
    with ThreadPoolExecutor(1) as worker, GraspClient() as grasp:
        asked = worker.submit(grasp.pick, "red")
        bench.until(lambda: "execute" in bench.world.log, what="the arm moves")
        bench.ros.executor.remove_node(bench.node)
        bench.ros.nodes.remove(bench.node)
        bench.node.close()
        bench.node.destroy_node()
        bench.until(asked.done, what="the script ends")
        with pytest.raises(OpenArmError) as error:
            asked.result()
    assert error.value.code is Code.NOT_READY


def test_the_client_says_when_no_server_answers(ros):
    with GraspClient(timeout=0.2) as grasp, pytest.raises(OpenArmError, match="is the graph up") as error:
        grasp.pick("red")
    assert error.value.code is Code.NOT_READY


@pytest.mark.requirement("P-01", "R-21")
def test_a_node_that_starts_with_a_full_hand_names_what_it_holds_and_the_client_releases_it(ros) -> None:
    robot = RobotDescription.load()
    finger, tcp = robot.finger_joint("right"), robot.tcp_link("right")
    box = held_markers({"right": (tcp, [box_from("target/mug", (0.0, 0.0, 0.0), (0.05, 0.05, 0.08))])})
    ros.node.create_publisher(MarkerArray, "/motion/attached_objects", QOS_LATCHED).publish(box)
    bench = Bench(ros)
    bench.world.q[finger], bench.world.efforts[finger] = 0.025, -30.0
    bench.until(lambda: bench.node.count_publishers("/motion/attached_objects") == 1)
    refused, released, nothing = bench.program(lambda grasp: [grasp.pick("red"), grasp.release(), grasp.release()])
    assert (refused.outcome, refused.code) == ("REFUSED", Code.NOT_READY)
    assert "the right hand still holds 'mug'" in refused.message
    assert (released.success, released.message) == (True, "the right hand is open; it held 'mug'")
    assert bench.world.log == ["gripper 0.044"]
    assert (nothing.code, nothing.message) == (Code.NOT_READY, "no hand holds anything")


@pytest.fixture
def stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> LearnedStore[StoredHands]:
    """Where hands are stored, and the file of a run that has begun without any."""
    monkeypatch.setenv("OPENARM_CALIBRATIONS", str(tmp_path))
    monkeypatch.setenv(ZEROS, str(keep_zeros(Zeros(robot="openarm_v1", of="bench", offsets={}), tmp_path / "run")))
    return LearnedStore(tmp_path, StoredHands)


def test_a_hand_is_learned_for_this_run_and_those_to_come_and_works_with_the_width_that_it_has(
    ros, stored: LearnedStore[StoredHands], tmp_path: Path
) -> None:
    bench = Bench(ros)
    bench.world.stops = (0.0016, 0.038)
    shut, learned, picked = bench.program(
        lambda grasp: [grasp.pick("red"), grasp.learn_hand("right"), grasp.pick("red", arm="right")]
    )
    assert (shut.code, "`openarm hardware learn-hand --arm right`" in shut.message) == (Code.EXECUTION_FAILED, True)
    assert learned.success, learned.message
    assert "the right hand goes from 3.2 to 76.0 mm" in learned.message
    assert "presses with 6 N closed on nothing" in learned.message
    assert picked.success, picked.message
    assert bench.world.log[-1] == "move home"
    assert [one for one in bench.world.log if one.startswith("gripper")][-3:] == [
        "gripper 0.038",
        "gripper 0",
        "gripper 0.038",
    ]
    hands = stored.in_use("bench").hands
    assert list(hands) == ["right"]
    assert read_zeros(tmp_path / "run" / "bench.yaml").hands == hands


def test_where_it_is_allowed_unknown_hands_are_learned_before_the_first_request_and_full_ones_refused(
    ros, stored: LearnedStore[StoredHands]
) -> None:
    bench = Bench(ros, learn=True)
    finger = RobotDescription.load().finger_joint("left")
    bench.world.stops = (0.02, 0.038)  # something is between the fingers of either hand
    full = bench.program(lambda grasp: grasp.pick("red"))
    assert (full.outcome, full.code) == ("REFUSED", Code.NOT_READY)
    assert "the left hand closes to 40.0 mm, expected 0 to 8.8 mm of an empty one; take out" in full.message
    assert not stored.names()
    bench.world.stops, bench.world.q[finger] = (0.0016, 0.038), 0.0016
    bench.world.log.clear()
    first, second = bench.program(lambda grasp: [grasp.pick("red"), grasp.pick("blue")])
    assert first.success, first.message
    assert second.success, second.message
    assert bench.world.log[:6] == ["gripper 0", "gripper 0.044", "gripper 0"] * 2
    assert bench.world.log.count("gripper 0.044") == 2
    assert sorted(stored.in_use("bench").hands) == ["left", "right"]
