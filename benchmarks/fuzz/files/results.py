# SPDX-License-Identifier: Apache-2.0
"""JSON: numbers of a bag, rows and settings of campaigns."""

from __future__ import annotations

import json
import random
from pathlib import Path

from benchmarks.fuzz.alter import altered_json
from benchmarks.fuzz.files.reader import BAG, Reader


def results(folder: Path) -> list[Reader]:
    """Make readers of results."""
    from openarm_bringup.bags import golden
    from openarm_evaluation.campaign import agree
    from openarm_evaluation.campaign.campaign import read_rows
    from openarm_evaluation.campaign.options import CampaignOptions
    from openarm_evaluation.campaign.report import summarise

    grasp = {"label": "red", "arm": "left", "attempts": 1, "placed": True, "place_error_mm": 1.0, "sim_s": 9.0}
    row = {
        "set": "nominal", "seed": 0, "scene_hash": "a", "outcome": "placed", "code": "OK", "grasps": [grasp],
        "detector": "color", "kind": "demo", "expected": ["placed"], "as_expected": True, "placed": True,
        "false_success": False, "attempts": 1,
    }  # fmt: skip
    rows = b"".join(json.dumps({**row, "seed": seed}).encode() + b"\n" for seed in range(3))
    options = CampaignOptions(seeds=(0, 1, 2))
    settings = options.settings()
    known = json.loads(json.dumps([{**row, "seed": seed} for seed in range(3)]))

    def line(data: bytes, rng: random.Random) -> bytes:
        lines = data.splitlines(keepends=True)
        at = rng.randrange(len(lines))
        lines[at] = altered_json(lines[at], rng) + b"\n"
        return b"".join(lines)

    def compared(path: Path) -> None:
        agree.text_of(agree.compare(agree.rows_of(path.parent), known))

    def resumed(path: Path) -> None:
        (path.parent / "rows.jsonl").write_bytes(rows)
        summarise(read_rows(path.parent, options))

    def cut_off(path: Path) -> None:
        (path.parent / "settings.json").unlink(missing_ok=True)
        summarise(read_rows(path.parent, options))

    return [
        Reader("golden.json", ((BAG / "golden.json").read_bytes(),), altered_json,
               lambda path: golden.compare(golden.read(path), {"frames": 1.0})),
        Reader("campaign/rows.jsonl", (rows,), line, compared),
        Reader("resumed/settings.json", (json.dumps(settings).encode(),), altered_json, resumed),
        Reader("again/rows.jsonl", (rows,), line, cut_off),
    ]  # fmt: skip
