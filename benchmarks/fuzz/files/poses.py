# SPDX-License-Identifier: Apache-2.0
"""Poses of other tools."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.fuzz.alter import altered_bytes, altered_json, altered_xml, altered_yaml
from benchmarks.fuzz.files.reader import Alter, Reader


def poses(folder: Path) -> list[Reader]:
    """Make readers of poses."""
    from openarm_bringup.calibration.foreign import imported
    from openarm_bringup.calibration.foreign_options import Foreign
    from tests.openarm_calibration import foreign_files as files
    from tests.openarm_calibration import test_pose_source as written

    sound: dict[str, bytes] = {}
    known = files.truth("to_hand", 6)
    files.easy_handeye2(folder / "a.samples", known)
    files.moveit_yaml(folder / "b.yaml", known)
    files.moveit_json(folder / "c.json", known)
    for write, name in (
        (written.storage, "d.yml"), (written.storage_of_parts, "e.xml"), (written.arrays_of_parts, "f.npz"),
        (written.lines_of_either, "g.csv"), (written.named_columns, "h.txt"), (written.one_line_each, "i.tsv"),
    ):  # fmt: skip
        write(folder / name)
    np.save(folder / "j.npy", known.A)
    for path in folder.iterdir():
        sound[path.name] = path.read_bytes()
    ways: dict[str, Alter] = {
        ".json": altered_json, ".xml": altered_xml, ".yaml": altered_yaml, ".yml": altered_yaml,
        ".samples": altered_yaml,
    }  # fmt: skip

    def read(path: Path) -> None:
        imported(path, Foreign(camera_kind="eye_to_hand"))

    return [
        Reader(name, (data,), way, read)
        for name, data in sorted(sound.items())
        for way in (ways.get(Path(name).suffix, altered_bytes), altered_bytes)
    ]
