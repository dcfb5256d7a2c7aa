# SPDX-License-Identifier: Apache-2.0
"""What the cameras of the simulated robot see, without ROS: frames for the benchmark of the map, and its judge's truth.

Coordinates are in the base frame (`world`), m.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.camera.cameras import CameraConfig, load_cameras, true_mount
from openarm_common.camera.housings import with_housings
from openarm_common.octree.lattice import Lattice
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import Scene
from openarm_common.types import Array
from openarm_octomap.grid import DepthScan
from openarm_octomap.mapper import Frame
from openarm_sim_bridge.cameras.noise import DepthNoiseConfig, add_depth_noise
from openarm_sim_bridge.cameras.renderer import SnapshotRenderer
from openarm_sim_bridge.world.model import compile_model
from openarm_sim_bridge.world.world import Snapshot

SIDES = RobotDescription.load().arm_names

_D435 = DepthNoiseConfig()


@dataclass(frozen=True)
class Visible:
    """Cells of a lattice, (nx, ny, nz).

    Attributes:
        surface: Has a piece of surface that a camera can see, not at a grazing angle.
        solid: Has a piece of something solid.
    """

    surface: NDArray[np.bool_]
    solid: NDArray[np.bool_]


class MapScene:
    """Renders a scene; the robot stands where the joints say, objects where they are put.

    Args:
        scene: Table and objects.
        mount_seed: Seed of the true mounts of the cameras; None is where the configuration says.
    """

    def __init__(self, scene: Scene, mount_seed: int | None = None) -> None:
        self.description = RobotDescription.load()
        self.body = with_housings(self.description, load_cameras().values())  # what is cut out of images
        self.cameras: dict[str, CameraConfig] = {n: c for n, c in load_cameras().items() if c.depth}
        self.mount_seed = mount_seed
        self.model = compile_model(self.description, scene, self.cameras, mount_seed)
        self._data = mujoco.MjData(self.model)
        self._renderer = SnapshotRenderer(self.cameras)
        self.joints: dict[str, float] = {}
        for side in SIDES:
            self.joints |= self.description.group_state(f"{side}_arm", "home")
            self.joints |= {self.description.finger_joint(side): 0.0}
        self._colour = {n: np.empty((c.height, c.width, 3), np.uint8) for n, c in self.cameras.items()}

    def put(self, name: str, position: tuple[float, float, float], yaw: float = 0.0) -> None:
        """Put an object somewhere."""
        at = int(self.model.joint(name).qposadr[0])
        self._data.qpos[at : at + 3] = position
        self._data.qpos[at + 3 : at + 7] = (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))

    def T_base_camera(self, name: str, *, true: bool = False) -> Array:
        """Optical frame of a camera, where the configuration or where the mount seed puts it."""
        camera = self.cameras[name]
        mount = true_mount(camera, self.mount_seed if true else None)
        T_link_optical = se3.inverse(camera.T_parent_link) @ camera.T_parent_optical
        return self.description.link_pose(camera.parent, self.joints) @ mount @ T_link_optical

    def frames(self, t_ns: int, rng: np.random.Generator | None = None, noise: DepthNoiseConfig = _D435) -> list[Frame]:
        """What both cameras see, mm; as noisy as a D435 when there is a generator."""
        self._place_robot()
        self._renderer.load(Snapshot(self.model, t_ns, self._data.qpos.copy()))
        out: list[Frame] = []
        for name, camera in self.cameras.items():
            depth = np.empty((camera.height, camera.width), np.uint16)

            def spoil(_: str, z: NDArray[np.float32], focal: float = camera.intrinsics.fy) -> NDArray[np.float32]:
                return z if rng is None else add_depth_noise(z, focal, noise, rng)

            self._renderer.draw(name, self._colour[name], depth, spoil)
            scan = DepthScan(depth, camera.intrinsics, self.T_base_camera(name), camera.near, camera.far)
            out.append(Frame(name, t_ns, scan, dict(self.joints)))
        return out

    def truth(self, lattice: Lattice) -> Visible:
        """Surfaces of table, floor and objects that a camera sees past the robot, from the geometry itself."""
        self._place_robot()
        mujoco.mj_forward(self.model, self._data)
        surface, solid = np.zeros(lattice.shape, bool), np.zeros(lattice.shape, bool)
        eyes = [(self.T_base_camera(name, true=True), camera) for name, camera in self.cameras.items()]
        for geom in range(self.model.ngeom):
            body = self.model.body(self.model.geom_bodyid[geom]).name
            if body.startswith("openarm_") or self.model.geom_group[geom] > 2:
                continue
            points, normals = _surface_of(self.model, self._data, geom, lattice)
            index = lattice.indices(points)
            inside = lattice.contains(index)
            index, points, normals = index[inside], points[inside], normals[inside]
            # a sample half a millimetre below the surface says which cell the solid is in
            within = lattice.indices(points - 5e-4 * normals)
            within = within[lattice.contains(within)]
            solid[tuple(index.T)] = solid[tuple(within.T)] = True
            seen = np.zeros(len(points), bool)
            for T, camera in eyes:
                seen |= self._sees(T, camera, points, normals)
            surface[tuple(index[seen].T)] = True
        return Visible(surface, solid)

    def _sees(self, T: Array, camera: CameraConfig, points: Array, normals: Array) -> NDArray[np.bool_]:
        """Whether rays from a camera reach points: in the picture, in range, not grazing, nothing before them."""
        local = se3.apply(se3.inverse(T), points)
        pixel = camera.intrinsics.project(local)
        away = points - T[:3, 3]
        distance = np.linalg.norm(away, axis=1)
        facing = -(away * normals).sum(axis=1) / distance
        seen = (local[:, 2] > camera.near) & (local[:, 2] < camera.far) & (facing > 0.25)
        with np.errstate(invalid="ignore"):
            for axis, size in enumerate((camera.width, camera.height)):
                seen &= (pixel[:, axis] > 2) & (pixel[:, axis] < size - 3)
        candidates = np.flatnonzero(seen)
        if not candidates.size:
            return seen
        direction = np.ascontiguousarray(away[candidates] / distance[candidates, None])
        hit, reached = np.zeros(candidates.size, np.int32), np.zeros(candidates.size)
        origin = np.ascontiguousarray(T[:3, 3])
        for i in range(candidates.size):
            one = np.zeros(1, np.int32)
            reached[i] = mujoco.mj_ray(self.model, self._data, origin, direction[i], None, 1, -1, one)
            hit[i] = one[0]
        blocked = (hit >= 0) & (reached < distance[candidates] - 2e-3)
        seen[candidates[blocked]] = False
        return seen

    def _place_robot(self) -> None:
        qpos = self._data.qpos
        for name, joint in self.description.joints.items():
            if joint.type == "fixed":
                continue
            leader = joint.mimic or name
            value = self.joints[leader] * (joint.multiplier if joint.mimic else 1.0) + joint.offset
            qpos[int(self.model.joint(name).qposadr[0])] = value

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()


def _surface_of(
    model: mujoco.MjModel, data: mujoco.MjData, geom: int, lattice: Lattice, step: float = 0.004
) -> tuple[Array, Array]:
    """Samples of the surface of a geom and their outward normals, in the world."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    R, p = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    grids: list[tuple[Array, Array]] = []
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        for axis in range(3):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            u, v = np.meshgrid(_line(size[a], step), _line(size[b], step))
            for sign in (-1.0, 1.0):
                points, normals = np.zeros((u.size, 3)), np.zeros((u.size, 3))
                points[:, a], points[:, b], points[:, axis] = u.ravel(), v.ravel(), sign * size[axis]
                normals[:, axis] = sign
                grids.append((points, normals))
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        angle = np.arange(0.0, 2 * np.pi, step / size[0])
        u, v = np.meshgrid(angle, _line(size[1], step))
        normals = np.stack([np.cos(u).ravel(), np.sin(u).ravel(), np.zeros(u.size)], axis=1)
        grids.append((normals * size[0] + np.stack([np.zeros(u.size), np.zeros(u.size), v.ravel()], axis=1), normals))
        x, y = (w.ravel() for w in np.meshgrid(_line(size[0], step), _line(size[0], step)))
        disc = np.hypot(x, y) <= size[0]
        for sign in (-1.0, 1.0):
            points = np.stack([x[disc], y[disc], np.full(disc.sum(), sign * size[1])], axis=1)
            grids.append((points, np.tile((0.0, 0.0, sign), (len(points), 1))))
    elif kind == mujoco.mjtGeom.mjGEOM_PLANE:
        x, y = np.meshgrid(*(np.arange(lattice.lower[k], lattice.upper[k], step) for k in (0, 1)))
        points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        return points, np.tile((0.0, 0.0, 1.0), (len(points), 1))
    if not grids:
        return np.empty((0, 3)), np.empty((0, 3))
    points, normals = (np.concatenate(part) for part in zip(*grids, strict=True))
    return points @ R.T + p, normals @ R.T


def _line(half: float, step: float) -> Array:
    return np.linspace(-half, half, max(2, int(np.ceil(2.0 * half / step)) + 1))
