# SPDX-License-Identifier: Apache-2.0
"""A PDF that readers take: offsets of its table, text that needs escapes, circles that are round."""

from __future__ import annotations

import re
import zlib

import numpy as np

from openarm_common import pdf


def test_every_object_is_where_the_table_says() -> None:
    page = pdf.document(pdf.text(10.0, 20.0, 8, "a (b) \\ c"), 200.0, 100.0)
    assert page.startswith(b"%PDF-1.4")
    places = [int(line) for line in re.findall(rb"(\d{10}) 00000 n", page)]
    assert len(places) == 5
    for number, place in enumerate(places, start=1):
        assert page[place:].startswith(b"%d 0 obj" % number)
    (table,) = re.findall(rb"startxref\n(\d+)", page)
    assert page[int(table) :].startswith(b"xref")
    length, stream = re.search(rb"/Length (\d+).*?stream\n(.*)\nendstream", page, re.DOTALL).groups()
    assert len(stream) == int(length)
    assert zlib.decompress(stream).decode("latin-1") == r"BT /F1 8 Tf 10.0000 20.0000 Td (a \(b\) \\ c) Tj ET"


def test_a_circle_is_round() -> None:
    """Four cubics through the middle of which the radius is kept to 0.03 %."""
    numbers = [float(word) for word in re.findall(r"-?\d+\.\d+", pdf.circle(3.0, -2.0, 5.0))]
    points = np.array(numbers).reshape(-1, 2)
    start = points[0]
    for control in points[1:].reshape(4, 3, 2):
        a, b, end = control
        middle = (start + 3 * a + 3 * b + end) / 8.0
        assert abs(np.linalg.norm(middle - [3.0, -2.0]) - 5.0) < 5.0 * 3e-4
        start = end
    assert np.allclose(start, points[0])
