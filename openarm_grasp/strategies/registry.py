# SPDX-License-Identifier: Apache-2.0
"""The strategies, in the order in which they are tried: a new one is a function in a file, and a line here.

A strategy carries out a request of a user, a `Task`, and returns the answer; None, when it has nothing to offer for
what the strategies before it found out. Parts of it may be carried out by `pick_and_place`. The answer's `route` is the
name of the strategy that succeeded.
"""

from __future__ import annotations

import traceback
from collections.abc import Awaitable, Callable
from dataclasses import replace

from openarm_common.errors import Code, OpenArmError
from openarm_grasp.planning.options import NO_WAY
from openarm_grasp.requests.request import ENDS, GraspOutcome
from openarm_grasp.requests.task import Task
from openarm_grasp.strategies.aside import aside
from openarm_grasp.strategies.direct import direct
from openarm_grasp.strategies.hand_over import hand_over
from openarm_grasp.strategies.height import height
from openarm_grasp.strategies.in_hand import take_up
from openarm_grasp.strategies.push import push

Strategy = Callable[[Task], Awaitable[GraspOutcome | None]]

#: For one object.
STRATEGIES: dict[str, Strategy] = {
    "direct": direct,
    "height": height,
    "push": push,
    "hand_over": hand_over,
}
#: For phase aside: nothing is grasped.
ASIDE: dict[str, Strategy] = {"aside": aside}


async def carry_out(task: Task) -> GraspOutcome:
    """Carry out a request by the first strategy that succeeds; only an object that is refused untouched goes on.

    Raises:
        OpenArmError: INVALID_ARGUMENT or NOT_READY, when the request is not taken.
    """
    await take_up(task.session, task.robot, task.request)
    for route, strategy in (ASIDE if task.request.phase == "aside" else STRATEGIES).items():
        try:
            outcome = await strategy(task)
        except OpenArmError as error:
            known = task.outcome
            if known is None or error.code not in (*ENDS, *NO_WAY, Code.PLACE_FAILED):
                raise
            if error.code in ENDS:
                return task.answer(replace(known, code=error.code, message=error.message), "")
            task.outcome = replace(known, message=f"{known.message}; {error.message}")
            continue
        except Exception as error:
            # A defect of a strategy: the request must still be answered, and the next one served.
            task.robot.warn(traceback.format_exc())
            text = f"strategy {route!r}: {type(error).__name__}: {error}; see the log of the grasp node"
            return task.answer(GraspOutcome(Code.INTERNAL, text, task.request.label), "")
        if outcome is not None:
            task.outcome = outcome
            if not task.may_go_on(outcome) or await task.robot.stuck():
                return task.answer(outcome, route)
    if task.outcome is None:
        raise OpenArmError(Code.INTERNAL, f"none of the strategies {', '.join(STRATEGIES)} answered")
    return task.answer(task.outcome, "")
