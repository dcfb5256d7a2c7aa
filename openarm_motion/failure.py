# SPDX-License-Identifier: Apache-2.0
"""Why a plan failed: at which stage, which pair was in the way, and how near it came."""

from __future__ import annotations

from typing import Literal

from openarm_common.errors import Code, OpenArmError
from openarm_motion.surroundings import Contact

#: How far planning got: the request itself, the start, the goal, the straight line, the search, the dense look at the
#: timed plan, the planning scene.
Stage = Literal["request", "start", "goal", "line", "search", "certificate", "scene"]


class PlanFailedError(OpenArmError):
    """An error that knows where it happened.

    Args:
        code: As `OpenArmError`.
        message: As `OpenArmError`.
        stage: How far planning got.
        contact: The pair in the way, where there is one.
    """

    def __init__(self, code: Code, message: str, stage: Stage, contact: Contact | None = None) -> None:
        super().__init__(code, message)
        self.stage: Stage = stage
        self.contact = contact
