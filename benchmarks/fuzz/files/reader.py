# SPDX-License-Identifier: Apache-2.0
"""What reads a kind of file, and sound files to alter for it."""

from __future__ import annotations

import functools
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Alter = Callable[[bytes, random.Random], bytes]
#: The bag of the repository.
BAG = Path(__file__).parents[3] / "tests/data/demo_pick"


@dataclass(frozen=True)
class Reader:
    """One way in for files.

    Args:
        name: Name of the file that is written; its suffix matters to some readers.
        sound: What is altered.
        alter: How.
        read: Takes the path of the altered file.
    """

    name: str
    sound: tuple[bytes, ...]
    alter: Alter
    read: Callable[[Path], object]

    def attempt(self, folder: Path, rng: random.Random) -> Callable[[], object]:
        """Write one altered file; return the work of reading it."""
        path = folder / self.name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            path.unlink()
        path.write_bytes(self.alter(rng.choice(self.sound), rng))
        return functools.partial(self.read, path)
