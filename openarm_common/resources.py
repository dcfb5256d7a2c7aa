# SPDX-License-Identifier: Apache-2.0
"""Files of the suite: where `models/` and `config/` are (checkout, wheel, colcon install), and files written whole."""

from __future__ import annotations

import os
import sys
import tempfile
from functools import lru_cache
from pathlib import Path

from openarm_common.errors import Code, OpenArmError

_MARKER = Path("models") / "robots"


@lru_cache(maxsize=1)
def resource_root() -> Path:
    """Return the folder that holds `models/` and `config/`.

    Raises:
        OpenArmError: ENVIRONMENT, when none of the known places has them.
    """
    package = Path(__file__).resolve().parent
    prefixes = [Path(sys.prefix), *package.parents]
    candidates = [package.parent, *(p / "share" / "openarm" for p in prefixes)]
    for candidate in candidates:
        if (candidate / _MARKER).is_dir():
            return candidate
    places = ", ".join(str(c) for c in candidates[:3])
    raise OpenArmError(Code.ENVIRONMENT, f"{_MARKER} was not found in {places}, …; is the installation complete?")


def models_dir() -> Path:
    """Return the folder of robot models and scenes."""
    return resource_root() / "models"


def config_dir() -> Path:
    """Return the folder of graphs and parameters."""
    return resource_root() / "config"


def cache_dir() -> Path:
    """Return the folder of what is computed once: `openarm` in $XDG_CACHE_HOME, or in ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "openarm"


def is_file(path: Path) -> bool:
    """Whether a path is that of a file; what can't be a path (too long, with a NUL) is none."""
    return os.path.isfile(path)


def write_whole(path: Path, data: bytes, code: Code = Code.ENVIRONMENT) -> None:
    """Write a file under another name, then rename it: a reader gets the old or the new one, never a part.

    Raises:
        OpenArmError: `code`, when it can't be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".", delete=False) as file:
            try:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
                os.fchmod(file.fileno(), 0o644)
                os.replace(file.name, path)
            except OSError:
                Path(file.name).unlink(missing_ok=True)  # nothing of it stays on a full disk
                raise
    except OSError as error:
        raise OpenArmError(code, f"can't write {str(path)[:200]}: {error.strerror}") from error
