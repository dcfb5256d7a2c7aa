# SPDX-License-Identifier: Apache-2.0
"""The grasp node by service and action."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from openarm_interfaces.action import Pick
from openarm_interfaces.srv import Grasp
from rclpy.task import Future
from tf2_msgs.msg import TFMessage

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import matrix_to_transform
from openarm_common.ros.node import QOS_LATCHED
from openarm_grasp.config import BudgetConfig
from openarm_grasp.ros import graph_clients
from openarm_grasp.ros.node import GraspNode
from tests.nodes.grasp.conftest import FakeGraph, silence


@pytest.mark.requirement("B-51", "B-53", "B-71")
def test_a_grasp_by_service_places_the_object_publishes_its_states_and_moves_hand_and_arm_in_order(bench):
    near: list[int] = []
    holds = bench.ros.hear(DiagnosticStatus, "/arm_holds")
    bench.until(lambda: bench.ros.node.count_publishers("/arm_holds"), what="the holder")
    bench.world.during = lambda _: near.append(bench.world.count_subscribers("/wrist/detections_3d"))
    answer = bench.ask()
    assert answer.success, answer.message
    assert (answer.code, answer.label, answer.arm, answer.attempts) == ("OK", "red", "right", 1)
    target = answer.place_position
    assert bench.world.objects["red"][:2] == pytest.approx((target.x, target.y), abs=0.005)
    bench.until(lambda: bench.states()[-1] == "IDLE" and len(bench.status) > 5)
    seen = bench.states()
    order = [s for i, s in enumerate(seen) if i == 0 or s != seen[i - 1]]
    names = "IDLE DETECT TRANSFORM PLAN MOVE_TO_PREGRASP MOVE_TO_GRASP CLOSE_GRIPPER LIFT PLACE RESET IDLE"
    assert " ".join(order) == names
    assert all(s.reason for s in bench.status)
    stamps = [s.header.stamp.sec + s.header.stamp.nanosec * 1e-9 for s in bench.status[1:]]
    assert stamps == sorted(stamps)
    assert stamps[0] >= 5.0
    assert answer.duration == pytest.approx(stamps[-1] - stamps[0], abs=0.2)
    assert near[:2] == [1, 0]  # the detector of the camera on the hand wakes during the motion to the pre-grasp
    log = [entry for entry in bench.world.log if not entry.startswith("plan")]
    assert sorted(log[:2]) == ["execute", "gripper 0.044"]  # at the same time
    assert log[2:] == [
        "execute",  # to the grasp
        "gripper 0",
        "execute",  # lift
        "execute",  # carry and down
        "gripper 0.044",
        "execute",  # leave
        "move home",
    ]
    bench.until(lambda: holds and not holds[-1].values, what="the arm is left to others")
    assert {hold.name for hold in holds} == {"the grasp node (a grasp of 'red')"}
    assert {tuple(value.key for value in hold.values) for hold in holds} == {("right",), ()}
    assert {goal_id[:8].hex() for goal_id in bench.world.goal_ids} == {holds[0].hardware_id}


@pytest.mark.long
def test_out_of_reach_names_the_nearest_arm_distance(bench):
    bench.world.unreachable = True
    answer = bench.ask()
    assert answer.code == "UNREACHABLE"
    assert "right arm gets within 250 mm" in answer.message
    assert "too far" in answer.message
    assert "execute" not in bench.world.log
    ways = [option.id for option in answer.options]
    assert len(set(ways)) == len(ways) == 56
    assert {f"{way}/short" for way in ways[:28]} == set(ways[28:])  # near the end of the reach, shorter lines are tried
    assert {(o.arm, o.code, o.message) for o in answer.options} == {("right", "UNREACHABLE", "too far for it")}


def test_an_unknown_arm_and_a_place_off_the_table_are_refused(bench):
    answer = bench.ask(arm="middle")
    assert answer.code == "INVALID_ARGUMENT"
    assert "auto, left, right" in answer.message
    request = Grasp.Request(label="red", has_place_position=True)
    request.place_position.x = 3.0
    answer = bench.ros.call(bench.service, request)
    assert answer.code == "INVALID_ARGUMENT"
    assert "not on the table" in answer.message
    answer = bench.ask(label="x" * 1_000_000)
    assert (answer.code, len(answer.label)) == ("INVALID_ARGUMENT", 256)
    assert "has 1000000 characters; expected at most 256" in answer.message


@pytest.mark.requirement("B-63")
def test_a_dry_run_plans_to_put_an_object_down_on_the_table_as_it_was_measured_and_moves_nothing(bench):
    edge = matrix_to_transform("world", "table", se3.make(None, (0.0, 0.0, 0.415)), 0)
    bench.world.create_publisher(TFMessage, "/tf_static", QOS_LATCHED).publish(TFMessage(transforms=[edge]))
    bench.until(lambda: bench.node._session.context.table.top_z == pytest.approx(0.415), what="another table")
    for position in bench.world.objects.values():
        position[2] += 0.015
    answer = bench.ask(dry_run=True)
    assert answer.success, answer.message
    assert answer.place_position.z == pytest.approx(0.415, abs=1e-3)
    assert bench.world.log == ["plan right", "plan right"]
    chosen, *others = answer.options
    assert (chosen.arm, chosen.code, chosen.limit_margin) == ("right", "OK", 0.25)
    assert chosen.score == pytest.approx(sum(chosen.values))
    assert chosen.parts == ["tilt", "width", "side", "room"]
    assert {(o.code, o.message) for o in others} == {("", "not needed: another was chosen")}
    bench.until(lambda: bench.markers, what="markers of the candidates")
    assert len(bench.markers[-1].markers) > 20


@pytest.mark.long
def test_a_robot_that_goes_silent_ends_the_grasp_within_two_seconds(bench):
    never = Future()
    bench.world.during = lambda what: never if what == "execute" else None
    asked = bench.service.call_async(Grasp.Request(label="red"))
    bench.until(lambda: "execute" in bench.world.log, what="the arm moves")
    bench.world.silent = True
    answer = bench.ros.result(asked)
    assert answer.code == "ROBOT_LOST"
    assert silence(answer.message) < 2.0
    never.set_result(None)
    # And it works again when the robot is back.
    bench.world.silent, bench.world.during = False, lambda what: None
    assert bench.ask(dry_run=True).success


def test_without_motion_or_detector_the_answer_names_what_is_missing(benches, monkeypatch):
    ahead = [0.0]
    monkeypatch.setattr(graph_clients, "time", SimpleNamespace(monotonic=lambda: time.monotonic() + ahead[0]))
    bench = benches(motion=False, detector=False)
    asked = bench.service.call_async(Grasp.Request(label="red"))
    bench.until(lambda: bench.node._robot._nodes.has_joint_states, what="joint states")
    ahead[0] = 100.0  # s: the wait for other nodes is over
    answer = bench.ros.result(asked)
    assert answer.code == "NOT_READY"
    assert "/motion/plan_approach (motion node)" in answer.message
    assert "/detections_3d (detector)" in answer.message
    assert "joint_states" not in answer.message


@pytest.mark.requirement("B-69")
def test_a_second_request_is_refused_at_once_and_nothing_is_subscribed_that_is_not_looked_at(bench):
    probe = bench.ros.node
    assert probe.count_subscribers("/joint_states") == 0
    assert probe.count_subscribers("/detections_3d") == 0
    held_up = Future()
    bench.world.during = lambda what: held_up if what == "execute" else None
    asked = bench.service.call_async(Grasp.Request(label="red"))
    bench.until(lambda: "execute" in bench.world.log, what="the arm moves")
    bench.until(lambda: probe.count_subscribers("/detections_3d") == 0, what="detections are left")
    assert probe.count_subscribers("/joint_states") == 1
    second = bench.ask("blue")
    assert (second.success, second.code) == (False, "BUSY")
    assert not asked.done()
    _, result = bench.ros.send_goal(bench.action, Pick.Goal(label="blue"))
    assert bench.ros.result(result).result.code == "BUSY"
    held_up.set_result(None)
    assert bench.ros.result(asked).success
    bench.until(lambda: probe.count_subscribers("/joint_states") == 0, what="joint states are left")
    assert probe.count_subscribers("/detections_3d") == 0


@pytest.mark.requirement("B-48")
def test_a_pregrasp_within_the_path_tolerance_is_refused_at_start(ros):
    with pytest.raises(OpenArmError, match="at least twice path_tolerance") as error:
        ros.start(GraspNode, approach__pregrasp_distance=0.05, approach__path_tolerance=0.04)
    assert error.value.code is Code.CONFIG_INVALID


@pytest.mark.requirement("N-19")
def test_a_state_that_takes_longer_than_its_budget_is_a_warning_in_diagnostics_and_in_the_answer(ros):
    world = ros.add(FakeGraph())
    budgets = {f"budget.{name}": 600.0 for name in BudgetConfig.model_fields} | {"budget.close_gripper": 0.1}
    node = ros.start(GraspNode, **budgets)
    heard = ros.hear(DiagnosticArray, "/diagnostics")
    answer = ros.call(ros.node.create_client(Grasp, "/grasp"), Grasp.Request(label="red"))
    assert answer.success, answer.message
    late = [one.state for one in answer.state_times if 0.0 < one.budget < one.longest]
    assert late == ["CLOSE_GRIPPER"]

    def warned() -> list[str]:
        statuses = [one for message in heard for one in message.status if node.get_name() in one.name]
        return [one.message for one in statuses if one.level == DiagnosticStatus.WARN]

    ros.spin_until(lambda: any("CLOSE_GRIPPER" in text for text in warned()), what="the warning")
    assert world.log
