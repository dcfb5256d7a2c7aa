# SPDX-License-Identifier: Apache-2.0
"""Node `octomap` in process: images in, maps out, services, faults."""

from __future__ import annotations

import array
import struct
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import Point
from nav_msgs.msg import OccupancyGrid
from octomap_msgs.msg import Octomap
from octomap_msgs.srv import BoundingBoxQuery, GetOctomap
from openarm_interfaces.srv import ClearMap, MapFile, QueryMap
from sensor_msgs.msg import JointState, PointCloud2
from std_srvs.srv import Empty
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common import se3
from openarm_common.errors import OpenArmError
from openarm_common.octree.distance_field import DistanceFieldReader, field_path
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import (
    cloud_from_points,
    info_from_intrinsics,
    matrix_to_pose,
    matrix_to_transform,
    ns_to_stamp,
    points_from_cloud,
    stamp_to_ns,
)
from openarm_common.ros.node import QOS_LATCHED, QOS_SENSOR
from openarm_octomap.ros.node import OctomapNode
from tests.nodes.octomap_bench import FRAME, JOINTS, ROBOT, T_BASE_CAMERA, Bench, K, sheet

BASE_FRAME = RobotDescription.load().base


@pytest.fixture
def bench(ros, tmp_path) -> Bench:
    return Bench(ros, tmp_path)


ON_TABLE = (0.45, 0.25, 0.41)
ABOVE = (0.45, 0.25, 0.51)


@pytest.mark.requirement("A-53", "A-54", "A-57")
def test_images_become_a_latched_octree(bench) -> None:
    """In the base frame, with the stamp of the image, 2 cm, readable as OctoMap; a late subscriber gets it too."""
    bench.show(sheet(0.41), lambda: bench.state(ON_TABLE) == "occupied", "the table is in the map")
    assert bench.state(ABOVE) == "free"
    newest = bench.maps[-1]
    assert (newest.header.frame_id, newest.id, newest.binary, newest.resolution) == (BASE_FRAME, "OcTree", True, 0.02)
    late = bench.ros.hear(Octomap, "octomap_full", QOS_LATCHED)
    bench.ros.spin_until(lambda: late, what="the full map")
    assert bench.state(ON_TABLE, late[0]) == "occupied"
    assert not late[0].binary
    for name, full in (("octomap_binary", False), ("octomap_full", True)):
        answer = bench.call(GetOctomap, name).map
        assert answer.binary != full
        assert bench.state(ON_TABLE, answer) == "occupied"


@pytest.mark.requirement("A-56", "A-55")
def test_what_moves_away_is_gone_and_what_arrives_is_there(bench) -> None:
    bench.show(sheet(0.51), lambda: bench.state(ABOVE) == "occupied", "an obstacle")
    bench.show(sheet(0.41), lambda: bench.state(ABOVE) == "free", "it is gone")
    bench.show(sheet(0.51), lambda: bench.state(ABOVE) == "occupied", "it is back")


@pytest.mark.requirement("A-47", "A-75")
def test_metres_and_millimetres_are_the_same_and_coarse_maps_are_answered(bench) -> None:
    metres = (sheet(0.41) * 1e-3).astype(np.float32)
    metres[metres == 0] = np.nan
    bench.show(metres, lambda: bench.state(ON_TABLE) == "occupied", "the table is in the map", "32FC1")
    for depth, edge in ((15, 0.04), (14, 0.08), (13, 0.16)):
        answer = bench.call(GetOctomap, f"/octomap/depth_{depth}/octomap_binary").map
        assert answer.resolution == pytest.approx(edge)
        assert bench.state(ON_TABLE, answer) == "occupied"


@pytest.mark.requirement("P-06")
def test_reset_is_visible_at_once_and_boxes_are_cleared(bench) -> None:
    bench.show(sheet(0.41), lambda: bench.state(ON_TABLE) == "occupied", "the table is in the map")
    # an update under way would put back what it saw
    bench.ros.spin_until(lambda: bench.node.idle, what="all images are in the map")
    box = BoundingBoxQuery.Request(min=Point(x=0.4, y=0.2, z=0.38), max=Point(x=0.5, y=0.3, z=0.44))
    bench.call(BoundingBoxQuery, "/octomap/clear_bbox", box)
    bench.ros.spin_until(lambda: bench.state(ON_TABLE) == "free", what="the box is free")
    answer = bench.call(ClearMap, "/octomap/clear", ClearMap.Request(min=box.min, max=box.max, state="unknown"))
    assert (answer.success, answer.code, answer.cells) == (True, "OK", 6 * 6 * 4)
    bench.ros.spin_until(lambda: bench.state(ON_TABLE) == "unknown", what="the box is unknown")
    answer = bench.call(ClearMap, "/octomap/clear", ClearMap.Request(min=box.min, max=box.max))
    bench.ros.spin_until(lambda: bench.state(ON_TABLE) == "free", what="the box is free")
    bench.call(Empty, "/octomap/reset")
    bench.ros.spin_until(lambda: len(bench.maps[-1].data) == 0, what="the map is empty")
    wrong = BoundingBoxQuery.Request(min=Point(x=1.0), max=Point(x=0.0))
    bench.call(BoundingBoxQuery, "/octomap/clear_bbox", wrong)
    for request, text in (
        (ClearMap.Request(min=wrong.min, max=wrong.max), "the lower one first"),
        (ClearMap.Request(min=Point(x=float("nan"))), "expected finite corners"),
        (ClearMap.Request(state="gone"), "valid: free, unknown"),
    ):
        answer = bench.call(ClearMap, "/octomap/clear", request)
        assert (answer.success, answer.code) == (False, "INVALID_ARGUMENT")
        assert text in answer.message


@pytest.mark.requirement("A-75")
def test_points_are_answered_by_cells_of_any_size_with_a_policy_for_unknown_ones(bench) -> None:
    bench.show(sheet(0.41), lambda: bench.state(ON_TABLE) == "occupied", "the table is in the map")
    points = [Point(x=x, y=y, z=z) for x, y, z in (ON_TABLE, (0.45, 0.25, 0.45), (0.45, 0.25, 0.2), (9.0, 0.0, 0.0))]

    def ask(**fields) -> QueryMap.Response:
        return bench.call(QueryMap, "/octomap/query", QueryMap.Request(points=points, **fields))

    fine = ask()
    assert fine.success, fine.message
    assert list(fine.states) == [fine.OCCUPIED, fine.FREE, fine.UNKNOWN, fine.UNKNOWN]
    assert list(fine.blocked) == [True, False, True, True]
    assert (fine.resolution, stamp_to_ns(fine.stamp) > 0) == (0.02, True)
    assert list(ask(unknown="free").blocked) == [True, False, False, False]
    coarse = ask(resolution=0.3)  # the largest cells not larger than this
    assert coarse.resolution == pytest.approx(0.16)
    assert list(coarse.states)[:2] == [coarse.OCCUPIED, coarse.OCCUPIED]
    for fields, text in (({"resolution": 0.01}, "at least the map's 0.02 m"), ({"unknown": "maybe"}, "occupied, free")):
        answer = ask(**fields)
        assert (answer.success, answer.code) == (False, "INVALID_ARGUMENT")
        assert text in answer.message
    points.append(Point(x=float("inf")))
    assert "not finite" in ask().message


def test_maps_are_saved_and_loaded_and_damaged_files_leave_the_map_alone(bench, tmp_path) -> None:
    bench.show(sheet(0.41), lambda: bench.state(ON_TABLE) == "occupied", "the table is in the map")

    def file(name: str, path: object) -> MapFile.Response:
        return bench.call(MapFile, f"/octomap/{name}", MapFile.Request(path=str(path)))

    assert "path is empty" in bench.call(MapFile, "/octomap/save").message
    assert "expected a file that ends in .bt or .ot" in file("save", tmp_path / "map.pcd").message
    for suffix in (".bt", ".ot"):
        answer = file("save", tmp_path / f"map{suffix}")
        assert answer.success, answer.message
        assert answer.nodes > 1000
    (tmp_path / "damaged.bt").write_bytes((tmp_path / "map.bt").read_bytes()[:-5])
    (tmp_path / "cloud.bt").write_text("VERSION .7")
    (tmp_path / "link.bt").symlink_to("cloud.bt")
    assert "link" in file("save", tmp_path / "link.bt").message
    assert (tmp_path / "cloud.bt").read_text() == "VERSION .7"
    before = bytes(bench.call(GetOctomap, "octomap_full").map.data)
    refused = {
        "damaged.bt": "octree is damaged",
        "cloud.bt": "not an octree",
        "none.bt": "No such file",
        "a.pcd": "a file that ends in .bt or .ot; a cloud is inserted",
        "a.yaml": "a flat map, as of Nav2, has no heights",
        "a.bt.gz": "unpack it: gunzip",
    }
    for name, text in refused.items():
        answer = file("load", tmp_path / name)
        assert (answer.success, answer.code) == (False, "INVALID_ARGUMENT")
        assert text in answer.message
    assert bytes(bench.call(GetOctomap, "octomap_full").map.data) == before
    for suffix in (".bt", ".ot"):
        bench.ros.spin_until(lambda: bench.node.idle, what="all images are in the map")
        bench.call(Empty, "/octomap/reset")
        bench.ros.spin_until(lambda: bench.state(ON_TABLE) == "unknown", what="the map is empty")
        answer = file("load", tmp_path / f"map{suffix}")
        assert (answer.success, answer.outside) == (True, 0)
        bench.ros.spin_until(lambda: bench.state(ON_TABLE) == "occupied", what="the map is back")


@pytest.mark.requirement("P-05")
def test_the_robot_and_what_it_holds_are_not_in_the_map(bench) -> None:
    """A sheet of cells across the left tool, then a held box around it: its cells vanish with the next update."""
    tool = ROBOT.link_pose("openarm_left_hand_tcp", dict.fromkeys(JOINTS, 0.0))
    near = tuple(tool[:3, 3] + (0.06, 0.12, 0.0))
    bench.show(sheet(tool[2, 3]), lambda: bench.state(near) == "occupied", "the sheet is in the map")
    hand = ROBOT.link_pose("openarm_left_hand", dict.fromkeys(JOINTS, 0.0))[:3, 3]
    assert bench.state(tuple(hand)) != "occupied"
    marker = Marker(ns="left/tray", type=Marker.CUBE, action=Marker.ADD)
    marker.header.frame_id = "openarm_left_hand_tcp"
    marker.pose = matrix_to_pose(np.eye(4))
    marker.scale.x = marker.scale.y = marker.scale.z = 0.4
    bench.held.publish(MarkerArray(markers=[Marker(action=Marker.DELETEALL), marker]))
    bench.show(sheet(tool[2, 3]), lambda: bench.state(near) != "occupied", "the held tray is cut out")
    bench.ros.spin_until(
        lambda: int(bench.value("overhead_removed/held/left/tray") or 0) > 100, what="its pixels counted"
    )
    bench.held.publish(MarkerArray(markers=[Marker(action=Marker.DELETEALL)]))
    bench.show(sheet(tool[2, 3]), lambda: bench.state(near) == "occupied", "it was let go")


def test_the_distance_field_is_shared_with_version_and_age(bench) -> None:
    """And taken away with the node."""
    reader = DistanceFieldReader(bench.field)
    bench.show(sheet(0.41), lambda: bench.state(ON_TABLE) == "occupied", "the table is in the map")
    field = reader.latest()
    assert field.at([ON_TABLE, (0.45, 0.25, 0.61)]) == pytest.approx([0.0, 0.2], abs=1e-6)
    assert field.frame == BASE_FRAME
    field.require_fresh(time.monotonic_ns(), 10.0)
    bench.ros.spin_until(lambda: reader.latest().t_ns == bench.t_ns, what="the last image is in the map")
    bench.call(Empty, "/octomap/reset")
    bench.ros.spin_until(
        lambda: reader.latest().version > field.version and reader.latest().at([ON_TABLE])[0] > 0.39,
        what="a newer field",
    )
    bench.node.close()
    assert not bench.field.exists()


def test_clouds_are_a_second_input(ros, tmp_path) -> None:
    """cloud_in, in any known frame."""
    bench = Bench(ros, tmp_path, cloud_topic="cloud_in")
    clouds = ros.node.create_publisher(PointCloud2, "cloud_in", QOS_SENSOR)
    at = np.array([ON_TABLE], np.float64)
    points = se3.apply(se3.inverse(T_BASE_CAMERA), at).astype(np.float32)
    points = np.concatenate([points, [[np.nan] * 3]]).astype(np.float32)

    def send() -> None:
        bench.t_ns += 100_000_000
        state = JointState(name=list(JOINTS), position=[0.0] * len(JOINTS))
        state.header.stamp = ns_to_stamp(bench.t_ns)
        bench.joints.publish(state)
        clouds.publish(cloud_from_points(points, FRAME, bench.t_ns))

    ros.send_until(send, 0.1, lambda: bench.state(ON_TABLE) == "occupied", "the point is in the map")
    assert bench.state(ABOVE) in ("free", "unknown")


def test_pictures_of_the_map_while_it_has_a_subscriber(bench) -> None:
    """Centres, coloured cubes, the projection, and what changed."""
    hear = bench.ros.hear
    clouds = hear(PointCloud2, "octomap_point_cloud_centers", QOS_LATCHED)
    cubes = hear(MarkerArray, "occupied_cells_vis_array", QOS_LATCHED)
    grids = hear(OccupancyGrid, "projected_map", QOS_LATCHED)
    changes = hear(PointCloud2, "octomap_changes", QOS_LATCHED)
    got = (clouds, cubes, grids, changes)
    bench.show(sheet(0.41), lambda: all(got) and grids[-1].data.count(100), "all pictures")
    assert np.abs(points_from_cloud(clouds[-1]) - np.array(ON_TABLE)).sum(axis=1).min() < 0.02
    assert len(cubes[-1].markers[0].points) == len(cubes[-1].markers[0].colors) > 100
    grid = grids[-1]
    column = int((ON_TABLE[0] - grid.info.origin.position.x) / 0.02)
    row = int((ON_TABLE[1] - grid.info.origin.position.y) / 0.02)
    assert grid.data[row * grid.info.width + column] == 100
    assert changes[-1].fields[3].name == "state"


@pytest.mark.requirement("B-28", "B-30", "B-34", "B-60")
def test_what_does_not_fit_is_named_and_the_map_unharmed(bench) -> None:
    uncalibrated = info_from_intrinsics(K, FRAME, 0)
    uncalibrated.k = [0.0] * 9
    bench.show(sheet(0.41), lambda: bench.heard("not calibrated"), "it is named", send={"info": uncalibrated})
    assert bench.maps == []
    bench.show(sheet(0.41), lambda: bench.state(ON_TABLE) == "occupied", "the table is in the map")
    for pixels, encoding, frame, text in (
        (np.zeros((480, 640), np.uint8), "mono8", FRAME, "'mono8' is not supported"),
        (np.zeros((240, 320), np.uint16), "16UC1", FRAME, "320x240"),
        (np.zeros((1, 1), np.float32), "32FC1", FRAME, "1x1"),
        (np.zeros((480, 640), np.uint16), "16UC1", "overhead_link", "expected the optical frame"),
        (np.zeros((480, 640), np.uint16), "16UC1", "nowhere", "depth is in frame 'nowhere'"),
    ):
        bench.show(pixels, partial(bench.heard, text), f"diagnostics with {text!r}", encoding, frame=frame)
        assert bench.state(ON_TABLE) == "occupied"


@pytest.mark.requirement("B-59", "B-60")
def test_a_frame_without_a_joint_state_at_its_stamp_is_skipped(bench) -> None:
    """Here 20 s ahead of the robot."""
    bench.show(sheet(0.41), lambda: bench.state(ON_TABLE) == "occupied", "the table is in the map")
    bench.t_ns += 20_000_000_000
    dark = np.zeros((480, 640), np.uint16)
    ahead = {"send": {"joints": False}}
    bench.show(dark, lambda: bench.heard("no joint state at stamp"), "the gap is named", **ahead)
    assert bench.state(ON_TABLE) == "occupied"
    assert int(bench.value("overhead_late")) > 0


def test_a_camera_that_falls_silent_is_named(ros, tmp_path) -> None:
    """The other one goes on."""
    bench = Bench(ros, tmp_path, cameras=["overhead", "wrist"], stale_after=0.5)
    bench.show(sheet(0.41), lambda: bench.heard("wrist never used"), "the silent camera is named")
    bench.show(sheet(0.41), lambda: bench.state(ON_TABLE) == "occupied", "the other one is in the map")
    field = DistanceFieldReader(bench.field).latest()
    with pytest.raises(OpenArmError, match="'wrist' has not contributed"):
        field.require_fresh(time.monotonic_ns(), 1.0)


def test_a_map_to_start_from_is_published_and_a_damaged_one_refused(ros, tmp_path) -> None:
    """And leaves no shared memory behind."""
    reference = Path(__file__).parents[1] / "openarm_octomap" / "data" / "reference.bt"
    bench = Bench(ros, tmp_path, map_file=str(reference))
    bench.ros.spin_until(lambda: bench.maps, what="the map of the file")
    assert len(bench.maps[0].data) > 1000
    damaged = tmp_path / "damaged.bt"
    damaged.write_bytes(reference.read_bytes()[:2000])
    name = f"test_{tmp_path.name}_2"
    with pytest.raises(OpenArmError, match="octree is damaged"):
        ros.start(OctomapNode, map_file=str(damaged), field__name=name)
    assert not field_path(name).exists()


def test_unknown_cameras_and_wrong_parameters_are_refused(ros) -> None:
    for params, text in (({"cameras": ["spectator"]}, "has no depth"), ({"grid.resolution": 0.0}, "grid.resolution")):
        with pytest.raises(OpenArmError, match=text):
            ros.start(OctomapNode, **params)


def test_a_map_of_another_program_comes_by_a_topic(ros, tmp_path) -> None:
    """In any class with occupancy and of any cells; in a frame that is fixed to the robot, once that is known."""
    bench = Bench(ros, tmp_path, map_topic="/map_server/octomap_full")
    publisher = ros.node.create_publisher(Octomap, "/map_server/octomap_full", QOS_LATCHED)

    def value(log_odds: float, children: int) -> bytes:
        return struct.pack("<f3BB", log_odds, 255, 0, 0, children)

    # one cell of 4 cm at (0.40 .. 0.44, 0.24 .. 0.28, 0.40 .. 0.44): each node names the child on the way there
    keys = [32768 + round(v / 0.04) for v in (0.40, 0.24, 0.40)]
    path = [sum((key >> level & 1) << k for k, key in enumerate(keys)) for level in range(15, -1, -1)]
    data = b"".join(value(1.0, 1 << child) for child in path) + value(1.0, 0)
    message = Octomap(binary=False, id="ColorOcTree", resolution=0.04, data=array.array("b", data))
    message.header.frame_id = "map"
    publisher.publish(message)
    bench.ros.spin_until(lambda: bench.heard("frame 'map' is not connected"), what="the frame is missed")
    assert bench.heard("--child-frame-id 'map'")
    static = TFMessage(transforms=[matrix_to_transform("map", ROBOT.root, se3.make(None, (0.0, 0.0, 0.1)), 0)])
    bench.static.publish(static)
    bench.ros.spin_until(lambda: "ColorOcTree" in bench.value("map_topic"), what="the map is taken")
    T_root_base = ROBOT.link_pose(BASE_FRAME, {})
    at = (np.array([0.42, 0.26, 0.42]) - (0.0, 0.0, 0.1)) - T_root_base[:3, 3]
    bench.ros.spin_until(lambda: bench.state(tuple(at)) == "occupied", what="its cell is in the map")
    assert "17 nodes of 0.04 m in cells of 0.02 m of a ColorOcTree" in bench.value("map_topic")
    message.header.frame_id, message.id = BASE_FRAME, "SemanticOcTree"
    publisher.publish(message)
    bench.ros.spin_until(lambda: bench.heard("expected one of OcTree"), what="another class is named")
    assert bench.state(tuple(at)) == "occupied"
    message.header.frame_id, message.id = "openarm_left_hand", "ColorOcTree"
    publisher.publish(message)
    bench.ros.spin_until(lambda: bench.heard("moves with the robot"), what="a moving frame is named")


def test_the_map_of_the_node_is_no_map_of_another_program(ros) -> None:
    with pytest.raises(OpenArmError, match="which this node publishes itself"):
        ros.start(OctomapNode, map_topic="/octomap_full")
