# SPDX-License-Identifier: Apache-2.0
"""The text of a robot description's file, of xacro expanded."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from xml.parsers.expat import ExpatError

import xacro
from xacro import substitution_args

from openarm_common.config import read_text
from openarm_common.errors import Code, OpenArmError, said
from openarm_common.resources import cache_dir, write_whole
from openarm_common.robot.meshes import package_advice, package_folders

#: What xacro raises for faulty files: little of it is wrapped.
_XACRO_RAISES = (
    xacro.XacroException, ExpatError, OSError, RuntimeError, ValueError, TypeError, LookupError, AttributeError,
    SyntaxError,
)  # fmt: skip

#: What makes an expansion depend on more than the files that it read: packages, variables, files that may come.
_OF_ELSEWHERE = re.compile(rb"\$\((?!arg )|optional=|filename=[\"'][^\"']*[*?\[]")


class _Arguments(dict[str, str]):
    """Arguments of a xacro file, and which of them it asks for."""

    def __init__(self, given: Mapping[str, str]) -> None:
        super().__init__(given)
        self.asked: set[str] = set()

    def __contains__(self, key: object) -> bool:
        self.asked.add(str(key))
        return super().__contains__(key)

    def __getitem__(self, key: str) -> str:
        self.asked.add(key)
        return super().__getitem__(key)


def description_text(
    source: Path, arguments: Mapping[str, str] | None = None, packages: Mapping[str, Path] | None = None
) -> str:
    """Read a URDF; what is named `.xacro` is expanded.

    Args:
        source: File of the description.
        arguments: Arguments of xacro by name.
        packages: Folders of packages that `$(find NAME)` names; see `package_folders`.

    Raises:
        OpenArmError: CONFIG_INVALID, with what xacro says; INVALID_ARGUMENT, for an argument that the file does not
            have.
    """
    given = _Arguments(arguments or {})
    wanted = set(given)
    if source.suffix != ".xacro":
        text = read_text(source)
    else:
        text = _expanded(source, given, packages or {}) if given or packages else _kept(source)
    if unknown := wanted - given.asked:
        there = ", ".join(sorted(given.asked)) or "none"
        text = f"{source} has no argument {', '.join(sorted(unknown))}; it has: {there}"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    return text


def _kept(source: Path) -> str:
    """Return an expansion without arguments; what depends on files alone is kept in the cache of the user."""
    path = cache_dir() / "xacro" / hashlib.sha256(os.fsencode(source.resolve())).hexdigest()[:32]
    with suppress(OSError, ValueError, TypeError, KeyError):
        kept = json.loads(path.read_bytes())
        if kept["files"] == _digests(kept["files"]):
            return str(kept["text"])
    xacro.all_includes.clear()
    text = _expanded(source, _Arguments({}), {})
    with suppress(OSError, OpenArmError):  # a cache that can't be written costs time
        read = [str(source), *xacro.all_includes]
        if not any(_OF_ELSEWHERE.search(Path(file).read_bytes()) for file in read):
            kept = {"files": _digests([xacro.__file__, *read]), "text": text}
            write_whole(path, json.dumps(kept).encode())
    return text


def _digests(files: Iterable[str]) -> dict[str, str]:
    return {os.path.abspath(file): hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in files}


def _expanded(source: Path, arguments: _Arguments, packages: Mapping[str, Path]) -> str:
    def find(package: str) -> str:
        found = next((path for path in package_folders(package, source, packages) if os.path.isdir(path)), None)
        if found is None:
            text = f"there is no package {package[:80]!r}, which {source} names; {package_advice(package[:80])}"
            raise OpenArmError(Code.CONFIG_INVALID, text)
        return str(found.resolve())

    # xacro itself finds packages of an ament index only
    before = substitution_args._eval_find
    substitution_args._eval_find = substitution_args._eval_dict["find"] = find
    try:
        return xacro.process_file(str(source), mappings=arguments).toxml()
    except _XACRO_RAISES as error:
        cause = _cause(error)
        if isinstance(cause, OpenArmError):
            raise cause from error
        text = f"xacro does not expand {source}: {said(error, 600)}"
        if isinstance(cause, substitution_args.ArgException):
            text += "; give it by --arg NAME:=VALUE of `openarm model new`"
        raise OpenArmError(Code.CONFIG_INVALID, text) from error
    finally:
        substitution_args._eval_find = substitution_args._eval_dict["find"] = before


def _cause(error: BaseException) -> BaseException:
    """Return what xacro has wrapped, once or more."""
    inner = getattr(error, "exc", None)
    return _cause(inner) if isinstance(inner, BaseException) else error
