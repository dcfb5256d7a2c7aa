# SPDX-License-Identifier: Apache-2.0
"""Compile the kernels of this package once, so that the first calibration does not wait for them."""

from __future__ import annotations

import numpy as np

from openarm_calibration.handeye.refine import Noise
from openarm_calibration.handeye.solve import solve
from openarm_calibration.synthetic import synthetic


def warm() -> None:
    """Solve one small problem."""
    solve(synthetic.trial("in_hand", 5, Noise(0.1), np.random.default_rng(0)).problem)
