# SPDX-License-Identifier: Apache-2.0
"""Figures of an exact size, and pages that escape what they are given."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from jinja2 import UndefinedError

from openarm_common.figures import METRE, data_uri, render_figure, render_page, sheet


def test_a_sheet_has_the_size_that_was_asked_for_in_each_format() -> None:
    axes = sheet(0.210, 0.297, unit=METRE)
    box = re.search(rb"/MediaBox \[([^\]]*)\]", render_figure(axes, "pdf"))
    assert box is not None
    assert [float(part) / 72.0 * 25.4 for part in box.group(1).split()] == pytest.approx([0, 0, 210, 297], abs=1e-6)
    root = ElementTree.fromstring(render_figure(axes, "svg"))
    assert float(root.get("width", "").removesuffix("pt")) / 72.0 * 25.4 == pytest.approx(210.0, abs=1e-4)
    image = cv2.imdecode(np.frombuffer(render_figure(axes, "png", dpi=100.0), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape[:2] == (1169, 826)


def test_coordinates_run_right_and_down_from_the_upper_left_corner() -> None:
    axes = sheet(100.0, 50.0)
    axes.fill([10.0, 30.0, 30.0, 10.0], [5.0, 5.0, 20.0, 20.0], color="black", lw=0.0)
    image = cv2.imdecode(np.frombuffer(render_figure(axes, "png"), np.uint8), cv2.IMREAD_GRAYSCALE)
    rows, columns = np.nonzero(image < 128)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (5, 19, 10, 29)


def test_the_same_drawing_gives_the_same_file() -> None:
    def draw() -> list[bytes]:
        axes = sheet(100.0, 50.0)
        axes.text(10.0, 20.0, "a < b")
        return [render_figure(axes, "pdf"), render_figure(axes, "svg")]

    assert draw() == draw()
    assert b"a &lt; b" in draw()[1]


def test_a_page_escapes_values_and_refuses_a_name_without_one(tmp_path: Path) -> None:
    template = tmp_path / "page.html"
    template.write_text("<p>{{ text }}</p>")
    assert render_page(template, text="<b> & c") == "<p>&lt;b&gt; &amp; c</p>"
    with pytest.raises(UndefinedError, match="'text' is undefined"):
        render_page(template)


def test_an_image_is_part_of_the_page() -> None:
    assert data_uri(b"ab", "image/png") == "data:image/png;base64,YWI="


@pytest.mark.long
def test_neither_library_is_imported_before_the_first_figure() -> None:
    modules = ["openarm_calibration.report.report", "openarm_bringup.commands.tf", "openarm_evaluation.campaign.report"]
    code = f"import sys, {', '.join(modules)}; assert not {{'matplotlib', 'jinja2', 'PIL'}} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True)
