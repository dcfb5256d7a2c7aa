# SPDX-License-Identifier: Apache-2.0
"""Random views of the suite's own world for training a detector: robot, table, objects, light, cameras.

One model is compiled; every picture changes postures, sizes, colours, textures, light and mounts in place. World frame:
x forward, y left, z up; m, rad. Boxes are in pixels, left top right bottom; a pixel covers one unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.camera.cameras import CameraConfig, Intrinsics, hand_cameras, load_cameras, table_camera
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_work
from openarm_common.scene.scene import SHAPES, Scene, SceneObject
from openarm_common.types import Array
from openarm_evaluation.detector.appearance import draw_shape, sensor, surface
from openarm_sim_bridge.cameras.renderer import create_gl_context
from openarm_sim_bridge.world.appearance import (
    PATTERNS,
    add_texture,
    colour,
    draw_floor,
    draw_lamps,
    draw_table,
    pattern,
)
from openarm_sim_bridge.world.model import build_spec
from openarm_sim_bridge.world.world import start_qpos

Rng = np.random.Generator

#: Share of the views that are taken from hands.
_FROM_HANDS = 0.35
#: Share of pictures for which no object is drawn.
EMPTY = 0.15
_SLOTS = {"box": 5, "cylinder": 5, "sphere": 4}
_SHEETS, _BARS, _TEXTURES = 3, 3, 9
#: An object is labelled when this share of its silhouette and this many pixels are visible.
_SEEN, _PIXELS = 0.35, 150
#: From the front, back and side edges of the table to the middle of what lies on it, m.
_NEAR_EDGE, _FAR_EDGE, _SIDE_EDGE = 0.03, 0.16, 0.1
_AWAY = (0.0, 0.0, -8.0)


@dataclass(frozen=True)
class Picture:
    """A rendered picture and what is in it.

    Attributes:
        rgb: (h, w, 3) uint8.
        classes: (n,) index in `SHAPES`.
        boxes: (n, 4) left, top, right, bottom of the visible part, pixels.
    """

    rgb: NDArray[np.uint8]
    classes: NDArray[np.int64]
    boxes: Array


@dataclass(frozen=True)
class _Placed:
    """An object of the picture: its geom, its class and its surface as points (n, 3), m."""

    geom: int
    kind: int
    points: Array


class RandomViews:
    """Draws random pictures of the world. One thread.

    Raises:
        OpenArmError: ENVIRONMENT, when there is no OpenGL.
    """

    def __init__(self) -> None:
        self._description = RobotDescription.load()
        self._cameras = load_cameras()
        self._table = robot_work().table
        self._model = self._compile()
        self._data = mujoco.MjData(self._model)
        self._on_hands = hand_cameras()
        share = _FROM_HANDS / max(len(self._on_hands), 1)
        above = {table_camera(): 1.0 - _FROM_HANDS * bool(self._on_hands)} if table_camera() else {}
        self._views = above | dict.fromkeys(self._on_hands, share)
        size = {(self._cameras[name].width, self._cameras[name].height) for name in self._views}
        if len(size) != 1:
            names = ", ".join(self._views) or "none"
            raise OpenArmError(Code.CONFIG_INVALID, f"expected cameras of one size, got {names}: {sorted(size)}")
        self._gl = create_gl_context(*next(iter(size)))
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(self._model, 2000)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False

    def close(self) -> None:
        """Free the OpenGL context."""
        self._context.free()
        self._gl.free()

    def draw(self, rng: Rng) -> Picture:
        """Draw one picture; the same state of the generator gives the same picture."""
        name = str(rng.choice(list(self._views), p=list(self._views.values())))
        camera = self._cameras[name]
        self._light(rng)
        self._surfaces(rng)
        self._pose_robot(rng, name)
        self._mount(rng, camera)
        mujoco.mj_kinematics(self._model, self._data)
        T_world_optical = self._optical(camera)
        self._distract(rng)
        placed = self._fill(rng, name, camera.intrinsics, T_world_optical)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        rgb, geoms = self._render(camera)
        labels = _label(placed, geoms, camera.intrinsics, T_world_optical)
        rgb = sensor(rng, rgb)
        return Picture(
            rgb,
            np.array([kind for kind, _ in labels], np.int64),
            np.array([box for _, box in labels], np.float64).reshape(-1, 4),
        )

    def _compile(self) -> mujoco.MjModel:
        objects = [
            SceneObject(
                name=f"{kind}_{i}",
                label=f"{kind}{i}",
                shape=kind,
                size=(0.05, 0.05, 0.05),
                color="red",
                position=(0.3, 0.0, 1.0),
            )
            for kind in SHAPES
            for i in range(_SLOTS[kind])
        ]
        spec = build_spec(self._description, Scene(table=self._table, objects=tuple(objects)), self._cameras)
        for i in range(_SHEETS + _BARS):
            body = spec.worldbody.add_body(name=f"other_{i}", mocap=True)
            kind = mujoco.mjtGeom.mjGEOM_BOX if i < _SHEETS or i % 2 else mujoco.mjtGeom.mjGEOM_CAPSULE
            body.add_geom(name=f"other_{i}", type=kind, size=(0.03, 0.05, 0.05), group=0)
        rng = np.random.default_rng(11)
        for i in range(_TEXTURES):
            add_texture(spec, f"pattern_{i}", pattern(rng, i % PATTERNS))
            material = spec.add_material(name=f"pattern_{i}", specular=0.05, shininess=0.1)
            material.texrepeat = tuple(rng.uniform(0.5, 4.0, 2))
            material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = f"pattern_{i}"
        return spec.compile()

    # --- environment
    def _light(self, rng: Rng) -> None:
        model, lamps = self._model, draw_lamps(rng, self._model.nlight)
        model.vis.headlight.ambient[:] = lamps.ambient
        model.vis.headlight.diffuse[:] = lamps.diffuse
        model.light_dir[:], model.light_diffuse[:] = lamps.directions, lamps.colors
        model.light_specular[:] = lamps.specular[:, None]

    def _surfaces(self, rng: Rng) -> None:
        model = self._model
        top = model.geom("table_top").id
        kind, tint = draw_table(rng, _TEXTURES)
        model.geom_matid[top] = model.material("table" if kind is None else f"pattern_{kind}").id
        model.geom_rgba[top] = (0.5, 0.5, 0.5, 1.0)  # the default: anything else would override the material
        model.mat_rgba[model.geom_matid[top]] = (*tint, 1.0)
        model.geom_rgba[model.geom("floor").id, :3] = draw_floor(rng)

    def _pose_robot(self, rng: Rng, camera: str) -> None:
        description = self._description
        joints: dict[str, float] = {}
        for side in description.arm_names:
            observes = self._cameras[camera].parent in description.links_of(side)
            state = description.group_state(f"{side}_arm", "wrist_look" if observes else "home")
            spread = 0.10 if observes else 0.05 if rng.random() < 0.55 else 0.5
            joints |= {name: state[name] + float(rng.normal(0.0, spread)) for name in description.arm_joints(side)}
            hand = description.hand(side)
            joints[hand.joint] = hand.position(float(rng.uniform(0.0, hand.parts.opening)))
        self._data.qpos[:] = start_qpos(self._model, joints)

    def _mount(self, rng: Rng, camera: CameraConfig) -> None:
        """The nominal mount, off by up to a few centimetres and degrees."""
        model, index = self._model, self._model.camera(camera.name).id
        T = camera.T_parent_optical @ se3.make(se3.exp_so3(rng.normal(0.0, 0.04, 3)), rng.normal(0.0, 0.02, 3))
        model.cam_pos[index] = T[:3, 3]
        model.cam_quat[index] = np.roll(se3.quat_xyzw_from_matrix(T[:3, :3] @ se3.rot_x(math.pi)[:3, :3]), 1)

    def _optical(self, camera: CameraConfig) -> Array:
        model, data = self._model, self._data
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        index = model.camera(camera.name).id
        R = data.cam_xmat[index].reshape(3, 3) @ se3.rot_x(math.pi)[:3, :3]
        return se3.make(R, data.cam_xpos[index])

    def _distract(self, rng: Rng) -> None:
        """Sheets of paper, which are coloured but no objects, and grey bars in the air."""
        for i in range(_SHEETS + _BARS):
            body, geom = self._model.body(f"other_{i}"), self._model.geom(f"other_{i}").id
            slot = int(body.mocapid[0])
            if rng.random() > 0.25:
                self._data.mocap_pos[slot] = _AWAY
                continue
            turn = se3.rot_z(rng.uniform(-math.pi, math.pi))[:3, :3]
            if i < _SHEETS:
                half = (*rng.uniform(0.02, 0.09, 2), 0.0005)
                position = (*self._spot(rng), self._table.top_z + 0.0005 * (i + 1))
                color = colour(rng)
            else:
                half = (rng.uniform(0.012, 0.04), rng.uniform(0.03, 0.2), rng.uniform(0.012, 0.08))
                position = (*self._spot(rng), self._table.top_z + rng.uniform(0.18, 0.35))
                turn = se3.exp_so3(rng.normal(0.0, 1.5, 3))
                color = np.repeat(rng.uniform(0.05, 0.7), 3)
            self._resize(geom, np.array(half))
            self._model.geom_rgba[geom, :3] = color
            self._data.mocap_pos[slot] = position
            self._data.mocap_quat[slot] = np.roll(se3.quat_xyzw_from_matrix(turn), 1)

    def _spot(self, rng: Rng) -> tuple[float, float]:
        (front, back), (right, left) = self._table.x, self._table.y
        x = rng.uniform(round(front + _NEAR_EDGE, 3), round(back - _FAR_EDGE, 3))
        return float(x), float(rng.uniform(round(right + _SIDE_EDGE, 3), round(left - _SIDE_EDGE, 3)))

    # --- objects
    def _fill(self, rng: Rng, view: str, lens: Intrinsics, T_world_optical: Array) -> list[_Placed]:
        model, data = self._model, self._data
        for kind, count in _SLOTS.items():
            for i in range(count):
                start = model.joint(f"{kind}_{i}").qposadr[0]
                data.qpos[start : start + 7] = (*_AWAY, 1.0, 0.0, 0.0, 0.0)
        wanted = 0 if rng.random() < EMPTY else int(rng.integers(1, 7))
        used = dict.fromkeys(_SLOTS, 0)
        taken: list[tuple[float, float, float]] = []
        placed: list[_Placed] = []
        for _ in range(wanted):
            kind = str(rng.choice(list(_SLOTS)))
            half, R = draw_shape(rng, kind)
            reach = float(np.hypot(*(np.abs(R[:2]) @ half))) if kind == "box" else float((np.abs(R[:2]) @ half).max())
            spot = self._free_spot(rng, reach, taken, lens, T_world_optical, inside=view in self._on_hands)
            if spot is None or used[kind] == _SLOTS[kind]:
                continue
            taken.append((*spot, reach))
            name = f"{kind}_{used[kind]}"
            used[kind] += 1
            low = surface(kind, half) @ R.T
            position = np.array([*spot, self._table.top_z - low[:, 2].min()])
            start = model.joint(name).qposadr[0]
            data.qpos[start : start + 7] = (*position, *np.roll(se3.quat_xyzw_from_matrix(R), 1))
            geom = model.geom(name).id
            self._resize(geom, half if kind == "box" else np.array([half[0], half[2], 0.0]))
            model.geom_rgba[geom, :3] = colour(rng)
            placed.append(_Placed(geom, SHAPES.index(kind), low + position))
        return placed

    def _free_spot(
        self,
        rng: Rng,
        reach: float,
        taken: list[tuple[float, float, float]],
        lens: Intrinsics,
        T_world_optical: Array,
        *,
        inside: bool,
    ) -> tuple[float, float] | None:
        """Find a free place on the table, in the picture if `inside`; None after many tries."""
        for _ in range(60):
            spot = self._spot(rng)
            if any(math.hypot(spot[0] - x, spot[1] - y) < reach + other for x, y, other in taken):
                continue
            if inside:
                point = se3.apply(se3.inverse(T_world_optical), np.array([*spot, self._table.top_z + 0.03]))
                u, v = lens.project(point)
                if not (0 <= u < lens.width and 0 <= v < lens.height):
                    continue
            return spot
        return None

    def _resize(self, geom: int, size: Array) -> None:
        self._model.geom_size[geom] = size
        self._model.geom_rbound[geom] = float(np.linalg.norm(size)) + 0.01

    # --- drawing
    def _render(self, camera: CameraConfig) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        """Colour, and the geom of every pixel (-1: none)."""
        view = mujoco.MjvCamera()
        view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, self._model.camera(camera.name).id
        self._gl.make_current()
        scene, rect = self._scene, mujoco.MjrRect(0, 0, camera.width, camera.height)
        mujoco.mjv_updateScene(
            self._model, self._data, mujoco.MjvOption(), None, view, mujoco.mjtCatBit.mjCAT_ALL, scene
        )
        images: list[NDArray[np.uint8]] = []
        for segmented in (False, True):
            scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = segmented
            scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = segmented
            mujoco.mjr_render(rect, scene, self._context)
            image = np.empty((camera.height, camera.width, 3), np.uint8)
            mujoco.mjr_readPixels(image, None, rect, self._context)
            images.append(np.ascontiguousarray(image[::-1]))
        scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = False
        number = images[1].astype(np.int64) @ np.array([1, 256, 65536])
        geoms = np.full(scene.ngeom + 1, -1, np.int64)
        for i in range(scene.ngeom):
            geom = scene.geoms[i]
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.segid >= 0:
                geoms[geom.segid + 1] = geom.objid
        return images[0], geoms[number]


def _label(
    placed: list[_Placed], geoms: NDArray[np.int64], lens: Intrinsics, T_world_optical: Array
) -> list[tuple[int, tuple[int, int, int, int]]]:
    """Return class and box of every object that is visible enough to be labelled."""
    labels: list[tuple[int, tuple[int, int, int, int]]] = []
    T_optical_world = se3.inverse(T_world_optical)
    for item in placed:
        v, u = np.nonzero(geoms == item.geom)
        outline = lens.project(se3.apply(T_optical_world, item.points))
        if len(u) < _PIXELS or not np.isfinite(outline).all():
            continue
        silhouette = float(cv2.contourArea(cv2.convexHull(outline.astype(np.float32))))
        if len(u) >= _SEEN * silhouette:
            labels.append((item.kind, (int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1)))
    return labels
