# SPDX-License-Identifier: Apache-2.0
"""Two objects at once, by the action /grasp/pick_two."""

from __future__ import annotations

import json
import os
from itertools import groupby

import pytest
from action_msgs.msg import GoalStatus
from openarm_interfaces.action import Pick, PickTwo
from openarm_interfaces.msg import PickRequest
from rclpy.task import Future

from openarm_bringup import cli

STATES = "DETECT TRANSFORM PLAN MOVE_TO_PREGRASP MOVE_TO_GRASP CLOSE_GRIPPER LIFT PLACE RESET IDLE"


def goal(*labels: str, arms: tuple[str, str] = ("", ""), **fields) -> PickTwo.Goal:
    requests = [PickRequest(label=label, arm=arm) for label, arm in zip(labels, arms, strict=True)]
    return PickTwo.Goal(requests=requests, **fields)


def ask(bench, *labels: str, **fields) -> PickTwo.Result:
    _, result = bench.ros.send_goal(bench.two, goal(*labels, **fields))
    return bench.ros.result(result, 60.0).result


def simultaneous(bench, **fields) -> tuple[object, Future]:
    """Two grasps whose lifts do not end; the goal and its result."""
    lifts: list[Future] = []

    def hold(what: str) -> Future | None:
        arm, _, _ = bench.world.asked[-1]
        if what != "execute" or arm not in bench.world.hands:
            return None
        lifts.append(Future())
        return lifts[-1]

    bench.world.during = hold
    handle, result = bench.ros.send_goal(bench.two, goal("red", "blue", **fields))
    bench.until(lambda: len(lifts) == 2, what="both lifts")
    return handle, result


@pytest.mark.long
@pytest.mark.requirement("A-65")
def test_two_objects_are_picked_at_once_each_by_its_arm_and_each_publishes_its_states(bench) -> None:
    heard: list[PickTwo.Feedback] = []
    wish = goal("red", "blue")
    wish.requests[1].has_place_position = True
    wish.requests[1].place_position.x, wish.requests[1].place_position.y = 0.3, 0.3
    ended = lambda: {f.request for f in heard if f.status.label and f.status.state == "IDLE"} == {0, 1}  # noqa: E731
    result: PickTwo.Result = bench.ros.hear_all(bench.two, wish, heard, ended, 60.0)
    assert (result.success, result.outcome, result.code, result.simultaneous) == (True, "SUCCESS", "OK", True), result
    assert [(a.label, a.arm, a.attempts, a.route) for a in result.results] == [
        ("red", "right", 1, "direct"),
        ("blue", "left", 1, "direct"),
    ]
    for answer in result.results:
        target = (answer.place_position.x, answer.place_position.y)
        assert bench.world.objects[answer.label][:2] == pytest.approx(target, abs=0.005)
    assert (result.results[1].place_position.x, result.results[1].place_position.y) == (0.3, 0.3)
    # both are under way before either has ended, and each motion may rest for the other arm
    states = [(f.request, f.status.state) for f in heard]
    assert max(states.index((k, "MOVE_TO_PREGRASP")) for k in (0, 1)) < min(states.index((k, "LIFT")) for k in (0, 1))
    assert {arm for arm, _, _ in bench.world.asked} == {"left", "right"}
    assert all(wait > 0.0 for _, _, wait in bench.world.asked)
    for k, label in enumerate(("red", "blue")):
        mine = [f.status for f in heard if f.request == k and f.status.label == label]
        assert " ".join(state for state, _ in groupby(s.state for s in mine)) == STATES
        assert mine[-1].arm == result.results[k].arm


@pytest.mark.long
def test_the_arm_that_has_ended_is_free_and_the_newest_status_is_of_the_one_that_is_at_work(bench) -> None:
    held_up = Future()
    bench.world.during = lambda what: held_up if bench.world.asked[-1][0] == "left" else None
    _, result = bench.ros.send_goal(bench.two, goal("red", "blue"))
    bench.until(lambda: any(s.state == "IDLE" and s.label == "red" for s in bench.status), what="red is done")
    bench.until(lambda: bench.status[-1].label == "blue", what="blue is published again")
    ended = next(i for i, s in enumerate(bench.status) if (s.state, s.label) == ("IDLE", "red"))
    again = bench.status[ended + 1]
    assert (again.label, again.arm, again.state) == ("blue", "left", "MOVE_TO_PREGRASP")
    assert again.previous_state == again.state
    answer = bench.ask("red", arm="left")
    assert (answer.code, answer.success) == ("BUSY", False)
    assert "a grasp of 'blue' is running" in answer.message
    busy = ask(bench, "red", "blue")
    assert (busy.code, busy.outcome, len(busy.results)) == ("BUSY", "REFUSED", 0)
    handle, _ = bench.ros.send_goal(bench.action, Pick.Goal(label="red", arm="left"))
    assert not bench.ros.result(handle.cancel_goal_async()).goals_canceling
    held_up.set_result(None)
    assert bench.ros.result(result, 60.0).result.success
    bench.until(lambda: (bench.status[-1].state, bench.status[-1].label) == ("IDLE", "blue"), what="blue is done")
    assert bench.ask("red", dry_run=True).success


@pytest.mark.long
def test_words_that_fit_several_objects_are_for_two_and_not_for_one_twice(bench) -> None:
    both = ask(bench, "anything", "anything")
    assert (both.success, both.simultaneous) == (True, True), both.message
    assert {answer.label for answer in both.results} == {"red", "blue"}
    alone = ask(bench, "red", "red")
    assert [answer.code for answer in alone.results] == ["OK", "UNKNOWN_OBJECT"], alone.message
    assert (alone.outcome, alone.simultaneous) == ("PARTIAL", False)


@pytest.mark.requirement("P-01", "P-21")
def test_a_cancel_stops_both_arms_and_each_hand_keeps_its_object_until_it_is_placed(bench) -> None:
    handle, result = simultaneous(bench)
    assert bench.ros.result(handle.cancel_goal_async()).goals_canceling
    end = bench.ros.result(result)
    assert end.status == GoalStatus.STATUS_CANCELED
    assert (end.result.code, end.result.outcome) == ("CANCELLED", "CANCELLED")
    assert [answer.code for answer in end.result.results] == ["CANCELLED", "CANCELLED"]
    assert bench.world.cancelled == ["execute", "execute"]
    assert bench.world.hands == {"right": "red", "left": "blue"}
    # either hand would drop what it holds
    bench.world.during = lambda what: None
    for refused in (bench.ask("green"), ask(bench, "red", "blue")):
        assert (refused.code, refused.outcome) == ("NOT_READY", "REFUSED")
        assert "hand still holds" in refused.message
    for label, arm, other in (("blue", "left", "right"), ("red", "right", "left")):
        bench.world.asked.clear()
        placed = bench.ask("", phase="place", arm=arm)
        assert (placed.success, placed.label, placed.arm) == (True, label, arm), placed.message
        assert {name for name, _, _ in bench.world.asked} == {arm}, f"the {other} hand stays where it is"
    assert bench.world.hands == {}
    bench.world.asked.clear()
    planned = ask(bench, "red", "blue", dry_run=True)
    assert (planned.success, planned.simultaneous) == (True, True), planned.message
    assert bench.world.asked == []


@pytest.mark.long
def test_a_limit_of_time_ends_both_with_their_hands_closed(bench) -> None:
    _, answer = simultaneous(bench, timeout=100.0)
    bench.world.step_ns *= 10  # both have come that far in time
    result: PickTwo.Result = bench.ros.result(answer).result
    assert (result.success, result.code, result.outcome) == (False, "TIMEOUT", "PARTIAL")
    assert [answer.code for answer in result.results] == ["TIMEOUT", "TIMEOUT"]
    assert result.duration >= 100.0
    assert bench.world.hands == {"right": "red", "left": "blue"}


def test_a_cancel_while_both_are_looked_at_moves_nothing(bench) -> None:
    bench.world.blind = True
    handle, result = bench.ros.send_goal(bench.two, goal("red", "blue"))
    bench.until(lambda: any("observing both" in s.reason for s in bench.status), what="the observation of both")
    assert bench.ros.result(handle.cancel_goal_async()).goals_canceling
    end = bench.ros.result(result)
    assert (end.status, end.result.code) == (GoalStatus.STATUS_CANCELED, "CANCELLED")
    assert bench.world.asked == []
    bench.world.blind = False
    assert bench.ask("red").success


@pytest.mark.long
def test_of_two_that_one_arm_is_asked_for_one_waits_for_the_other(bench) -> None:
    bench.world.objects["blue"][:2] = (0.30, -0.08)
    result = ask(bench, "red", "blue", arms=("right", "right"))
    assert (result.success, result.simultaneous) == (True, False), result.message
    assert [answer.arm for answer in result.results] == ["right", "right"]
    assert "the same arm is asked for: one after the other" in result.message.replace(")", "")


def test_openarm_pick_red_blue_picks_both_and_says_so_as_json(bench, tmp_path, capsys) -> None:
    domain, report = os.environ["ROS_DOMAIN_ID"], tmp_path / "answer.json"
    words = f"pick red blue --arm right --arm left --domain {domain} --json {report}".split()
    code = bench.in_thread(lambda: cli.run(words))
    written = json.loads(report.read_text(encoding="utf-8"))
    assert (code, written["success"], written["code"], written["simultaneous"]) == (0, True, "OK", True), written
    assert [(a["label"], a["arm"], a["outcome"]) for a in written["answers"]] == [
        ("red", "right", "SUCCESS"),
        ("blue", "left", "SUCCESS"),
    ]
    steps = capsys.readouterr().err.splitlines()
    assert any("red   LIFT" in line for line in steps)
    assert any("blue  LIFT" in line for line in steps)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("red blue --arm left", "--arm is given 1 times, expected 2: once for each of 'red' and 'blue'"),
        ("red --place 0.3 0.3 0 --place 0.3 -0.3 0", "--place is given 2 times, expected 1: once for each of 'red'"),
        ("red blue --phase pick", "--phase pick is of one object; two are picked and placed"),
    ],
)
def test_a_wrong_call_for_two_is_met_with_what_is_right(words: str, why: str, capsys) -> None:
    assert cli.run(["pick", *words.split()]) == 2
    assert why in capsys.readouterr().err
