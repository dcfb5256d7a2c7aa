# SPDX-License-Identifier: Apache-2.0
"""The motion node's planning scene and map: services, versions, and plans that keep to them."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
from geometry_msgs.msg import Point, PoseStamped, Vector3
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, PlanApproach
from openarm_interfaces.msg import ApproachTarget, CollisionBox, CollisionObject
from openarm_interfaces.srv import ApplyScene, GetScene
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common import se3
from openarm_common.octree.distance_field import CameraMoment, DistanceFieldWriter, field_path
from openarm_common.octree.lattice import Lattice
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import matrix_to_pose, matrix_to_transform
from openarm_common.ros.node import QOS_LATCHED
from openarm_motion.ros.convert import solid_from_msg

BASE_FRAME = RobotDescription.load().base

LATTICE = Lattice.from_bounds(0.02, (-0.48, -1.0, -0.08), (1.28, 1.0, 1.36))


def body(bench, id: str, p, size=(0.05, 0.05, 0.05), shape: str = "box", frame: str = "") -> CollisionObject:
    message = CollisionObject(id=id, shape=shape, pose=bench.stamped(se3.make(None, p), frame))
    message.size = Vector3(x=size[0], y=size[1], z=size[2])
    return message


@pytest.mark.requirement("B-50")
def test_sizes_of_bodies_are_edges_diameters_and_heights() -> None:
    message = CollisionObject(id="it", size=Vector3(x=0.06, y=0.06, z=0.2))
    kinds = {}
    for message.shape in ("box", "cylinder", "sphere"):
        kinds[message.shape] = solid_from_msg(message, lambda T, _: T)
    assert kinds["box"].size == pytest.approx((0.06, 0.06, 0.2))
    assert (kinds["cylinder"].radius, kinds["cylinder"].length) == pytest.approx((0.03, 0.2))
    assert kinds["sphere"].radius == pytest.approx(0.03)


@pytest.mark.requirement("B-63")
def test_the_table_is_where_its_frame_is(bench) -> None:
    """A measured height moves the obstacle and makes another version of the scene."""
    planned = bench.run(bench.move_client, bench.named(plan_only=True)).scene_version
    edge = matrix_to_transform("world", "table", se3.make(None, (0.0, 0.0, 0.415)), 0)
    bench.robot.tf.publish(TFMessage(transforms=[edge]))
    service = bench.node.service
    bench.ros.spin_until(lambda: service.scene.version == planned + 1, what="another table")
    scene = bench.ros.call(bench.get_client, GetScene.Request())
    (table,) = scene.objects
    assert table.pose.pose.position.z + table.size.z / 2.0 == pytest.approx(0.415)
    assert {box.T[2, 3] + box.size[2] / 2.0 for arm in service.arms.values() for box in arm.static} == {0.415}
    late = ApplyScene.Request(clear=True, expected_version=planned)
    assert bench.ros.call(bench.apply_client, late).code == "STALE_DATA"


def goal_tip(bench) -> np.ndarray:
    """Where the right tool is in the posture `official_home`."""
    return bench.node.service.arms["right"].kinematics.fk([0, 0, 0, 1.5708, 0, 0, 0])[:3, 3]


@pytest.mark.requirement("B-50")
def test_every_shape_is_stored_shown_and_kept_clear_of_when_the_answer_comes(bench) -> None:
    shown = bench.ros.hear(MarkerArray, "/motion/scene", QOS_LATCHED)
    first = bench.ros.call(bench.get_client, GetScene.Request())
    assert (first.version, first.fixed, [o.id for o in first.objects]) == (1, ["table"], ["table"])
    tip = goal_tip(bench)
    at_table = tip - [0.0, 0.0, 0.40]
    rock = body(bench, "rock", tip, shape="mesh")
    rock.vertices = [Point(x=x, y=y, z=z) for x in (-0.03, 0.03) for y in (-0.03, 0.03) for z in (-0.03, 0.03)]
    for message in (
        body(bench, "can", at_table, (0.06, 0.06, 0.1), "cylinder", "table"),
        body(bench, "ball", tip, (0.06, 0.0, 0.0), "sphere"),
        rock,
    ):
        answer = bench.ros.call(bench.apply_client, ApplyScene.Request(clear=True, add=[message]))
        assert answer.success, answer.message
        stored = bench.ros.call(bench.get_client, GetScene.Request()).objects[-1]
        assert (stored.id, stored.shape, stored.pose.header.frame_id) == (message.id, message.shape, BASE_FRAME)
        np.testing.assert_allclose([stored.pose.pose.position.z], [tip[2]], atol=1e-9)
        assert len(stored.vertices) == len(message.vertices)
        # no wait: the next plan sees it
        result = bench.run(bench.move_client, bench.named(plan_only=True))
        assert (result.code, result.scene_version) == ("IN_COLLISION", answer.version), result.message
        assert (result.failure.stage, result.failure.second) == ("goal", message.id)
        assert result.failure.first.startswith("openarm_right_")
        assert result.failure.distance < 0.0
        assert len(result.failure.alternative) == 7
        assert 0.0 < result.failure.alternative_distance < 0.5
    bench.ros.spin_until(lambda: shown and [m.ns for m in shown[-1].markers[1:]] == ["table", "rock"], what="markers")


@pytest.mark.requirement("B-50", "P-20")
def test_a_plan_is_shown_and_carried_out_when_a_human_agrees_unless_the_scene_has_changed(bench) -> None:
    shown = bench.ros.hear(MarkerArray, "/motion/preview", QOS_LATCHED)
    before = bench.q("right")
    plan = bench.run(bench.move_client, bench.named(plan_only=True, expected_scene_version=1))
    assert (plan.success, plan.scene_version) == (True, 1)
    bench.ros.spin_until(lambda: shown, what="the preview")
    markers = {m.ns: m for m in shown[-1].markers if m.action == Marker.ADD}
    assert set(markers) == {"right/way", "right/start", "right/end"}
    arm = bench.node.service.arms["right"]
    end = markers["right/way"].points[-1]
    np.testing.assert_allclose([end.x, end.y, end.z], goal_tip(bench), atol=1e-3)
    start = markers["right/start"].pose.position
    np.testing.assert_allclose([start.x, start.y, start.z], arm.kinematics.fk(before)[:3, 3], atol=1e-3)
    np.testing.assert_array_equal(bench.q("right"), before)

    far = body(bench, "far", (0.9, 0.9, 0.9))
    assert bench.ros.call(bench.apply_client, ApplyScene.Request(add=[far], expected_version=1)).version == 2
    again = bench.ros.call(bench.apply_client, ApplyScene.Request(add=[far], expected_version=1))
    assert (again.success, again.code, again.version) == (False, "STALE_DATA", 2)
    assert "version 2, expected 1" in again.message
    late = bench.run(bench.move_client, bench.named(plan_only=True, expected_scene_version=1))
    assert (late.code, late.failure.stage) == ("STALE_DATA", "scene")
    goal = ExecuteTrajectory.Goal(arm="right", trajectory=plan.trajectory, scene_version=plan.scene_version)
    refused = bench.run(bench.execute_client, goal)
    assert (refused.code, bool(bench.robot.active)) == ("STALE_DATA", False)
    goal.scene_version = 0
    assert bench.run(bench.execute_client, goal).success


def test_bad_bodies_and_goals_change_nothing_and_say_why(bench) -> None:
    good = body(bench, "good", (0.9, 0.0, 0.9))
    nan = body(bench, "nan", (float("nan"), 0.0, 0.9))
    oval = body(bench, "oval", (0.9, 0.0, 0.9), (0.1, 0.2, 0.1), "cylinder")
    cone, flat = body(bench, "x", (0, 0, 1), shape="cone"), body(bench, "x", (0, 0, 1), (0.1, 0.0, 0.1))
    cases = [
        (ApplyScene.Request(add=[good, body(bench, "table", (0, 0, 0))]), "INVALID_ARGUMENT", "'table' belongs to"),
        (ApplyScene.Request(add=[good, good]), "INVALID_ARGUMENT", "two bodies of the request have the id 'good'"),
        (ApplyScene.Request(add=[body(bench, "", (0, 0, 1))]), "INVALID_ARGUMENT", "body 0 has no id"),
        (ApplyScene.Request(remove=["ghost"]), "INVALID_ARGUMENT", "can't remove 'ghost'"),
        (ApplyScene.Request(add=[cone]), "INVALID_ARGUMENT", "shape 'cone'; shapes"),
        (ApplyScene.Request(add=[flat]), "INVALID_ARGUMENT", "box 'x' has size"),
        (ApplyScene.Request(add=[body(bench, "x", (0, 0, 1), frame="moon")]), "NO_TRANSFORM", "'moon'"),
        (ApplyScene.Request(add=[oval]), "INVALID_ARGUMENT", "diameters 0.1 and 0.2"),
        (ApplyScene.Request(add=[nan]), "INVALID_ARGUMENT", "nan"),
        (ApplyScene.Request(add=[body(bench, "flat", (0, 0, 1), shape="mesh")]), "INVALID_ARGUMENT", "0 vertices"),
    ]
    for request, code, text in cases:
        answer = bench.ros.call(bench.apply_client, request)
        assert (answer.success, answer.code, answer.version) == (False, code, 1), answer.message
        assert text in answer.message
    assert [o.id for o in bench.ros.call(bench.get_client, GetScene.Request()).objects] == ["table"]
    nowhere = PoseStamped()
    nowhere.pose.position.x = float("nan")
    nowhere.pose.orientation.w = 1.0
    for goal, code in (
        (MoveArm.Goal(arm="right", kind=MoveArm.Goal.POSE, pose=nowhere), "INVALID_ARGUMENT"),
        (MoveArm.Goal(arm="right", kind=MoveArm.Goal.POSE, pose=bench.stamped(np.eye(4), "moon")), "NO_TRANSFORM"),
        (MoveArm.Goal(arm="right", joint_positions=[float("nan")] * 7), "INVALID_ARGUMENT"),
        (MoveArm.Goal(arm="tail", joint_positions=[0.0] * 7), "INVALID_ARGUMENT"),
    ):
        result = bench.run(bench.move_client, goal)
        assert (result.success, result.code, result.failure.stage) == (False, code, "request"), result.message
        assert len(result.message) > 10


# --- the map
@pytest.fixture
def writer(ros) -> Iterator[DistanceFieldWriter]:
    path = field_path(str(ros.node.context.get_domain_id()))
    made = DistanceFieldWriter(path, LATTICE, 0.4, BASE_FRAME, ["overhead", "wrist"])
    yield made
    made.close()


def write(writer: DistanceFieldWriter, points, ages: dict[str, float] | None = None) -> None:
    """Commit a map with the cells of some points occupied; ages of the cameras' looks, s."""
    out = writer.begin()
    out[:] = 0.4
    for index in LATTICE.indices(np.array(points, np.float64).reshape(-1, 3)):
        out[tuple(index)] = 0.0
    now = time.monotonic_ns()
    ages = {"overhead": 0.0, "wrist": 0.0} | (ages or {})
    writer.commit(1, now, {name: CameraMoment(1, now - int(age * 1e9)) for name, age in ages.items()})


@pytest.mark.requirement("A-59")
def test_the_map_is_in_the_way_unless_something_known_explains_it(make_bench, writer) -> None:
    bench = make_bench()
    cell = goal_tip(bench)
    write(writer, [cell])
    result = bench.run(bench.move_client, bench.named(plan_only=True))
    assert (result.code, result.failure.second) == ("IN_COLLISION", "the map"), result.message
    assert f"the map at ({np.floor(cell[0] / 0.02) * 0.02 + 0.01:.2f}" in result.message
    # the table's own cells, up to the first above it, are no obstacle of their own
    top = [(x, y, 0.405) for x in np.arange(0.15, 0.8, 0.02) for y in np.arange(-0.5, 0.5, 0.02)]
    write(writer, top)
    scene = bench.ros.call(bench.get_client, GetScene.Request())
    assert (scene.map, scene.map_used, scene.map_version, scene.map_message) == ("optional", True, 2, "")
    assert 0.0 <= scene.map_age < 3.0
    pose = bench.stamped(se3.make(bench.DOWN, (0.26, -0.24, 0.44)))
    goal = MoveArm.Goal(arm="right", kind=MoveArm.Goal.POSE, pose=pose, velocity_scale=1.0, plan_only=True)
    assert bench.run(bench.move_client, goal).success
    # a body of the scene explains its cells
    write(writer, [cell])
    assert not bench.run(bench.move_client, bench.named(plan_only=True)).success
    ball = body(bench, "ball", cell, (0.02, 0.0, 0.0), "sphere")
    assert bench.ros.call(bench.apply_client, ApplyScene.Request(add=[ball])).success
    result = bench.run(bench.move_client, bench.named(plan_only=True))
    assert (result.code, result.failure.second) == ("IN_COLLISION", "ball"), result.message


def test_what_will_be_gone_by_then_is_no_obstacle(make_bench, writer) -> None:
    """A place planned ahead of the pick: the map still shows the object where it stands."""
    bench = make_bench()
    stands = se3.make(None, (0.26, -0.24, 0.43))
    cube = CollisionBox(id="cube", pose=matrix_to_pose(stands), size=Vector3(x=0.05, y=0.05, z=0.06))
    held = CollisionBox(id="cube", pose=matrix_to_pose(np.eye(4)), size=cube.size)
    down = ApproachTarget(id="down", pose=matrix_to_pose(se3.make(bench.DOWN, (0.26, -0.20, 0.435))), score=1.0)
    down.approach_offset.z = down.retreat_offset.z = 0.08
    goal = PlanApproach.Goal(arm="right", targets=[down], attached=[held], detached_after_approach=True)
    cells = [stands[:3, 3] + [x, y, z] for x in (-0.02, 0, 0.02) for y in (-0.02, 0, 0.02) for z in (-0.02, 0, 0.02)]
    write(writer, cells)
    result = bench.run(bench.plan_client, goal)
    assert (result.success, result.failure.second) == (False, "the map"), result.message
    goal.ignore_regions = [cube]
    write(writer, cells)
    bench.done(bench.plan_client, goal)
    write(writer, [*cells, (0.26, -0.17, 0.45)])  # something else stands where it is to go
    assert bench.run(bench.plan_client, goal).failure.second == "the map"


def test_a_stale_map_is_refused_where_it_is_required_and_said_where_not(make_bench, writer) -> None:
    bench = make_bench(map__use="required", map__max_age=2.0)
    result = bench.run(bench.move_client, bench.named(plan_only=True))
    assert (result.code, result.failure.stage) == ("NOT_READY", "scene")
    assert "no version yet" in result.message
    write(writer, [], {"wrist": 5.0})
    result = bench.run(bench.move_client, bench.named(plan_only=True))
    assert result.code == "STALE_DATA"
    assert "camera 'wrist' last contributed to the map 5.0 s ago, expected at most 2 s" in result.message
    scene = bench.ros.call(bench.get_client, GetScene.Request())
    assert (scene.map, scene.map_used) == ("required", False)
    assert "wrist" in scene.map_message
    write(writer, [])
    assert bench.run(bench.move_client, bench.named(plan_only=True)).success


def test_one_camera_may_be_required(make_bench, writer) -> None:
    bench = make_bench(map__use="required", map__cameras=["overhead"])
    write(writer, [], {"wrist": 100.0})
    assert bench.run(bench.move_client, bench.named(plan_only=True)).success


def test_an_optional_map_that_is_old_is_left_out_and_cells_at_the_gripper_do_not_hold_the_arm(
    make_bench, writer
) -> None:
    bench = make_bench()
    write(writer, [goal_tip(bench)], {"overhead": 60.0})
    result = bench.run(bench.move_client, bench.named(plan_only=True))
    assert result.success
    assert "without the map: camera 'overhead' last contributed" in result.message
    arm = bench.node.service.arms["right"]
    T = arm.kinematics.fk(bench.q("right"))
    write(writer, [T[:3, 3] + T[:3, 0] * x + T[:3, 1] * y for x in (-0.02, 0.0, 0.02) for y in (-0.05, 0.0, 0.05)])
    assert bench.run(bench.move_client, bench.named(plan_only=True)).success


def test_a_map_that_is_off_is_not_looked_at(make_bench, writer) -> None:
    bench = make_bench(map__use="off")
    write(writer, [goal_tip(bench)])
    result = bench.run(bench.move_client, bench.named(plan_only=True))
    assert (result.success, "map" in result.message) == (True, False)
