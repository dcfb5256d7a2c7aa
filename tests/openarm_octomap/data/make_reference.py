# SPDX-License-Identifier: Apache-2.0
"""Makes reference.bt and digests of reference.ot and of other cells next to this file with liboctomap (pyoctomap).

    pip install pyoctomap numpy
    python tests/openarm_octomap/data/make_reference.py

The tests take `frames` from here, put the same images into the suite's map, and compare bytes. Images and poses are
made of integers and of products in float32, so that every machine makes the same points.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

HEIGHT, WIDTH, FOCAL = 24, 32, 28.0
RESOLUTION = 0.02
FRAMES = 10
#: Edges of the cells that the reference is looked up for, mm, and cells along each axis of their box around the origin.
EDGES, CELLS = (10, 25, 30, 40, 50, 160), 16
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


def state_at(tree: Any, edge: int) -> np.ndarray:
    """What liboctomap says of cells of `edge` mm: occupied (2) where a part is, free (1) where all is, unknown (0).

    Args:
        tree: OcTree of cells of 20 mm.
        edge: All of its parts of the size of the greatest common divisor are looked up.
    """
    part = math.gcd(edge, 20)
    n = edge // part
    at = (np.arange(-CELLS // 2 * n, CELLS // 2 * n) + 0.5) * part * 1e-3
    found = (tree.search([x, y, z]) for x in at for y in at for z in at)
    states = np.array([0 if node is None else 2 if node.getLogOdds() >= 0.0 else 1 for node in found], np.uint8)
    parts = states.reshape(CELLS, n, CELLS, n, CELLS, n).transpose(0, 2, 4, 1, 3, 5).reshape((CELLS,) * 3 + (-1,))
    return np.where((parts == 2).any(-1), 2, np.where((parts == 1).all(-1), 1, 0)).astype(np.uint8)


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
    states = {edge: hashlib.sha256(state_at(tree, edge).tobytes()).hexdigest() for edge in EDGES}
    (here / "resampled.sha256").write_text("".join(f"{edge} {digest}\n" for edge, digest in states.items()))


if __name__ == "__main__":
    main()
