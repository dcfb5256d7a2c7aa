# SPDX-License-Identifier: Apache-2.0
"""What a calibration is worth: the same box, the same true mounts, grasped without and with it."""

from __future__ import annotations

from benchmarks.calibration_matters import compare, shipped_mounts


def test_without_calibration_the_grasp_of_a_narrow_box_fails_and_with_it_it_holds() -> None:
    """Mount seed 1 and the calibration of it that comes with the suite; physical contact, judged by ground truth."""
    without, calibrated = compare("narrow", "red", 1, shipped_mounts())
    assert not without["placed"]
    assert without["code"] != "OK"
    assert without["reasons"]  # of the judge: never lifted, dropped, or tilted, by where the fingers happen to touch it
    assert not without["false_success"]
    assert calibrated["placed"]
    assert calibrated["attempts"] == 1
    assert calibrated["place_error_mm"] < 5.0
