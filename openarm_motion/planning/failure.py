# SPDX-License-Identifier: Apache-2.0
"""Why a plan failed: at which stage, which pair was in the way, and how near it came."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

if TYPE_CHECKING:
    from openarm_motion.collision.exact import Contact

#: How far planning got: the request itself, the start, the goal, the straight line, the search, the validation of
#: the timed plan ("certificate"), the planning scene, next to another arm under way ("execution").
Stage = Literal["request", "start", "goal", "line", "search", "certificate", "scene", "execution"]


@dataclass(frozen=True, eq=False)
class Alternative:
    """A goal that a plan was found for.

    Attributes:
        q: (n,) rad.
        pose: (4, 4) of the tool there, base frame, m.
        distance: Distance of the tool from where it was asked to be, m.
    """

    q: Array
    pose: Array
    distance: float


class PlanFailedError(OpenArmError):
    """An error that knows where it happened.

    Args:
        code: Same as for `OpenArmError`.
        message: Same as for `OpenArmError`.
        stage: Stage that planning got to.
        contact: The pair in the way, where there is one.
        alternative: The nearest goal that works, where one was searched and found.
        at: Moment of a trajectory, s; NaN where it is about none.
    """

    def __init__(
        self,
        code: Code,
        message: str,
        stage: Stage,
        contact: Contact | None = None,
        alternative: Alternative | None = None,
        at: float = math.nan,
    ) -> None:
        super().__init__(code, message)
        self.stage: Stage = stage
        self.contact = contact
        self.alternative = alternative
        self.at = at
