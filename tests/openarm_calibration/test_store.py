# SPDX-License-Identifier: Apache-2.0
"""Stored calibrations: hash, history, rollback, names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from openarm_calibration.store.store import CalibrationStore, StoredCalibration, of_these_mounts
from openarm_calibration.store.table import StoredTable, TableStore
from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.records import RecordStore
from openarm_common.robot.folder import ROBOT
from openarm_common.robot.servo_store import StoredServos
from tests.refusals import refuses


def calibration(x: float = 0.1, **more) -> StoredCalibration:
    T = se3.make(se3.exp_so3((0.1, 0.2, 0.3)), (x, 0.2, 0.3))
    return StoredCalibration.of_mount(
        "wrist", "openarm_right_link7", T, samples=12, created="2026-01-01T00:00:00Z", **more
    )


@pytest.mark.requirement("A-45")
def test_a_saved_mount_comes_back_exactly(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path / "store")
    assert store.find("wrist") is None
    saved = calibration()
    path = store.save(saved)
    assert store.load("wrist") == saved
    np.testing.assert_allclose(store.load("wrist").T_parent_link, saved.T_parent_link, atol=1e-15)
    assert store.names() == ("wrist",)
    assert [p.name for p in path.parent.iterdir() if p.name.startswith(".")] == []


@pytest.mark.requirement("A-32", "R-15")
def test_intrinsics_are_kept_and_hashed_and_a_file_of_old_without_them_is_good(tmp_path: Path) -> None:
    store, optics = CalibrationStore(tmp_path), Intrinsics(640, 480, 415.7, 415.7, 319.5, 239.5)
    path = store.save(calibration(intrinsics=optics))
    assert store.load("wrist").intrinsics == optics
    path.write_text(path.read_text().replace("fx: 415.7", "fx: 425.7"))
    with pytest.raises(OpenArmError, match="was edited"):
        store.load("wrist")
    of_old = calibration(robot="")
    assert "intrinsics" not in store.save(of_old).read_text()
    assert of_old.digest() == "3cc517fe953ead421cfa9c408191ac2e654289da5f452c8b3301a03cbff3907e"
    with pytest.raises(OpenArmError, match=r"fx=0, fy=415\.7, expected 1"):
        calibration(intrinsics=Intrinsics(640, 480, 0.0, 415.7, 319.5, 239.5))


def test_an_edited_or_cut_file_is_refused_and_the_last_good_one_stays(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path)
    store.save(calibration(0.1))
    path = store.save(calibration(0.2))
    text = path.read_text()
    for damaged in (text.replace("0.2\n", "0.9\n", 1), text[: len(text) // 2], "", "- a list\n", "a: [", "\x00"):
        path.write_text(damaged)
        with refuses(Code.CONFIG_INVALID):
            store.load("wrist")
        found = store.find("wrist")
        assert found is not None
        assert found.record.position[0] == 0.2
        assert "last good one" in found.warning


def test_yaml_that_would_run_something_is_refused(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path)
    mark = tmp_path / "ran"
    (tmp_path / "wrist.yaml").write_text(f"!!python/object/apply:os.mkdir ['{mark}']\n")
    with pytest.raises(OpenArmError, match="not valid YAML"):
        store.load("wrist")
    assert not mark.exists()


@pytest.mark.parametrize(
    "name", ["../wrist", "a/b", "", ".", "..", "/etc/passwd", "Wrist", "wrist\n", "a" * 65, "w\x00"]
)
def test_names_with_path_tricks_are_refused(tmp_path: Path, name: str) -> None:
    store = CalibrationStore(tmp_path)
    for use in (store.load, store.find, store.history, store.rollback, store.path):
        with pytest.raises(OpenArmError, match="expected lower-case letters"):
            use(name)
    with pytest.raises(OpenArmError, match="camera"):
        StoredCalibration.of_mount(name, "p", np.eye(4))


def test_rollback_goes_back_one_and_says_when_there_is_none(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path)
    for x in (0.1, 0.2, 0.3):
        store.save(calibration(x))
    assert [c.position[0] for c in store.history("wrist")] == [0.1, 0.2, 0.3]
    assert store.rollback("wrist").position[0] == 0.2
    assert store.load("wrist").position[0] == 0.2
    assert store.rollback("wrist").position[0] == 0.1
    with pytest.raises(OpenArmError, match="before the present one; stored: 1"):
        store.rollback("wrist")


def test_a_calibration_of_another_mount_seed_is_refused(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path)
    store.save(calibration(mount_seed=1))
    parent = store.load("wrist").parent
    found, reasons = of_these_mounts([store], "wrist", parent, 1)
    assert (found is not None, reasons) == (True, ())
    found, reasons = of_these_mounts([store], "wrist", parent, None)
    assert found is None
    assert "is of mount seed 1, the mounts in use are of mount seed none" in reasons[0]


def test_a_missing_camera_lists_those_there_are(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path)
    store.save(calibration())
    with pytest.raises(OpenArmError, match=r"no calibration of 'overhead' in .*; stored are: wrist"):
        store.load("overhead")


def test_a_folder_that_cant_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with refuses(Code.ENVIRONMENT, "can't write"):
        CalibrationStore(tmp_path / "file").save(calibration())


def test_a_mount_of_another_robot_is_refused_and_that_of_this_one_in_the_history_is_used(
    tmp_path: Path, nearer, monkeypatch
) -> None:
    store = CalibrationStore(tmp_path / "store")
    monkeypatch.setenv(ROBOT, "openarm_v1")
    of_old = store.save(calibration(0.1, robot=""))  # files of old are of openarm_v1
    assert store.load("wrist").robot == ""
    monkeypatch.setenv(ROBOT, nearer)
    with refuses(Code.CONFIG_INVALID, r"wrist\.yaml is of robot 'openarm_v1', expected 'nearer'"):
        store.load("wrist")
    assert store.in_use("wrist", None) is None
    found, reasons = of_these_mounts([store], "wrist", "openarm_right_link7", None)
    assert (found, reasons) == (None, ())
    mine = calibration(0.2)
    assert "robot: nearer" in store.save(mine).read_text()
    assert store.load("wrist") == mine
    monkeypatch.setenv(ROBOT, "openarm_v1")
    found = store.find("wrist")
    assert found is not None
    assert found.record.position[0] == 0.1
    assert found.warning == ""  # robots that store in turn are no fault
    assert of_old.is_file()


def test_going_back_leaves_the_history_of_another_robot(tmp_path: Path, nearer, monkeypatch) -> None:
    store = CalibrationStore(tmp_path / "store")
    store.save(calibration(0.1))
    store.save(calibration(0.2))
    monkeypatch.setenv(ROBOT, "openarm_v1")
    store.save(calibration(0.3))
    monkeypatch.setenv(ROBOT, nearer)
    assert store.rollback("wrist").position[0] == 0.1
    assert store.load("wrist").position[0] == 0.1
    monkeypatch.setenv(ROBOT, "openarm_v1")
    assert [record.position[0] for record in store.history("wrist")] == [0.3]


def test_the_table_and_the_servos_of_another_robot_are_not_those_of_this_one(
    tmp_path: Path, nearer, monkeypatch
) -> None:
    tables, servos = TableStore(tmp_path), RecordStore(tmp_path, StoredServos)
    tables.save(StoredTable(height=0.46, configured=0.45))
    values = dict.fromkeys(("stiffness", "damping", "friction", "armature", "latency"), (1.0,) * 7)
    servos.save(StoredServos(arm="left", **values))
    assert tables.in_use(0.45, None)[0] == 0.46
    assert servos.load("left").robot == nearer
    monkeypatch.setenv(ROBOT, "openarm_v1")
    height, source, fault = tables.in_use(0.45, None)
    assert (height, source, fault) == (0.45, "of the scene", "")
    assert servos.find("left") is None
