# SPDX-License-Identifier: Apache-2.0
"""Makes reference.bt and the digest of reference.ot next to this file with liboctomap (through pyoctomap).

    pip install pyoctomap numpy
    python tests/openarm_octomap/data/make_reference.py

The tests take `frames` from here, put the same images into the suite's map, and compare bytes. Images and poses are
made of integers and of products in float32, so that every machine makes the same points.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

HEIGHT, WIDTH, FOCAL = 24, 32, 28.0
RESOLUTION = 0.02
FRAMES = 10
#: Turns of a quarter and of 3-4-5, so that no sine is needed: (cosine, sine) about z, then about x.
TURNS = [(1.0, 0.0), (0.8, 0.6), (0.6, 0.8), (0.0, 1.0), (-0.6, 0.8), (-0.8, 0.6), (0.8, -0.6), (0.6, -0.8)]


def frames() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Depth images (24, 32) uint16 mm and poses (4, 4) of the camera: walls, steps, noise, dropouts.

    Later frames look through where earlier ones saw something, so cells are cleared as well as marked.
    """
    rng = np.random.default_rng(20)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    for i in range(FRAMES):
        depth = 500 + 40 * (i % 4) + 9 * np.abs(u - 16 + i) + 6 * np.abs(v - 9 - i)
        depth[(u // 6 + v // 6 + i) % 5 == 0] -= 170
        depth = depth + rng.integers(-12, 13, depth.shape)
        depth[rng.integers(0, 100, depth.shape) < 6] = 0
        (cz, sz), (cx, sx) = TURNS[(3 * i) % 8], TURNS[(i // 2) % 8]
        T = np.eye(4)
        T[:3, :3] = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        T[:3, 3] = rng.integers(-120, 121, 3) / 1000.0
        yield depth.astype(np.uint16), T


def points(depth: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Points (n, 3) of an image in the frame of the map, every operation in float32."""
    z = depth.astype(np.float32) * np.float32(1e-3)
    a = ((np.arange(WIDTH) - (WIDTH - 1) / 2) / FOCAL).astype(np.float32)[None, :]
    b = ((np.arange(HEIGHT) - (HEIGHT - 1) / 2) / FOCAL).astype(np.float32)[:, None]
    M = T.astype(np.float32)
    xyz = [(M[k, 0] * a + (M[k, 1] * b + M[k, 2])) * z + M[k, 3] for k in range(3)]
    return np.stack(xyz, axis=-1)[depth > 0]


def main() -> None:
    """Write the files."""
    import pyoctomap

    tree = pyoctomap.OcTree(RESOLUTION)
    for depth, T in frames():
        origin = T[:3, 3].astype(np.float32).astype(np.float64)
        tree.insertPointCloud(points(depth, T).astype(np.float64), origin, discretize=True)
    here = Path(__file__).parent
    full = here / "reference.ot"
    tree.write(str(full))  # before writeBinary, which rounds the tree to occupied and free
    (here / "reference.ot.sha256").write_text(hashlib.sha256(full.read_bytes()).hexdigest() + "\n")
    full.unlink()
    tree.writeBinary(str(here / "reference.bt"))


if __name__ == "__main__":
    main()
