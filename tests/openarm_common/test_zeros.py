# SPDX-License-Identifier: Apache-2.0
"""Zeros of joints in the description: kinematics, limits, postures, texts, and the file that a process reads."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common.robot import folder
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.learned import LearnedStore, StoredZeros
from openarm_common.robot.zeros import ZEROS, Zeros, keep_zeros, zeros_label
from tests.refusals import refused

ROBOT = RobotDescription.from_folder("openarm_v1")
JOINTS = tuple(name for arm in ROBOT.arm_names for name in ROBOT.arm_joints(arm))
angles = st.lists(st.floats(-0.1, 0.1), min_size=len(JOINTS), max_size=len(JOINTS))


@pytest.mark.requirement("R-11")
@settings(max_examples=5)
@given(angles, st.integers(0, 1000))
def test_a_calibrated_robot_that_reports_q_is_where_the_described_one_is_at_q_plus_its_zeros(
    values: list[float], seed: int
) -> None:
    offsets = dict(zip(JOINTS, values, strict=True))
    calibrated = ROBOT.with_zeros(offsets)
    rng = np.random.default_rng(seed)
    q = dict.fromkeys(ROBOT.joints, 0.0) | {name: float(rng.uniform(-2.0, 2.0)) for name in JOINTS}
    true = q | {name: q[name] + offsets[name] for name in JOINTS}
    again = RobotDescription.from_urdf(calibrated.urdf, calibrated.srdf)
    wanted, found, read = ROBOT.link_poses(true), calibrated.link_poses(q), again.link_poses(q)
    for link in ROBOT.links:
        np.testing.assert_allclose(found[link], wanted[link], atol=1e-12)
        np.testing.assert_allclose(read[link], wanted[link], atol=1e-9)
    for name, offset in offsets.items():
        for robot in (calibrated, again):
            assert robot.joint(name).lower == pytest.approx(ROBOT.joint(name).lower - offset)
            assert robot.joint(name).upper == pytest.approx(ROBOT.joint(name).upper - offset)
    assert again.semantics.states == calibrated.semantics.states
    assert calibrated.described is ROBOT


@pytest.mark.requirement("R-11")
def test_named_postures_stay_within_the_limits_and_zeros_add_up() -> None:
    twice = ROBOT.with_zeros({JOINTS[3]: 0.02}).with_zeros({JOINTS[3]: -0.05, JOINTS[1]: 0.01})
    assert twice.zeros == pytest.approx({JOINTS[3]: -0.03, JOINTS[1]: 0.01})
    assert twice.described is ROBOT
    for arm in ROBOT.arm_names:
        home, described = twice.group_state(f"{arm}_arm", "home"), ROBOT.group_state(f"{arm}_arm", "home")
        for name, q in home.items():
            assert q == pytest.approx(described[name] - twice.zeros.get(name, 0.0))
            assert twice.joint(name).lower - 1e-9 <= q <= twice.joint(name).upper + 1e-9


@pytest.mark.requirement("R-11")
@pytest.mark.parametrize(("name", "offset"), [("nothing", 0.0), (JOINTS[0], math.nan), (JOINTS[0], math.inf)])
def test_zeros_of_joints_that_have_none_are_refused(name: str, offset: float) -> None:
    refused(f"{name}", ROBOT.with_zeros, {name: offset})
    fixed = next(joint.name for joint in ROBOT.joints.values() if joint.type == "fixed")
    refused("moves by itself", ROBOT.with_zeros, {fixed: 0.01})


@pytest.mark.requirement("R-11")
def test_a_process_loads_its_robot_with_the_zeros_of_the_file_that_the_environment_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(ZEROS, str(keep_zeros(Zeros(robot="openarm_v1", offsets={JOINTS[2]: 0.03}), tmp_path)))
    assert RobotDescription.load().zeros == {JOINTS[2]: 0.03}
    assert RobotDescription.load().described.zeros == {}
    assert RobotDescription.load("panda").zeros == {}
    monkeypatch.setenv(ZEROS, str(tmp_path / "missing.yaml"))
    refused(r"missing\.yaml", RobotDescription.load)
    monkeypatch.setenv(ZEROS, str(keep_zeros(Zeros(robot="panda", of="other", offsets={}), tmp_path)))
    refused("is of robot 'panda'", RobotDescription.load)


@pytest.mark.requirement("R-11")
def test_the_way_back_from_the_first_zeros_leads_to_the_description(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = LearnedStore(tmp_path, StoredZeros)
    assert store.in_use("zeros").offsets == {}
    store.save(StoredZeros(offsets={JOINTS[2]: 0.03}))
    store.save(StoredZeros(offsets={JOINTS[2]: 0.05}))
    assert store.rollback("zeros").offsets == {JOINTS[2]: 0.03}
    assert store.rollback("zeros").offsets == {}
    refused("going back needs", store.rollback, "zeros")
    monkeypatch.setenv(folder.ROBOT, "panda")
    refused("is of robot 'openarm_v1', expected 'panda'", store.load, "zeros")
    assert store.in_use("zeros").offsets == {}


def test_labels_tell_zeros_apart_and_none_has_no_label() -> None:
    assert zeros_label({}) == zeros_label({"a": 0.0}) == ""
    assert zeros_label({"a": 0.1}) == zeros_label({"a": 0.1}) != zeros_label({"a": 0.2})
