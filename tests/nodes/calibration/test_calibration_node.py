# SPDX-License-Identifier: Apache-2.0
"""Node `calibration` with a camera and a robot of the test: samples, refusals, solving, storing."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from openarm_interfaces.srv import (
    ComputeCalibration,
    GetSampleList,
    ListAlgorithms,
    RemoveSample,
    SampleFile,
    SaveCalibration,
    SetAlgorithm,
    TakeSample,
)

from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.ros.node import CalibrationNode
from openarm_calibration.store.store import CalibrationStore
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL
from tests.openarm_calibration.known_session import make_session

MS = 1_000_000


@pytest.fixture
def call(ros) -> Callable[..., Any]:
    """Calls a service of the node: kind, name, fields of the request."""
    return lambda kind, name, **fields: ros.call(
        ros.node.create_client(kind, f"/calibration/{name}"), kind.Request(**fields)
    )


@pytest.fixture
def store(tmp_path: Path) -> CalibrationStore:
    return CalibrationStore(tmp_path / "store")


def start(ros, store: CalibrationStore, camera: str = "wrist", **more) -> CalibrationNode:
    patience = {"image_timeout": 20.0, "state_timeout": 20.0, **more}
    return ros.start(CalibrationNode, camera=camera, store=str(store.folder), mount_seed=1, **patience)


@pytest.mark.parametrize(
    ("camera", "setup"), [pytest.param("wrist", "in_hand", marks=pytest.mark.long), ("overhead", "to_hand")]
)
@pytest.mark.requirement("A-33", "A-34", "A-45")
def test_from_images_to_a_stored_mount(ros, call, posed_robot, store, tmp_path: Path, camera: str, setup: str) -> None:
    """Ten samples by service, solved and stored: the true mount to 0.3 mm and 0.03°; saved and loaded the same."""
    known = make_session(setup, 10, px=1e-9)
    robot = posed_robot(camera, known)
    start(ros, store, camera)
    assert "first sample" in call(GetSampleList, "get_sample_list").advice
    for k in range(10):
        robot.pose(k)
        taken = call(TakeSample, "take_sample")
        assert taken.success, taken.message
        assert len(taken.samples) == k + 1
    solved = call(ComputeCalibration, "compute_calibration")
    assert solved.success, solved.message
    assert solved.grade == "pass", solved.reasons
    assert solved.child == f"{camera}_link"
    assert json.loads(solved.report)["figures"]["samples"] == 10
    saved = call(SaveCalibration, "save_calibration")
    assert saved.success, saved.message
    stored = store.load(camera)
    offset, angle = mount_error(stored.T_parent_link, known.X @ se3.inverse(T_LINK_OPTICAL))
    assert offset < 0.3e-3
    assert angle < math.radians(0.03)
    assert stored.mount_seed == 1
    path = str(tmp_path / "session.npz")
    assert call(SampleFile, "save_samples", path=path).success
    assert call(RemoveSample, "remove_sample").samples == [f"s{k:03d}" for k in range(1, 10)]
    assert len(call(SampleFile, "load_samples", path=path).samples) == 10
    again = call(ComputeCalibration, "compute_calibration")
    assert again.mount == solved.mount
    assert again.success


@pytest.mark.requirement("A-44", "A-41")
def test_refusals_come_with_a_code_and_the_node_goes_on(ros, call, posed_robot, store) -> None:
    """Late stamps, a moving robot, no board, no image, too few samples, wrong names."""
    robot = posed_robot("wrist", make_session("in_hand", 3, px=1e-9))
    robot.pose(0)
    node = start(ros, store, state_timeout=1.0)
    assert call(SaveCalibration, "save_calibration").code == "NOT_READY"
    nothing = call(ComputeCalibration, "compute_calibration")
    assert (nothing.success, nothing.code) == (False, "DEGENERATE")
    assert "too few poses" in nothing.message
    robot.offset_ns = 100_000 * MS
    late = call(TakeSample, "take_sample")
    assert late.code == "STALE_DATA", late.message
    robot.offset_ns, robot.speed = 0, 0.2
    moving = call(TakeSample, "take_sample")
    assert moving.code == "MOVING"
    assert "rad/s" in moving.message
    robot.speed, robot.blank = 0.0, True
    assert call(TakeSample, "take_sample").code == "NOTHING_DETECTED"
    robot.blank, robot.images = False, False
    patient = node.capture._config  # and hasty, where none will come
    node.capture._config = patient.model_copy(update={"image_timeout": 0.1, "state_timeout": 0.1})
    none = call(TakeSample, "take_sample")
    assert none.code == "NOT_READY"
    assert "/wrist/color/image_raw" in none.message
    node.capture._config, robot.images = patient, True
    assert call(TakeSample, "take_sample").success
    assert "samples: s001" in call(RemoveSample, "remove_sample", sample="s7").message
    assert call(SetAlgorithm, "set_algorithm", algorithm="tsai").success
    assert "algorithms: REFINED, TSAI" in call(SetAlgorithm, "set_algorithm", algorithm="tsay").message
    assert call(ListAlgorithms, "list_algorithms").current == "TSAI"
    assert call(SampleFile, "load_samples", path="/nowhere.npz").code == "INVALID_ARGUMENT"
    assert call(SampleFile, "save_samples", path="").code == "INVALID_ARGUMENT"
    assert call(ComputeCalibration, "compute_calibration").code == "DEGENERATE"
