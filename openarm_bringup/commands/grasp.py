# SPDX-License-Identifier: Apache-2.0
"""`openarm grasp`: look at the grasp's state machine."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from cyclopts import App

from openarm_bringup.outcome import Outcome

grasp = App(name="grasp", help="The grasp's state machine.")


@grasp.command
def graph(transitions: Path | None = None, *, form: Literal["text", "mermaid"] = "text") -> Outcome:
    """Check and draw the states of a grasp and which follows which: a table, or a Mermaid diagram.

    Args:
        transitions: YAML of a state machine; that of the suite when not given.
        form: text or mermaid.
    """
    from openarm_grasp.strategy.states import as_text, load_transitions, mermaid

    table = load_transitions(transitions)
    drawing = mermaid(table) if form == "mermaid" else as_text(table)
    data = {
        state.value: {event.value: follower.value for event, follower in row.items()} for state, row in table.items()
    }
    return Outcome(True, data={"transitions": data, "drawing": drawing}, text=drawing)
