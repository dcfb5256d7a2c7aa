# SPDX-License-Identifier: Apache-2.0
"""From weights to ONNX files of fixed sizes in the layout of YOLOv8, names of the classes in their metadata."""

from __future__ import annotations

from pathlib import Path

import onnx
import torch

from openarm_evaluation.detector.training.fit import SIZES
from openarm_evaluation.detector.training.model import Deployed, Network

_OPSET = 17


def export(network: Network, names: tuple[str, ...], folder: Path, stem: str) -> list[Path]:
    """Write `STEM_WxH.onnx` for every size; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    for width, height in SIZES:
        path = folder / f"{stem}_{width}x{height}.onnx"
        image = torch.zeros(1, 3, height, width)
        torch.onnx.export(
            Deployed(network, height, width).eval(),
            (image,),
            str(path),
            input_names=["images"],
            output_names=["output0"],
            opset_version=_OPSET,
            dynamo=False,
        )
        model = onnx.load(path)
        entry = model.metadata_props.add()
        entry.key, entry.value = "names", str(dict(enumerate(names)))
        onnx.save(model, path)
        paths.append(path)
    return paths
