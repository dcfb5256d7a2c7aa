# SPDX-License-Identifier: Apache-2.0
"""What is kept with a bag about its making."""

from __future__ import annotations

from pathlib import Path

from openarm_bringup.supervision.runs import RunRecord
from openarm_bringup.versions import versions

#: Packages whose versions are kept in a bag.
PACKAGES = ("openarm-vision", "mujoco", "numpy", "opencv-python-headless", "ros-jazzy-rclpy", "rosbags")


def about(run: RunRecord | None) -> dict[str, str]:
    """Return versions, and graph and parameters of the run that is recorded, where it is known."""
    custom = versions(PACKAGES)
    if run is None:
        return custom
    files = sorted(Path(run.run_dir, "params").glob("*.yaml"))
    return custom | {"graph": run.graph, "parameters": "".join(path.read_text(encoding="utf-8") for path in files)}
