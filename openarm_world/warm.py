# SPDX-License-Identifier: Apache-2.0
"""Compiles the numba kernel of this package, so that the first images of a process do not wait for that."""

from __future__ import annotations

import numpy as np

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.depth_view import DepthView
from openarm_world.shares import explain


def warm() -> None:
    """Run the kernel once with the types that the package uses; the compiled code is cached next to the sources."""
    view = DepthView(np.full((6, 8), 0.5, np.float32), Intrinsics.from_fovy(8, 6, 60.0), np.eye(4), 0.05, 3.0)
    explain(np.zeros((1, 3)), np.eye(4), view)


if __name__ == "__main__":
    warm()
