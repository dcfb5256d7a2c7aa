# SPDX-License-Identifier: Apache-2.0
"""The client of the grasp node, in a thread of its own next to the node."""

from __future__ import annotations

from threading import Thread

import pytest
from rclpy.task import Future
from visualization_msgs.msg import MarkerArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.node import QOS_LATCHED
from openarm_grasp.ros.client import GraspClient
from openarm_motion.collision.solids import box_from
from openarm_motion.ros.convert import held_markers
from tests.nodes.grasp.conftest import Bench


def test_the_client_picks_from_plain_python(bench):
    heard: list[str] = []
    results = []

    def script() -> None:
        with GraspClient() as grasp:
            results.append(grasp.pick("red", on_feedback=lambda status: heard.append(status.state)))
            results.append(grasp.pick("mug"))

    thread = Thread(target=script)
    thread.start()
    bench.until(lambda: not thread.is_alive(), what="the script ends")
    thread.join()
    assert results[0].success, results[0].message
    assert results[0].raise_for_code() is results[0]
    assert "LIFT" in heard
    chosen = results[0].options[0]
    assert (chosen.code, chosen.arm, set(chosen.parts)) == ("OK", "right", {"tilt", "width", "side", "room"})
    assert results[1].code is Code.UNKNOWN_OBJECT
    with pytest.raises(OpenArmError, match="no 'mug' in view"):
        results[1].raise_for_code()


@pytest.mark.requirement("P-01", "P-02")
def test_the_client_picks_and_places_in_two_requests(bench):
    results = []

    def script() -> None:
        with GraspClient() as grasp:
            results.append(grasp.pick("red", phase="pick"))
            results.append(grasp.pick("blue"))
            results.append(grasp.pick("red", phase="place", place=(0.3, -0.3)))

    thread = Thread(target=script)
    thread.start()
    bench.until(lambda: not thread.is_alive(), what="the script ends")
    thread.join()
    picked, other, placed = results
    assert (picked.outcome, picked.code) == ("SUCCESS", Code.OK), picked.message
    assert (other.outcome, other.code) == ("REFUSED", Code.NOT_READY)
    assert "still holds 'red'" in other.message
    assert (placed.outcome, placed.label) == ("SUCCESS", "red"), placed.message
    assert bench.world.objects["red"][:2] == pytest.approx((0.3, -0.3), abs=0.005)


@pytest.mark.requirement("P-03")
def test_the_client_means_an_object_by_its_position_and_leaves_others(bench):
    results = []

    def script() -> None:
        with GraspClient() as grasp:
            results.append(grasp.pick(object_at=(0.26, 0.21), dry_run=True))
            results.append(grasp.pick("red", exclude_near=((0.26, -0.2),), dry_run=True))
            results.append(grasp.pick("easiest thing", place_choices=((0.26, 0.22), (0.3, 0.35)), dry_run=True))

    thread = Thread(target=script)
    thread.start()
    bench.until(lambda: not thread.is_alive(), what="the script ends")
    thread.join()
    intended, left, chosen = results
    assert (intended.success, intended.label) == (True, "blue"), intended.message
    assert intended.object_position[:2] == pytest.approx((0.26, 0.2), abs=0.03)
    assert left.object_position is None
    assert chosen.success, chosen.message
    assert chosen.place_position[:2] == pytest.approx((0.3, 0.35))
    assert left.code is Code.UNKNOWN_OBJECT
    assert "must stay where they are" in left.message


def test_the_client_can_cancel_from_its_feedback(bench):
    results = []

    def script() -> None:
        with GraspClient() as grasp:
            results.append(grasp.pick("red", on_feedback=lambda s: grasp.cancel() if s.state == "PLAN" else None))

    thread = Thread(target=script)
    thread.start()
    bench.until(lambda: not thread.is_alive(), what="the script ends")
    thread.join()
    assert results[0].code is Code.CANCELLED


def test_what_the_feedback_raises_reaches_the_caller(bench):
    errors: list[Exception] = []

    def fail(_: object) -> None:
        raise ValueError("a fault in the user's code")

    def script() -> None:
        with GraspClient() as grasp:
            try:
                grasp.pick("red", on_feedback=fail)
            except ValueError as error:
                errors.append(error)

    thread = Thread(target=script)
    thread.start()
    bench.until(lambda: not thread.is_alive(), what="the script ends")
    thread.join()
    assert "user's code" in str(errors[0])


def test_the_client_notices_that_the_node_is_gone(bench):
    bench.world.during = lambda what: Future()
    errors: list[OpenArmError] = []

    def script() -> None:
        with GraspClient() as grasp:
            try:
                grasp.pick("red")
            except OpenArmError as error:
                errors.append(error)

    thread = Thread(target=script)
    thread.start()
    bench.until(lambda: "execute" in bench.world.log, what="the arm moves")
    bench.ros.executor.remove_node(bench.node)
    bench.ros.nodes.remove(bench.node)
    bench.node.close()
    bench.node.destroy_node()
    bench.until(lambda: not thread.is_alive(), what="the script ends")
    thread.join()
    assert errors[0].code is Code.NOT_READY


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
    results = []

    def script() -> None:
        with GraspClient() as grasp:
            results.append(grasp.pick("red"))
            results.append(grasp.release())
            results.append(grasp.release())

    thread = Thread(target=script)
    thread.start()
    bench.until(lambda: not thread.is_alive(), what="the script ends")
    thread.join()
    refused, released, nothing = results
    assert (refused.outcome, refused.code) == ("REFUSED", Code.NOT_READY)
    assert "the right hand still holds 'mug'" in refused.message
    assert (released.success, released.message) == (True, "the right hand is open; it held 'mug'")
    assert bench.world.log == ["gripper 0.044"]
    assert (nothing.code, nothing.message) == (Code.NOT_READY, "no hand holds anything")
