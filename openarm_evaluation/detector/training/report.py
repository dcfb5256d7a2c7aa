# SPDX-License-Identifier: Apache-2.0
"""Evaluation of a detector on a set that it was not trained with: figures, worst pictures, one page. No torch."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from openarm_bringup.view.wire import jpeg
from openarm_common.figures import data_uri, render_figure, render_page, sheet
from openarm_evaluation.detector.training.samples import Sample, Samples
from openarm_evaluation.detector.training.scores import SHOWN, Scores, Truth, score
from openarm_perception.detection.boxes import Candidates, overlap
from openarm_perception.detection.network import NetworkDetector

#: Detections are counted from this score on.
LEAST = 0.05
_WORST = 24
_COLORS = ((230, 60, 60), (60, 200, 90), (80, 130, 255), (240, 190, 40), (220, 90, 220))


@dataclass(frozen=True)
class Evaluation:
    """Figures of a detector on a set, and its detections picture by picture."""

    scores: Scores
    found: tuple[Candidates, ...]


def evaluate(
    network: NetworkDetector, samples: Samples, progress: Callable[[], None] | None = None, count: int | None = None
) -> Evaluation:
    """Run a detector over a set, or over the first `count` pictures of it."""
    found: list[Candidates] = []
    truth: list[Truth] = []
    for i in range(len(samples) if count is None else min(count, len(samples))):
        sample = samples[i]
        found.append(network.candidates(sample.rgb, LEAST))
        truth.append((sample.classes, sample.boxes))
        if progress is not None:
            progress()
    return Evaluation(score(found, truth, len(samples.names)), tuple(found))


def as_json(scores: Scores, names: Sequence[str]) -> dict[str, Any]:
    """Figures as JSON takes them."""
    data = asdict(scores) | {"confusion": scores.confusion.tolist(), "ap50": dict(zip(names, scores.ap50, strict=True))}
    return {key: round(value, 4) if isinstance(value, float) else value for key, value in data.items()}


def write_page(
    path: Path,
    samples: Samples,
    results: dict[str, Evaluation],
    curve: Sequence[dict[str, float]],
    facts: dict[str, Any],
) -> None:
    """Write the page, and its figures as JSON next to it.

    Args:
        path: Path of the HTML file.
        samples: The set.
        results: Results by name of the model; failures are shown of the last one.
        curve: Rows of a training run; empty without one.
        facts: Lines for the head of the page.
    """
    names = samples.names
    figures = {name: as_json(result.scores, names) for name, result in results.items()}
    path.with_suffix(".json").write_text(json.dumps({**facts, "models": figures}, indent=1), encoding="utf-8")
    last = list(results.values())[-1]
    faults = sorted(
        ((fault, i) for i, found in enumerate(last.found) if (fault := _fault(samples[i], found))), reverse=True
    )
    page = render_page(
        Path(__file__).with_name("report.html"),
        facts=facts,
        columns=("map50", "map", "any50", "centre_median_px", "centre_p95_px", "precision", "recall"),
        names=names,
        models=figures,
        confusion=list(zip((*names, "nothing"), last.scores.confusion.tolist(), strict=True)),
        shown=SHOWN,
        curves=_curves(curve) if curve else None,
        batches=int(curve[-1]["step"]) if curve else 0,
        failures=[(samples.paths[i].name, _picture(samples[i], last.found[i], names)) for _, i in faults[:_WORST]],
    )
    path.write_text(page, encoding="utf-8")


def _fault(sample: Sample, found: Candidates) -> float:
    """How wrong a picture is: objects that are missed or called something else, and what is shown of nothing."""
    shown = found.scores >= SHOWN
    fault = 0.0
    for kind, box in zip(sample.classes, sample.boxes, strict=True):
        shared = overlap(box, found.boxes) if len(found.boxes) else np.zeros(0)
        fault += not bool(np.any((shared >= 0.5) & shown & (found.classes == kind)))
    for kind, box, certain in zip(found.classes[shown], found.boxes[shown], found.scores[shown], strict=True):
        shared = overlap(box, sample.boxes) if len(sample.boxes) else np.zeros(0)
        if not np.any((shared >= 0.5) & (sample.classes == kind)):
            fault += float(certain)
    return fault


def _picture(sample: Sample, found: Candidates, names: Sequence[str]) -> str:
    picture = sample.rgb.copy()
    for kind, box in zip(sample.classes, sample.boxes.round().astype(int).tolist(), strict=True):
        cv2.rectangle(picture, box[:2], box[2:], _COLORS[kind % len(_COLORS)], 3)
    for kind, certain, box in zip(found.classes, found.scores, found.boxes.round().astype(int).tolist(), strict=True):
        if certain >= SHOWN:
            cv2.rectangle(picture, box[:2], box[2:], (255, 255, 255), 1)
            text = f"{names[kind]} {certain:.2f}"
            at = (box[0], max(box[1] - 3, 10))
            cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, _COLORS[kind % len(_COLORS)], 1, cv2.LINE_AA)
    return data_uri(jpeg(picture), "image/jpeg")


def _curves(curve: Sequence[dict[str, float]]) -> str:
    """Plot losses and figures of the selection set over the steps, each scaled to its own largest value."""
    steps = np.array([row["step"] for row in curve])
    axes = sheet(960.0, 240.0)
    axes.plot([60.0, 620.0], [220.0, 220.0], color="#888888", lw=1.0)
    for i, key in enumerate(k for k in curve[0] if k not in ("step", "cpu_s")):
        values = np.nan_to_num(np.array([row[key] for row in curve]))
        top = float(values.max()) or 1.0
        color = "#{:02x}{:02x}{:02x}".format(*_COLORS[i % len(_COLORS)])
        axes.plot(60.0 + 560.0 * steps / steps[-1], 220.0 - 200.0 * values / top, color=color, lw=2.0)
        axes.text(640.0, 30.0 + 22.0 * i, f"{key}: last {values[-1]:.4g}, top {top:.4g}", color=color, fontsize=14.0)
    return data_uri(render_figure(axes, "svg"), "image/svg+xml")
