# SPDX-License-Identifier: Apache-2.0
"""`openarm detector` on a data set of two pictures and a network that always says the same."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from openarm_bringup import cli
from openarm_evaluation.detector.yolo_text import write_classes, write_labels
from tests.openarm_perception.onnx_file import boxes, write_network


@pytest.fixture
def data(tmp_path) -> Path:
    """Nothing in the first picture, a box in the second."""
    write_classes(tmp_path, ("box", "ball"), ("report",))
    (tmp_path / "images" / "report").mkdir(parents=True)
    (tmp_path / "labels" / "report").mkdir(parents=True)
    for i in range(2):
        cv2.imwrite(str(tmp_path / "images" / "report" / f"{i}.png"), np.full((256, 320, 3), 80, np.uint8))
    text = write_labels(np.array([0]), np.array([[100.0, 100.0, 140.0, 140.0]]), 320, 256)
    (tmp_path / "labels" / "report" / "1.txt").write_text(text)
    return tmp_path


@pytest.mark.requirement("B-65")
def test_the_report_gives_figures_and_shows_failures(data, capsys) -> None:
    """Wrong in the first picture, right in the second: half of what is shown is right, the first picture is shown."""
    model = write_network(data / "net.onnx", boxes((100, 100, 141, 141, 0, 0.9)))
    out, figures = data / "page.html", data / "out.json"
    call = ["detector", "report", str(model), "--data", str(data), "--out", str(out), "--json", str(figures)]
    assert cli.run([*call, "--accept", "0.3"]) == 0
    figures_of_net = json.loads(figures.read_text())["models"]["net"]
    assert figures_of_net["precision"] == 0.5
    assert figures_of_net["recall"] == 1.0
    assert figures_of_net["map50"] == pytest.approx(0.5)  # balls are not there, and do not count
    assert figures_of_net["centre_median_px"] == pytest.approx(0.5 * 2**0.5, abs=1e-3)
    assert "centre 0.71 px" in capsys.readouterr().out
    page = out.read_text()
    assert page.count("<figure>") == 1
    assert "0.png" in page
    assert cli.run([*call, "--accept", "0.9"]) == 1


def test_a_model_that_is_not_there_is_refused_with_those_that_are(data, capsys) -> None:
    assert cli.run(["detector", "report", "pears", "--data", str(data)]) == 1
    assert "shapes_640x480" in capsys.readouterr().err


def test_without_a_data_set_it_is_said_how_to_get_one(tmp_path, capsys) -> None:
    assert cli.run(["detector", "report", "--data", str(tmp_path)]) == 1
    assert f"{tmp_path} holds no data set (no dataset.yaml); `openarm detector data` makes" in capsys.readouterr().err
