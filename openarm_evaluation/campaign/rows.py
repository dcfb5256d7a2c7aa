# SPDX-License-Identifier: Apache-2.0
"""Rows of a campaign, read from the file that it keeps them in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ConfigDict, Field

from openarm_common.config import Config, parse_json, read_text, validate
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief

#: File of the rows, one JSON object a line.
ROWS = "rows.jsonl"
#: Longest one, bytes; a row has some kB.
_MAX_BYTES = 512 * 2**20


class _Known(Config):
    model_config = ConfigDict(extra="allow", strict=True)


class _State(_Known):
    state: str
    seconds: float


class _Grasp(_Known):
    label: str
    arm: str
    attempts: int
    placed: bool
    place_error_mm: float | None
    sim_s: float | None
    states: list[_State] = Field(default_factory=list[_State])


class CompareRow(_Known):
    """What a comparison of two campaigns reads."""

    set: str
    seed: int
    scene_hash: str
    outcome: str
    code: str
    grasps: list[_Grasp]


class ReportRow(CompareRow):
    """What a report reads."""

    detector: str
    kind: str
    expected: list[str]
    as_expected: bool
    placed: bool
    false_success: bool
    attempts: int
    sim_s: float


def read_lines(path: Path, kind: type[CompareRow]) -> tuple[list[dict[str, Any]], str]:
    """Read rows; the last line may be cut short.

    Args:
        path: Path of the file.
        kind: Type of a row.

    Returns:
        The rows, and the text of all whole lines.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the line that is none.
    """
    lines = read_text(path, Code.INVALID_ARGUMENT, _MAX_BYTES).split("\n")[:-1]
    rows: list[dict[str, Any]] = []
    for number, line in enumerate(lines, 1):
        where = f"{path}, line {number}"
        row = parse_json(line, where)
        if not isinstance(row, dict):
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{where} is {brief(row)}, expected the row of a scene")
        found: dict[str, Any] = row
        validate(kind, found, where, Code.INVALID_ARGUMENT)
        rows.append(found)
    return rows, "".join(f"{line}\n" for line in lines)
