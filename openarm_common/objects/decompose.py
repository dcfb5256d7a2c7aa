# SPDX-License-Identifier: Apache-2.0
"""Approximate convex decomposition of a closed mesh by `coacd`, kept in a cache. m.

X. Wei, M. Liu, Z. Ling, H. Su, "Approximate Convex Decomposition for 3D Meshes with Collision-Aware Concavity and Tree
Search", ACM TOG 41(4), 2022.
"""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import numpy as np

from openarm_common.errors import Code, OpenArmError, said
from openarm_common.resources import cache_dir, write_whole
from openarm_common.types import Array, Ints

#: Concavity that a part may have, share of the mesh's size; most parts; seed of the search, and its rounds a cut.
_CONCAVITY, _PARTS, _SEED, _ROUNDS = 0.04, 32, 0, 60


def decomposed(vertices: Array, triangles: Ints, where: str) -> list[Array]:
    """Return the corners (n, 3) of convex parts of a mesh, m: from the cache, else computed within minutes.

    Args:
        vertices: (n, 3) m.
        triangles: (m, 3) indices.
        where: Begins the error.

    Raises:
        OpenArmError: ENVIRONMENT, when `coacd` is needed and not installed; CONFIG_INVALID, when it finds no parts.
    """
    key = hashlib.sha256(f"{_CONCAVITY} {_PARTS} {_SEED} {_ROUNDS}".encode())
    key.update(np.ascontiguousarray(vertices).tobytes())
    key.update(np.ascontiguousarray(triangles).tobytes())
    path = cache_dir() / "convex_parts" / f"{key.hexdigest()[:32]}.npz"
    if (kept := _read(path)) is not None:
        return kept
    try:
        import coacd  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise OpenArmError(
            Code.ENVIRONMENT,
            f"{where} has no collision.obj, and convex parts are made by coacd, which is not installed; install the"
            " extra `objects` (pip install 'openarm-vision[objects]'), or add collision.obj with a convex part a group",
        ) from error
    coacd.set_log_level("error")
    try:
        found = coacd.run_coacd(
            coacd.Mesh(vertices, triangles),
            threshold=_CONCAVITY,
            max_convex_hull=_PARTS,
            mcts_iterations=_ROUNDS,
            seed=_SEED,
        )
    except (RuntimeError, ValueError) as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"{where}: coacd finds no convex parts: {said(error)}") from error
    parts = [np.asarray(points, np.float64).reshape(-1, 3) for points, _ in found]
    buffer = io.BytesIO()
    np.savez_compressed(buffer, *parts)
    write_whole(path, buffer.getvalue())
    return parts


def _read(path: Path) -> list[Array] | None:
    """Return the parts that are kept in a file; None without, or where it is damaged."""
    try:
        with np.load(path, allow_pickle=False) as kept:
            return [np.asarray(kept[name], np.float64).reshape(-1, 3) for name in kept.files]
    except (OSError, ValueError, KeyError, EOFError):
        return None
    except Exception as error:  # zipfile and zlib have errors of their own
        if type(error).__module__ not in ("zipfile", "zlib"):
            raise
        return None
