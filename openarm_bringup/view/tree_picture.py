# SPDX-License-Identifier: Apache-2.0
"""The tree of frames as a figure: PNG for a page, SVG and PDF for print. Lengths in points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from openarm_common.errors import Code, OpenArmError
from openarm_common.figures import render_figure, sheet

FORMS: dict[str, Any] = {".png": "png", ".svg": "svg", ".pdf": "pdf"}
_ROW, _INDENT, _MARGIN, _DOT, _TEXT = 19.0, 22.0, 18.0, 7.2, 12.0
#: Twice as sharp as a page shows it.
_DPI = 144.0
_INK, _MOVES, _LINE = "#282c34", "#145cb2", "#b0b6be"


@dataclass(frozen=True)
class Row:
    """One frame: its depth in the tree, its name, and whether it is fixed to its parent."""

    depth: int
    name: str
    fixed: bool


def write(rows: Sequence[Row], path: Path) -> None:
    """Draw a tree in the format that the file's name ends in.

    Frames are listed below each other, children after and right of their parent; a ring marks a fixed frame, a disc
    one that moves.

    Args:
        rows: The frames, parents before their children.
        path: File to write.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for another ending; ENVIRONMENT, when it can't be written.
    """
    check(path)
    axes = sheet(_INDENT * (1 + max(row.depth for row in rows)), _ROW * (len(rows) + 1.0))
    last: dict[int, float] = {}
    for number, row in enumerate(rows):
        x, y = _INDENT * row.depth, _ROW * (number + 1.5)
        last[row.depth] = y
        if row.depth:
            axes.plot(
                [x - _INDENT, x - _INDENT, x], [last[row.depth - 1], y, y], color=_LINE, lw=1.0, zorder=1, clip_on=False
            )
        axes.plot(x, y, clip_on=False, **_mark(row.fixed))
        axes.text(x + 8.0, y, row.name, fontsize=_TEXT, color=_ink(row.fixed), va="center_baseline", parse_math=False)
    for fixed, label in ((False, "moves with the joints: /tf"), (True, "fixed: /tf_static")):
        axes.plot([], [], label=label, **_mark(fixed))
    axes.legend(
        loc="upper left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False, labelcolor="mec", fontsize=_TEXT,
        handlelength=0.0, handletextpad=0.7, borderpad=0.0, borderaxespad=0.0,
    )  # fmt: skip
    try:
        path.write_bytes(render_figure(axes, FORMS[path.suffix], dpi=_DPI, margin=_MARGIN))
    except OSError as error:
        raise OpenArmError(Code.ENVIRONMENT, f"can't write {path}: {error.strerror}") from error


def check(path: Path) -> None:
    """Refuse a file name without a known format.

    Raises:
        OpenArmError: INVALID_ARGUMENT.
    """
    if path.suffix not in FORMS:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--out {path}: expected a name that ends in .png, .svg or .pdf")


def _ink(fixed: bool) -> str:
    return _INK if fixed else _MOVES


def _mark(fixed: bool) -> dict[str, Any]:
    return {"ls": "", "marker": "o", "ms": _DOT, "mfc": "white" if fixed else _MOVES, "mec": _ink(fixed)}
