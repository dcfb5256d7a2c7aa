# SPDX-License-Identifier: Apache-2.0
"""Maps: octrees as OctoMap writes them."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import numpy as np

from benchmarks.fuzz.alter import altered_bytes
from benchmarks.fuzz.files.reader import Alter, Reader
from openarm_common.robot.description import RobotDescription


def maps(folder: Path) -> list[Reader]:
    """Make readers of maps."""
    from openarm_octomap.config import FieldConfig, FilterConfig, GridConfig
    from openarm_octomap.kernels import FREE
    from openarm_octomap.mapper import Mapper

    def mapper() -> Mapper:
        return Mapper(RobotDescription.load(), GridConfig(), FilterConfig(enabled=False), FieldConfig())

    one = mapper()
    one.clear_box((0.2, -0.3, 0.0), (0.6, 0.3, 0.4), FREE)
    one.save(folder / "map.bt")
    one.save(folder / "map.ot")
    target = mapper()
    binary, full = ((folder / f"map{suffix}").read_bytes() for suffix in (".bt", ".ot"))
    head, _, tree = full.partition(b"\ndata\n")
    nodes = np.frombuffer(tree, np.uint8).reshape(-1, 5)
    colored = np.insert(nodes, [4, 4, 4], 200, axis=1).tobytes()
    first = struct.pack("<idI", 3, 0.02, len(nodes)) + binary.partition(b"\ndata\n")[2]

    def sized(data: bytes, rng: random.Random) -> bytes:
        edge = rng.choice((b"0.0001", b"0.0007", b"0.01", b"0.025", b"0.04", b"0.05", b"3", b"100"))
        return altered_bytes(data.replace(b"res 0.02", b"res " + edge), rng) if rng.random() < 0.8 else data

    files: list[tuple[str, bytes, Alter]] = [
        ("altered.bt", binary, altered_bytes), ("altered.ot", full, altered_bytes), ("wrong.bt", full, altered_bytes),
        ("color.ot", head.replace(b"id OcTree", b"id ColorOcTree") + b"\ndata\n" + colored, altered_bytes),
        ("first.bt", first, altered_bytes), ("sized.bt", binary, sized), ("sized.ot", full, sized),
    ]  # fmt: skip
    return [Reader(name, (sound,), way, target.load) for name, sound, way in files]
