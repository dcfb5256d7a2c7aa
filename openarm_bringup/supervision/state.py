# SPDX-License-Identifier: Apache-2.0
"""Where supervisors leave what the commands of their user find them by. The standard library only."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Mapping
from pathlib import Path


def state_dir(environ: Mapping[str, str] = os.environ) -> Path:
    """Return the folder of records of running graphs, and of their sockets."""
    runtime = environ.get("XDG_RUNTIME_DIR")
    if runtime and os.access(runtime, os.W_OK):
        return Path(runtime) / "openarm"
    return Path(tempfile.gettempdir()) / f"openarm-{os.getuid()}"


def socket_path(pid: int) -> Path:
    """Return the socket of the graph whose supervisor has a process id."""
    return state_dir() / f"{pid}.sock"


def is_private(path: Path) -> bool:
    """Return whether a folder or socket is this user's, and nobody else can open it; a link is not."""
    found = path.lstat()
    kind = stat.S_ISDIR(found.st_mode) or stat.S_ISSOCK(found.st_mode)
    return kind and found.st_uid == os.geteuid() and not found.st_mode & 0o077


def foreign(folder: Path) -> str:
    """Say why what stands in a folder may not be this user's; empty when it is, or there is no folder."""
    try:
        found = folder.lstat()
    except FileNotFoundError:
        return ""
    if not stat.S_ISDIR(found.st_mode):
        return "it is no folder"
    if found.st_uid != os.geteuid():
        return f"it is the folder of user {found.st_uid}"
    return "other users may write there" if found.st_mode & 0o022 else ""
