# SPDX-License-Identifier: Apache-2.0
"""Drawing what the cameras see, from snapshots of single control ticks.

Depth is planar: the distance along the optical axis, not along the ray. It is given in whole millimetres (uint16) with
0 where nothing lies between the near and far limit of the camera, as a RealSense camera does, or in metres (float32)
with NaN there. Row 0 of an image is the top.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.cameras import CameraConfig
from openarm_common.camera.depth_view import millimetres
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Floats
from openarm_sim_bridge.world.world import Snapshot

Colour = NDArray[np.uint8]
Depth = NDArray[np.uint16] | NDArray[np.float32]
#: From the name of a camera and its clean depth to the measured one.
DepthNoise = Callable[[str, NDArray[np.float32]], NDArray[np.float32]]

_ADVICE = (
    "install a software renderer (Debian, Ubuntu: libegl1 libgl1 libegl-mesa0, or libosmesa6) and leave MUJOCO_GL"
    " unset, or set it to egl or osmesa"
)
_MAX_GEOMS = 2000


def create_gl_context(width: int, height: int) -> Any:
    """Make an off-screen OpenGL context of the calling thread, current.

    The backend is that of MUJOCO_GL (egl or osmesa); when it is not set, EGL is tried first and OSMesa second.

    Args:
        width: Width of the largest image, pixels.
        height: Height of the largest image, pixels.

    Raises:
        OpenArmError: ENVIRONMENT, with what failed and what to install.
    """
    # One rasteriser thread: more of them compete with the physics for the cores and are hardly faster.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    if wanted not in ("", "egl", "osmesa"):
        raise OpenArmError(
            Code.ENVIRONMENT,
            f"MUJOCO_GL is {wanted!r}, but images are drawn off screen; unset it, or use egl or osmesa",
        )
    failures: list[str] = []
    for backend in (wanted,) if wanted else ("egl", "osmesa"):
        try:
            context = _context_class(backend)(width, height)
            context.make_current()
        # PyOpenGL raises what its backends happen to: import, attribute, type, run-time and its own errors.
        except Exception as error:
            failures.append(f"{backend}: {type(error).__name__}: {error}")
        else:
            return context
    raise OpenArmError(Code.ENVIRONMENT, f"no off-screen OpenGL context ({'; '.join(failures)}); {_ADVICE}")


def _context_class(backend: str) -> Any:
    if backend == "egl":
        from mujoco.egl import GLContext
    else:
        from mujoco.osmesa import GLContext
    return GLContext


class SnapshotRenderer:
    """Draws snapshots; belongs to the thread that made it.

    Args:
        cameras: Cameras by the names that they have in the model.

    Raises:
        OpenArmError: ENVIRONMENT, when there is no OpenGL.
    """

    def __init__(self, cameras: Mapping[str, CameraConfig]) -> None:
        self._cameras = dict(cameras)
        width = max(camera.width for camera in cameras.values())
        height = max(camera.height for camera in cameras.values())
        self._gl = create_gl_context(width, height)
        self._option = mujoco.MjvOption()
        self._drawn: _Drawn | None = None
        self._colour = {name: np.empty((c.height, c.width, 3), np.uint8) for name, c in cameras.items()}
        self._depth = {name: np.empty((c.height, c.width), np.float32) for name, c in cameras.items() if c.depth}

    def load(self, snapshot: Snapshot) -> None:
        """Take the state to draw.

        Raises:
            OpenArmError: CONFIG_INVALID, when the model lacks a camera or its image is too large for the model.
        """
        self._gl.make_current()  # another renderer of this thread may have been closed, which leaves none current
        if self._drawn is None or self._drawn.model is not snapshot.model:
            if self._drawn is not None:
                self._drawn.context.free()
            self._drawn = _Drawn(snapshot.model, self._cameras)
        drawn = self._drawn
        drawn.data.qpos[:] = snapshot.qpos
        mujoco.mj_kinematics(drawn.model, drawn.data)
        mujoco.mj_comPos(drawn.model, drawn.data)
        mujoco.mj_camlight(drawn.model, drawn.data)

    def draw(self, name: str, colour: Colour, depth: Depth | None = None, noise: DepthNoise | None = None) -> None:
        """Draw one camera's view of the loaded state: colour and depth from one pass.

        Args:
            name: Name of the camera.
            colour: (height, width, 3), filled.
            depth: (height, width), filled with mm (uint16) or m (float32); None when it is not wanted.
            noise: Makes the depth (m, NaN where invalid, before rounding) as noisy as a real camera's.
        """
        drawn = self._drawn
        if drawn is None:
            raise OpenArmError(Code.INTERNAL, "draw was called before load")
        camera, rect = self._cameras[name], drawn.rects[name]
        mujoco.mjv_updateScene(
            drawn.model, drawn.data, self._option, None, drawn.cameras[name], mujoco.mjtCatBit.mjCAT_ALL, drawn.scene
        )
        drawn.leave_out(drawn.cameras[name].fixedcamid, camera.width / camera.height)
        mujoco.mjr_render(rect, drawn.scene, drawn.context)
        raw = self._depth[name] if depth is not None else None
        mujoco.mjr_readPixels(self._colour[name], raw, rect, drawn.context)
        np.copyto(colour, self._colour[name][::-1])  # OpenGL's first row is the bottom
        if depth is not None and raw is not None:
            z = planar_metres(raw, drawn.near, drawn.far)
            z[(z < camera.near) | (z > camera.far)] = np.nan
            if noise is not None:
                z = noise(name, z)
            np.copyto(depth, (millimetres(z) if depth.dtype == np.uint16 else z)[::-1])

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._drawn is not None:
            self._drawn.context.free()
            self._drawn = None
        self._gl.free()


def planar_metres(raw: Floats, near: float, far: float) -> Floats:
    """Convert a reversed depth buffer to distances along the optical axis, m, in place.

    Args:
        raw: Depth buffer: 1 at the near plane, 0 at the far plane.
        near: Near clipping plane, m.
        far: Far clipping plane, m.
    """
    # z = f n / (raw (f - n) + n); float32 is good for a micrometre at 1 m because the buffer is reversed.
    np.multiply(raw, np.float32(far - near), out=raw)
    np.add(raw, np.float32(near), out=raw)
    return np.divide(np.float32(far * near), raw, out=raw)


class _Drawn:
    """What belongs to one model: it is made again when the world is exchanged."""

    def __init__(self, model: mujoco.MjModel, cameras: Mapping[str, CameraConfig]) -> None:
        self.model = model
        self.data = mujoco.MjData(model)
        self.cameras = {name: _fixed_camera(model, name, camera) for name, camera in cameras.items()}
        self.rects = {name: mujoco.MjrRect(0, 0, camera.width, camera.height) for name, camera in cameras.items()}
        self.context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self.context)
        self.context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self.scene = mujoco.MjvScene(model, _MAX_GEOMS)
        # Shadows double the cost of software rendering, reflections too; neither says anything about depth.
        self.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self.near = float(model.vis.map.znear * model.stat.extent)  # clipping planes, m
        self.far = float(model.vis.map.zfar * model.stat.extent)

    def leave_out(self, camera: int, aspect: float) -> None:
        """Leave out of the scene what lies wholly outside the view: MuJoCo would have OpenGL clip its triangles.

        A wrist camera sees the hand alone of a robot of 65,000 triangles, and spares a third of its time.

        Args:
            camera: Index in the model.
            aspect: Width over height of the image.
        """
        # in the frame of the camera: x right, y up, z backward
        centres = (self.data.geom_xpos - self.data.cam_xpos[camera]) @ self.data.cam_xmat[camera].reshape(3, 3)
        radii = self.model.geom_rbound  # 0 of planes, which have no end
        slope_y = np.tan(0.5 * np.deg2rad(self.model.cam_fovy[camera]))
        outside = centres[:, 2] > radii
        for axis, slope in ((0, slope_y * aspect), (1, slope_y)):
            outside |= np.abs(centres[:, axis]) + slope * centres[:, 2] > radii * np.hypot(1.0, slope)
        hidden = (outside & (radii > 0.0)).tolist()
        for geom in self.scene.geoms[: self.scene.ngeom]:
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and hidden[geom.objid]:
                geom.type = mujoco.mjtGeom.mjGEOM_NONE


def _fixed_camera(model: mujoco.MjModel, name: str, camera: CameraConfig) -> mujoco.MjvCamera:
    identity = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name)
    buffer = model.vis.global_
    if identity < 0 or camera.width > buffer.offwidth or camera.height > buffer.offheight:
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"camera {name!r} of {camera.width}×{camera.height} pixels: the model has"
            f" {', '.join(model.camera(i).name for i in range(model.ncam)) or 'no cameras'} and an off-screen"
            f" buffer of {buffer.offwidth}×{buffer.offheight}",
        )
    view = mujoco.MjvCamera()
    view.type = mujoco.mjtCamera.mjCAMERA_FIXED
    view.fixedcamid = identity
    return view
