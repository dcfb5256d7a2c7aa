# SPDX-License-Identifier: Apache-2.0
"""Paths that a request names: what a node may read, write and replace for whoever can reach its services."""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from openarm_common.errors import Code, OpenArmError


def file_to_read(text: str, suffixes: Sequence[str], others: Mapping[str, str] = MappingProxyType({})) -> Path:
    """Return the path of a file that a request asks to read: a regular one, so that nothing waits for its end.

    Args:
        text: The path; ~ is the node's home, and a relative path begins at its working directory.
        suffixes: Those that it may have, such as .bt.
        others: Advice for a file of another suffix.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for another suffix or kind of file.
    """
    path = _path(text, suffixes, others)
    try:
        kind = path.stat().st_mode
    except OSError as error:
        raise _refused(path, error.strerror or str(error), "the path of a file that exists") from error
    if not stat.S_ISREG(kind):
        raise _refused(path, "it is no regular file", "one")
    return path


def file_to_write(text: str, suffixes: Sequence[str]) -> Path:
    """Return the path of a file that a request asks to write; what is there already must be a file of this user.

    Args:
        text: The path; ~ is the node's home, and a relative path begins at its working directory.
        suffixes: Those that it may have, such as .bt.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for another suffix, a folder that does not exist, a link, or a file that is
            another user's.
    """
    path = _path(text, suffixes)
    try:
        found = path.lstat()
    except FileNotFoundError:
        if path.parent.is_dir():
            return path
        raise _refused(path, "its folder does not exist", "one that does") from None
    except OSError as error:
        raise _refused(path, error.strerror or str(error), "a name for a file") from error
    if not stat.S_ISREG(found.st_mode) or found.st_uid != os.geteuid():
        raise _refused(path, "what is there is a link, no regular file, or another user's", "another name")
    return path


def _path(text: str, suffixes: Sequence[str], others: Mapping[str, str] = MappingProxyType({})) -> Path:
    wanted = f"a file that ends in {' or '.join(suffixes)}"
    if not text:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"path is empty; expected {wanted}")
    try:
        path = Path(text).expanduser()
    except RuntimeError as error:  # there is no such user
        raise _refused(text, str(error), wanted) from error
    if not text.isprintable() or path.suffix not in suffixes:
        way = f"; {others[path.suffix]}" if path.suffix in others else ""
        raise _refused(text, "it has another suffix, or characters that are no text", f"{wanted}{way}")
    return path


def _refused(path: Path | str, why: str, expected: str) -> OpenArmError:
    shown = str(path).encode("unicode_escape").decode()[:200]
    return OpenArmError(Code.INVALID_ARGUMENT, f"path {shown}: {why}; expected {expected}")
