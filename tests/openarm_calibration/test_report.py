# SPDX-License-Identifier: Apache-2.0
"""The page of a calibration: what every image contributes, with arrows from its marks to where the answer has them."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from openarm_calibration.handeye.offline import calibrate
from openarm_calibration.handeye.problem import residuals
from openarm_calibration.report.drawings import arrows
from openarm_calibration.report.report import page
from openarm_calibration.sampling.samples import SampleSet
from tests.openarm_calibration.known_session import make_session, photograph


@pytest.mark.requirement("R-11", "P-28")
def test_arrows_on_each_image_lead_from_its_marks_to_where_the_answer_has_them() -> None:
    made = make_session("in_hand", 8, px=0.2).samples
    samples = SampleSet(made.head, made.description)
    for k, sample in enumerate(made.samples):
        picture = photograph(made.board, sample.T_camera_board, made.head.optics).astype(np.uint8)
        png = cv2.imencode(".png", picture)[1].tobytes() if k < 3 else b""
        samples.add(replace(sample, png=png))
    result = calibrate(samples)
    found = arrows(result)
    estimate, problem = result.solution.estimate, result.solution.problem
    for view, away in zip(problem.views, residuals(problem, estimate.X, estimate.Z), strict=True):
        one = found[view.name]
        np.testing.assert_allclose(one.away, -one.zoom * away, atol=1e-9)
        assert one.rms == pytest.approx(0.2, rel=0.5)
    text = page(samples, result)
    drawn = re.findall(r'<path d="M(\S+) (\S+?)l(\S+) (\S+?)"/>', text)
    assert len(drawn) == 3 * len(made.board.points)
    tail = np.array(drawn[0], dtype=np.float64)
    np.testing.assert_allclose(tail[:2], samples.samples[0].detection.pixels[0], atol=0.06)
    np.testing.assert_allclose(tail[2:], found["s001"].away[0], atol=0.06)
