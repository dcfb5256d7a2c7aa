# SPDX-License-Identifier: Apache-2.0
"""Doctor of a graph that runs: each fault of it is found, with what to do."""

from __future__ import annotations

import pytest

from openarm_bringup.doctor.graph import GraphStatus, check_nodes, check_status
from openarm_bringup.supervision.runs import NodeRecord, RunRecord
from tests.openarm_bringup.commands import record_of

NODES = {name: NodeRecord(state="ready") for name in ("mujoco_bridge", "detector", "grasp")}
WELL = {name: (True, "fine") for name in NODES}
RATES = {"/joint_states": 99.8, "/clock": 100.1, "/tf": 50.0}


def run(**nodes: NodeRecord) -> RunRecord:
    return record_of("sim", 7, {**NODES, **nodes})


def test_a_sound_graph_is_ok_throughout() -> None:
    findings = check_nodes(run()) + check_status(run(), GraphStatus(RATES, WELL, [*NODES, "someone"]))
    assert {finding.level for finding in findings} == {"ok"}
    assert {"nodes", "/joint_states", "diagnostics", "domain clash"} <= {finding.name for finding in findings}


@pytest.mark.parametrize(
    ("node", "level", "observed"),
    [
        (NodeRecord(state="failed", restarts=5), "error", "failed"),
        (NodeRecord(state="backoff", restarts=1), "note", "backoff"),
        (NodeRecord(state="ready", restarts=2), "note", "ready, after 2 restarts"),
    ],
)
def test_nodes_that_are_not_as_they_should_be(node: NodeRecord, level: str, observed: str) -> None:
    (finding,) = check_nodes(run(detector=node))
    assert (finding.name, finding.level, finding.observed) == ("node detector", level, observed)
    assert "openarm logs detector" in finding.advice


@pytest.mark.parametrize(
    ("heard", "name", "level"),
    [
        (GraphStatus({**RATES, "/joint_states": 40.0}, WELL, [*NODES]), "/joint_states", "error"),
        (GraphStatus({**RATES, "/tf": 42.0}, WELL, [*NODES]), "/tf", "note"),
        (GraphStatus({**RATES, "/clock": 0.0}, WELL, [*NODES]), "/clock", "error"),
        (GraphStatus(RATES, {**WELL, "grasp": (False, "no camera")}, [*NODES]), "node grasp", "error"),
        (GraphStatus(RATES, {n: WELL[n] for n in ("mujoco_bridge", "grasp")}, [*NODES]), "node detector", "note"),
        (GraphStatus(RATES, WELL, [*NODES, "grasp"]), "domain clash", "error"),
        (GraphStatus({}, {}, []), "graph", "error"),
    ],
)
def test_what_is_heard_of_a_sick_graph(heard: GraphStatus, name: str, level: str) -> None:
    sick = [finding for finding in check_status(run(), heard) if finding.level != "ok"]
    assert [(finding.name, finding.level) for finding in sick] == [(name, level)]
    assert sick[0].advice
