# SPDX-License-Identifier: Apache-2.0
"""Camera bodies are part of what collides."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.camera.housings import mounted, with_housings
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription


def test_a_housing_hangs_behind_its_lens_on_the_parent_link() -> None:
    cameras = load_cameras()
    plain = RobotDescription.load()
    robot = with_housings(plain, cameras.values())
    shapes = {shape.name: (name, shape) for name, link in robot.links.items() for shape in link.collision}
    for name in ("overhead", "wrist"):
        link, shape = shapes[f"{name}_housing"]
        assert link == cameras[name].parent
        assert shape.size == cameras[name].housing
        T_link_housing = np.linalg.inv(cameras[name].T_parent_link) @ shape.T_link_primitive
        front = T_link_housing[0, 3] + shape.size[0] / 2.0
        assert front == pytest.approx(-0.002)
    assert "spectator_housing" not in shapes
    assert robot.urdf == plain.urdf
    assert all("housing" not in shape.name for link in plain.links.values() for shape in link.collision)


def test_a_camera_on_no_link_is_refused() -> None:
    camera = load_cameras()["wrist"].model_copy(update={"parent": "openarm_right_link9"})
    with pytest.raises(OpenArmError, match="no link 'openarm_right_link9'"):
        with_housings(RobotDescription.load(), [camera])


@given(arrays(float, 3, elements=st.floats(-3.0, 3.0)), arrays(float, 3, elements=st.floats(-1.0, 1.0)))
@settings(max_examples=20, deadline=None)
def test_a_housing_goes_with_its_mount(turn: np.ndarray, p: np.ndarray) -> None:
    T = se3.make(se3.exp_so3(turn), p)
    cameras = load_cameras()
    robot = with_housings(RobotDescription.load(), mounted(cameras, {"wrist": T}).values())
    shapes = {shape.name: shape for link in robot.links.values() for shape in link.collision}
    assert np.allclose(shapes["wrist_housing"].T_link_primitive, T @ cameras["wrist"].T_link_housing, atol=1e-9)
    overhead = cameras["overhead"].T_parent_link @ cameras["overhead"].T_link_housing
    assert np.array_equal(shapes["overhead_housing"].T_link_primitive, overhead)
