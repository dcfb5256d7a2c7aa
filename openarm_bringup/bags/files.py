# SPDX-License-Identifier: Apache-2.0
"""The files of a recording behind a path: a file of any name, or a folder with or without metadata.yaml."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from tempfile import TemporaryDirectory
from typing import Any

from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_mcap import zstd

from openarm_bringup.bags import mcap, sqlite_storage
from openarm_bringup.bags.mcap_storage import McapStorage
from openarm_bringup.bags.sqlite_storage import SqliteStorage
from openarm_bringup.bags.storage import Storage, custom_in
from openarm_common.config import load_yaml
from openarm_common.errors import Code, OpenArmError, said
from openarm_common.printable import brief_text, printable

ZSTD = b"\x28\xb5\x2f\xfd"
#: By which a file of messages may have been compressed.
_LARGEST_RATIO = 200
_METADATA = "metadata.yaml"
#: Name of a file of a recording: of its storage, maybe compressed as a whole; a split recording numbers its files.
_NAME = re.compile(r"(?P<stem>.*?)(?:_(?P<number>\d{1,9}))?\.(?P<kind>mcap|db3)(?:\.zstd?)?")
#: What other files are, by their first bytes, and what to type.
_OTHERS: Sequence[tuple[bytes, str]] = (
    (b"#ROSBAG V2", "a bag of ROS 1; convert it: {convert} --src {path} --dst {stem}"),
    (b"#ROSBAG", "a bag of ROS 1 of an old version; convert it in ROS 1 (rosbag fix), then with rosbags-convert"),
    (b"PK\x03\x04", "a zip archive; unpack it: unzip {path} -d {stem}"),
    (b"\x1f\x8b", "a gzip archive; unpack it: tar xzf {path}, or gunzip -k {path} if it holds one file"),
    (b"BZh", "a bzip2 archive; unpack it: tar xjf {path}, or bunzip2 -k {path} if it holds one file"),
    (b"\xfd7zXZ\0", "an xz archive; unpack it: tar xJf {path}, or unxz -k {path} if it holds one file"),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive; unpack it: 7z x {path}"),
    (b"Rar!", "a rar archive; unpack it: unrar x {path}"),
    (b"\x04\x22\x4d\x18", "compressed by lz4; unpack it: lz4 -d {path}"),
    (b"ply", "a point cloud or mesh (PLY), not a recording"),
    (b"# .PCD", "a point cloud (PCD), not a recording; `openarm perceive {path}` takes an organised one"),
    (b"\x89PNG", "an image (PNG), not a recording"),
    (b"\xff\xd8\xff", "an image (JPEG), not a recording"),
    (b"\x89HDF", "an HDF5 file, not a recording of ROS"),
    (b"\x93NUMPY", "an array of NumPy, not a recording"),
)


#: Names of archives, which may hold one: what they are is said.
_ARCHIVES = {".gz", ".tgz", ".tar", ".zip", ".bz2", ".xz", ".7z", ".rar", ".lz4"}


@dataclass(frozen=True)
class Found:
    """Files of a recording in their order, and what metadata.yaml says was kept with it."""

    files: Sequence[Path]
    custom: Mapping[str, str] = field(default_factory=dict[str, str])


def is_recording(path: Path) -> bool:
    """Whether a file is a recording by its name or its first bytes, of ROS 1 too, or a folder has such a file."""
    named = _is_part(path.name) or path.suffix == ".bag" or path.suffix.lower() in _ARCHIVES
    if named or not os.access(path, os.R_OK):
        return named
    if path.is_dir():
        return any(_is_part(file.name) for file in path.iterdir())
    return path.is_file() and _first(path).startswith((mcap.MAGIC, sqlite_storage.MAGIC, ZSTD, b"#ROSBAG"))


def find(path: Path, stack: ExitStack) -> Found:
    """Return the files of a recording; those that are compressed as a whole are unpacked, until the stack ends.

    Args:
        path: Folder or file; metadata.yaml stands for its folder.
        stack: Removes what was unpacked.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when there is none, or several recordings, or metadata list no files.
        ReaderError: When a file unpacks to much more than a recording does.
    """
    if not path.exists():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"there is no bag at {path}")
    if path.name == _METADATA:
        path = path.parent
    if path.is_file():
        return Found([_unpacked(path, stack)])
    if not path.is_dir():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{path} is neither a file nor a folder")
    found = _described(path) if _is_filled(path / _METADATA) else Found(_one_recording(path))
    return Found([_unpacked(file, stack) for file in found.files], found.custom)


def open_storage(path: Path) -> Storage:
    """Open a file of a recording, by its first bytes.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a file that is something else, saying what.
    """
    first = _first(path)
    if first.startswith(mcap.MAGIC):
        return McapStorage(path)
    if first.startswith(sqlite_storage.MAGIC):
        return SqliteStorage(path)
    raise OpenArmError(Code.INVALID_ARGUMENT, f"{path} {_what(path, first)}")


def _first(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(512)


def _what(path: Path, first: bytes) -> str:
    """Return what a file is that is no storage of rosbag2, and what to do."""
    if not first:
        return "is empty"
    convert = shutil.which("rosbags-convert", path=Path(sys.executable).parent) or "rosbags-convert"
    names = {
        "path": shlex.quote(str(path)),
        "stem": shlex.quote(str(path.with_name(path.name.partition(".")[0]))),
        "convert": shlex.quote(convert),
    }
    for magic, text in _OTHERS:
        if first.startswith(magic):
            return f"is {text.format_map(names)}"
    if first[257:262] == b"ustar":
        return f"is a tar archive; unpack it: tar xf {names['path']}"
    name = _NAME.fullmatch(path.name)
    expected = {"mcap": "an MCAP file", "db3": "a database of SQLite"}.get(name["kind"] if name else "")
    if expected:
        return f"is not {expected} (wrong magic at its start); copy it again"
    return "is not a bag: expected a folder of rosbag2, or a file of MCAP (.mcap) or SQLite (.db3)"


def _is_filled(path: Path) -> bool:
    """Whether there is a file that is not empty, as a full disk leaves it."""
    return path.is_file() and path.stat().st_size > 0


def _described(folder: Path) -> Found:
    """Return the files that metadata.yaml lists: by their names alone, since folders are moved and renamed."""
    about = folder / _METADATA
    try:
        document: Any = load_yaml(about, Code.INVALID_ARGUMENT)["rosbag2_bagfile_information"]
        listed: list[Any] = [*document["relative_file_paths"]]
    except (OpenArmError, LookupError, TypeError) as error:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{about} lists no files ({said(error)}); move it away to read the files of the folder without it",
        ) from error
    names = [PureWindowsPath(PurePosixPath(str(name)).name).name for name in listed]
    there = {file.name: file for file in folder.iterdir() if file.is_file()}
    found = {name: there.get(name) or there.get(name.removesuffix(".zstd").removesuffix(".zst")) for name in names}
    files = [file for file in found.values() if file is not None]
    missing = [name for name, file in found.items() if file is None]
    if not files and any(map(_NAME.fullmatch, there)):
        return Found(_one_recording(folder), custom_in(document))  # renamed
    if missing:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{folder} lacks {brief_text(printable(', '.join(missing)))}, which {_METADATA} lists; copy the bag again, "
            f"or move {_METADATA} away to read the files that are there",
        )
    for file in files:
        if file.suffix == ".mcap" and not mcap.is_closed(file):
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"{file} was cut short after it had been recorded; copy the bag again, or open this file by itself: "
                "all that is whole in it is kept",
            )
    return Found(files, custom_in(document))


def _one_recording(folder: Path) -> list[Path]:
    """Return the files of a folder that belong to one recording, in the order of their numbers.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when there is none, or when the files are not numbered as parts of one.
    """
    entries = sorted(folder.iterdir())
    named = {file: match for file in entries if (match := _NAME.fullmatch(file.name)) and file.is_file()}
    files = sorted(named, key=lambda file: (named[file]["stem"], int(named[file]["number"] or 0)))
    if len(files) == 1:
        return files
    if not files:
        inner = [one.name for one in entries if one.is_dir() and is_recording(one)]
        found = ", ".join(one.name for one in entries[:5]) or "nothing"
        there = f"bags in it: {', '.join(inner[:5])}; name one of them" if inner else f"found {found}"
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"{folder} is not a bag: expected {_METADATA}, or files .mcap or .db3; {there}"
        )
    numbers = [int(named[file]["number"] or -2) for file in files]
    alike = len({(named[file]["stem"], named[file]["kind"]) for file in files}) == 1
    if not alike or numbers != list(range(numbers[0], numbers[0] + len(files))):
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{folder} has files of several recordings and no {_METADATA}: {', '.join(f.name for f in files[:5])}; name"
            " one of them; parts of one recording have names such as NAME_0.mcap, NAME_1.mcap",
        )
    return files


def _is_part(name: str) -> bool:
    return name == _METADATA or _NAME.fullmatch(name) is not None


def _unpacked(path: Path, stack: ExitStack) -> Path:
    """Return a file, unpacked within bounds where it is compressed as a whole."""
    if not _first(path).startswith(ZSTD):
        return path
    folder = Path(stack.enter_context(TemporaryDirectory()))
    most = _LARGEST_RATIO * path.stat().st_size + 2**20
    out = folder / path.name.removesuffix(".zstd").removesuffix(".zst")
    with zstd.open(path, "rb") as source, out.open("wb") as target:
        while block := source.read(2**20):
            target.write(block)
            if target.tell() > most:
                raise ReaderError(f"{path.name} unpacks to more than {_LARGEST_RATIO} times its size")
    return out
