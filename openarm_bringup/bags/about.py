# SPDX-License-Identifier: Apache-2.0
"""What is kept with a bag about its making."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from openarm_bringup.supervision.runs import RunRecord
from openarm_bringup.versions import versions
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import DEFAULT, other_robot, robot_name

if TYPE_CHECKING:
    from openarm_bringup.bags.bag import Bag

#: In a bag of the suite: its own version, and the robot; older ones have no robot and are of openarm_v1.
_SUITE, ROBOT = "openarm-vision", "robot"
#: Packages whose versions are kept in a bag.
PACKAGES = (_SUITE, "mujoco", "numpy", "opencv-python-headless", "ros-jazzy-rclpy", "rosbags")


def about(run: RunRecord | None) -> dict[str, str]:
    """Return versions and robot, and graph and parameters of the run that is recorded, where it is known."""
    custom = versions(PACKAGES) | {ROBOT: robot_name() if run is None else run.robot}
    if run is None:
        return custom
    files = sorted(Path(run.run_dir, "params").glob("*.yaml"))
    return custom | {"graph": run.graph, "parameters": "".join(path.read_text(encoding="utf-8") for path in files)}


def require_robot(bag: Bag) -> None:
    """Refuse a bag of another robot than this process's; what another program has recorded does not say it.

    Raises:
        OpenArmError: CONFIG_INVALID.
    """
    whose = bag.custom.get(ROBOT) or (DEFAULT if _SUITE in bag.custom else "")
    if whose and (text := other_robot(whose)):
        raise OpenArmError(Code.CONFIG_INVALID, f"{bag.path} {text}")
