# SPDX-License-Identifier: Apache-2.0
"""Drafts of robots from URDF and xacro: packages, meshes, limits, fingers; and what keeps none from being made."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from scipy.spatial import ConvexHull

from openarm_bringup.commands.model import new
from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import load_folder, robot_names
from openarm_common.robot.meshes import is_convex, read_mesh
from openarm_sim_bridge.drafting.check import folder_faults
from openarm_sim_bridge.drafting.collisions import hull_mesh
from openarm_sim_bridge.drafting.draft import Draft, draft_folder, mirror_signs
from openarm_sim_bridge.drafting.mesh_files import simplified, write_stl
from openarm_sim_bridge.world.model import import_urdf
from tests.refusals import refused

ARM = {"arm": ("base", "tip")}
TETRAHEDRON = np.array([(0, 0, 0), (0.03, 0, 0), (0, 0.02, 0), (0, 0, 0.1)], np.float64)
FACES = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
#: Two of them, far from each other.
PAIR = np.concatenate([TETRAHEDRON, np.add(TETRAHEDRON, (0.0, 0.0, 0.5))])
PAIR_FACES = np.concatenate([FACES, FACES + 4])
INERTIA = '<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
DAE = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">{points}</float_array><technique_common>
<accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>{faces}</p></triangles></mesh></geometry>
</library_geometries><library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node>
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def mesh(name: str, scale: str = "1 1 1") -> str:
    """Shapes of a link, seen and touched."""
    shape = f'<geometry><mesh filename="{name}" scale="{scale}"/></geometry>'
    return f"<visual>{shape}</visual><collision>{shape}</collision>"


def link(name: str, shapes: str = "") -> str:
    return f'<link name="{name}">{INERTIA}{shapes}</link>'


def joint(name: str, kind: str, parent: str, child: str, more: str = "", span: str = 'lower="-1" upper="1"') -> str:
    limit = "" if kind == "fixed" else f'<axis xyz="0 1 0"/><limit {span} effort="5" velocity="2"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="0 0 0.2"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{limit}{more}</joint>'


def robot(shapes: str = "", more: str = "") -> str:
    """An arm of one joint, with shapes on the link that moves."""
    parts = link("base") + link("upper", shapes) + '<link name="tip"/>'
    joints = joint("shoulder", "revolute", "base", "upper") + joint("tip_fixed", "fixed", "upper", "tip")
    return f'<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">{parts}{joints}{more}</robot>'


def drafted(at: Path, text: str, name: str = "r.urdf", **more: object) -> tuple[Path, Draft]:
    """Draft a robot from a text; its folder, which holds, and what is said of it."""
    source = at / name
    source.parent.mkdir(parents=True, exist_ok=True)
    source.write_text(text, encoding="utf-8")
    folder = at / "robots" / "mine"
    return folder, draft_folder(folder, source, ARM, samples=10, **more)  # pyright: ignore[reportArgumentType]


@pytest.mark.requirement("B-07")
def test_a_package_is_found_above_the_file_and_the_draft_needs_it_no_longer(tmp_path):
    package = tmp_path / "workspace" / "checkout-1.2"
    package.mkdir(parents=True)
    (package / "package.xml").write_text("<package><name> parts </name></package>")
    for folder in (package, package.parent / "others"):
        (folder / "meshes").mkdir(parents=True)
        write_stl(folder / "meshes" / "m.stl", TETRAHEDRON, FACES)
    shapes = mesh("package://parts/meshes/m.stl") + mesh("package://others/meshes/m.stl", "2 1 1")
    folder, draft = drafted(package / "urdf" / "deep", robot(shapes))
    elsewhere = shutil.copytree(folder, tmp_path / "mine")
    shutil.rmtree(package.parent)
    assert sorted(path.name for path in elsewhere.glob("meshes/*/*")) == ["m.stl", "m_1.stl"]
    upper = RobotDescription.from_files(elsewhere / "mine.urdf").links["upper"]
    np.testing.assert_allclose([shape.size for shape in upper.collision], [(0.03, 0.02, 0.1), (0.06, 0.02, 0.1)])
    assert folder_faults(elsewhere) == []
    assert told(draft) == ()


def test_a_package_is_where_an_option_or_the_environment_says(tmp_path, monkeypatch):
    (tmp_path / "far" / "parts").mkdir(parents=True)
    write_stl(tmp_path / "far" / "parts" / "m.stl", TETRAHEDRON, FACES)
    text, at = robot(mesh("package://parts/m.stl")), tmp_path / "near"
    error = refused("there is no mesh 'package://parts/m.stl'; tried ", drafted, at, text)
    assert error.message.endswith("--package parts=FOLDER of `openarm model new`, or its parent in ROS_PACKAGE_PATH")
    drafted(at, text, packages={"parts": tmp_path / "far" / "parts"})
    for place in (tmp_path / "far", tmp_path / "far" / "parts"):
        monkeypatch.setenv("ROS_PACKAGE_PATH", f"{tmp_path / 'none'}:{place}")
        shutil.rmtree(at / "robots")
        drafted(at, text)


def test_a_path_of_another_machine_s_installed_package_is_that_of_the_package(tmp_path):
    (tmp_path / "parts").mkdir()
    write_stl(tmp_path / "parts" / "m.stl", TETRAHEDRON, FACES)
    text = robot(mesh("file:///home/maker/install/parts/share/parts//m.stl"))
    folder, _ = drafted(tmp_path, text)
    assert folder_faults(folder) == []
    words = "there is no mesh /home/maker/m.stl; name it from the folder of this file, or by package://NAME/PATH"
    refused(words, drafted, tmp_path / "2", robot(mesh("file:///home/maker/m.stl")))


NO_HAND = "arms.arm: no two fingers that come together, so robot.yaml has no `hand`; write it as docs/extending.md says"


def told(draft: Draft) -> tuple[str, ...]:
    """What a draft says of the maker's description, but that the robot stands on a column."""
    first = [remark for remark in draft.remarks if remark.startswith("'base' stands on 'mine_stand', 0.45 m high")]
    assert len(first) == 1
    return tuple(remark for remark in draft.remarks if remark not in first)


XACRO = (
    robot()
    .replace("<link", '<xacro:arg name="long" default="1"/><link', 1)
    .replace('xyz="0 0 0.2"', 'xyz="0 0 $(arg long)"', 1)
    .replace('name="r"', 'name="$(arg who)"', 1)
)


@pytest.mark.requirement("B-07")
def test_a_xacro_is_expanded_with_the_arguments_and_packages_given(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "more.xacro").write_text(
        "<robot>" + link("more") + joint("m", "fixed", "base", "more") + "</robot>"
    )
    text = XACRO.replace("</robot>", '<xacro:include filename="$(find parts)/more.xacro"/></robot>')
    where = (
        f"there is no package 'parts', which {tmp_path}/r.urdf.xacro names; name its folder by --package parts=FOLDER"
    )
    assert refused(None, drafted, tmp_path, text, "r.urdf.xacro", arguments={"who": "me"}).message.startswith(where)
    packages = {"parts": tmp_path / "far"}
    folder, _ = drafted(tmp_path, text, "r.urdf.xacro", packages=packages, arguments={"who": "me", "long": "0.7"})
    mine = RobotDescription.from_files(folder / "mine.urdf")
    assert mine.joints["shoulder"].T_parent_joint[2, 3] == 0.7
    assert "more" in mine.links


@pytest.mark.parametrize(
    ("more", "arguments", "words"),
    [
        ("", {}, r"Undefined substitution argument who; give it by --arg NAME:=VALUE"),
        ("", {"who": "me", "lnog": "1"}, "has no argument lnog; it has: long, who"),
        ("<xacro:arg/>", {"who": "me"}, "xacro does not expand .*missing attribute"),
        ("<xacro:nothing/>", {"who": "me"}, "xacro does not expand .*unknown macro name: xacro:nothing"),
        ('<link name="${1/0}"/>', {"who": "me"}, "xacro does not expand .*division by zero"),
        ("<link>", {"who": "me"}, "xacro does not expand .*mismatched tag"),
        ('<xacro:include filename="r.xacro"/>', {"who": "me"}, "xacro does not expand .*recursion"),
    ],
)
def test_what_xacro_lacks_is_said(tmp_path, more, arguments, words):
    text = XACRO.replace("</robot>", f"{more}</robot>")
    refused(words, drafted, tmp_path, text, "r.xacro", arguments=arguments)


def test_a_draft_that_fails_leaves_nothing_and_keeps_what_was_there(tmp_path):
    mine = tmp_path / "robots" / "mine"
    refused("there is no mesh", drafted, tmp_path, robot(mesh("m.stl")))
    assert not list((tmp_path / "robots").iterdir())
    mine.mkdir()
    (mine / "semantics.yaml").write_text("postures: {up: {arm: [0.5]}}\nsamples: 5\n")
    refused("there is no mesh", drafted, tmp_path, robot(mesh("m.stl")))
    assert [path.name for path in mine.iterdir()] == ["semantics.yaml"]
    folder, _ = drafted(tmp_path, robot())
    assert '<group_state name="up" group="arm_arm">' in (folder / "mine.srdf").read_text()
    assert [path.name for path in (tmp_path / "robots").iterdir()] == ["mine"]


@pytest.mark.requirement("B-07")
def test_a_convex_mesh_is_one_file_and_another_is_hulls_that_hold_it(tmp_path):
    write_stl(tmp_path / "m.stl", TETRAHEDRON, FACES)
    write_stl(tmp_path / "pair.stl", PAIR, PAIR_FACES)
    folder, _ = drafted(tmp_path, robot(mesh("m.stl", "2 -1 1") + mesh("pair.stl", "1 1 -3")))
    files = sorted(path.relative_to(folder / "meshes") for path in folder.glob("meshes/*/*"))
    assert [file.name for file in files if file.parent.name == "visual"] == ["m.stl", "pair.stl"]
    hulls = [folder / "meshes" / file for file in files if file.parent.name == "collision"]
    assert len(hulls) > 1
    meshes = [read_mesh(hull, np.ones(3)) for hull in hulls]
    assert all(is_convex(*found) for found in meshes)
    planes = [ConvexHull(vertices).equations for vertices, _ in meshes]
    inside = [(PAIR * (1, 1, -3)) @ e[:, :3].T + e[:, 3] <= 1e-6 for e in planes]
    assert np.any([rows.all(axis=1) for rows in inside], axis=0).all()
    assert folder_faults(folder) == []


def ascii_stl(path: Path) -> None:
    facets = (
        "facet normal 0 0 0\nouter loop\n" + "".join("vertex {} {} {}\n".format(*TETRAHEDRON[k]) for k in face)
        + "endloop\nendfacet\n"
        for face in FACES
    )  # fmt: skip
    path.write_text("solid a\n" + "".join(facets) + "endsolid a\n")


def obj(path: Path) -> None:
    lines = ["v {} {} {}".format(*point) for point in TETRAHEDRON]
    path.write_text("\n".join([*lines, *("f {} {} {}".format(*(face + 1)) for face in FACES), ""]))


def dae(path: Path) -> None:
    numbers = {"points": " ".join(map(str, TETRAHEDRON.ravel())), "faces": " ".join(map(str, FACES.ravel()))}
    path.write_text(DAE.format(**numbers))


@pytest.mark.requirement("B-07")
@pytest.mark.parametrize(("name", "write"), [("m.dae", dae), ("m.stl", ascii_stl), ("m.obj", obj)])
def test_meshes_that_mujoco_does_not_read_become_stl(tmp_path, name, write):
    write(tmp_path / name)
    folder, _ = drafted(tmp_path, robot(mesh(name)))
    (file,) = folder.glob("meshes/*/*")
    assert file.name == "m.stl"
    vertices, triangles = read_mesh(file, np.ones(3))
    assert sorted(map(tuple, np.unique(vertices, axis=0).round(6))) == sorted(map(tuple, TETRAHEDRON))
    assert len(triangles) == 4
    assert folder_faults(folder) == []
    model = import_urdf(RobotDescription.from_files(folder / "mine.urdf")).compile()
    assert model.nmesh == 1


def test_a_mesh_of_collada_that_is_cut_off_and_one_without_a_volume_end_in_a_sentence_and_a_box(tmp_path):
    dae(tmp_path / "m.dae")
    (tmp_path / "m.dae").write_text((tmp_path / "m.dae").read_text()[:-200])
    refused("can't read mesh .*/m.dae: unclosed token|no element found", drafted, tmp_path, robot(mesh("m.dae")))
    dae(tmp_path / "n.dae")
    (tmp_path / "n.dae").write_text((tmp_path / "n.dae").read_text().replace("<p>0 2 1", "<p>0 2B1"))
    refused("can't read mesh .*/n.dae: <p> has indices that are no numbers", drafted, tmp_path, robot(mesh("n.dae")))
    flat, triangles = hull_mesh(TETRAHEDRON * (1.0, 1.0, 0.0))
    np.testing.assert_allclose(np.ptp(flat, axis=0), (0.03, 0.02, 0.001))
    assert len(triangles) == 12


def test_settings_of_mujoco_textures_and_parts_of_other_programs_are_no_hindrance(tmp_path):
    write_stl(tmp_path / "m.stl", TETRAHEDRON, FACES)
    more = (
        '<mujoco><compiler meshdir="elsewhere" discardvisual="true" balanceinertia="true"/></mujoco>'
        '<material name="skin"><texture filename="package://nobody/skin.png"/></material>'
        '<ros2_control name="c" type="system"><param name="file">/home/maker/c.yaml</param></ros2_control>'
    )
    folder, _ = drafted(tmp_path, robot(mesh("m.stl").replace("</visual>", '<material name="skin"/></visual>'), more))
    text = (folder / "mine.urdf").read_text()
    assert "balanceinertia" in text
    assert not any(word in text for word in ("elsewhere", "skin.png", "/home/maker"))
    assert folder_faults(folder) == []


def test_a_branch_that_is_fixed_to_nothing_is_left_out_and_one_that_moves_is_refused(tmp_path):
    branch = link("logo") + link("screw") + joint("s", "{}", "logo", "screw") + joint("l", "fixed", "head", "logo")
    folder, draft = drafted(tmp_path, robot(more=branch.format("fixed")))
    assert told(draft) == ("left out logo, screw: joint 'l' fixes it to 'head', which the file does not have",)
    assert list(RobotDescription.from_files(folder / "mine.urdf").links) == [
        "base",
        "upper",
        "tip",
        "world",
        "mine_stand",
    ]
    # a link of a branch that is out already
    _, draft = drafted(tmp_path / "3", robot(more=branch.format("fixed") + joint("t", "fixed", "neck", "screw")))
    assert [remark.partition(":")[0] for remark in told(draft)] == ["left out logo, screw", "left out screw"]
    moving = link("head") + joint("h", "revolute", "neck", "head")
    refused("joint 'h' has the parent link 'neck', which does not exist", drafted, tmp_path / "2", robot(more=moving))


def test_limits_that_a_urdf_lacks_are_given_for_all_joints_at_once(tmp_path):
    text = robot(more=link("end") + joint("wrist", "continuous", "tip", "end"))
    text = text.replace('effort="5" velocity="2"', 'effort="0"', 1).replace('effort="5" velocity="2"', "")
    (velocity, effort) = folder_faults(drafted(tmp_path, text)[0])
    assert velocity.startswith("joints without a limit of velocity > 0: shoulder (0); give it for all of them")
    assert effort.startswith("joints without a limit of effort > 0: shoulder (0); give it for all of them")
    edits = tmp_path / "edits.yaml"
    edits.write_text('velocity: {"*": 1.5}\neffort: {shoulder: 7, "*": 3}\nrange: {"s*": [-0.5, 0.25]}\n')
    folder, _ = drafted(tmp_path / "again", text, edits=edits)
    assert folder_faults(folder) == []
    found = RobotDescription.from_files(folder / "mine.urdf").joints["shoulder"]
    assert (found.lower, found.upper, found.velocity, found.effort) == (-0.5, 0.25, 1.5, 7.0)
    edits.write_text("prefix: my_\n")
    error = refused(
        "edits prefix are of an MJCF; those of a URDF are range", drafted, tmp_path / "3", text, edits=edits
    )
    assert error.code is Code.INVALID_ARGUMENT


def test_a_joint_that_turns_without_end_stays_so_unless_edits_give_it_limits(tmp_path):
    text = robot().replace('"revolute"', '"continuous"')
    folder, draft = drafted(tmp_path / "1", text)
    found = RobotDescription.from_files(folder / "mine.urdf")
    assert (found.joints["shoulder"].type, found.joints["shoulder"].upper) == ("continuous", np.inf)
    assert not import_urdf(found).compile().joint("shoulder").limited
    (remark,) = (one for one in draft.remarks if "without end" in one)
    assert remark.startswith("arms.arm: joints that turn without end: shoulder; where a cable forbids that, write")
    assert folder_faults(folder) == []
    (tmp_path / "edits.yaml").write_text("range: {shoulder: [-6.5, 6.5]}\n")
    folder, draft = drafted(tmp_path / "2", text, edits=tmp_path / "edits.yaml")
    found = RobotDescription.from_files(folder / "mine.urdf")
    assert (found.joints["shoulder"].type, found.joints["shoulder"].lower) == ("revolute", -6.5)
    assert not any("without end" in one for one in draft.remarks)
    planar = text.replace('"continuous"', '"planar"')
    refused("joint 'shoulder' has type 'planar'; .* write type=\"fixed\"", drafted, tmp_path / "3", planar)


def hand(tmp_path: Path, more: str) -> tuple[dict[str, object], dict[str, object], tuple[str, ...]]:
    """What a draft says of the hand on the upper link: arm and gripper, and remarks."""
    folder, draft = drafted(tmp_path, robot(more=more))
    arm = yaml.safe_load((folder / "robot.yaml").read_text())["arms"]["arm"]
    text = (folder / "semantics.yaml").read_text()
    assert "inf" not in text
    return arm, yaml.safe_load(text)["gripper"], told(draft)


def pads(*names: str) -> str:
    box = '<collision name="{}_pad_collision"><geometry><box size="0.01 0.01 0.01"/></geometry></collision>'
    return "".join(link(name, box.format(name)) for name in names)


@pytest.mark.requirement("B-07")
def test_fingers_are_what_slides_together_and_not_a_propeller_before_them(tmp_path):
    slides = joint("left", "prismatic", "upper", "l", span='lower="0.02" upper="0.05"') + joint(
        "right", "prismatic", "upper", "r", '<mimic joint="left" multiplier="-1"/>', 'lower="-0.05" upper="-0.02"'
    )
    more = link("propeller") + joint("motor", "continuous", "upper", "propeller") + pads("l", "r") + slides
    arm, gripper, remarks = hand(tmp_path, more)
    assert (arm["finger_joint"], arm["fingers"]) == ("left", ["l", "r"])
    assert gripper == {"open": {"arm": 0.05}, "closed": {"arm": 0.02}}
    guess, fixed, _ = remarks
    assert guess.startswith("arms.arm: finger_joint 'left' is a guess; further joints of the hand: motor; ")
    assert fixed == "fixed at 0, since no arm and no hand drives them: motor"


def test_of_a_linkage_the_fingers_are_its_ends_and_closed_is_where_they_meet(tmp_path):
    def side(name: str, x: float, sign: int) -> str:
        def bar(end: str, parent: str, turn: int) -> str:
            follows = f'<mimic joint="l_bar" multiplier="{turn}"/>' if f"{name}_{end}" != "l_bar" else ""
            return link(f"{name}_{end}") + joint(
                f"{name}_{end}", "revolute", parent, f"{name}_{end}", follows, 'lower="0" upper="0.2"'
            )

        bars = bar("bar", "upper", sign).replace('"0 0 0.2"', f'"{x} 0 0"') + bar("inner", "upper", sign)
        fixed = joint(f"{name}_fixed", "fixed", f"{name}_tip", f"{name}_pad")
        return bars + bar("tip", f"{name}_bar", -sign) + pads(f"{name}_pad") + fixed

    arm, gripper, remarks = hand(tmp_path, side("l", -0.05, 1) + side("r", 0.05, -1))
    assert (arm["finger_joint"], arm["fingers"]) == ("l_bar", ["l_pad", "r_pad"])
    assert gripper == {"open": {"arm": 0.0}, "closed": {"arm": 0.2}}
    assert remarks == (NO_HAND,)


def test_one_jaw_and_a_hand_of_many_joints_are_said(tmp_path):
    arm, _, remarks = hand(tmp_path / "1", pads("jaw") + joint("grip", "revolute", "upper", "jaw"))
    assert (arm["finger_joint"], arm["fingers"]) == ("grip", ["jaw"])
    remark, no_hand = remarks
    assert no_hand == NO_HAND
    assert remark.startswith("arms.arm: 'grip' moves one finger, 'jaw'; where the other is a part of 'upper', add that")
    many = "".join(link(f"f{k}") + joint(f"j{k}", "revolute", "upper", f"f{k}") for k in range(4))
    arm, _, remarks = hand(tmp_path / "2", many)
    assert arm["finger_joint"] == "j0"
    assert remarks[0].startswith("arms.arm: finger_joint 'j0' is a guess; further joints of the hand: j1, j2, j3; ")
    arm, gripper, remarks = hand(tmp_path / "3", link("fan") + joint("motor", "continuous", "upper", "fan"))
    assert (arm["finger_joint"], arm["fingers"], gripper) == ("", [], {})
    assert remarks[0].startswith("arms.arm: no joint of the hand has limits, so it has no fingers: motor; ")


@pytest.mark.parametrize("name", robot_names())
def test_arms_are_mirror_images_where_their_axes_are(name):
    _, parts = load_folder(name)
    assert (
        tuple(mirror_signs(RobotDescription.load(name), [list(arm.joints) for arm in parts.arms.values()]))
        == parts.mirror
    )


def test_a_mesh_whose_corners_are_one_has_few_triangles_enough(tmp_path):
    pytest.importorskip("fast_simplification")
    rng = np.random.default_rng(0)
    # 500 triangles smaller than the distance at which corners are one, around one that is not
    small = 1e-7 * rng.normal(size=(500, 3, 3))
    vertices = np.concatenate([small.reshape(-1, 3), TETRAHEDRON])
    triangles = np.concatenate([np.arange(1500).reshape(-1, 3), FACES + 1500])
    _, left = simplified(vertices, triangles, 100)
    assert len(left) <= 100


def test_a_flat_mesh_is_given_a_thickness(tmp_path):
    square = np.array([(0, 0, 0), (0.1, 0, 0), (0.1, 0.1, 0), (0, 0.1, 0)], np.float64)
    write_stl(tmp_path / "m.stl", square, np.array([(0, 1, 2), (0, 2, 3)]))
    folder, _ = drafted(tmp_path, robot(mesh("m.stl").split("</visual>")[1]))
    (shape,) = RobotDescription.from_files(folder / "mine.urdf").links["upper"].collision
    assert shape.size == pytest.approx((0.1, 0.1, 0.001), abs=1e-6)


def test_the_command_takes_arguments_packages_and_says_what_is_left(tmp_path):
    (tmp_path / "r.urdf.xacro").write_text(XACRO)
    more = {"urdf": tmp_path / "r.urdf.xacro", "arm": ("arm=base:tip",), "samples": 10, "out": tmp_path / "robots"}
    refused("--arg 'who=me': expected NAME:=VALUE", new, "mine", **more, arg=("who=me",))
    refused("--package 'parts': expected NAME=FOLDER", new, "mine", **more, package=("parts",))
    done = new("mine", **more, arg=("who:=me",), package=(f"parts={tmp_path}",))
    assert done.data is not None
    stands, work = done.data["remarks"]
    assert stands.startswith("'base' stands on 'mine_stand'")
    assert work == "work: not looked for, since no arm has a hand: it is planned for alone"
    assert done.data["faults"] == []
    assert isinstance(mujoco.MjModel.from_xml_path(str(tmp_path / "robots" / "mine" / "mine.urdf")), mujoco.MjModel)


def test_a_visual_mesh_that_is_not_there_is_left_out_and_its_link_shows_what_collides(tmp_path):
    write_stl(tmp_path / "m.stl", TETRAHEDRON, FACES)
    (tmp_path / "pointer.stl").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
    both = "".join(mesh(name).split("<collision>")[0] for name in ("pointer.stl", "lost.stl"))
    folder, draft = drafted(tmp_path, robot(both + mesh("m.stl").split("</visual>")[1]))
    (remark,) = told(draft)
    assert remark.startswith(
        "left out visual meshes that are not there: pointer.stl, lost.stl; a link that has no other"
    )
    upper = RobotDescription.from_files(folder / "mine.urdf").links["upper"]
    assert len(upper.meshes) == len(upper.collision) == 1
    assert folder_faults(folder) == []
    words = "there is no mesh .*pointer.stl, but what Git LFS has in its place; `git lfs pull` in its folder brings it"
    refused(words, drafted, tmp_path / "2", robot(mesh(str(tmp_path / "pointer.stl"))))
    (tmp_path / "parts").mkdir()
    words = f"tried .*; {tmp_path / 'parts'} lacks it: get the file there, or name its folder by --package parts=FOLDER"
    refused(words, drafted, tmp_path / "3", robot(mesh("package://parts/lost.stl")))


def test_edits_of_a_urdf_couple_and_fix_joints_and_let_links_collide_where_they_are_seen(tmp_path):
    write_stl(tmp_path / "m.stl", TETRAHEDRON, FACES)
    more = link("a") + link("b") + joint("ja", "revolute", "tip", "a") + joint("jb", "revolute", "tip", "b")
    text = robot(mesh("m.stl").split("<collision>")[0], more + link("c") + joint("jc", "floating", "a", "c"))
    edits = tmp_path / "edits.yaml"
    edits.write_text("fixed: [jc]\n")
    _, draft = drafted(tmp_path / "1", text.replace("m.stl", str(tmp_path / "m.stl")), edits=edits)
    words = "links that are seen and collide with nothing: upper; `hulls: [LINK]` in --edits of a new draft"
    assert any(remark.startswith(words) for remark in draft.remarks)
    edits.write_text('fixed: ["j*"]\nhulls: [upper]\n')
    folder, draft = drafted(tmp_path / "2", text.replace("m.stl", str(tmp_path / "m.stl")), edits=edits)
    found = RobotDescription.from_files(folder / "mine.urdf")
    assert {name for name, one in found.joints.items() if one.type != "fixed"} == {"shoulder"}
    assert found.links["upper"].collision[0].size == pytest.approx((0.03, 0.02, 0.1))
    assert told(draft) == ()
    edits.write_text("fixed: [jc]\nmimic: {jb: {joint: ja, multiplier: -0.5}}\n")
    folder, _ = drafted(tmp_path / "3", text.replace("m.stl", str(tmp_path / "m.stl")), edits=edits)
    coupled = RobotDescription.from_files(folder / "mine.urdf").joints["jb"]
    assert (coupled.mimic, coupled.multiplier) == ("ja", -0.5)


BOX = '<collision><geometry><box size="0.1 0.2 0.3"/></geometry></collision>'


@pytest.mark.parametrize(
    ("inertial", "mass", "words"),
    [
        ("", 6.0, "no mass: upper; taken as heavy as water, 6 kg together; where it is known, give it in <inertial>"),
        (INERTIA.replace('ixx="0.01"', 'ixx="1"'), 1.0, "an inertia that no body has: upper; taken as that of a box"),
        (INERTIA.replace('"0.01"', '"0"'), 1.0, "an inertia that no body has: upper; taken as that of a box"),
    ],
)
def test_what_moves_is_weighed_where_its_mass_or_inertia_is_none(tmp_path, inertial, mass, words):
    folder, draft = drafted(
        tmp_path, robot(BOX).replace(link("upper", BOX), link("upper", BOX).replace(INERTIA, inertial))
    )
    (remark,) = told(draft)
    assert remark.startswith(words)
    assert folder_faults(folder) == []
    body = import_urdf(RobotDescription.from_files(folder / "mine.urdf")).compile().body("upper")
    assert body.mass[0] == pytest.approx(mass)
    # of a box: m / 12 (b2 + c2)
    moments = mass / 12.0 * np.array([0.2**2 + 0.3**2, 0.1**2 + 0.3**2, 0.1**2 + 0.2**2])
    assert sorted(body.inertia) == pytest.approx(sorted(moments), rel=1e-4)


@pytest.mark.parametrize("span", ['lower="0" upper="0.04"', 'lower="-0.04" upper="0"'])
def test_of_two_equal_fingers_the_second_follows_the_first_as_they_close(tmp_path, span):
    sign = 1.0 if span.startswith('lower="0"') else -1.0
    left = joint("left", "prismatic", "upper", "l", span='lower="0" upper="0.04"')
    right = joint("right", "prismatic", "upper", "r", span=span).replace('"0 1 0"', f'"0 {-sign:g} 0"')
    pad = '<collision name="{}_pad_collision"><origin xyz="0 {} 0"/><geometry><box size="0.01 0.01 0.01"/></geometry>'
    fingers = "".join(link(name, f"{pad.format(name, at)}</collision>") for name, at in (("l", 0.01), ("r", -0.01)))
    arm, gripper, remarks = hand(tmp_path, fingers + left + right)
    assert "'right' is taken to follow 'left', as the other finger of its hand" in remarks
    assert (arm["finger_joint"], arm["fingers"]) == ("left", ["l", "r"])
    assert gripper == {"open": {"arm": 0.04}, "closed": {"arm": 0.0}}
    coupled = RobotDescription.from_files(tmp_path / "robots" / "mine" / "mine.urdf").joints["right"]
    assert (coupled.mimic, coupled.multiplier, coupled.offset) == ("left", sign, 0.0)


def test_a_finger_is_the_part_of_it_that_reaches_farthest(tmp_path):
    box = '<collision><origin xyz="0 0 {}"/><geometry><box size="0.02 0.01 {}"/></geometry></collision>'
    more = joint("left", "prismatic", "upper", "l", span='lower="0" upper="0.04"') + joint(
        "right", "prismatic", "upper", "r", '<mimic joint="left" multiplier="-1"/>', 'lower="-0.04" upper="0"'
    )
    for name in ("l", "r"):
        more += link(name, box.format(0.0, 0.02)) + link(f"{name}_tip", box.format(0.0, 0.06)) + link(f"{name}_frame")
        more += joint(f"{name}_f", "fixed", name, f"{name}_tip") + joint(
            f"{name}_g", "fixed", f"{name}_tip", f"{name}_frame"
        )
    assert hand(tmp_path, more)[0]["fingers"] == ["l_tip", "r_tip"]


def test_what_slides_below_the_arms_is_their_lift(tmp_path):
    column = (
        link("foot")
        + link("column", BOX)
        + joint("rail", "prismatic", "foot", "column", span='lower="0.1" upper="0.5"')
    )
    text = robot(BOX, column + joint("mount", "fixed", "column", "base")).replace('xyz="0 0 0.2"', 'xyz="0 0 0.5"')
    folder, _ = drafted(tmp_path, text)
    assert yaml.safe_load((folder / "robot.yaml").read_text())["lift"] == {"joint": "rail", "home": 0.1}
    assert folder_faults(folder) == []


def test_a_draft_whose_links_touch_at_0_has_another_home(tmp_path):
    elbow = link("fore", BOX) + joint("elbow", "revolute", "tip", "fore", span='lower="-3" upper="3"')
    more = elbow.replace('<origin xyz="0 0 0.2"/>', '<origin xyz="0.3 0 0"/>') + link("end")
    text = robot(BOX, more + joint("end_fixed", "fixed", "fore", "end")).replace(
        link("base"), link("base", BOX.replace("<geometry>", '<origin xyz="0.35 0 0.35"/><geometry>'))
    )
    source = tmp_path / "r.urdf"
    source.write_text(text)
    draft = draft_folder(tmp_path / "mine", source, {"arm": ("base", "end")}, samples=10)
    assert "links touch with all joints at 0; posture 'home' is another, where none do" in draft.remarks
    assert list(yaml.safe_load((tmp_path / "mine" / "semantics.yaml").read_text())["postures"]) == ["home"]
    assert folder_faults(tmp_path / "mine") == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            ('lower="-1" upper="1"', ""),
            "joints without limits, or with one for both, so that they can't move: shoulder; ",
        ),
        (('lower="-1" upper="1"', 'lower="1" upper="1"'), "joints without limits, or with one for both, .*`range: "),
        (("0.1 0.2 0.3", "100 200 300"), "link 'upper' has a shape 300 m long; where it is in mm, write scale="),
    ],
)
def test_a_joint_without_limits_and_a_mesh_in_mm_are_to_do(tmp_path, change, words):
    folder, _ = drafted(tmp_path, robot(BOX).replace(*change))
    assert any(re.match(words, fault) for fault in folder_faults(folder))


def test_links_that_touch_in_nearly_all_states_are_not_checked_and_said(tmp_path):
    ball = '<collision><geometry><sphere radius="0.98"/></geometry></collision>'
    slide = joint("slide", "prismatic", "tip", "fore", span='lower="0" upper="1"')
    more = link("fore", ball) + slide + link("end") + joint("end_fixed", "fixed", "fore", "end")
    text = robot(BOX, more).replace('lower="-1" upper="1"', 'lower="-0.01" upper="0.01"', 1)
    # the ball leaves the box of the base, 0.45 m below it, where it has gone 0.97 m
    (tmp_path / "r.urdf").write_text(text.replace(link("base"), link("base", BOX)))
    draft = draft_folder(tmp_path / "mine", tmp_path / "r.urdf", {"arm": ("base", "end")}, samples=10)
    words = "not checked, since they touch in nearly all states: base and fore; may_touch in semantics.yaml says so"
    assert told(draft) == (words,)
    assert folder_faults(tmp_path / "mine") == []
    assert draft.reasons[frozenset(("base", "fore"))] == "Default"
