# SPDX-License-Identifier: Apache-2.0
"""The calibration that comes with the suite, and where calibrations are looked for."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from openarm_calibration.handeye.offline import calibrate
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.sampling.samples import load_session
from openarm_calibration.store.store import CalibrationStore, StoredCalibration, of_these_mounts, places
from openarm_common import se3
from openarm_common.camera.cameras import load_cameras, true_mount, uncertain_cameras
from openarm_common.resources import models_dir
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import ROBOT, robot_names

SHIPPED = models_dir() / "robots" / "openarm_v1" / "calibration" / "mount_seed_1"
SESSIONS = Path(__file__).parent / "data"


@pytest.mark.parametrize("name", ["overhead", "wrist"])
@pytest.mark.requirement("A-45")
def test_what_comes_with_the_suite_is_what_its_samples_give(name: str) -> None:
    """Samples that `openarm calibrate auto --mount-seed 1` took are solved again: same mount, right to 0.05 mm."""
    samples, digest = load_session(SESSIONS / f"mount_seed_1_{name}.npz", RobotDescription.load())
    result = calibrate(samples)
    stored = CalibrationStore(SHIPPED).load(name)
    assert stored.session == digest
    assert result.verdict.grade == "pass"
    offset, angle = mount_error(result.calibration.T_parent_link, stored.T_parent_link)
    assert offset < 1e-5
    assert angle < 1e-5
    offset, angle = mount_error(stored.T_parent_link, true_mount(load_cameras()[name], 1))
    assert offset < 5e-5
    assert angle < math.radians(0.01)


@pytest.mark.parametrize("robot", robot_names())
@pytest.mark.requirement("A-45", "R-06")
def test_each_robot_comes_with_the_mounts_of_the_default_seed(robot, monkeypatch) -> None:
    """Found by the suite, and as the simulation has them: 0.1 mm and 0.01°."""
    monkeypatch.setenv(ROBOT, robot)
    store = CalibrationStore(models_dir() / "robots" / robot / "calibration" / "mount_seed_1")
    for name in uncertain_cameras():
        camera = load_cameras()[name]
        found, warnings = of_these_mounts((store,), name, camera.parent, 1)
        assert found is not None, warnings
        offset, angle = mount_error(found.record.T_parent_link, true_mount(camera, 1))
        assert offset < 1e-4
        assert angle < math.radians(0.01)


def stored(x: float, seed: int | None, parent: str = "hand") -> StoredCalibration:
    return StoredCalibration.of_mount("wrist", parent, se3.make(None, (x, 0.0, 0.0)), mount_seed=seed)


def test_the_first_calibration_of_the_mounts_in_use_is_taken(tmp_path: Path) -> None:
    """The folder, then its subfolder of the seed, then what comes with the suite; others are passed over and named."""
    assert of_these_mounts(places(tmp_path, 7), "wrist", "hand", 7) == (None, ())
    own, of_seed = CalibrationStore(tmp_path), CalibrationStore(tmp_path / "mount_seed_7")
    of_seed.save(stored(0.2, 7))
    own.save(stored(0.1, 3))
    found, warnings = of_these_mounts(places(tmp_path, 7), "wrist", "hand", 7)
    assert found is not None
    assert found.record.position[0] == 0.2
    assert "of mount seed 3, the mounts in use are of mount seed 7" in warnings[0]
    own.save(stored(0.1, 7))
    found, warnings = of_these_mounts(places(tmp_path, 7), "wrist", "hand", 7)
    assert found is not None
    assert (found.record.position[0], warnings) == (0.1, ())
    assert of_these_mounts(places(tmp_path, 7), "wrist", "foot", 7)[0] is None


def test_the_suite_s_own_is_for_its_seed_and_link_alone(tmp_path: Path) -> None:
    camera = load_cameras()["wrist"]
    found, _ = of_these_mounts(places(tmp_path, 1), "wrist", camera.parent, 1)
    assert found is not None
    np.testing.assert_allclose(found.record.T_parent_link, true_mount(camera, 1), atol=1e-4)
    assert of_these_mounts(places(tmp_path, 2), "wrist", camera.parent, 2)[0] is None
    assert of_these_mounts(places(tmp_path, None), "wrist", camera.parent, None)[0] is None
