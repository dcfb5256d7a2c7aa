# SPDX-License-Identifier: Apache-2.0
"""YAML: scenes, graphs, cameras, stored calibrations and the like."""

from __future__ import annotations

from pathlib import Path

import yaml

from benchmarks.fuzz.alter import altered_yaml
from benchmarks.fuzz.files.reader import Reader
from openarm_common.resources import config_dir, models_dir


def settings(folder: Path) -> list[Reader]:
    """Make readers of settings."""
    from trajectory_msgs.msg import JointTrajectory

    from openarm_bringup.messages import fill
    from openarm_bringup.supervision.graph import load_graph
    from openarm_bringup.supervision.params import read_params
    from openarm_calibration.board.board import read_board
    from openarm_calibration.store.store import CalibrationStore
    from openarm_calibration.store.table import StoredTable, TableStore
    from openarm_common.camera.cameras import load_cameras
    from openarm_common.config import load_config, parse_yaml
    from openarm_common.scene.scene import load_scene
    from openarm_evaluation.detector.yolo_text import read_classes
    from openarm_grasp.requests.bins import load_bins
    from openarm_perception.detection.detector import ColorDetectorConfig
    from openarm_sim_bridge.faults.faults import FAULTS, parse_fault

    robot = models_dir() / "robots/openarm_v1"

    def of(*folders: Path) -> tuple[bytes, ...]:
        return tuple(path.read_bytes() for folder in folders for path in sorted(folder.glob("*.yaml")))

    def stored(path: Path) -> object:
        CalibrationStore(path.parent).load("wrist")
        return CalibrationStore(path.parent).history("wrist")

    def measured(path: Path) -> object:
        return TableStore(path.parents[1]).load("table")

    TableStore(folder).save_level(StoredTable(height=0.4, configured=0.4))
    faults = [
        yaml.safe_dump({"name": name, "parameters": model().model_dump(mode="json")}).encode()
        for name, model in FAULTS.items()
        if not any(field.is_required() for field in model.model_fields.values())
    ]

    def fault(path: Path) -> None:
        for name in rng_names:
            parse_fault(name, path.read_text("utf-8", "replace"))

    rng_names = tuple(FAULTS)[:4]
    words = b"joint_names: [a, b]\npoints: [{positions: [0.1, 0.2], time_from_start: {sec: 1, nanosec: 5}}]\n"
    params = b"/**:\n  ros__parameters: {a: 1, b: {c: [1, 2]}}\nnode:\n  ros__parameters: {d: text}\n"
    bins = b"bins: {left: [0.3, 0.2], right: [0.3, -0.2]}\nclasses: {red: left}\nrest: right\n"
    return [
        Reader("scene.yaml", of(models_dir() / "scenes", robot / "scenes"), altered_yaml, load_scene),
        Reader("graph.yaml", of(config_dir() / "graphs"), altered_yaml, lambda path: load_graph(str(path))),
        Reader("params.yaml", (params,), altered_yaml, lambda path: read_params(path, "node")),
        Reader("cameras.yaml", ((robot / "cameras.yaml").read_bytes(),), altered_yaml, load_cameras),
        Reader(
            "detector.yaml", ((config_dir() / "params/detector.yaml").read_bytes(),), altered_yaml,
            lambda path: load_config(path, ColorDetectorConfig),
        ),
        Reader("store/wrist.yaml", of(robot / "calibration/mount_seed_1"), altered_yaml, stored),
        Reader("tables/table/table.yaml", ((folder / "table/table.yaml").read_bytes(),), altered_yaml, measured),
        Reader("bins.yaml", (bins,), altered_yaml, load_bins),
        Reader(
            "board.yaml", (b"kind: circles\nrows: 11\ncolumns: 4\n", b"kind: charuco\n"), altered_yaml,
            lambda path: read_board(path.read_text("utf-8", "replace")),
        ),
        Reader("fault.yaml", tuple(faults) or (b"{}",), altered_yaml, fault),
        Reader("dataset.yaml", (b"train: images\nnames: [a, b]\n", b"names: {0: a, 1: b}\n"), altered_yaml,
               lambda path: read_classes(path.parent)),
        Reader(
            "message.yaml", (words,), altered_yaml,
            lambda path: fill(JointTrajectory(), parse_yaml(path.read_text("utf-8", "replace"), "the message")),
        ),
    ]  # fmt: skip
