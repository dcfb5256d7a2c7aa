# SPDX-License-Identifier: Apache-2.0
"""Objects of any shape in the world: they stand still, have their mass, come and go, and are seen as they are."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from openarm_common.objects.model import load_object, object_names
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_work
from openarm_common.scene.scene import Scene, SceneObject, parse_scene
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.object_meshes import texture_picture
from openarm_sim_bridge.world.stage import Stage, with_object
from tests.refusals import refused


@pytest.fixture(scope="module")
def stage() -> Stage:
    return Stage(RobotDescription.load(), {}, None, PhysicsConfig())


def mesh(source: str, k: int = 0, **keys) -> dict:
    place = [0.25 + 0.14 * (k % 4), -0.42 + 0.21 * (k // 4)]
    return {"name": f"it_{k}", "label": f"it {k}", "shape": "mesh", "object": source, "position": place} | keys


#: Things that differ: hollow, many parts, round, pointed, long.
STILL = ("mug", "egg", "pear", "screwdriver", "goblet", "superquadric:3", "torus", "spray_bottle", "duck")


@pytest.mark.long
def test_objects_stand_still_for_two_seconds(stage) -> None:
    """On the side that is second in frequency, where they have one."""
    items = [mesh(s, k, side=min(1, len(load_object(s).sides) - 1), yaw=0.4 * k) for k, s in enumerate(STILL)]
    for k, item in enumerate(items):
        item["position"] = [0.3 + 0.26 * (k // 4), -0.42 + 0.28 * (k % 4)]
    table = robot_work().table.model_copy(update={"x": (0.11, 1.4), "y": (-0.7, 0.7)})
    world = stage.world(Scene(table=table, objects=tuple(SceneObject.model_validate(item) for item in items)))
    before = {item.object.name: item.T_world_object for item in world.objects()}
    world.step(1000)
    for item in world.objects():
        moved = np.linalg.norm(item.T_world_object[:3, 3] - before[item.object.name][:3, 3])
        assert moved < 1e-3, (item.object.object, moved)
        assert np.linalg.norm(item.linear) < 1e-3, item.object.object
        assert np.linalg.norm(item.angular) < 0.03, item.object.object


def test_an_object_has_its_mass_in_parts_and_is_seen_as_one_geom(stage) -> None:
    scene = parse_scene({"objects": [mesh("hammer", mass=0.3)]}, "here")
    world = stage.world(scene)
    model, data = world.model, world.data
    body = model.body("it_0").id
    assert model.body_mass[body] == pytest.approx(0.3)
    geoms = np.flatnonzero(model.geom_bodyid == body)
    assert len(geoms) == 1 + len(load_object("hammer").parts)
    seen = model.geom_contype[geoms] == 0
    assert seen.sum() == 1
    assert set(model.geom_group[geoms[~seen]]) == {3}
    assert np.allclose(model.geom_friction[geoms[~seen], 0], 0.6)
    # the centre of mass is where that of the parts is
    posed = scene.objects[0].posed
    centre = posed.T_box_object @ np.array([*posed.model.centre_of_mass, 1.0])
    expected = scene.objects[0].T_world_object(scene.table) @ centre
    np.testing.assert_allclose(data.xipos[body], expected[:3], atol=1e-5)


@pytest.mark.long
def test_an_object_is_spawned_and_taken_out_while_the_world_runs(stage) -> None:
    scene = parse_scene({"objects": [mesh("mug")]}, "here")
    world = stage.world(scene)
    world.step(100)
    more = with_object(scene, mesh("superquadric:7", 5, mass=0.0))
    world.extend(stage.compile(world, more))
    world.step(500)
    assert [item.object.object for item in world.objects()] == ["mug", "superquadric:7"]
    assert world.object("it_5").T_world_object[2, 3] == pytest.approx(0.4 + 0.5 * more.objects[1].size[2], abs=1e-3)
    refused("no object 'nothing'", with_object, scene, mesh("nothing", 5))
    refused("already", with_object, scene, mesh("mug"))


def test_a_request_to_spawn_says_which_object_and_side() -> None:
    pytest.importorskip("openarm_interfaces")
    from geometry_msgs.msg import PoseStamped, Vector3

    from openarm_sim_bridge.ros.simulation_server import _object_of

    pose = PoseStamped()
    pose.pose.position.x, pose.pose.position.y, pose.pose.orientation.w = 0.3, -0.2, 1.0
    request = SimpleNamespace(
        name="it", shape="mesh", object="mug", side=1, size=Vector3(), color="", mass=0.0, pose=pose
    )
    item = SceneObject.model_validate(_object_of(request, 0.4))
    assert (item.object, item.side, item.mass) == ("mug", 1, 0.32)
    assert item.position == pytest.approx((0.3, -0.2, 0.4 + 0.5 * item.size[2]))


def test_a_label_is_drawn_the_right_way_up(stage) -> None:
    """The carton has a blue band at its bottom, and its roof is white."""
    carton = load_object("carton")
    assert carton.texture is not None
    picture, uv = texture_picture(carton.texture), carton.visual.uv
    corner = carton.visual.uv_triangles[:, 0]
    z = carton.visual.vertices[carton.visual.triangles[:, 0], 2]
    low = uv[corner[np.argmin(z)]]
    row, column = int(low[1] * picture.shape[0]), int(low[0] * picture.shape[1])
    red, _, blue = picture[row, column].astype(int)
    assert blue > red + 50


def test_appearance_changes_light_table_and_paper_and_nothing_else(stage) -> None:
    def model(seed: int | None) -> mujoco.MjModel:
        told = {"objects": [mesh("mug")]} | ({} if seed is None else {"appearance": seed})
        return stage.world(parse_scene(told, "here")).model

    plain, one, same, other = model(None), model(1), model(1), model(2)
    assert np.array_equal(one.light_dir, same.light_dir)
    assert not np.array_equal(one.light_dir, other.light_dir)
    assert not np.array_equal(one.mat_rgba, other.mat_rgba)
    touching = [m.geom_contype.astype(bool).sum() for m in (plain, one, other)]
    assert touching[0] == touching[1] == touching[2]


def test_textures_that_are_none_are_refused(tmp_path) -> None:
    path = tmp_path / "texture.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\nnothing")
    refused("no PNG or JPEG that can be read", texture_picture, path)
    assert all(texture_picture(load_object(name).texture).shape[2] == 3 for name in object_names()[:3])  # type: ignore
