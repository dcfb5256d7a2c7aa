# SPDX-License-Identifier: Apache-2.0
"""What the Python bindings of liboctomap make of the same frames and of our map; run by benchmarks/perception.py.

    PYTHON octomap_bindings.py FRAMES.npz OURS.bt FOLDER

PYTHON needs numpy and pyoctomap, octomap-python or both, not this suite. Prints JSON: for each binding that is there
the CPU time of inserting two frames, ms, and for OURS.bt, read and written again by it, whether the bytes are the same.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

BINDINGS = {"pyoctomap": "pyoctomap", "octomap-python": "octomap"}


def cycle_ms(binding: Any, frames: Any) -> float:
    """Median CPU time of inserting the frames of two cameras, ms; end points are made unique by cell."""
    tree = binding.OcTree(0.02)
    cycles: list[float] = []
    for i in range(0, int(frames["n"]), 2):
        begin = time.process_time()
        for k in (i, i + 1):
            tree.insertPointCloud(frames[f"p{k}"].astype(float), frames[f"o{k}"].astype(float), discretize=True)
        cycles.append(time.process_time() - begin)
    return 1e3 * float(np.median(cycles))


def same_bytes(binding: Any, ours: Path, copy: Path) -> bool:
    """Whether the map is the same file when the binding has read and written it."""
    tree = binding.OcTree(0.02)
    encoded = binding.__name__ == "octomap"  # which takes file names as bytes alone
    if not tree.readBinary(bytes(ours) if encoded else str(ours)):
        return False
    tree.writeBinary(bytes(copy) if encoded else str(copy))
    return ours.read_bytes() == copy.read_bytes()


def main() -> None:
    """Try every binding that can be imported."""
    frames, ours, folder = np.load(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3])
    answers: dict[str, dict[str, float | bool]] = {}
    for name, module in BINDINGS.items():
        try:
            binding = importlib.import_module(module)
        except ImportError:
            continue
        answers[name] = {"ms": cycle_ms(binding, frames), "same": same_bytes(binding, ours, folder / f"{name}.bt")}
    print(json.dumps(answers))


if __name__ == "__main__":
    main()
