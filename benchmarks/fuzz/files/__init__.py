# SPDX-License-Identifier: Apache-2.0
"""Readers of files by kind, each with sound files that are altered for it."""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

from benchmarks.fuzz.files.bags import bags, contents
from benchmarks.fuzz.files.clouds import clouds
from benchmarks.fuzz.files.maps import maps
from benchmarks.fuzz.files.networks import networks
from benchmarks.fuzz.files.pictures import pictures
from benchmarks.fuzz.files.poses import poses
from benchmarks.fuzz.files.reader import Reader
from benchmarks.fuzz.files.results import results
from benchmarks.fuzz.files.robots import robots
from benchmarks.fuzz.files.sessions import sessions
from benchmarks.fuzz.files.settings import settings
from benchmarks.fuzz.judge import Tally

#: By kind: makes the readers, with a folder for sound files.
KINDS: Mapping[str, Callable[[Path], list[Reader]]] = {
    "bags": bags, "contents": contents, "maps": maps, "clouds": clouds, "pictures": pictures, "yaml": settings,
    "json": results, "npz": sessions, "onnx": networks, "robots": robots, "poses": poses,
}  # fmt: skip


def read_altered(kind: str, count: int, seed: int) -> Tally:
    """Read altered files of a kind.

    Args:
        kind: Of `KINDS`.
        count: How many.
        seed: The same files for the same seed.
    """
    rng, tally = random.Random(f"{kind}{seed}"), Tally(kind)
    with tempfile.TemporaryDirectory() as folder:
        sound = Path(folder, "sound")
        sound.mkdir()
        readers = KINDS[kind](sound)
        for k in range(count):
            tally.take(readers[k % len(readers)].attempt(Path(folder), rng))
    return tally
