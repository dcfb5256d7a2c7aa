# SPDX-License-Identifier: Apache-2.0
"""The node `mujoco_bridge` in process: reset, pause, step, spawn."""

from __future__ import annotations

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Vector3
from openarm_interfaces.msg import ObjectStateArray
from openarm_interfaces.srv import ResetWorld, SetPause, SpawnObject, StepSimulation
from sensor_msgs.msg import JointState

from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.node import QOS_COMMAND


@pytest.mark.requirement("P-25")
def test_pause_and_step(bench) -> None:
    assert not bench.call(StepSimulation, "/sim/step", steps=5).success  # it runs
    assert bench.call(SetPause, "/sim/set_pause", paused=True).success
    bench.ros.spin_until(
        lambda: len(bench.joints) > 2 and bench.joints[-1].header.stamp == bench.joints[-2].header.stamp,
        what="time to stand",
    )
    before = bench.t_ns
    n = len(bench.joints)
    bench.ros.spin_until(lambda: len(bench.joints) >= n + 3, what="signs of life")
    assert bench.t_ns == before
    bench.done(StepSimulation, "/sim/step", steps=203)
    bench.ros.spin_until(lambda: bench.t_ns == before + 203 * 2_000_000, what="203 steps of 2 ms")
    assert not bench.call(StepSimulation, "/sim/step", steps=0).success
    assert bench.call(SetPause, "/sim/set_pause", paused=False).success
    bench.spin_sim(0.2)


@pytest.mark.requirement("P-25")
def test_reset_puts_the_robot_back_and_aborts_what_runs(bench) -> None:
    _, future = bench.follow(bench.goal((60.0, bench.NEAR_HOME)))
    bench.spin_sim(1.5)
    before = bench.t_ns
    bench.reset()
    assert "reset" in bench.ros.result(future).result.error_string
    bench.spin_sim(0.3)
    assert bench.t_ns > before
    np.testing.assert_allclose(bench.arm, bench.HOME, atol=0.01)
    assert np.all(np.diff([stamp_to_ns(m.header.stamp) for m in bench.joints]) > 0)


@pytest.mark.requirement("P-25")
def test_reset_takes_a_keyframe_and_overrides(bench) -> None:
    got = bench.collect(ObjectStateArray, "/sim/ground_truth/objects", 5)
    pose = PoseStamped()
    pose.pose.position.x, pose.pose.position.y = 0.45, 0.30
    bench.reset(
        keyframe="hands_up",
        joint_names=["openarm_right_joint7", bench.FINGER],
        joint_positions=[0.25, 0.03],
        object_names=["red_cube"],
        object_poses=[pose],
    )
    up = bench.node.description.group_state("right_arm", "hands_up")
    bench.ros.spin_until(lambda: abs(bench.arm[6] - 0.25) < 0.01, what="a joint state of the new posture")
    np.testing.assert_allclose(bench.arm, [*(up[name] for name in bench.ARM[:6]), 0.25], atol=0.01)
    assert bench.position(bench.FINGER) == pytest.approx(0.03, abs=0.001)
    red = next(o for o in bench.fresh(got, 2)[-1].objects if o.name == "red_cube").pose.position
    np.testing.assert_allclose([red.x, red.y, red.z], [0.45, 0.30, 0.425], atol=0.001)
    bench.spin_sim(0.5)
    assert bench.arm[6] == pytest.approx(0.25, abs=0.01)  # held there
    assert bench.call(ResetWorld, "/sim/reset_world").success  # the overrides are of one reset
    bench.ros.spin_until(lambda: np.allclose(bench.arm, bench.HOME, atol=0.01), what="home again")


@pytest.mark.requirement("P-25")
def test_a_reset_that_makes_no_sense_changes_nothing(bench) -> None:
    elbow = "openarm_right_joint4"
    _, running = bench.follow(bench.goal((3.0, bench.NEAR_HOME)))
    for fields, parts in (
        ({"keyframe": "handstand"}, ["handstand", "hands_up", "home"]),
        ({"joint_names": ["tail"], "joint_positions": [0.1]}, ["tail", "openarm_left_joint1"]),
        ({"joint_names": [elbow], "joint_positions": [9.0]}, [elbow, "9.0", "limits"]),
        ({"joint_names": [elbow]}, ["1 names", "0 positions"]),
        ({"object_names": ["pear"], "object_poses": [PoseStamped()]}, ["pear", "red_cube"]),
        ({"object_names": ["red_cube"]}, ["1 object names", "0 poses"]),
        (
            {"keyframe": "hands_up", "joint_names": [elbow], "joint_positions": [1.0]},
            ["SCENE_INVALID", "openarm_right_link5", "table"],
        ),
        ({"seed": -1}, ["seed", "-1"]),
    ):
        answer = bench.call(ResetWorld, "/sim/reset_world", **fields)
        assert not answer.success, fields
        for part in parts:
            assert part in answer.message
    assert bench.ros.result(running).result.error_code == 0  # the arm went on


def test_a_diverged_world_takes_no_command_until_it_is_reset(bench, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning to a file there
    simulation = bench.node._simulation
    monkeypatch.setattr(simulation, "_dump_folder", tmp_path)
    got = bench.collect(DiagnosticArray, "/diagnostics", QOS_COMMAND)
    _, running = bench.follow(bench.goal((60.0, bench.NEAR_HOME)))
    bench.spin_sim(0.3)
    simulation.call(lambda: simulation.world.data.qvel.fill(np.nan))
    answer = bench.ros.result(running)
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert "diverged" in answer.result.error_string
    assert "The last second is in" in answer.result.error_string
    _, refused = bench.follow(bench.goal((1.0, bench.NEAR_HOME)))
    assert "no command is taken" in bench.ros.result(refused).result.error_string
    assert not bench.send_grip(JointState(name=[bench.FINGER], position=[0.02]))[0].accepted
    bench.ros.spin_until(lambda: any("diverged" in s.message for m in got for s in m.status), what="/diagnostics")
    assert bench.call(ResetWorld, "/sim/reset_world").success
    assert bench.grip(0.02).result.reached_goal


@pytest.mark.requirement("P-25")
def test_another_scene_is_loaded_while_time_goes_on(bench) -> None:
    got = bench.collect(ObjectStateArray, "/sim/ground_truth/objects", 5)
    bench.reset(scene="random", seed=7)
    bench.ros.spin_until(
        lambda: got and got[-1].objects and got[-1].objects[0].name != "red_cube", what="the new objects"
    )
    names = [o.name for o in got[-1].objects]
    bad = bench.call(ResetWorld, "/sim/reset_world", scene="nowhere")
    assert not bad.success
    assert "SCENE_INVALID" in bad.message
    assert "demo" in bad.message
    n = len(got)
    bench.ros.spin_until(lambda: len(got) > n + 2)
    assert [o.name for o in got[-1].objects] == names


@pytest.mark.requirement("B-16")
def test_spawn_adds_an_object_on_the_table_and_names_what_is_wrong(bench) -> None:
    got = bench.collect(ObjectStateArray, "/sim/ground_truth/objects", 5)
    size, pose = Vector3(x=0.04, y=0.04, z=0.04), PoseStamped()
    pose.pose.position.x, pose.pose.position.y = 0.4, 0.0
    box = {"shape": "box", "size": size, "pose": pose}
    bench.done(SpawnObject, "/sim/spawn_object", name="extra", color="purple", **box)
    bench.ros.spin_until(lambda: any(o.name == "extra" for m in got for o in m.objects), what="the object")
    extra = next(o for o in got[-1].objects if o.name == "extra")
    assert extra.pose.position.z == pytest.approx(0.42, abs=0.002)
    for change, text in (
        ({"name": "extra"}, "already"),
        ({"name": "other"}, "overlap"),
        ({"name": "other", "shape": "cone"}, "'box', 'cylinder'"),
        ({"name": "other", "color": "pink"}, "red"),
    ):
        answer = bench.call(SpawnObject, "/sim/spawn_object", **(box | {"color": "orange"} | change))
        assert not answer.success, change
        assert text in answer.message
    assert bench.call(ResetWorld, "/sim/reset_world").success
    bench.ros.spin_until(lambda: all(o.name != "extra" for o in got[-1].objects), what="the object to be gone")
