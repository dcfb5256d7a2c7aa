# SPDX-License-Identifier: Apache-2.0
"""The environment of the robot in MuJoCo: floor, light, table, objects, cameras.

World frame: x forward, y left, z up; metres. Everything but the objects is without a hue, so that the colour detector
finds objects only, and no light throws a shadow: an arm's would wander over the object region, and shadows double the
cost of an image.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import mujoco
import numpy as np

from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL, CameraConfig, true_mount
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import models_dir
from openarm_common.robot.work import Table
from openarm_common.scene.scene import Fixture, SceneObject
from openarm_sim_bridge.world.object_meshes import add_mesh

_TABLE_RGBA = (0.80, 0.785, 0.76, 1.0)
_FLOOR_RGBA = (0.48, 0.48, 0.49, 1.0)  # plain: a texture that fills half of an image doubles the cost of drawing it
_LEG_RGBA = (0.30, 0.30, 0.31, 1.0)
_HOUSING_RGBA = (0.13, 0.13, 0.14, 1.0)
_LENS_RGBA = (0.02, 0.02, 0.02, 1.0)
_ROUND = 16  # facets of a sphere from pole to pole
_LEG = 0.02  # half the edge of a table leg, m
#: Clipping planes of every camera, m; the near one lies before anything that a camera reports.
NEAR, FAR = 0.02, 20.0
#: A MuJoCo camera looks along -z with y up, an optical frame along z with y down.
_T_OPTICAL_MUJOCO = se3.make(se3.rot_x(math.pi))


def add_environment(spec: mujoco.MjSpec, contact: Mapping[str, Any]) -> None:
    """Add floor, sky and light."""
    visual = spec.visual
    visual.headlight.ambient = (0.38, 0.38, 0.38)
    visual.headlight.diffuse = (0.22, 0.22, 0.22)
    visual.headlight.specular = (0.05, 0.05, 0.05)
    visual.quality.offsamples = 0
    # Plain boxes and cylinders: the default facets (16 stacks, 4 quads) cost a software renderer a third of its time.
    visual.quality.numstacks = 4
    visual.quality.numquads = 1
    # With an extent of one metre the map's near and far are metres too.
    spec.stat.extent = 1.0
    spec.stat.center = (0.25, 0.0, 0.5)
    visual.map.znear = NEAR
    visual.map.zfar = FAR
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.93, 0.93, 0.93),
        rgb2=(0.55, 0.55, 0.56),
        width=64,
        height=384,
    )
    world = spec.worldbody
    world.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(4.0, 4.0, 0.1), rgba=_FLOOR_RGBA, group=0, **contact
    )
    for name, direction, strength in (("key", (-0.65, 0.35, -1.0), 0.5), ("fill", (-0.3, -0.8, -0.5), 0.22)):
        world.add_light(
            name=name,
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=(1.5, 0.0, 2.5),
            dir=direction,
            diffuse=(strength,) * 3,
            specular=(0.25 * strength,) * 3,
            castshadow=False,
        )


def add_table(spec: mujoco.MjSpec, table: Table, contact: Mapping[str, Any]) -> None:
    """Add the body `table`, its origin in the middle of the top's surface.

    Args:
        spec: Model that is extended.
        table: The table.
        contact: Geom attributes of its top.
    """
    x, y = table.centre
    length, width, thickness = table.extents
    spec.add_material(name="table", rgba=_TABLE_RGBA, specular=0.05, shininess=0.1)
    body = spec.worldbody.add_body(name="table", pos=(x, y, table.top_z))
    body.add_geom(
        name="table_top",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(0.0, 0.0, -thickness / 2.0),
        size=(length / 2.0, width / 2.0, thickness / 2.0),
        material="table",
        group=0,
        **contact,
    )
    height = table.top_z - thickness
    if height <= 0.0:
        return
    for along, x_sign in (("front", -1.0), ("back", 1.0)):
        for across, y_sign in (("right", -1.0), ("left", 1.0)):
            body.add_geom(
                name=f"table_leg_{along}_{across}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=(
                    x_sign * max(length / 2.0 - 2.0 * _LEG, 0.0),
                    y_sign * max(width / 2.0 - 2.0 * _LEG, 0.0),
                    -thickness - height / 2.0,
                ),
                size=(_LEG, _LEG, height / 2.0),
                rgba=_LEG_RGBA,
                group=0,
            )


def add_object(spec: mujoco.MjSpec, item: SceneObject, table: Table, contact: Mapping[str, Any], condim: int) -> None:
    """Add a free body; body and joint carry the object's name.

    Args:
        spec: Model that is extended.
        item: The object.
        table: Table on which it is placed where it has no height.
        contact: Geom attributes.
        condim: Contact dimensions.
    """
    body = spec.worldbody.add_body(
        name=item.name, pos=item.centre(table), quat=(math.cos(item.yaw / 2.0), 0.0, 0.0, math.sin(item.yaw / 2.0))
    )
    body.add_freejoint(name=item.name)
    if item.shape == "mesh":
        add_mesh(spec, body, item, contact, condim)
        return
    x, y, z = item.size
    if item.shape == "cylinder":
        kind, size = mujoco.mjtGeom.mjGEOM_CYLINDER, (x / 2.0, z / 2.0, 0.0)
    elif item.shape == "sphere":
        kind, size = mujoco.mjtGeom.mjGEOM_SPHERE, (x / 2.0, 0.0, 0.0)
        spec.visual.quality.numstacks = _ROUND  # the facets of `add_environment` would make a double cone of it
    else:
        kind, size = mujoco.mjtGeom.mjGEOM_BOX, (x / 2.0, y / 2.0, z / 2.0)
    body.add_geom(
        name=item.name, type=kind, size=size, mass=item.mass_kg, rgba=item.rgba, condim=condim, group=1, **contact
    )


def add_fixture(spec: mujoco.MjSpec, item: Fixture) -> None:
    """Add the body of an MJCF file, fixed to a link or to the world; all its names begin with the fixture's.

    Raises:
        OpenArmError: CONFIG_INVALID, when the link or the file does not exist, or the file is no MJCF of one body.
    """
    parent = _parent(spec, item.link or "world", f"fixture {item.name!r}")
    path = models_dir() / item.model
    if not path.is_file():
        raise OpenArmError(Code.CONFIG_INVALID, f"fixture {item.name!r}: there is no file {path}")
    try:
        child = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise OpenArmError(
            Code.CONFIG_INVALID, f"fixture {item.name!r}: MuJoCo does not read {path}: {error}"
        ) from error
    body = child.worldbody.first_body()
    if body is None:
        raise OpenArmError(Code.CONFIG_INVALID, f"fixture {item.name!r}: {path} has no body")
    parent.add_frame(**_pose(item.T_link_fixture)).attach_body(body, f"{item.name}_", "")


def add_cameras(spec: mujoco.MjSpec, cameras: Iterable[CameraConfig], mount_seed: int | None) -> None:
    """Add cameras at their true mounts, with their housings right behind the lens.

    Args:
        spec: Model that is extended.
        cameras: Cameras with nominal mounts.
        mount_seed: Seed of the mount errors; None is the nominal mounts.

    Raises:
        OpenArmError: CONFIG_INVALID, when a parent is not a link of the robot.
    """
    offscreen = spec.visual.global_
    for camera in cameras:
        parent = _parent(spec, camera.parent, f"camera {camera.name!r}")
        T_parent_link = true_mount(camera, mount_seed)
        parent.add_camera(
            name=camera.name,
            **_pose(T_parent_link @ T_LINK_OPTICAL @ _T_OPTICAL_MUJOCO),
            fovy=camera.fovy_deg,
            resolution=(camera.width, camera.height),
        )
        offscreen.offwidth = max(offscreen.offwidth, camera.width)
        offscreen.offheight = max(offscreen.offheight, camera.height)
        if camera.housing is not None:
            _add_housing(parent, camera.name, camera.housing, T_parent_link, camera.T_link_housing)


def _add_housing(
    parent: Any, name: str, housing: tuple[float, float, float], T_parent_link: se3.Array, T_link_housing: se3.Array
) -> None:
    """Add a box with its front face just behind the lens; it collides like a part of the link that carries it."""
    depth, width, height = housing
    parent.add_geom(
        name=f"{name}_housing",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        **_pose(T_parent_link @ T_link_housing),
        size=(depth / 2.0, width / 2.0, height / 2.0),
        rgba=_HOUSING_RGBA,
        mass=0.0,
        group=2,
    )
    T_parent_lens = T_parent_link @ se3.make(se3.rot_y(math.pi / 2.0), (-0.0015, 0.0, 0.0))
    parent.add_geom(
        name=f"{name}_lens",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        **_pose(T_parent_lens),
        size=(min(width, height) * 0.35, 0.001, 0.0),
        rgba=_LENS_RGBA,
        mass=0.0,
        contype=0,
        conaffinity=0,
        group=2,
    )


def _parent(spec: mujoco.MjSpec, link: str, what: str) -> Any:
    """Return the body of a link; `what` begins the error when there is none."""
    body = spec.body(link)
    if body is None:
        names = ", ".join(body.name for body in spec.bodies)
        raise OpenArmError(Code.CONFIG_INVALID, f"{what}: no link {link!r}; links: {names}")
    return body


def _pose(T: se3.Array) -> dict[str, se3.Array]:
    """Return position and quaternion as MuJoCo's elements take them."""
    return {"pos": T[:3, 3], "quat": np.roll(se3.quat_xyzw_from_matrix(T[:3, :3]), 1)}
