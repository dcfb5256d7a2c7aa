# SPDX-License-Identifier: Apache-2.0
"""Wrist and overhead camera in one solve."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from openarm_calibration.handeye.offline import calibrate, calibrate_together, join
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.handeye.solve import SolveConfig
from openarm_calibration.handeye.transforms import moved
from openarm_calibration.sampling.samples import SampleSet
from openarm_common.camera.cameras import T_LINK_OPTICAL
from openarm_common.errors import OpenArmError
from tests.openarm_calibration.known_session import Known

ROBOT = (4e-4, math.radians(0.04))


class Erring(SampleSet):
    """Samples whose robot poses are off by an error of each posture."""

    def pose(self, joints):
        rng = np.random.default_rng([round(1e6 * (value + 10.0)) for value in joints.values()])
        error = rng.normal(0.0, 1.0, 6) * np.repeat(ROBOT, 3)
        return moved(super().pose(joints)[None], error[None])[0]


def erring(known: Known) -> Erring:
    out = Erring(known.samples.head, known.description)
    for sample in known.samples.samples:
        out.add(sample)
    return out


@pytest.mark.long
def test_both_set_ups_in_one_solve_give_each_camera_its_result(session) -> None:
    """Errors stay within the predicted ones; six poses of one camera learn the robot's errors from the other's."""
    wrist, overhead = session("in_hand", 12, px=0.2, seed=3), session("to_hand", 6, px=0.2, seed=4)
    sets = [erring(wrist), erring(overhead)]
    results = calibrate_together(sets, hashes=["a", "b"], created="now")
    for known, result, digest in zip((wrist, overhead), results, "ab", strict=True):
        offset, angle = mount_error(result.calibration.T_parent_link @ T_LINK_OPTICAL, known.X)
        t, r = result.solution.sigma()
        assert offset < 3.5 * t < 0.01
        assert angle < 3.5 * r
        assert result.calibration.camera == known.samples.head.camera
        assert result.calibration.session == digest
        assert result.verdict.figures["samples"] == len(known.samples)
        assert len(result.solution.tests) == len(known.samples)
    shared, alone = results[1].solution.estimate.noise, calibrate(sets[1]).solution.estimate.noise
    assert shared == results[0].solution.estimate.noise
    assert abs(math.log(shared.translation / ROBOT[0])) < 0.5
    assert abs(math.log(shared.translation / ROBOT[0])) < abs(math.log(max(alone.translation, 1e-7) / ROBOT[0]))


def test_views_of_one_posture_share_the_robots_error_and_equal_set_ups_a_board(session) -> None:
    """A second camera on the hand with the samples of the first: as many poses as before, one board mount."""
    wrist = session("in_hand", 8, px=0.2).samples
    second = SampleSet(wrist.head.model_copy(update={"camera": "second"}), session("in_hand", 3).description)
    for sample in wrist.samples:
        joints = {name: value + 2e-4 for name, value in sample.joints.items()}
        second.add(replace(sample, joints=joints))
    joint, own = join([wrist, second])
    assert (len(joint), joint.cameras, joint.boards, len(np.unique(joint.pose))) == (16, 2, 1, 8)
    assert [len(problem) for problem in own] == [8, 8]
    apart, _ = join([wrist, second], one_board=False)
    assert apart.boards == 2
    first, other = calibrate_together([wrist, second], config=SolveConfig(reject_outliers=False))
    offset, _ = mount_error(first.calibration.T_parent_link, other.calibration.T_parent_link)
    assert offset < 1e-3


def test_a_sample_that_contradicts_is_named_as_in_its_own_session(session) -> None:
    wrist, overhead = session("in_hand", 12).samples, session("to_hand", 12).samples
    bad = overhead.remove("s005")
    joints = dict(bad.joints)
    joints[overhead.joint_names[2]] += 0.05
    overhead.add(replace(bad, joints=joints))
    results = calibrate_together([wrist, overhead])
    assert results[0].solution.outliers == ()
    assert [outlier.name for outlier in results[1].solution.outliers] == ["s005"]


def test_sessions_that_do_not_go_together_are_refused(session) -> None:
    wrist = session("in_hand", 3).samples
    with pytest.raises(OpenArmError, match="sessions of wrist, wrist; expected one session for each camera"):
        calibrate_together([wrist, wrist])
    with pytest.raises(OpenArmError, match="sessions of none"):
        calibrate_together([])
    with pytest.raises(OpenArmError, match="extras scale in a solve of several cameras"):
        calibrate_together([wrist], config=SolveConfig(extras=("scale",)))
