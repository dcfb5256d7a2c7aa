# SPDX-License-Identifier: Apache-2.0
"""Training: assignment, loss, checkpoints, export; needs torch and onnx (extra `train`), else it is skipped.

./openarm test tests/openarm_evaluation/test_training.py
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from openarm_evaluation.detector.training.report import evaluate as evaluate_onnx
from openarm_evaluation.detector.training.report import write_page
from openarm_evaluation.detector.training.samples import Samples, vary
from openarm_evaluation.detector.yolo_text import write_classes, write_labels
from openarm_perception.detection.network import NetworkConfig, NetworkDetector
from tests.refusals import refused

torch = pytest.importorskip("torch", reason="the extra `train` is not installed")
pytest.importorskip("onnx", reason="the extra `train` is not installed")

from openarm_evaluation.detector.training.export import export  # noqa: E402
from openarm_evaluation.detector.training.fit import Fit, FitConfig, evaluate  # noqa: E402
from openarm_evaluation.detector.training.model import Deployed, Network, assign, folded, grid, overlap  # noqa: E402

CONFIG = FitConfig(steps=40, batch=4, width=96, height=96, every=20, warm_up=5, rate=4e-3)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """Squares and discs of 20 to 40 pixels."""
    folder = tmp_path_factory.mktemp("data")
    write_classes(folder, ("square", "disc"), ("train", "select", "report"))
    rng = np.random.default_rng(0)
    for name, count in (("train", 12), ("select", 3), ("report", 3)):
        (folder / "images" / name).mkdir(parents=True)
        (folder / "labels" / name).mkdir(parents=True)
        for i in range(count):
            image = np.full((96, 128, 3), 90, np.uint8)
            kind, r = int(rng.integers(2)), int(rng.integers(10, 20))
            x, y = int(rng.integers(25, 100)), int(rng.integers(25, 70))
            color = [int(c) for c in rng.integers(150, 255, 3)]
            if kind:
                cv2.circle(image, (x, y), r, color, cv2.FILLED)
            else:
                cv2.rectangle(image, (x - r, y - r), (x + r, y + r), color, cv2.FILLED)
            cv2.imwrite(str(folder / "images" / name / f"{i}.png"), image)
            box = np.array([[x - r, y - r, x + r + 1, y + r + 1]], np.float64)
            (folder / "labels" / name / f"{i}.txt").write_text(write_labels(np.array([kind]), box, 128, 96))
    return folder


@pytest.mark.requirement("B-68")
def test_samples_are_read_and_varied_with_their_boxes(data) -> None:
    """The box of a varied picture is still around what is bright: within a pixel or two of its outline."""
    samples = Samples(data, "train")
    rng = np.random.default_rng(1)
    seen = 0
    for i in range(len(samples)):
        for _ in range(8):
            out = vary(samples[i], rng, 96, 96)
            assert out.rgb.shape == (96, 96, 3)
            assert (out.boxes >= 0).all()
            assert (out.boxes <= 96).all()
            for left, top, right, bottom in out.boxes:
                middle = out.rgb[int((top + bottom) / 2), int((left + right) / 2)].astype(float)
                near = np.abs(out.rgb.astype(float) - middle).max(axis=2) < 25
                rows, columns = (np.nonzero(near.any(axis=axis))[0] for axis in (1, 0))
                edges = np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1])
                assert np.abs(edges - [left, top, right, bottom]).max() <= 2.0
                seen += 1
    assert seen > 50


def test_each_object_is_answered_for_by_cells_inside_it() -> None:
    middles = grid(96, 96)
    truth = torch.tensor([[10.0, 10.0, 40.0, 40.0], [50.0, 50.0, 90.0, 90.0]])
    boxes = torch.cat([middles.T - 15.0, middles.T + 15.0], 1)
    cells, owner, aim = assign(torch.full((middles.shape[1], 2), 0.1), boxes, middles, torch.tensor([0, 1]), truth)
    assert set(owner.tolist()) == {0, 1}
    for cell, mine in zip(cells.tolist(), owner.tolist(), strict=True):
        x, y = middles[:, cell].tolist()
        left, top, right, bottom = truth[mine].tolist()
        assert left < x < right
        assert top < y < bottom
    assert 0.0 < float(aim.min()) <= float(aim.max()) <= 1.0


def test_overlap_of_boxes_and_its_complete_form() -> None:
    a = torch.tensor([0.0, 0.0, 10.0, 10.0])
    assert float(overlap(a, torch.tensor([5.0, 0.0, 15.0, 10.0]))) == pytest.approx(1 / 3, abs=1e-6)
    assert float(overlap(a, a, complete=True)) == pytest.approx(1.0, abs=1e-5)
    far, near = torch.tensor([30.0, 0.0, 40.0, 10.0]), torch.tensor([12.0, 0.0, 22.0, 10.0])
    assert float(overlap(a, far, complete=True)) < float(overlap(a, near, complete=True)) < 0.0


def test_folding_the_batch_norms_changes_nothing() -> None:
    torch.manual_seed(0)
    network = Network(3)
    with torch.no_grad():
        for _ in range(3):
            network(torch.rand(2, 3, 64, 96))
        network.eval()
        image = torch.rand(1, 3, 64, 96)
        for ours, theirs in zip(network(image), folded(network)(image), strict=True):
            assert torch.allclose(ours, theirs, atol=1e-4)
        assert Deployed(network, 64, 96)(image).shape == (1, 7, 64 * 96 // 64 + 64 * 96 // 256 + 64 * 96 // 1024)


@pytest.mark.requirement("N-14")
def test_training_learns_goes_on_after_a_stop_and_exports_what_it_learnt(data, tmp_path) -> None:
    """A run that is stopped half way and goes on ends like one that is not; the ONNX file gives what torch gives."""
    whole = Fit(data, tmp_path / "whole", CONFIG)
    whole.run(lambda row: None)
    losses = [row["box_loss"] for row in whole.curve]
    assert losses[-1] < losses[0]
    assert whole.step == 40

    class Stop(Exception):
        pass

    def stop(row: dict[str, float]) -> None:
        raise Stop

    with pytest.raises(Stop):
        Fit(data, tmp_path / "parts", CONFIG).run(stop)
    second = Fit(data, tmp_path / "parts", CONFIG)
    assert second.step == 20
    second.run(lambda row: None)
    for ours, theirs in zip(whole.averaged().parameters(), second.averaged().parameters(), strict=True):
        assert torch.allclose(ours, theirs, atol=1e-5)
    refused("holds a run with other rate", Fit, data, tmp_path / "parts", CONFIG.model_copy(update={"rate": 1e-3}))

    files = export(whole.averaged(), whole.names, tmp_path, "net")
    network = NetworkDetector(NetworkConfig(model=str(files[0])))
    assert network.names == ("square", "disc")
    image = np.random.default_rng(0).random((1, 3, 256, 320), np.float32)
    with torch.no_grad():
        expected = Deployed(whole.averaged(), 256, 320)(torch.from_numpy(image))[0].numpy()
    assert np.abs(network.run(image) - expected).max() < 2e-3
    samples = Samples(data, "report")
    by_onnx, by_torch = evaluate_onnx(network, samples).scores, evaluate(whole.averaged(), samples, (320, 256))
    assert by_onnx.map50 == pytest.approx(by_torch.map50, abs=0.02)
    write_page(tmp_path / "page.html", samples, {"net": evaluate_onnx(network, samples)}, whole.curve, {"steps": 40})
    page = (tmp_path / "page.html").read_text()
    assert "AP50 disc" in page
    assert "polyline" in page
    assert dataclasses.is_dataclass(by_onnx)


@pytest.mark.requirement("B-65")
def test_a_data_set_without_pictures_is_refused_with_what_to_do(tmp_path) -> None:
    write_classes(tmp_path, ("a",), ("train",))
    refused(r"no pictures .*; make some: openarm detector data", Samples, tmp_path, "train")
