# SPDX-License-Identifier: Apache-2.0
"""`openarm detector`: data sets, training and reports of the network detector, and requests in words."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import App

from openarm_bringup.commands.connect import Domain, join_graph
from openarm_bringup.outcome import Outcome, console
from openarm_common.errors import Code, OpenArmError
from openarm_common.wanted import describe

if TYPE_CHECKING:
    from collections.abc import Iterator

    from openarm_evaluation.detector.training.report import Evaluation

detector = App(name="detector", help="Data, training and evaluation of the network detector; objects by description.")

DATA, RUN = Path("runs/detector/data"), Path("runs/detector/train")


@detector.command
def data(*, out: Path = DATA, train: int = 4000, select: int = 400, report: int = 600, seed: int = 0) -> Outcome:
    """Render pictures of the suite's own world with labels in the YOLO text format; goes on where it was stopped.

    Args:
        out: Folder of the data set.
        train: Pictures for training.
        select: Pictures that choose the best weights.
        report: Pictures for the report, of which nothing else knows.
        seed: Seed of all of them; same seed, same pictures.
    """
    from openarm_evaluation.detector.data import DataConfig, make_data, write_sheet

    config = DataConfig(train=train, select=select, report=report, seed=seed)
    with _progress(config.counts()) as advance:
        made = make_data(out, config, lambda name, _: advance(name))
    sheet = write_sheet(out, "train" if train else "report")
    text = ", ".join(f"{name} {count}" for name, count in config.counts().items())
    message = f"{text} pictures in {out}, {sum(made.values())} of them made now; preview: {sheet}"
    return Outcome(True, message, data={"made": made, "folder": str(out)})


@detector.command
def train(
    *,
    data: Path = DATA,
    out: Path = RUN,
    steps: int = 7000,
    rate: float = 2e-3,
    batch: int = 16,
    threads: int = 1,
    seed: int = 0,
    first: Path | None = None,
    name: str = "shapes",
) -> Outcome:
    """Train a network, write it as ONNX files, and evaluate it on other pictures; needs the extra `train`.

    Stopped, it goes on where it was with the same command. For a data set of your own, see docs/detector.md.

    Args:
        data: Data set: images/, labels/ (train, select, report) and dataset.yaml.
        out: Folder of the run.
        steps: Batches; fewer when the selection set gets no better.
        rate: Learning rate; 1e-3 with few pictures of your own.
        batch: Pictures a batch.
        threads: Threads of torch.
        seed: Seed of weights, order and variations.
        first: Weights to begin with: the best.pt of another run of the same classes.
        name: Name of the ONNX files.
    """
    for module in ("torch", "onnx"):
        if find_spec(module) is None:
            raise OpenArmError(
                Code.ENVIRONMENT,
                f"training needs {module}, which is not installed: pip install 'openarm-vision[train]'",
            )
    _require(data)
    from openarm_evaluation.detector.training.export import export
    from openarm_evaluation.detector.training.fit import Fit, FitConfig, load_weights
    from openarm_evaluation.detector.training.model import Network

    config = FitConfig(steps=steps, rate=rate, batch=batch, threads=threads, seed=seed)
    run = Fit(data, out, config, first)
    with _progress({"training": config.steps}) as advance:
        for _ in range(run.step):
            advance("training")
        run.run(_print_row, lambda: advance("training"))
    network = Network(len(run.names))
    network.load_state_dict(load_weights(out / "best.pt", run.names))
    files = export(network, run.names, out, name)
    facts = {"steps": run.step, "cpu_s": round(run.cpu_s), "pictures": len(run.train)}
    page, results = _report(data, files, out / "report.html", facts, run.curve)
    return _outcome(page, results, {"steps": run.step, "cpu_s": run.cpu_s, "files": [str(file) for file in files]})


@detector.command
def report(
    *models: str, data: Path = DATA, out: Path = Path("runs/detector/report.html"), accept: float = 0.9
) -> Outcome:
    """Measure networks on the report set: average precision by class, centre error, confusion, failures.

    Args:
        models: ONNX files, or names in models/detector; the suite's when none is given.
        data: Data set with a report set.
        out: The page.
        accept: Least mean average precision (at an overlap of one half) of the last model.
    """
    _require(data)
    from openarm_perception.detection.network import model_path

    files = [model_path(model) for model in models or ("shapes_320x256", "shapes_640x480")]
    facts = {str(file): f"sha256 {hashlib.sha256(file.read_bytes()).hexdigest()}" for file in files}
    page, results = _report(data, files, out, facts, [])
    return _outcome(page, results, {"report": str(page)}, accept)


@detector.command
def find(*words: str, domain: Domain = None, timeout: float = 20.0) -> Outcome:
    """Find the object that words describe among those that the running detector observes: attributes and position.

    `openarm detector find red cube left of the can`. Sides are the robot's: left is +y of the base frame.

    Args:
        words: Colour, shape, size, and relation to another object.
        timeout: Longest wait for a detection, s.
    """
    join_graph(domain)
    from openarm_bringup.ros import object_client

    found = object_client.find(" ".join(words), timeout)
    x, y, z = (round(float(value), 4) for value in found.p_base)
    what = {"name": found.name, "color": found.color, "kind": found.kind}
    return Outcome(True, f"{describe([found])} at x {x} y {y} z {z} m", data={**what, "position": [x, y, z]})


def _require(folder: Path) -> None:
    if not (folder / "dataset.yaml").is_file():
        hint = "`openarm detector data` makes the suite's own, --data names another"
        raise OpenArmError(Code.CONFIG_INVALID, f"{folder} holds no data set (no dataset.yaml); {hint}")


def _report(
    folder: Path, files: list[Path], page: Path, facts: dict[str, Any], curve: list[dict[str, float]]
) -> tuple[Path, dict[str, Evaluation]]:
    from openarm_evaluation.detector.training.report import evaluate, write_page
    from openarm_evaluation.detector.training.samples import Samples
    from openarm_perception.detection.network import NetworkConfig, NetworkDetector

    samples = Samples(folder, "report")
    page.parent.mkdir(parents=True, exist_ok=True)
    results: dict[str, Evaluation] = {}
    with _progress({file.stem: len(samples) for file in files}) as advance:
        for file in files:
            network = NetworkDetector(NetworkConfig(model=str(file), names=samples.names))
            results[file.stem] = evaluate(network, samples, lambda stem=file.stem: advance(stem))
    write_page(page, samples, results, curve, {**facts, "report set": f"{len(samples)} pictures of {folder}"})
    return page, results


def _outcome(page: Path, results: dict[str, Evaluation], extra: dict[str, Any], accept: float = 0.0) -> Outcome:
    figures = json.loads(page.with_suffix(".json").read_text(encoding="utf-8"))["models"]
    lines: list[str] = []
    for name, scores in ((name, result.scores) for name, result in results.items()):
        classes = ", ".join(f"{kind} {value:.3f}" for kind, value in figures[name]["ap50"].items())
        lines += [
            f"{name}: mAP50 {scores.map50:.3f} ({classes}), any class {scores.any50:.3f}",
            f"  centre {scores.centre_median_px:.2f} px (95 % within {scores.centre_p95_px:.2f}), precision"
            f" {scores.precision:.3f}, recall {scores.recall:.3f}",
        ]
    text = "\n".join(lines)
    good = list(results.values())[-1].scores.map50 >= accept
    code = Code.OK if good else Code.NOTHING_DETECTED
    return Outcome(good, f"Report: {page}", code, {**extra, "models": figures}, text)


@contextmanager
def _progress(bars: dict[str, int]) -> Iterator[Callable[[str], None]]:
    from openarm_bringup.progress import progress

    with progress() as shown:
        tasks = {name: shown.add_task(name, total=count) for name, count in bars.items()}
        yield lambda name: shown.advance(tasks[name])


def _print_row(row: dict[str, float]) -> None:
    """A row of the curve on the console."""
    console().print("  ".join(f"{key} {value:g}" for key, value in row.items()))
