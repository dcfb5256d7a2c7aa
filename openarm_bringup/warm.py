# SPDX-License-Identifier: Apache-2.0
"""`python -m openarm_bringup.warm`: compile what the nodes run, kernels and byte code: no start waits for it."""

from __future__ import annotations

import compileall
import importlib
import sys
from pathlib import Path

import numpy as np

from openarm_bringup.supervision.graph import load_graph
from openarm_calibration.warm import warm as warm_calibration
from openarm_common.camera.cameras import Intrinsics
from openarm_motion.warm import warm as warm_motion
from openarm_octomap.warm import warm as warm_octomap
from openarm_perception.geometry.depth import Deprojector, DepthLimits
from openarm_perception.geometry.filters import drop_flying, voxel_filter


def warm_perception() -> None:
    """Run the depth kernels with both encodings."""
    intrinsics = Intrinsics.from_fovy(8, 6, 1.0)
    deprojector = Deprojector(DepthLimits(near=0.05, far=3.0))
    for depth in (np.full((6, 8), 500, np.uint16), np.full((6, 8), 0.5, np.float32)):
        deprojector.organised(depth, intrinsics)
        drop_flying(depth, 0.03)
        voxel_filter(deprojector.valid_points(depth, intrinsics), 0.01)


def imported_by_nodes() -> list[Path]:
    """Import the nodes and the command line; return the sources that this took, also those of other projects."""
    nodes = load_graph("sim").nodes.values()
    for name in (
        "openarm_bringup.cli",
        "openarm_bringup.daemon.server",
        *(node.module for node in nodes if node.module),
    ):
        importlib.import_module(name)
    files = [getattr(module, "__file__", None) for module in list(sys.modules.values())]
    return sorted({Path(file) for file in files if file and file.endswith(".py")})


def keep_byte_code() -> None:
    """Compile what the nodes import.

    The installer of packages leaves that to their first import, which is in all nodes at the same time, and, where the
    environment has PYTHONDONTWRITEBYTECODE, as in many containers, at every start.
    """
    for file in imported_by_nodes():
        compileall.compile_file(file, quiet=2)


def main() -> None:
    """Warm all packages that have kernels, and all that nodes import."""
    warm_perception()
    warm_calibration()
    warm_motion()
    warm_octomap()
    keep_byte_code()


if __name__ == "__main__":
    main()
