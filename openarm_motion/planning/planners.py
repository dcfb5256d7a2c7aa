# SPDX-License-Identifier: Apache-2.0
"""Planners by name, so that configuration alone puts another one (MoveIt 2, say) behind the same calls."""

from __future__ import annotations

import importlib
from typing import Any

from openarm_common.errors import Code, OpenArmError
from openarm_motion.planning.fast_planner import FastPlanner
from openarm_motion.planning.planner import OmplPlanner, Planner


def make_planner(name: str) -> Planner:
    """The planner of a name: fast, ompl, or `package.module:Class`, whose class is made without arguments.

    Whatever it answers is timed, held against the limits and looked at densely on the exact layer like our own paths.

    Raises:
        OpenArmError: CONFIG_INVALID, when there is no such class, or it can't plan.
    """
    if name == "fast":
        return FastPlanner()
    if name == "ompl":
        return OmplPlanner()
    module, _, attribute = name.partition(":")
    valid = "valid: fast, ompl, or package.module:Class with a method plan(query)"
    try:
        found: Any = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"planning.planner {name!r}: {error}; {valid}") from error
    if not callable(getattr(found, "plan", None)):
        raise OpenArmError(Code.CONFIG_INVALID, f"planning.planner {name!r} has no method plan; {valid}")
    return found()
