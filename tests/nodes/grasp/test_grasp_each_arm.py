# SPDX-License-Identifier: Apache-2.0
"""A request for each arm at the same time, each by itself, by the action /grasp/pick; orders of both arms."""

from __future__ import annotations

import json
import os

import pytest
from action_msgs.msg import GoalStatus
from openarm_interfaces.action import Pick, PickTwo
from openarm_interfaces.msg import PickRequest
from rclpy.task import Future

from openarm_bringup import cli


def held_up(bench, *arms: str) -> dict[str, Future]:
    """Lifts of arms do not end before these futures are done."""
    waits = {arm: Future() for arm in arms}
    begun: dict[str, Future] = {}

    def hold(what: str) -> Future | None:
        arm, _, _ = bench.world.asked[-1]
        if what != "execute" or arm not in bench.world.hands or arm not in waits:
            return None
        return begun.setdefault(arm, waits[arm])

    bench.world.during = hold
    bench.begun = begun
    return waits


def send(bench, label: str, **fields) -> tuple[object, Future]:
    return bench.ros.send_goal(bench.action, Pick.Goal(label=label, **fields))


@pytest.mark.requirement("A-65")
def test_each_arm_carries_out_its_own_request_and_any_arm_is_the_one_that_is_free(bench) -> None:
    waits = held_up(bench, "left", "right")
    _, blue = send(bench, "blue", arm="left")
    bench.until(lambda: "left" in bench.begun, what="the left arm lifts")
    _, red = send(bench, "red")
    bench.until(lambda: "right" in bench.begun, what="the right arm lifts")
    assert bench.world.hands == {"left": "blue", "right": "red"}
    for arm in ("", "left", "right"):
        busy = bench.ask("red", arm=arm)
        assert (busy.code, busy.outcome) == ("BUSY", "REFUSED")
        assert "a grasp of" in busy.message
    waits["right"].set_result(None)
    assert bench.ros.result(red, 60.0).result.success
    bench.until(lambda: (bench.status[-1].label, bench.status[-1].arm) == ("blue", "left"), what="blue is shown again")
    assert (bench.status[-1].state, "left" in bench.world.hands) == ("LIFT", True)
    again = bench.ask("red", arm="right")  # the left arm is at work still, and is not sent home
    assert (again.success, again.arm) == (True, "right"), again.message
    assert not blue.done()
    waits["left"].set_result(None)
    assert bench.ros.result(blue, 60.0).result.success
    bench.until(lambda: bench.ros.node.count_subscribers("/joint_states") == 0, what="joint states are left")


@pytest.mark.requirement("P-01", "P-21")
def test_a_cancel_ends_its_own_request_and_the_other_arm_goes_on(bench) -> None:
    waits = held_up(bench, "left", "right")
    handle, blue = send(bench, "blue", arm="left")
    _, red = send(bench, "red", arm="right")
    bench.until(lambda: len(bench.begun) == 2, what="both lifts")
    assert bench.ros.result(handle.cancel_goal_async()).goals_canceling
    end = bench.ros.result(blue)
    assert (end.status, end.result.code, end.result.outcome) == (GoalStatus.STATUS_CANCELED, "CANCELLED", "CANCELLED")
    waits["right"].set_result(None)
    assert bench.ros.result(red, 60.0).result.success
    assert bench.world.hands == {"left": "blue"}
    assert bench.world.cancelled == ["execute"]
    refused = bench.ask("red")
    assert (refused.code, "left hand still holds 'blue'" in refused.message) == ("NOT_READY", True)
    bench.world.during = lambda what: None
    next_to = bench.ask("red", arm="right")  # which drops nothing
    assert next_to.success, next_to.message
    assert bench.world.hands == {"left": "blue"}


def test_what_was_cancelled_ends_nothing_that_comes_later(bench) -> None:
    waits = held_up(bench, "right")
    handle, red = send(bench, "red")
    bench.until(lambda: bench.begun, what="the right arm lifts")
    assert bench.ros.result(handle.cancel_goal_async()).goals_canceling
    assert bench.ros.result(red).result.code == "CANCELLED"
    waits["right"].cancel()
    bench.world.during = lambda what: None
    assert bench.ask("", phase="place").success
    _, both = bench.ros.send_goal(bench.two, PickTwo.Goal(requests=[PickRequest(label=n) for n in ("red", "blue")]))
    assert bench.ros.result(both, 60.0).result.success
    assert bench.ask("red", arm="right").success


def test_an_order_asks_both_arms_and_what_is_placed_by_one_is_not_taken_by_the_other(bench, tmp_path, capsys) -> None:
    report = tmp_path / "answer.json"
    words = f"order anything --domain {os.environ['ROS_DOMAIN_ID']} --json {report}".split()
    code = bench.in_thread(lambda: cli.run(words))
    written = json.loads(report.read_text(encoding="utf-8"))
    assert (code, written["outcome"], written["placed"]) == (0, "SUCCESS", ["anything"] * 2), written
    said = "".join(capsys.readouterr())
    assert said.count("anything: OK: ") == 2
    assert "UNKNOWN_OBJECT" not in said
    assert {arm for arm, _, _ in bench.world.asked} == {"left", "right"}
    places = [row["place"][:2] for row in written["results"] if row["place"]]
    for place in places:
        assert any(p[:2] == pytest.approx(place, abs=0.005) for p in bench.world.objects.values())


@pytest.mark.long
def test_an_order_goes_on_with_one_arm_when_the_hand_of_the_other_is_missing(benches, tmp_path) -> None:
    bench, report = benches(), tmp_path / "answer.json"
    bench.node._robot._config.limits.__dict__["ready_timeout"] = 3.0
    bench.world.lose_hand("left")
    bench.until(lambda: not bench.node._robot._grippers["left"].server_is_ready(), what="the left hand is gone")
    bench.world.objects["blue"][:2] = (0.30, -0.08)
    words = f"order anything --domain {os.environ['ROS_DOMAIN_ID']} --json {report}".split()
    code = bench.in_thread(lambda: cli.run(words))
    written = json.loads(report.read_text(encoding="utf-8"))
    assert (code, written["placed"]) == (0, ["anything"] * 2), written
    assert {arm for arm, _, _ in bench.world.asked} == {"right"}
    assert any("left_gripper_controller" in row["message"] for row in written["results"])
