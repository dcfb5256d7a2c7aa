# SPDX-License-Identifier: Apache-2.0
"""A PDF of one page, from its drawing operators; lengths in points (1/72 inch), y up, (0, 0) at the lower left."""

from __future__ import annotations

import math
import zlib

#: Of a quarter circle as a cubic curve.
_KAPPA = 4.0 / 3.0 * (math.sqrt(2.0) - 1.0)


def document(content: str, width: float, height: float) -> bytes:
    """Return the file.

    Args:
        content: Operators of the page, in Latin-1; text is set in `/F1`, Helvetica.
        width: Of the page.
        height: Of the page.
    """
    stream = zlib.compress(content.encode("latin-1", "replace"))
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4f} {height:.4f}] /Contents 4 0 R"
        " /Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        b"<< /Length %d /Filter /FlateDecode >>\nstream\n%s\nendstream" % (len(stream), stream),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out = bytearray(b"%PDF-1.4\n")
    places: list[int] = []
    for number, body in enumerate(objects, start=1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    for place in places:
        out += b"%010d 00000 n \n" % place
    out += b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, table)
    return bytes(out)


def circle(x: float, y: float, r: float) -> str:
    """Return the path of a circle; `f` after it fills, `S` strokes it."""
    k = _KAPPA * r
    corners = [(x + r, y), (x, y + r), (x - r, y), (x, y - r)]
    inner = [
        ((x + r, y + k), (x + k, y + r)),
        ((x - k, y + r), (x - r, y + k)),
        ((x - r, y - k), (x - k, y - r)),
        ((x + k, y - r), (x + r, y - k)),
    ]
    out = [f"{corners[0][0]:.4f} {corners[0][1]:.4f} m"]
    for n, (a, b) in enumerate(inner):
        end = corners[(n + 1) % 4]
        out.append(" ".join(f"{v:.4f}" for p in (a, b, end) for v in p) + " c")
    return " ".join(out)


def text(x: float, y: float, size: float, words: str) -> str:
    """Return the operators that write words from (x, y), the start of their base line, on."""
    escaped = words.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
    return f"BT /F1 {size:g} Tf {x:.4f} {y:.4f} Td ({escaped}) Tj ET"
