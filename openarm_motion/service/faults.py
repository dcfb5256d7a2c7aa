# SPDX-License-Identifier: Apache-2.0
"""Fault injection: approach plans that fail although there is a path."""

from __future__ import annotations

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_motion.config import FaultsConfig


class PlanFaults:
    """Counts plans and says which fail; the same seed, the same ones.

    Args:
        config: Share of the plans that fails.
    """

    def __init__(self, config: FaultsConfig) -> None:
        self.config = config
        self._rng = np.random.default_rng(config.seed)
        self._failed = 0

    def check(self, arm: str) -> None:
        """Let a plan of an arm pass.

        Raises:
            OpenArmError: NO_PLAN, when it is one that fails.
        """
        share, most = self.config.no_plan_share, self.config.no_plan_limit
        if self._rng.random() >= share or 0 < most <= self._failed:
            return
        self._failed += 1
        raise OpenArmError(Code.NO_PLAN, f"{arm} arm: no path, by fault injection (motion.faults.no_plan_share)")
