# SPDX-License-Identifier: Apache-2.0
"""Meshes of a URDF: where their files are, scales that mirror, and convex ones that are taken as they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot import folder
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.meshes import is_convex, mesh_file
from tests.refusals import refused

ROBOT = """<robot name="r"><link name="a">
  <visual name="seen"><geometry><mesh filename="{visual}"/></geometry></visual>
  <collision name="c"><origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/>
    <geometry><mesh filename="{collision}" scale="{scale}"/></geometry></collision></link></robot>"""
#: A wedge without a plane of symmetry, m.
WEDGE = np.array([(0, 0, 0), (0.3, 0, 0), (0, 0.2, 0), (0, 0, 0.1)], np.float64)
FACES = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])


def write_stl(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    facets = [
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in vertices[face])
        + "endloop\nendfacet\n"
        for face in faces
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("solid a\n" + "".join(facets) + "endsolid a\n", encoding="utf-8")


def robot(at: Path, collision: str = "m.stl", scale: str = "1 1 1", visual: str = "m.stl") -> Path:
    path = at / "r.urdf"
    path.write_text(ROBOT.format(collision=collision, scale=scale, visual=visual), encoding="utf-8")
    return path


@pytest.mark.requirement("B-07")
@pytest.mark.parametrize("scale", [(1, 1, 1), (1, -1, 1), (-2, -1, 0.5)])
def test_a_convex_mesh_is_one_shape_with_the_name_of_its_element_whatever_its_scale(tmp_path, scale):
    write_stl(tmp_path / "m.stl", WEDGE, FACES)
    link = RobotDescription.from_files(robot(tmp_path, scale="{} {} {}".format(*scale))).links["a"]
    (shape,) = link.collision
    assert (shape.name, len(link.meshes), link.unread) == ("c", 1, ())
    assert shape.corners is not None
    T = shape.T_link_primitive
    x, y, z = (WEDGE * scale).T
    found = shape.corners @ T[:3, :3].T + T[:3, 3]
    expected = np.stack([-y, x, z + 1.0], axis=1)
    assert sorted(map(tuple, found.round(6) + 0.0)) == sorted(map(tuple, expected.round(6) + 0.0))


def test_a_scale_of_zero_is_refused(tmp_path):
    write_stl(tmp_path / "m.stl", WEDGE, FACES)
    with pytest.raises(OpenArmError, match=r"link 'a'.*m\.stl has scale \[1.0, 0.0, 1.0\], expected no 0"):
        RobotDescription.from_files(robot(tmp_path, scale="1 0 1"))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(8, 60))
def test_hulls_are_convex_and_dented_ones_are_not(seed, count):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    hull = ConvexHull(points)
    assert is_convex(points, hull.simplices.astype(np.int64))
    dented = points.copy()
    dented[hull.vertices[0]] = 0.7 * dented[hull.vertices[1:]].mean(axis=0) + 0.3 * dented[hull.vertices[0]]
    inside = ConvexHull(dented)
    if hull.vertices[0] not in inside.vertices and inside.volume < 0.99 * hull.volume:
        assert not is_convex(dented, hull.simplices.astype(np.int64))


def test_packages_are_found_in_prefixes_and_in_the_tree_of_an_installed_package(tmp_path, monkeypatch):
    urdf = robot(tmp_path, "package://parts/sub/m.stl", visual="package://nobody/m.stl")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path / 'none'}:{tmp_path / 'prefix'}")
    wanted = tmp_path / "prefix" / "share" / "parts" / "sub" / "m.stl"
    error = refused(r"there is no mesh 'package://parts/sub/m\.stl'; tried ", RobotDescription.from_files, urdf)
    assert error.code is Code.CONFIG_INVALID
    assert str(wanted) in error.message
    write_stl(wanted, WEDGE, FACES)
    text = RobotDescription.from_files(urdf).urdf
    assert f"file://{wanted}" in text
    assert "package://nobody/m.stl" in text  # nothing needs a visual
    monkeypatch.delenv("AMENT_PREFIX_PATH")
    write_stl(tmp_path / "site" / "parts" / "sub" / "m.stl", WEDGE, FACES)
    (tmp_path / "site" / "parts" / "__init__.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    assert mesh_file("package://parts/sub/m.stl", urdf) == tmp_path / "site" / "parts" / "sub" / "m.stl"


def test_a_file_that_is_not_there_is_named(tmp_path):
    refused(r"there is no mesh .*/m\.stl", RobotDescription.from_files, robot(tmp_path))
    refused("there is no file", RobotDescription.from_files, tmp_path / "none.urdf")


@pytest.fixture
def parts(tmp_path, monkeypatch) -> dict[str, object]:
    """What `robot.yaml` of the robot `mine` says, whose URDF has a mesh."""
    mine = tmp_path / "robots" / "mine"
    write_stl(mine / "meshes" / "m.stl", WEDGE, FACES)
    text = robot(mine, "meshes/m.stl").read_text()
    chain = '<link name="b"/><joint name="{}" type="revolute"><parent link="a"/><child link="b"/>{}</joint></robot>'
    limit = '<limit lower="0" upper="1" effort="1" velocity="1"/>'
    (mine / "r.urdf").write_text(text.replace("</robot>", chain.format("j", limit)), encoding="utf-8")
    (mine / "r.srdf").write_text('<robot name="r"><group name="one_arm"/></robot>', encoding="utf-8")
    monkeypatch.setattr(folder, "models_dir", lambda: tmp_path)
    arm = {"base": "a", "joints": ["j"], "flange": "b", "hand": "b", "tcp": "b", "finger_joint": "j", "fingers": ["b"]}
    return {"urdf": "r.urdf", "srdf": "r.srdf", "base": "a", "arms": {"one": arm}}


def test_a_folder_names_a_urdf_whose_meshes_are_beside_it(parts, tmp_path):
    path = tmp_path / "robots" / "mine" / "robot.yaml"
    path.write_text(yaml.safe_dump(parts))
    mine = RobotDescription.from_folder("mine")
    assert mine.links["a"].collision[0].corners is not None
    assert str(path.parent / "meshes" / "m.stl") in mine.urdf


@pytest.mark.parametrize(("given", "words"), [({"xacro": "r.urdf.xacro"}, "got both"), ({"urdf": ""}, "got neither")])
def test_a_folder_has_one_source(parts, tmp_path, given, words):
    (tmp_path / "robots" / "mine" / "robot.yaml").write_text(yaml.safe_dump({**parts, **given}))
    refused(f"expected one of xacro and urdf, {words}", RobotDescription.from_folder, "mine")
