# SPDX-License-Identifier: Apache-2.0
"""Archives of calibration samples."""

from __future__ import annotations

from pathlib import Path

from benchmarks.fuzz.alter import altered_archive
from benchmarks.fuzz.files.reader import Reader
from openarm_common.robot.description import RobotDescription


def sessions(folder: Path) -> list[Reader]:
    """Make readers of archives."""
    from openarm_calibration.sampling.samples import load_session
    from tests.openarm_calibration.known_session import make_session

    sound: list[bytes] = []
    for setup in ("in_hand", "to_hand"):
        make_session(setup, count=3).samples.save(folder / f"{setup}.npz")
        sound.append((folder / f"{setup}.npz").read_bytes())
    robot = RobotDescription.load()

    def read(path: Path) -> None:
        samples, _ = load_session(path, robot)
        samples.problem()

    return [Reader("session.npz", tuple(sound), altered_archive, read)]
