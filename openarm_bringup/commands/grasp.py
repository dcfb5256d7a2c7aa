# SPDX-License-Identifier: Apache-2.0
"""`openarm grasp`: the states of a grasp."""

from __future__ import annotations

from typing import Literal

from cyclopts import App

from openarm_bringup.outcome import Outcome

grasp = App(name="grasp", help="The states of a grasp.")


@grasp.command
def graph(*, form: Literal["text", "mermaid"] = "text") -> Outcome:
    """Draw the states of a grasp and which may follow which: a list, or a Mermaid diagram.

    Args:
        form: text or mermaid.
    """
    from openarm_grasp.strategies.states import SUCCESSORS, as_text, mermaid

    drawing = mermaid() if form == "mermaid" else as_text()
    data = {state.value: {other.value: when for other, when in row.items()} for state, row in SUCCESSORS.items()}
    return Outcome(True, data={"successors": data, "drawing": drawing}, text=drawing)
