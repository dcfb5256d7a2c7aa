# SPDX-License-Identifier: Apache-2.0
"""Calibrated once for each mount seed."""

from __future__ import annotations

from pathlib import Path

import pytest
from openarm_interfaces.action import AutoCalibrate

from openarm_bringup.calibration.run import CalibrationOptions, CalibrationRun
from openarm_calibration.store.store import CalibrationStore, StoredCalibration
from openarm_common.camera.cameras import load_cameras, true_mount
from openarm_common.errors import Code, OpenArmError
from openarm_evaluation.demo import mounts

pytestmark = pytest.mark.usefixtures("own_store")


def answer(*, success: bool = True) -> AutoCalibrate.Result:
    code, message = (Code.OK, "pass") if success else (Code.NO_PLAN, "no way")
    return AutoCalibrate.Result(success=success, code=code.value, message=message, grade="pass", samples=10)


def test_mount_seed_1_needs_no_calibration_and_others_are_calibrated_once(tmp_path: Path, monkeypatch) -> None:
    asked: list[CalibrationOptions] = []

    def run_it(options: CalibrationOptions, _: object) -> CalibrationRun:
        asked.append(options)
        for name in options.cameras:
            camera = load_cameras()[name]
            T = true_mount(camera, options.mount_seed)
            CalibrationStore(options.store).save(  # type: ignore[arg-type]
                StoredCalibration.of_mount(name, camera.parent, T, mount_seed=options.mount_seed)
            )
        return CalibrationRun(tmp_path, {name: answer() for name in options.cameras})

    monkeypatch.setattr(mounts, "run_calibration", run_it)
    notes: list[str] = []
    mounts.calibrate_once(1, notes.append)
    assert (asked, notes) == ([], [])
    before = mounts.errors(5, nominal=False)["overhead"]
    mounts.calibrate_once(5, notes.append)
    mounts.calibrate_once(5, notes.append)
    assert [(options.cameras, options.mount_seed, options.save, options.zeros) for options in asked] == [
        (("overhead", "wrist"), 5, True, True)
    ]
    assert "no calibration of mount seed 5 yet" in notes[0]
    after = mounts.errors(5, nominal=False)["overhead"]
    assert before["used_mm"] == before["nominal_mm"] == after["nominal_mm"] > 5.0
    assert after["used_mm"] < 1e-3
    assert mounts.errors(5, nominal=True)["overhead"]["used_mm"] == before["nominal_mm"]


@pytest.mark.parametrize(
    ("run", "words"),
    [
        (CalibrationRun(Path(), {"overhead": answer(success=False)}), "calibration of overhead: no way"),
        (CalibrationRun(Path(), error=OpenArmError(Code.TIMEOUT, "not ready")), "not ready"),
        (CalibrationRun(Path(), {"overhead": answer()}), "not found there"),
    ],
)
def test_a_calibration_that_did_not_work_is_an_error(monkeypatch, run: CalibrationRun, words: str) -> None:
    monkeypatch.setattr(mounts, "run_calibration", lambda *_: run)
    with pytest.raises(OpenArmError, match=words):
        mounts.calibrate_once(5, lambda _: None)
