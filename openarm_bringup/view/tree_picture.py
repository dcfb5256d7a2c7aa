# SPDX-License-Identifier: Apache-2.0
"""The tree of frames as a picture: PNG for a page, SVG and PDF for print. Lengths in points, y down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

from openarm_common import pdf
from openarm_common.errors import Code, OpenArmError

SUFFIXES = (".png", ".svg", ".pdf")
_ROW, _INDENT, _MARGIN, _DOT, _TEXT = 19.0, 22.0, 18.0, 3.6, 12.0
#: A letter is about this share of its height wide, in the fonts of all three.
_LETTER = 0.56
#: Pixels a point: sharp where a page shows it at half its size.
_SCALE = 2
_INK, _MOVES, _LINE = (40, 44, 52), (20, 92, 178), (176, 182, 190)


@dataclass(frozen=True)
class Row:
    """One frame: how deep it hangs, its name, and whether it is fixed to its parent."""

    depth: int
    name: str
    fixed: bool


@dataclass(frozen=True)
class Layout:
    """Where everything is.

    Attributes:
        width: Of the page.
        height: Of the page.
        lines: (x0, y0, x1, y1).
        dots: (x, y, fixed); what is fixed is a ring, what moves a disc, so that it shows without colours too.
        words: (x, y of the base line, text, fixed).
    """

    width: float
    height: float
    lines: tuple[tuple[float, float, float, float], ...]
    dots: tuple[tuple[float, float, bool], ...]
    words: tuple[tuple[float, float, str, bool], ...]


def lay_out(rows: Sequence[Row]) -> Layout:
    """Place the rows of a tree, parents before their children, below a line that explains the marks."""
    lines: list[tuple[float, float, float, float]] = []
    dots: list[tuple[float, float, bool]] = []
    words: list[tuple[float, float, str, bool]] = []
    base, x = _MARGIN + 0.36 * _TEXT, _MARGIN
    for fixed, text in ((False, "moves with the joints: /tf"), (True, "fixed: /tf_static")):
        dots.append((x + _DOT, _MARGIN, fixed))
        words.append((x + 3.0 * _DOT, base, text, fixed))
        x += (len(text) + 3) * _LETTER * _TEXT + 3.0 * _DOT
    last: dict[int, float] = {}
    for number, row in enumerate(rows):
        x, y = _MARGIN + _DOT + _INDENT * row.depth, _MARGIN + _ROW * (number + 1.6)
        last[row.depth] = y
        if row.depth:
            stem = x - _INDENT
            lines.append((stem, last[row.depth - 1] + _DOT + 1.0, stem, y))
            lines.append((stem, y, x - _DOT - 1.0, y))
        dots.append((x, y, row.fixed))
        words.append((x + 2.2 * _DOT, y + 0.36 * _TEXT, row.name, row.fixed))
    width = max(x + len(text) * _LETTER * _TEXT for x, _, text, _ in words) + _MARGIN
    height = 2.0 * _MARGIN + _ROW * (len(rows) + 1.0)
    return Layout(width, height, tuple(lines), tuple(dots), tuple(words))


def write(rows: Sequence[Row], path: Path) -> None:
    """Draw a tree in the form that the file's name ends in.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for another ending; ENVIRONMENT, when it can't be written.
    """
    check(path)
    layout = lay_out(rows)
    draw = {".png": png, ".svg": svg, ".pdf": page}[path.suffix]
    try:
        path.write_bytes(draw(layout))
    except OSError as error:
        raise OpenArmError(Code.ENVIRONMENT, f"can't write {path}: {error.strerror}") from error


def check(path: Path) -> None:
    """Refuse a name that says no form.

    Raises:
        OpenArmError: INVALID_ARGUMENT.
    """
    if path.suffix not in SUFFIXES:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"--out {path}: expected a name that ends in {', '.join(SUFFIXES[:-1])} or .pdf"
        )


def png(layout: Layout) -> bytes:
    """As pixels."""
    import cv2
    import numpy as np

    bits = 4  # of fractions of a pixel, in what cv2 takes

    def at(*values: float) -> tuple[int, ...]:
        return tuple(round(value * _SCALE * 2**bits) for value in values)

    width, height = (round(length * _SCALE) for length in (layout.width, layout.height))
    picture = np.full((height, width, 3), 255, np.uint8)
    for x0, y0, x1, y1 in layout.lines:
        cv2.line(picture, at(x0, y0), at(x1, y1), _LINE[::-1], _SCALE, cv2.LINE_AA, bits)
    for x, y, fixed in layout.dots:
        colour = (_INK if fixed else _MOVES)[::-1]
        cv2.circle(picture, at(x, y), at(_DOT)[0], colour, _SCALE if fixed else -1, cv2.LINE_AA, bits)
    for x, y, text, fixed in layout.words:
        place = round(x * _SCALE), round(y * _SCALE)
        colour = (_INK if fixed else _MOVES)[::-1]
        size = cv2.getFontScaleFromHeight(cv2.FONT_HERSHEY_SIMPLEX, round(0.72 * _TEXT * _SCALE), _SCALE - 1)
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, _SCALE, cv2.LINE_AA)
    small = [cv2.IMWRITE_PNG_COMPRESSION, 9, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_DEFAULT]
    return cv2.imencode(".png", picture, small)[1].tobytes()


def svg(layout: Layout) -> bytes:
    """As vectors, for a browser."""
    width, height = f"{layout.width:g}", f"{layout.height:g}"
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
        f' font-family="Helvetica, Arial, sans-serif" font-size="{_TEXT:g}">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
        f'<path d="{" ".join(f"M{a:g} {b:g}L{c:g} {d:g}" for a, b, c, d in layout.lines)}" stroke="{_hex(_LINE)}"/>',
    ]
    for x, y, fixed in layout.dots:
        style = f'fill="white" stroke="{_hex(_INK)}"' if fixed else f'fill="{_hex(_MOVES)}"'
        out.append(f'<circle cx="{x:g}" cy="{y:g}" r="{_DOT:g}" {style}/>')
    for x, y, text, fixed in layout.words:
        out.append(f'<text x="{x:g}" y="{y:g}" fill="{_hex(_INK if fixed else _MOVES)}">{escape(text)}</text>')
    return "\n".join([*out, "</svg>\n"]).encode()


def page(layout: Layout) -> bytes:
    """As vectors, for print."""
    top = layout.height
    out = [f"{_rgb(_LINE)} RG 1 w"]
    out += [f"{a:.2f} {top - b:.2f} m {c:.2f} {top - d:.2f} l S" for a, b, c, d in layout.lines]
    for x, y, fixed in layout.dots:
        colour = f"{_rgb(_INK)} RG" if fixed else f"{_rgb(_MOVES)} rg"
        out.append(f"{colour} {pdf.circle(x, top - y, _DOT)} {'S' if fixed else 'f'}")
    for x, y, text, fixed in layout.words:
        out += [f"{_rgb(_INK if fixed else _MOVES)} rg", pdf.text(x, top - y, _TEXT, text)]
    return pdf.document("\n".join(out), layout.width, layout.height)


def _hex(colour: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


def _rgb(colour: tuple[int, int, int]) -> str:
    return " ".join(f"{part / 255.0:.3f}" for part in colour)
