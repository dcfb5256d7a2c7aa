# SPDX-License-Identifier: Apache-2.0
"""Clouds: PCD, PLY, arrays, text."""

from __future__ import annotations

import functools
import random
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.fuzz.alter import altered_bytes
from benchmarks.fuzz.files.reader import Reader
from openarm_common.resources import config_dir


def clouds(folder: Path) -> list[Reader]:
    """Make readers of clouds."""
    from openarm_common.camera.cameras import Intrinsics
    from openarm_common.config import load_config
    from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig
    from openarm_perception.frames.cloud_fields import Cloud
    from openarm_perception.frames.clouds import read_cloud
    from openarm_perception.frames.found import find
    from openarm_perception.frames.pcd import write_pcd
    from openarm_perception.geometry.depth import Deprojector, DepthLimits
    from tests.openarm_perception.test_cloud_files import FORMS, Ply, vertices

    limits, lens = DepthLimits(near=0.1, far=3.0), Intrinsics(40, 30, 35.0, 35.0, 19.5, 14.5)
    z = np.full((30, 40), 0.7, np.float32)
    z[10:20, 15:25] = 0.62
    points = Deprojector(limits).organised(z, lens)
    flat = points.reshape(1, -1, 3)
    rgb = np.full(points.shape, 90, np.uint8)
    colors = ColorDetector(load_config(config_dir() / "params" / "detector.yaml", ColorDetectorConfig))

    def read(axes: Literal["optical", "base"], path: Path) -> None:
        cloud = read_cloud(path, limits, axes=axes)
        find(cloud.frame, limits, colors, cloud.T_base_camera)

    write_pcd(folder / "image.pcd", Cloud(points, rgb, None))
    write_pcd(folder / "strewn.pcd", Cloud(flat, rgb.reshape(1, -1, 3), None))
    np.save(folder / "a.npy", points)
    rows = [f"{x:.4f} {y:.4f} {d:.4f}" for x, y, d in flat[0].tolist()]
    (folder / "a.xyz").write_text("\n".join(rows))
    head = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1200\nHEIGHT 1\nDATA ascii\n"
    (folder / "ascii.pcd").write_bytes(head + "\n".join(rows).encode())
    face, cells = [("vertex_indices", "uchar", "int")], [[[k] if k % 9 else []] for k in range(1200)]
    plys: list[bytes] = []
    for form in FORMS:
        info = ("num_cols 40", "num_rows 30")
        for ply in (vertices(Ply(form).element("face", face, cells[:300]), flat[0]),
                    vertices(Ply(form, *info), flat[0]).element("range_grid", face, cells)):  # fmt: skip
            plys.append(ply.write(folder / "a.ply").read_bytes())

    def early(data: bytes, rng: random.Random) -> bytes:
        """Where the header is, or anywhere."""
        return altered_bytes(data[:500], rng) + data[500:] if rng.random() < 0.5 else altered_bytes(data, rng)

    sound = {
        "altered.ply": tuple(plys), "altered.npy": ((folder / "a.npy").read_bytes(),),
        "altered.xyz": ((folder / "a.xyz").read_bytes(),),
        "altered.pcd": tuple((folder / f"{name}.pcd").read_bytes() for name in ("image", "strewn", "ascii")),
    }  # fmt: skip
    return [
        Reader(name, files, early, functools.partial(read, axes))
        for axes in ("optical", "base")
        for name, files in sound.items()
    ]
