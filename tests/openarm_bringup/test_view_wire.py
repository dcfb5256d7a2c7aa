# SPDX-License-Identifier: Apache-2.0
"""What a page is sent: frames, shapes, poses, cells, clouds."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from openarm_bringup.view import wire
from openarm_bringup.view.assets import Assets
from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import OpenArmError
from openarm_common.octree.codec import decode, encode_states
from openarm_common.octree.lattice import Lattice
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_names
from openarm_common.robot.meshes import read_mesh
from openarm_perception.geometry.depth import Deprojector, DepthLimits

SIDES = RobotDescription.load().arm_names


@pytest.mark.parametrize("name", ["a", "ab", "abc", "abcd", "µ"])
def test_a_frame_is_head_and_arrays_that_begin_at_a_multiple_of_four(name: str) -> None:
    data = wire.frame({"kind": name}, np.array([[1.5, 2.5]], np.float32), np.array([7, 8], np.uint8), b"\x09")
    length = int.from_bytes(data[:4], "little")
    assert length % 4 == 0
    assert json.loads(data[4 : 4 + length]) == {"kind": name}
    body = data[4 + length :]
    np.testing.assert_array_equal(np.frombuffer(body[:8], np.float32), [1.5, 2.5])
    assert body[8:] == b"\x07\x08\x09"


def test_shapes_and_poses_put_every_shape_where_the_description_does() -> None:
    description = RobotDescription.load()
    q = {description.finger_joint(side): 0.01 for side in SIDES} | {"openarm_right_joint4": 1.0}
    shapes = json.loads(json.dumps(wire.robot_shapes(description)))
    poses = wire.link_poses(description, q)
    assert poses.shape == (len(description.links), 16)
    full = {name: 0.0 for name, joint in description.joints.items() if joint.type != "fixed"} | q
    visuals = [(link, shape) for link in description.links.values() for shape in link.visual]
    assert len(shapes["shapes"]) == len(visuals) > 100
    for sent, (link, shape) in list(zip(shapes["shapes"], visuals, strict=True))[::9]:
        assert shapes["links"][sent["link"]] == link.name
        T = poses[sent["link"]].reshape(4, 4).T @ np.array(sent["pose"]).reshape(4, 4).T
        expected = description.link_pose(link.name, full) @ shape.T_link_primitive
        np.testing.assert_allclose(T, expected, atol=2e-6)


@pytest.mark.parametrize("name", robot_names())
def test_viewers_can_fetch_every_mesh_of_a_description(name: str) -> None:
    """STL, OBJ and Collada are what RViz, by `file://`, and Foxglove, by addresses of the node, read."""
    description, assets = RobotDescription.load(name), Assets()
    meshes = [mesh.file for link in description.links.values() for mesh in link.meshes]
    addresses = {
        node.attrib["filename"] for node in ElementTree.fromstring(assets.describe(description.urdf)).iter("mesh")
    }
    assert len(addresses) >= len(set(meshes))
    for address in addresses:
        assert Path(address).suffix.lower() in {".stl", ".obj", ".dae"}
        assert assets.read(address) == Path(address.removeprefix("package://robot")).read_bytes()


@pytest.mark.requirement("R-04")
def test_meshes_are_sent_once_a_file_and_drawn_where_the_description_has_them() -> None:
    description = RobotDescription.load("openarm_v2")
    shapes = json.loads(json.dumps(wire.robot_shapes(description)))
    drawn = [shape for shape in shapes["shapes"] if shape["kind"] == "mesh"]
    visuals = [(name, mesh) for name, link in description.links.items() for mesh in link.meshes]
    assert len(drawn) == len(visuals) > 50
    data = wire.robot_meshes(description)
    length = int.from_bytes(data[:4], "little")
    counts = json.loads(data[4 : 4 + length])["counts"]
    assert len(counts) == len({mesh.file for _, mesh in visuals}) < len(drawn)
    corners = np.frombuffer(data[4 + length :], np.float32).reshape(-1, 3, 3)
    assert len(corners) == sum(counts) < 40_000
    for sent, (name, mesh) in list(zip(drawn, visuals, strict=True))[::7]:
        assert shapes["links"][sent["link"]] == name
        first = sum(counts[: sent["mesh"]])
        own, _ = read_mesh(Path(mesh.file.removeprefix("file://")), np.ones(3))
        low, high = (f(corners[first : first + counts[sent["mesh"]]], axis=(0, 1)) for f in (np.min, np.max))
        np.testing.assert_allclose([low, high], [own.min(axis=0), own.max(axis=0)], atol=1e-6)
        np.testing.assert_allclose(np.array(sent["pose"]).reshape(4, 4).T, mesh.T_link_mesh, atol=1e-6)
        assert tuple(sent["size"]) == mesh.scale


def test_occupied_cells_cover_what_is_occupied_and_nothing_else() -> None:
    lattice = Lattice.from_bounds(0.05, (-0.4, -0.4, 0.0), (0.4, 0.4, 0.8), align=16)
    rng = np.random.default_rng(5)
    states = rng.choice(np.array([0, 1, 2], np.uint8), lattice.shape, p=(0.5, 0.3, 0.2))
    states[:4, :4, :4] = 2  # pruned to one leaf
    payload = encode_states(lattice, states)
    cells = wire.occupied_cells(decode(payload.data, lattice.resolution, binary=True))
    assert {round(float(edge), 3) for edge in cells[:, 3]} >= {0.05, 0.2}
    assert np.sum(np.round(cells[:, 3] / 0.05) ** 3) == np.count_nonzero(states == 2)
    for x, y, z, edge in cells:
        lower = np.round((np.array([x, y, z]) - edge / 2 - lattice.lower) / 0.05).astype(int)
        n = round(edge / 0.05)
        a, b, c = (slice(k, k + n) for k in lower)
        assert (states[a, b, c] == 2).all()


def test_a_cloud_is_thin_coloured_and_in_the_base_frame() -> None:
    """A wall 0.8 m before a camera that looks along base x from (1, 0, 0.5)."""
    depth = np.full((120, 160), 800, np.uint16)
    depth[:, 100:] = 0
    rgb = np.zeros((120, 160, 3), np.uint8)
    rgb[60:, :, 1] = 250  # the lower half is green
    intrinsics = Intrinsics.from_fovy(160, 120, 60.0)
    T_base_optical = se3.make(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), (1.0, 0.0, 0.5))
    points, colors = wire.thin_cloud(Deprojector(DepthLimits()), depth, rgb, intrinsics, T_base_optical, edge=0.02)
    np.testing.assert_allclose(points[:, 0], 1.8, atol=1e-4)
    assert 500 < len(points) == len(colors) < 50 * 60
    cells = np.floor(points[:, 1:] / 0.02).astype(int)
    assert len(np.unique(cells, axis=0)) == len(points)
    # v of a point from its height: the colour is that of its pixel
    v = (0.5 - points[:, 2]) / 0.8 * intrinsics.fy + intrinsics.cy
    np.testing.assert_array_equal(colors[:, 1] == 250, np.round(v) >= 60)
    # the hole has no points
    u = -points[:, 1] / 0.8 * intrinsics.fx + intrinsics.cx
    assert u.max() < 99.5


def test_a_colour_image_of_another_size_is_refused() -> None:
    depth, rgb = np.ones((8, 8), np.float32), np.zeros((4, 4, 3), np.uint8)
    with pytest.raises(OpenArmError, match=r"\(4, 4\), depth \(8, 8\)"):
        wire.thin_cloud(Deprojector(DepthLimits()), depth, rgb, Intrinsics(8, 8, 4, 4, 4, 4), np.eye(4))


def test_a_picture_keeps_its_colours() -> None:
    rgb = np.zeros((32, 32, 3), np.uint8)
    rgb[..., 0] = 200
    back = cv2.imdecode(np.frombuffer(wire.jpeg(rgb), np.uint8), cv2.IMREAD_COLOR)
    assert back[16, 16, 2] > 180
    assert back[16, 16, :2].max() < 20
