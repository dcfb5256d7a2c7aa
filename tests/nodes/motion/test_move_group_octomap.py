# SPDX-License-Identifier: Apache-2.0
"""The octomap of MoveIt's planning scene: the map's is given, a client's is an obstacle."""

from __future__ import annotations

import array
import copy
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from moveit_msgs.msg import CollisionObject, PlanningScene
from moveit_msgs.msg import MoveItErrorCodes as Codes
from moveit_msgs.srv import ApplyPlanningScene
from octomap_msgs.msg import Octomap, OctomapWithPose
from octomap_msgs.srv import GetOctomap
from std_srvs.srv import Empty

from openarm_common import se3
from openarm_common.octree.codec import decode, read_file
from openarm_common.ros.convert import matrix_to_pose
from openarm_common.ros.node import QOS_COMMAND
from openarm_octomap.ros.node import OctomapNode
from tests.nodes.motion.moveit_client import Client

pytestmark = pytest.mark.requirement("R-28")

#: One cell of 0.1 m with its corner in the origin, as liboctomap 1.10 writes it: writeBinaryData and writeData.
BINARY = bytes.fromhex("00c0" + 14 * "0300" + "0200")
FULL = bytes.fromhex("bab4604080" + 15 * "bab4604001" + "bab4604000")
REFERENCE = Path(__file__).parents[2] / "openarm_octomap" / "data" / "reference.bt"


def cell_at(p, data: bytes = BINARY, R=None, **fields) -> OctomapWithPose:
    """The cell with its middle at a place (3,)."""
    T = se3.make(R, p)
    T[:3, 3] -= T[:3, :3] @ np.full(3, 0.05)
    tree = Octomap(binary=data == BINARY, id="OcTree", resolution=0.1, data=array.array("b", data))
    message = OctomapWithPose(octomap=tree, origin=matrix_to_pose(T))
    for name, value in fields.items():
        setattr(tree, name, value)
    return message


class Scenes(Client):
    """A client that changes the octomap alone."""

    def see(self, octomap: OctomapWithPose, *, is_diff: bool = True) -> bool:
        scene = PlanningScene(is_diff=is_diff)
        scene.robot_state.is_diff, scene.world.octomap = True, octomap
        request = ApplyPlanningScene.Request(scene=scene)
        return self.call(ApplyPlanningScene, "/apply_planning_scene", request).success

    def blocked(self) -> bool:
        """Whether the octomap is in the way of the goal."""
        answer = self.plan(self.joint_goal(self.named()))
        if answer.error_code.val == Codes.SUCCESS:
            return False
        assert answer.error_code.val == Codes.GOAL_IN_COLLISION, answer.error_code.message
        assert "the map at" in answer.error_code.message
        return True

    def at_goal(self) -> np.ndarray:
        return self.arm.kinematics.fk(self.named())[:3, 3]


@pytest.fixture
def scenes(moveit_bench) -> Scenes:
    return Scenes(moveit_bench)


AWAY = (0.9, 0.9, 1.2)


@pytest.mark.parametrize("data", [BINARY, FULL], ids=["binary", "full"])
def test_an_octomap_is_an_obstacle_until_it_is_replaced_or_removed(scenes: Scenes, data: bytes) -> None:
    given = cell_at(scenes.at_goal(), data)

    assert scenes.see(given)
    assert scenes.blocked()
    seen = scenes.scene().world.octomap
    assert seen.header.frame_id == scenes.bench.description.base
    assert (seen.octomap, seen.origin) == (given.octomap, given.origin)
    assert scenes.see(OctomapWithPose()), "a change of something else"
    assert scenes.blocked()

    assert scenes.see(cell_at(AWAY, data))
    assert not scenes.blocked()
    assert scenes.see(given)
    assert scenes.see(OctomapWithPose(octomap=Octomap(id="cleared")))
    assert not scenes.blocked()
    assert not scenes.scene().world.octomap.octomap.data
    assert scenes.see(given)
    assert scenes.see(OctomapWithPose(), is_diff=False), "a whole scene without one"
    assert not scenes.blocked()


def test_an_octomap_is_where_its_header_and_origin_say(scenes: Scenes) -> None:
    R = se3.rot_z(0.7)[:3, :3] @ se3.rot_x(0.4)[:3, :3]
    p = scenes.at_goal()
    turned = cell_at(p, R=R)
    table = scenes.bench.node.service.in_base(np.eye(4), "table")
    turned.origin = matrix_to_pose(se3.inverse(table) @ se3.make(R, p - R @ np.full(3, 0.05)))
    turned.header.frame_id = turned.octomap.header.frame_id = "table"
    topic = scenes.node.create_publisher(PlanningScene, "/planning_scene", QOS_COMMAND)
    scenes.ros.spin_until(topic.get_subscription_count, what="the node to listen")
    scene = PlanningScene(is_diff=True)
    scene.robot_state.is_diff, scene.world.octomap = True, turned
    topic.publish(scene)
    service = scenes.bench.node.service
    scenes.ros.spin_until(lambda: service.scene.octree is not None, what="the octomap of the topic")

    assert scenes.blocked()
    there = service.scene.octree.beside(None, p - 1.0, p + 1.0)
    inside = np.abs((there.centres - p) @ R)
    assert inside.max() < 0.05 + 0.02 * np.sqrt(3.0), "cells that the turned cell overlaps"
    assert len(there.indices) > (0.1 / 0.02) ** 3


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"data": array.array("b", BINARY[:-3])}, "octree is damaged: it ends after 29 bytes"),
        ({"id": ""}, "world.octomap.octomap.id is empty and there are data, expected the class of the tree, such as"),
        ({"id": "Elevation", "binary": False}, "tree is of class 'Elevation', expected one of OcTree"),
        ({"resolution": 0.0}, "res is 0.0 m"),
        ({"frame": "moon"}, "moon"),
        ({"inner": "moon"}, "octomap.header.frame_id is 'moon', header.frame_id ''; expected the same twice"),
        ({"far": 1e9}, "is not finite, or beyond 10000 m"),
        ({"far": float("nan")}, "is not finite, or beyond 10000 m"),
    ],
)
def test_an_octomap_that_is_none_is_refused_and_changes_nothing(scenes: Scenes, change: dict, said: str) -> None:
    reports = scenes.ros.hear(DiagnosticArray, "/diagnostics")
    assert scenes.see(cell_at(scenes.at_goal()))
    wrong = cell_at(AWAY)
    wrong.header.frame_id = change.pop("frame", "")
    wrong.octomap.header.frame_id = change.pop("inner", "")
    wrong.origin.position.x += change.pop("far", 0.0)
    for name, value in change.items():
        setattr(wrong.octomap, name, value)

    assert not scenes.see(wrong)
    values = lambda: [v.value for m in reports for s in m.status for v in s.values if v.key == "last_refusal"]  # noqa: E731
    scenes.ros.spin_until(lambda: any(said in value for value in values()), what=said)
    assert scenes.blocked(), "the one before it"


def test_the_map_is_given_and_left_to_the_map_when_a_client_sends_it_back(scenes: Scenes, tmp_path: Path) -> None:
    assert not scenes.scene().world.octomap.octomap.data, "no map yet"
    scenes.ros.start(
        OctomapNode,
        map_file=str(REFERENCE),
        field__name=f"test_{tmp_path.name}",
        cameras=["overhead"],
        cloud_topic="",
        grid__lower=[-1.28] * 3,
        grid__upper=[1.28] * 3,
    )
    client = scenes.node.create_client(GetOctomap, "/octomap_full")
    scenes.ros.spin_until(client.service_is_ready, what="the map's service")
    scenes.ros.spin_until(scenes.group.scene._octomap._map.service_is_ready, what="the map's service")
    shown = scenes.ros.hear(PlanningScene, "/monitored_planning_scene", QOS_COMMAND)

    scene = scenes.scene()

    octomap = scene.world.octomap
    assert octomap.header.frame_id == scenes.bench.description.base
    assert octomap.origin == OctomapWithPose().origin
    assert (octomap.octomap.id, octomap.octomap.binary, octomap.octomap.header.frame_id) == ("OcTree", False, "")
    leaves = decode(np.frombuffer(octomap.octomap.data, np.uint8), octomap.octomap.resolution, binary=False)
    cells, values = leaves.arrays()
    wanted, sign = read_file(REFERENCE).arrays()  # as liboctomap wrote it
    occupied = lambda cells, values: sorted(cells[values > 0.0].tolist())  # noqa: E731
    assert occupied(cells, values) == occupied(wanted, sign)
    scenes.ros.spin_until(lambda: shown and shown[-1].world.octomap.octomap.data, what="the map as it is shown")
    assert shown[-1].world.octomap.octomap == octomap.octomap

    back = ApplyPlanningScene.Request(scene=copy.deepcopy(scene))
    assert scenes.call(ApplyPlanningScene, "/apply_planning_scene", back).success
    assert scenes.bench.node.service.scene.octree is None, "or its cells would stay when the map has changed"
    assert scenes.see(cell_at(scenes.at_goal()))
    assert scenes.scene().world.octomap.octomap.data.tobytes() == BINARY
    assert scenes.call(ApplyPlanningScene, "/apply_planning_scene", back).success
    assert scenes.bench.node.service.scene.octree is None


def test_links_may_touch_the_octomap_where_the_matrix_says_so_and_the_clear_service_removes_it(scenes: Scenes) -> None:
    assert scenes.see(cell_at(scenes.at_goal()))
    assert scenes.blocked()
    matrix = scenes.scene().allowed_collision_matrix
    k = list(matrix.entry_names).index("<octomap>")
    before = copy.deepcopy(matrix)
    for i, row in enumerate(matrix.entry_values):
        row.enabled = [on or k in (i, j) for j, on in enumerate(row.enabled)]
    assert scenes.apply(PlanningScene(allowed_collision_matrix=matrix))
    assert not scenes.blocked()
    assert (
        list(scenes.scene().allowed_collision_matrix.entry_values[k].enabled).count(True) >= len(matrix.entry_names) - 1
    )
    assert scenes.apply(PlanningScene(allowed_collision_matrix=before))
    assert scenes.blocked()

    scenes.call(Empty, "/clear_octomap", Empty.Request())
    assert not scenes.blocked()

    body = scenes.box(se3.make(None, AWAY), "<octomap>")
    scene = PlanningScene()
    scene.world.collision_objects = [body]
    assert body.operation == CollisionObject.ADD
    assert not scenes.apply(scene)
