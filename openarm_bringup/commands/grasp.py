# SPDX-License-Identifier: Apache-2.0
"""`openarm grasp`: the states of a grasp, and the release of a hand."""

from __future__ import annotations

from typing import Literal

from cyclopts import App

from openarm_bringup.commands.connect import Domain, check_arms, join_graph, requires_node
from openarm_bringup.outcome import Outcome

grasp = App(name="grasp", help="The states of a grasp; release of a hand.")


@grasp.command
def graph(*, form: Literal["text", "mermaid"] = "text") -> Outcome:
    """Draw the states of a grasp and which may follow which: a list, or a Mermaid diagram.

    Args:
        form: text or mermaid.
    """
    from openarm_grasp.requests.states import SUCCESSORS, as_text, mermaid

    drawing = mermaid() if form == "mermaid" else as_text()
    data = {state.value: {other.value: when for other, when in row.items()} for state, row in SUCCESSORS.items()}
    return Outcome(True, data={"successors": data, "drawing": drawing}, text=drawing)


@grasp.command
def release(*, arm: str = "", domain: Domain = None) -> Outcome:
    """Open a hand where it is: what it holds falls from there. `openarm pick --phase place` puts it down instead.

    Args:
        arm: Arm of the hand; when not given, of the one that holds something.
    """
    join_graph(domain)
    check_arms(arm)
    from openarm_grasp.ros.client import GraspClient

    with requires_node("grasp", "sim"), GraspClient() as client:
        answer = client.release(arm)
    return Outcome(answer.success, answer.message, answer.code)
