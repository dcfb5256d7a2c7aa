# SPDX-License-Identifier: Apache-2.0
"""Two campaigns compared."""

from __future__ import annotations

import json

from openarm_evaluation.campaign.agree import compare, rows_of, text_of
from tests.refusals import refused


def row(seed: int, *, code: str = "OK", arm: str = "left", attempts: int = 1, scene: str = "abc") -> dict:
    grasp = {"label": "red", "placed": code == "OK", "arm": arm, "attempts": attempts, "place_error_mm": 2.0 + seed,
             "sim_s": 10.0}  # fmt: skip
    outcome = "placed" if code == "OK" else "failed"
    return {"set": "nominal", "seed": seed, "scene_hash": scene, "outcome": outcome, "code": code, "grasps": [grasp]}


def test_scenes_agree_by_outcome_code_arm_and_attempts() -> None:
    here = [row(0), row(1), row(2), row(3), row(9)]
    there = [row(0), row(1, code="GRASP_LOST"), row(2, arm="right"), row(3, attempts=2), row(8)]
    found = compare(here, there)
    assert (found["agree"]["count"], found["agree"]["n"]) == (1, 4)
    assert found["differ"] == {
        1: "outcome placed, there failed; code OK, there GRASP_LOST",
        2: "red: arm left, there right",
        3: "red: attempts 1, there 2",
    }
    assert found["time_ratio"] == 1.0
    assert "agree on 1 of 4 scenes = 25.0 %" in text_of(found)


def test_what_cannot_be_compared_is_refused(tmp_path) -> None:
    refused("no scene in common", compare, [row(0)], [row(1)])
    refused(r"seeds \[0\] mean other scenes", compare, [row(0)], [row(0, scene="other")])
    refused("no folder of a campaign", rows_of, tmp_path)
    (tmp_path / "rows.jsonl").write_text(json.dumps(row(0)) + '\n{"torn')
    assert [found["seed"] for found in rows_of(tmp_path)] == [0]
