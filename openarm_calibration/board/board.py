# SPDX-License-Identifier: Apache-2.0
"""Calibration boards by their keys, or by a short spelling.

Board frame: origin in the middle of the marks, x right and y down as the board is read, z into the board, away from
the viewer; metres. A board lies in an image so that its axes turn as those of the image do. (The mirror image of a grid
without ids is a grid itself after a turn, so that a mirrored camera is detected by boards with ids only.)
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

from openarm_calibration.board.circles import CircleGrid, SymmetricCircles
from openarm_calibration.board.squares import AprilGrid, Charuco, Chessboard, Marker, known_dictionary
from openarm_common.config import describe_faults, parse_yaml, read_text
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief

Board = CircleGrid | SymmetricCircles | Chessboard | Charuco | AprilGrid | Marker
_ADAPTER: TypeAdapter[Board] = TypeAdapter(Annotated[Board, Field(discriminator="kind")])
_MODELS: dict[str, type[Board]] = {
    "circles": CircleGrid, "symmetric_circles": SymmetricCircles, "chessboard": Chessboard, "charuco": Charuco,
    "aprilgrid": AprilGrid, "marker": Marker,
}  # fmt: skip
KINDS = tuple(_MODELS)
#: One of each kind; what is left out has its default.
SPELLINGS = (
    "circles:4x11:20mm:15mm", "symmetric_circles:7x6:30mm:15mm", "chessboard:8x5:25mm",
    "charuco:7x5:34mm:26mm:DICT_5X5_100[:legacy]", "aprilgrid:6x6:24mm:0.3", "marker:100mm:DICT_APRILTAG_36h11:id=0",
)  # fmt: skip
_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
#: What the lengths of a spelling are, in their order.
_LENGTHS = {"chessboard": ("spacing",), "aprilgrid": ("diameter",), "marker": ("diameter",)}
#: Keys of Kalibr's target files.
_KALIBR = {"tagCols": "columns", "tagRows": "rows", "tagSize": "diameter", "tagSpacing": "ratio"}
_KALIBR_CHESS = {"targetCols": "columns", "targetRows": "rows", "colSpacingMeters": "spacing"}


def parse_board(data: dict[str, Any], where: str = "board") -> Board:
    """Make a board of its keys; `kind` chooses, circles when it is missing. Kalibr's own keys are read, too.

    Raises:
        OpenArmError: CONFIG_INVALID, naming `where` and the key.
    """
    if "target_type" in data:
        data = _from_kalibr(data, where)
    kind = data.get("kind", "circles")
    if kind not in KINDS:
        raise OpenArmError(Code.CONFIG_INVALID, f"{where}:kind: no board {brief(kind)}; boards: {', '.join(KINDS)}")
    try:
        return _ADAPTER.validate_python({**data, "kind": kind})
    except ValidationError as error:
        raise OpenArmError(Code.CONFIG_INVALID, describe_faults(error, where, _MODELS[kind])) from error


def read_board(text: str, where: str = "board") -> Board:
    """Make a board of a spelling, of its keys as YAML, or of a YAML file; an empty text is the default board.

    Args:
        text: Such as `charuco:7x5:34mm:26mm:DICT_6X6_250`, `{kind: circles, rows: 11}`, or `board.yaml`.
        where: Begins the error.

    Raises:
        OpenArmError: CONFIG_INVALID, naming `where` and what is wrong.
    """
    if re.fullmatch(r"[a-z_]+(:[\w.=%]+)+", text) or text in KINDS:
        return parse_board(_spelled(text, where), where)
    if text.endswith((".yaml", ".yml")):
        text, where = read_text(Path(text).expanduser()), f"{where} {text}"
    keys: Any = parse_yaml(text, where) if text else {}
    if not isinstance(keys, dict):
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"{where} is {brief(text)}, expected keys and values, such as {{kind: charuco}}, a YAML file, or one of"
            f" {', '.join(SPELLINGS)}",
        )
    return parse_board(keys, where)  # pyright: ignore[reportUnknownArgumentType]


def _spelled(text: str, where: str) -> dict[str, Any]:
    """Return the keys of a board that is spelled in one word."""
    kind, *parts = text.split(":")
    out: dict[str, Any] = {"kind": kind}
    lengths = list(_LENGTHS.get(kind, ("spacing", "diameter")))
    for part in parts:
        if found := re.fullmatch(r"(\d{1,3})x(\d{1,3})", part):
            out["columns"], out["rows"] = int(found[1]), int(found[2])
        elif (found := re.fullmatch(r"(\d*\.?\d+)(mm|cm|m)", part)) and lengths:
            out[lengths.pop(0)] = round(float(found[1]) * _UNITS[found[2]], 9)
        elif re.fullmatch(r"0?\.\d+|1\.0*", part) and kind == "aprilgrid":
            out["ratio"] = float(part)
        elif found := re.fullmatch(r"id=(\d{1,4})", part):
            out["id"] = int(found[1])
        elif part == "legacy":
            out["legacy"] = True
        else:
            try:
                out["dictionary"] = known_dictionary(part)
            except ValueError as error:
                unknown = f" ({error})" if part.upper().startswith("DICT_") else ""
                raise OpenArmError(
                    Code.CONFIG_INVALID,
                    f"{where} {text}: {brief(part)} is no size of a {kind} board{unknown}; expected such as"
                    f" {', '.join(SPELLINGS)}",
                ) from error
    return out


def _from_kalibr(data: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the keys of a target file of Kalibr as they are here."""
    named = {"aprilgrid": ("aprilgrid", _KALIBR), "checkerboard": ("chessboard", _KALIBR_CHESS)}
    kind = data["target_type"]
    if kind not in named:
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"{where}:target_type: {brief(kind)} of Kalibr is not read; expected {' or '.join(named)}",
        )
    ours, keys = named[kind]
    if kind == "checkerboard" and data.get("rowSpacingMeters") != data.get("colSpacingMeters"):
        raise OpenArmError(Code.CONFIG_INVALID, f"{where}: squares of a chessboard must have equal edges")
    rest = {key: value for key, value in data.items() if key not in ("target_type", "rowSpacingMeters")}
    return {"kind": ours, **{keys.get(key, key): value for key, value in rest.items()}}
