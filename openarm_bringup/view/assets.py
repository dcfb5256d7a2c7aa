# SPDX-License-Identifier: Apache-2.0
"""Meshes of a robot for viewers that can't read files of this machine: what its description names, and nothing else."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote

_FILE, _PACKAGE = "file://", "package://robot"
_NAMED = re.compile(r'(filename\s*=\s*["\'])' + _FILE + r'(/[^"\']*)')


class Assets:
    """Meshes that a description names, by `package://` addresses, the only ones that Foxglove asks its server for."""

    def __init__(self) -> None:
        self._files: dict[str, Path] = {}

    def describe(self, urdf: str) -> str:
        """Return the description with its files named by addresses, which are served from now on."""
        self._files = {_PACKAGE + path: Path(unquote(path)) for _, path in _NAMED.findall(urdf)}
        return _NAMED.sub(lambda found: found[1] + _PACKAGE + found[2], urdf)

    def read(self, address: str) -> bytes | None:
        """Return a file's bytes; None for an address that the description doesn't have, and for a file that is gone."""
        file = self._files.get(address)
        try:
            return None if file is None else file.read_bytes()
        except OSError:
            return None
