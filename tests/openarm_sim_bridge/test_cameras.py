# SPDX-License-Identifier: Apache-2.0
"""Cameras: planar depth, geometry of the image, and what is said where nothing can be drawn."""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from openarm_common import se3
from openarm_common.camera.cameras import CameraConfig, load_cameras
from openarm_common.camera.depth_view import millimetres
from openarm_common.errors import Code
from openarm_sim_bridge.cameras.renderer import SnapshotRenderer, create_gl_context, planar_metres
from openarm_sim_bridge.world.world import Snapshot
from tests.refusals import refuses

CAMERA = CameraConfig(
    name="eye",
    parent="world",
    position=(0, 0, 1),
    forward=(0, 0, -1),
    image_right=(0, -1, 0),
    width=320,
    height=240,
    near=0.1,
    far=3.0,
)
#: A camera 1 m above a plane, tilted by 30 degrees about its image's horizontal axis; MuJoCo looks along -z with y up.
MODEL = """
<mujoco><compiler angle="radian"/><statistic extent="1"/><visual><map znear="0.02" zfar="20"/>
<quality offsamples="0" numslices="64" numstacks="64"/>
<global offwidth="640" offheight="480"/></visual><worldbody><light pos="0 0 3" castshadow="false"/>
<geom type="plane" size="5 5 .1" rgba=".5 .5 .5 1"/>
<body name="ball" pos="{x} {y} {z}"><freejoint/><geom type="sphere" size="{r}" rgba="1 0 0 1"/></body>
<camera name="eye" pos="0 0 1" euler="{tilt} 0 0" fovy="60"/></worldbody></mujoco>"""


def snapshot(
    tilt: float = 0.0, ball: tuple[float, float, float] = (50.0, 0.0, 1.0), radius: float = 0.01, t_ns: int = 0
) -> Snapshot:
    x, y, z = ball
    model = mujoco.MjModel.from_xml_string(MODEL.format(tilt=tilt, x=x, y=y, z=z, r=radius))
    return Snapshot(model, t_ns, model.qpos0.copy())


def pose_of(state: Snapshot) -> np.ndarray:
    """T_world_optical of the model's camera: z forward, x right, y down."""
    data = mujoco.MjData(state.model)
    mujoco.mj_forward(state.model, data)
    R = data.camera("eye").xmat.reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
    return se3.make(R, data.camera("eye").xpos)


@pytest.fixture(scope="module")
def renderer() -> Iterator[SnapshotRenderer]:
    out = SnapshotRenderer({"eye": CAMERA})
    yield out
    out.close()


def draw(renderer: SnapshotRenderer, state: Snapshot) -> tuple[np.ndarray, np.ndarray]:
    colour, depth = np.empty((240, 320, 3), np.uint8), np.empty((240, 320), np.uint16)
    renderer.load(state)
    renderer.draw("eye", colour, depth)
    return colour, depth


@pytest.mark.parametrize("tilt", [0.0, 0.5])
@pytest.mark.requirement("A-28", "A-29")
def test_depth_is_planar_within_a_millimetre(renderer: SnapshotRenderer, tilt: float) -> None:
    state = snapshot(tilt)
    _, depth = draw(renderer, state)
    T = pose_of(state)
    v, u = np.mgrid[0:240, 0:320]
    rays = CAMERA.intrinsics.deproject(np.stack([u, v], axis=-1), np.ones((240, 320)))  # at planar depth 1
    expected = -T[2, 3] / (rays @ T[:3, :3].T)[..., 2]
    seen = (expected > CAMERA.near) & (expected < 2.0)
    assert seen.mean() > 0.5
    assert np.abs(depth[seen] * 1e-3 - expected[seen]).max() <= 1e-3


@pytest.mark.parametrize("ball", [(0.05, 0.1, 0.2), (-0.2, -0.1, 0.3)])
@pytest.mark.requirement("A-28")
def test_depth_of_a_sphere_is_that_of_the_ray_that_meets_it(
    renderer: SnapshotRenderer, ball: tuple[float, float, float]
) -> None:
    radius = 0.05
    state = snapshot(0.2, ball, radius=radius)
    colour, depth = draw(renderer, state)
    centre = se3.apply(se3.inverse(pose_of(state)), np.array(ball))
    v, u = np.mgrid[0:240, 0:320]
    rays = CAMERA.intrinsics.deproject(np.stack([u, v], axis=-1), np.ones((240, 320)))  # |z| = 1: t is planar depth
    a, b, c = (rays**2).sum(axis=-1), rays @ centre, centre @ centre - radius**2
    root = np.maximum(b * b - a * c, 0.0)
    expected = (b - np.sqrt(root)) / a
    # Not its rim, where the drawn facets (a sphere has none) turn away from the ray.
    inside = root > 0.5 * root.max()
    assert inside.sum() > 200
    assert (colour[inside][:, 0] > 60).all()
    assert np.abs(depth[inside] * 1e-3 - expected[inside]).max() <= 1e-3


@pytest.mark.requirement("P-27", "A-30")
def test_a_point_is_seen_where_the_intrinsics_project_it(renderer: SnapshotRenderer) -> None:
    for ball in ((0.2, 0.1, 0.3), (-0.25, 0.3, 0.2), (0.1, -0.05, 0.5)):
        state = snapshot(0.2, ball, radius=0.03)
        colour, depth = draw(renderer, state)
        p_optical = se3.apply(se3.inverse(pose_of(state)), ball)
        red = (colour[..., 0] > 60) & (colour[..., 1] < 40)
        v, u = np.nonzero(red)
        # The outline of a sphere is an ellipse whose centre lies a little further out than the sphere's: by the ratio
        # of z² to z² - r², along the line to the principal point.
        x, y, z = p_optical
        apparent = np.array([x, y, z - 0.03**2 / z])
        np.testing.assert_allclose([u.mean(), v.mean()], CAMERA.intrinsics.project(apparent), atol=0.5)
        assert depth[red].min() * 1e-3 == pytest.approx(p_optical[2] - 0.03, abs=0.004)


def test_what_lies_outside_the_view_is_left_out_and_no_pixel_changes(
    renderer: SnapshotRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    hidden = set[bool]()
    for x in np.linspace(-1.2, 1.2, 7):
        state = snapshot(0.2, (x, 0.25, 0.4), radius=0.1)
        colour, depth = draw(renderer, state)
        scene = renderer._drawn.scene  # type: ignore[union-attr]
        hidden.add(any(g.type == mujoco.mjtGeom.mjGEOM_NONE for g in scene.geoms[: scene.ngeom]))
        with monkeypatch.context() as patch:
            patch.setattr("openarm_sim_bridge.cameras.renderer._Drawn.leave_out", lambda *_: None)
            whole = draw(renderer, state)
        assert np.array_equal(colour, whole[0])
        assert np.array_equal(depth, whole[1])
    assert hidden == {True, False}


def test_what_is_nearer_or_farther_than_the_limits_is_invalid(renderer: SnapshotRenderer) -> None:
    _, depth = draw(renderer, snapshot(0.0, ball=(0.0, 0.0, 0.94), radius=0.03))  # 3 cm before the camera
    assert depth[120, 160] == 0
    _, depth = draw(renderer, snapshot(1.4))  # towards the horizon
    assert depth.max() <= 3000
    assert (depth[0] == 0).all()


def test_depth_rounds_to_the_nearest_millimetre() -> None:
    z = np.array([0.3004, 0.3006, 1.2343])
    near, far = 0.02, 20.0
    raw = ((far * near / z - near) / (far - near)).astype(np.float32)
    metres = planar_metres(raw, near, far)
    np.testing.assert_allclose(metres, z, atol=1e-5)
    assert millimetres(np.append(metres, np.float32(np.nan))).tolist() == [300, 301, 1234, 0]


@pytest.mark.requirement("A-47")
def test_depth_in_metres_says_the_same_with_nan_for_invalid(renderer: SnapshotRenderer) -> None:
    state = snapshot(1.2)
    _, mm = draw(renderer, state)
    metres = np.empty((240, 320), np.float32)
    renderer.load(state)
    renderer.draw("eye", np.empty((240, 320, 3), np.uint8), metres)
    np.testing.assert_array_equal(np.isnan(metres), mm == 0)
    assert 0.05 < np.isnan(metres).mean() < 0.95
    np.testing.assert_allclose(metres[mm > 0], mm[mm > 0] * 1e-3, atol=0.00051)


def test_another_model_is_drawn_after_an_exchange(renderer: SnapshotRenderer) -> None:
    _, before = draw(renderer, snapshot(ball=(0, 0, 0.5), radius=0.05))
    _, after = draw(renderer, snapshot())
    assert before[120, 160] == pytest.approx(450, abs=2)
    assert after[120, 160] == pytest.approx(1000, abs=1)


def test_a_camera_that_the_model_lacks_is_named(renderer: SnapshotRenderer) -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><camera name='c'/></worldbody></mujoco>")
    with refuses(Code.CONFIG_INVALID, "camera 'eye' of 320×240 pixels: the model has c"):
        renderer.load(Snapshot(model, 0, model.qpos0.copy()))


@pytest.mark.requirement("A-26", "A-27")
def test_the_two_cameras_are_640_by_480_with_60_degrees() -> None:
    cameras = load_cameras()
    for name in ("overhead", "wrist"):
        camera = cameras[name]
        assert (camera.width, camera.height, camera.fovy_deg) == (640, 480, 60.0)
        assert camera.depth
        assert camera.intrinsics.fy == pytest.approx(240 / math.tan(math.radians(30)), abs=1e-6)


def test_the_backend_must_be_off_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    with refuses(Code.ENVIRONMENT, r"MUJOCO_GL is 'glfw'.*egl or osmesa"):
        create_gl_context(64, 64)


def test_without_opengl_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_backend: str) -> type:
        raise ImportError("libEGL.so.1: cannot open shared object file")

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr("openarm_sim_bridge.cameras.renderer._context_class", broken)
    with refuses(Code.ENVIRONMENT) as caught:
        SnapshotRenderer({"eye": CAMERA})
    for part in ("libEGL.so.1", "osmesa", "libosmesa6"):
        assert part in caught.value.message
