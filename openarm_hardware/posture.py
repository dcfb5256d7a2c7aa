# SPDX-License-Identifier: Apache-2.0
"""Where the joints were when they were last seen: by it a zero that has jumped is known at the next start."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from openarm_common.errors import OpenArmError
from openarm_common.records import default_folder
from openarm_common.resources import write_whole
from openarm_common.robot.folder import robot_name


class LastPosture:
    """A file with the last positions of the joints of this process's robot.

    Args:
        folder: Folder of the file; empty: that of calibrations.
        name: Tells robots apart that are of one kind, such as an emulated one.
    """

    def __init__(self, folder: str, name: str = "") -> None:
        self.path = (Path(folder) if folder else default_folder()) / f"last_posture{name}.json"

    def read(self) -> dict[str, float]:
        """Return positions by joint; none when there is no file, or it can't be read or is of another robot."""
        try:
            found: dict[str, Any] = json.loads(self.path.read_text(encoding="utf-8"))
            if found["robot"] != robot_name():
                return {}
            return {str(joint): float(q) for joint, q in found["positions"].items() if math.isfinite(float(q))}
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return {}

    def write(self, positions: Mapping[str, float]) -> str:
        """Store positions; return why not, else nothing."""
        text = json.dumps({"robot": robot_name(), "positions": dict(positions)})
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self.path, text.encode())
        except (OSError, OpenArmError) as error:
            return f"can't store where the joints are: {error}"
        return ""
