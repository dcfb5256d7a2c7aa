# SPDX-License-Identifier: Apache-2.0
"""What a campaign through the graph keeps of a task that did not go as expected."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest
from openarm_interfaces.srv import SaveRecording

from openarm_common.errors import Code, OpenArmError
from openarm_evaluation.campaign.ros.graph import keep_recording

pytestmark = pytest.mark.requirement("N-24")

ROW = {
    "set": "nominal",
    "seed": 10003,
    "scene_hash": "abc",
    "outcome": "false success",
    "code": "OK",
    "message": "placed",
    "reasons": ["it\nlies beside"],
    "again": "./openarm campaign --seeds 10003 --graph",
}


class Recorder:
    """A flight recorder, asked through a client: the recording appears a moment after the answer."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.reasons = folder, list[str]()

    def call(self, kind: type, name: str, request: SaveRecording.Request) -> SaveRecording.Response:
        assert (kind, name) == (SaveRecording, "/flight_recorder/save")
        self.reasons.append(request.reason)
        path = self.folder / "07_OK"
        threading.Timer(0.05, path.mkdir).start()
        return SaveRecording.Response(success=True, code="OK", path=str(path))


class Absent:
    def call(self, *_: object) -> SaveRecording.Response:
        raise OpenArmError(Code.NOT_READY, "no service /flight_recorder/save within 10 s")


def test_the_recording_of_a_task_is_next_to_its_reason_and_says_how_to_repeat_it(tmp_path: Path) -> None:
    recorder, folder = Recorder(tmp_path), tmp_path / "failures" / "10003"
    keep_recording(recorder, ROW, folder)  # type: ignore[arg-type]
    assert {path.name for path in folder.iterdir()} == {"07_OK", "row.json", "reason.txt"}
    assert json.loads((folder / "row.json").read_text())["seed"] == 10003
    assert "again: ./openarm campaign --seeds 10003 --graph" in (folder / "reason.txt").read_text()
    lines = recorder.reasons[0].splitlines()
    assert lines[0] == "OK"
    assert {"set: nominal", "seed: 10003", "scene_hash: abc", f"again: {ROW['again']}"} <= set(lines)


def test_a_campaign_goes_on_without_a_flight_recorder(tmp_path: Path) -> None:
    keep_recording(Absent(), ROW, tmp_path / "1")  # type: ignore[arg-type]
    assert {path.name for path in (tmp_path / "1").iterdir()} == {"row.json", "reason.txt", "no_recording.txt"}
    assert "NOT_READY" in (tmp_path / "1" / "no_recording.txt").read_text()
