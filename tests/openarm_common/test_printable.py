# SPDX-License-Identifier: Apache-2.0
"""Text of others in logs and on the terminal."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from openarm_interfaces.action import Pick
from vision_msgs.msg import Detection3D, Detection3DArray

from openarm_bringup.cli import _show
from openarm_bringup.outcome import Outcome, console, show
from openarm_bringup.supervision.log import LogFile
from openarm_common.errors import OpenArmError
from openarm_common.printable import LONGEST_LINE, LONGEST_TEXT, printable, printable_lines
from openarm_common.ros.detections import detections_from_msg, hypothesis
from openarm_common.ros.log import PrintableLogger
from openarm_grasp.ros.messages import request_from_msg

HOSTILE = "red\x1b[2J\x1b]0;title\x07\u202ecba\x9b\r"
SHOWN = "red\\x1b[2J\\x1b]0;title\\x07\\u202ecba\\x9b"


def test_what_is_not_printable_is_escaped_and_the_rest_stays() -> None:
    assert printable(HOSTILE) == SHOWN + "\\r"
    assert printable("a\nb\u2028c") == "a\\nb\\u2028c"
    assert printable("rød 箱 │ …\tend") == "rød 箱 │ …\tend"
    assert printable("x" * 50, longest=10) == "x" * 9 + "…"


def test_colours_stay_where_they_are_asked_for() -> None:
    text = "\x1b[1;32mready\x1b[0m\x1b[2J"
    assert printable(text, colours=True) == "\x1b[1;32mready\x1b[0m\\x1b[2J"
    assert "\x1b" not in printable(text)


def test_lines_after_the_first_are_indented() -> None:
    assert printable_lines("a\n[FATAL] b", "  ") == "a\n  [FATAL] b"


def test_the_command_line_prints_no_controls(capsys: pytest.CaptureFixture[str]) -> None:
    _show(Outcome(False, f"{HOSTILE}\nopenarm: OK: forged", "BUSY"), None)
    _show(Outcome(True, HOSTILE, text=f"{HOSTILE}\n\x1b[1mbold\x1b[0m"), None)
    show(f"{HOSTILE}\n")
    console().print(HOSTILE, markup=False, soft_wrap=True)
    out, err = capsys.readouterr()
    assert out == f"{SHOWN}\n\x1b[1mbold\x1b[0m\n{SHOWN}\n{SHOWN}\n"
    assert err == f"openarm: BUSY: {SHOWN}\n  openarm: OK: forged\n{SHOWN}\n"


def test_a_log_file_takes_no_controls_and_no_line_without_end(tmp_path: Path) -> None:
    LogFile(tmp_path / "node.log", print).write([HOSTILE, "x" * 1_000_000])
    first, second = (tmp_path / "node.log").read_text().splitlines()
    assert first.endswith(f" {SHOWN}\\r")
    assert len(second) < LONGEST_LINE + 40


def test_a_node_logs_no_controls_and_throttles_by_caller(capfd: pytest.CaptureFixture[str]) -> None:
    logger = PrintableLogger("printable")
    for _ in range(3):
        logger.warning(f"{HOSTILE}\n[FATAL] forged", throttle_duration_sec=60.0)
        logger.error("another place", throttle_duration_sec=60.0)
    sys.stderr.flush()
    said = capfd.readouterr().err
    assert said.count(f"{SHOWN}\n    [FATAL] forged") == 1
    assert said.count("another place") == 1


def detections(label: str, name: str = "") -> Any:
    return detections_from_msg(Detection3DArray(detections=[Detection3D(id=name, results=[hypothesis(label, 0.5)])]))


def test_labels_of_requests_and_detections_are_bounded() -> None:
    longest, longer = "x" * LONGEST_TEXT, "x" * 1_000_000
    assert detections(longest)[0].name == longest
    request_from_msg(Pick.Goal(label=longest)).check(("left", "right"))
    assert request_from_msg(Pick.Goal(label=longer)).cut().label == longest
    for take in (
        lambda: detections(longer),
        lambda: detections("red", longer),
        lambda: request_from_msg(Pick.Goal(label=longer)).check(("left", "right")),
        lambda: request_from_msg(Pick.Goal(arm=longer)).check(("left", "right")),
        lambda: request_from_msg(Pick.Goal(phase=longer)).check(("left", "right")),
    ):
        with pytest.raises(OpenArmError, match="has 1000000 characters; expected at most 256") as refused:
            take()
        assert len(refused.value.message) < 300
