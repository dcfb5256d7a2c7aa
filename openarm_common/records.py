# SPDX-License-Identifier: Apache-2.0
"""Records that are kept: one YAML each, checked by its own hash, with history and rollback.

Files are written to another name and renamed, so that a reader gets an old or a new one, never a part. A damaged file
and one of another robot are passed over, and the newest good one of the history takes their place.
"""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import json
import os
import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import yaml
from pydantic import Field

from openarm_common.config import Config, load_yaml, validate
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import write_whole
from openarm_common.robot.folder import DEFAULT, other_robot, robot_name

_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")


class Record(Config, ABC):
    """What is stored under a name.

    Attributes:
        place: Folder of its kind below that of the calibrations.
        noun: Name of a record in messages.
        command: Command that makes one.
        usual: Name of the one that is meant where none is named.
    """

    place: ClassVar[str] = ""
    noun: ClassVar[str]
    command: ClassVar[str]
    usual: ClassVar[str] = ""

    robot: str = Field(
        default_factory=robot_name, description="that it is of; files of old do not say it and are of openarm_v1"
    )

    @property
    @abstractmethod
    def name(self) -> str:
        """What it is stored under."""

    def fields(self) -> dict[str, Any]:
        """Return what is written and hashed; a file of old has no robot and keeps its hash."""
        return self.model_dump(mode="json", exclude=None if self.robot else {"robot"})

    def digest(self) -> str:
        """Return the hash of all fields."""
        text = json.dumps(self.fields(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()


RecordT = TypeVar("RecordT", bound=Record)


@dataclass(frozen=True)
class Found(Generic[RecordT]):
    """What a store has under a name: the record, and what was wrong with the file when it is an older one."""

    record: RecordT
    warning: str = ""


class RecordStore(Generic[RecordT]):
    """The records of a kind, below a folder of calibrations; each of its folders is made at the first save.

    Args:
        calibrations: Folder of the calibrations.
        kind: Model of the records.
    """

    def __init__(self, calibrations: Path, kind: type[RecordT]) -> None:
        self.folder = calibrations / kind.place
        self.kind = kind

    def path(self, name: str) -> Path:
        """Return the file of a name.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for a name that could lead elsewhere.
        """
        return self.folder / f"{checked_name(name)}.yaml"

    def names(self) -> tuple[str, ...]:
        """Return the names that have a file, damaged or not."""
        return tuple(sorted(p.stem for p in self.folder.glob("*.yaml") if _NAME.fullmatch(p.stem)))

    def save(self, record: RecordT) -> Path:
        """Make it the present one of its name; the one before stays in the history.

        Raises:
            OpenArmError: ENVIRONMENT, when the folder can't be written.
        """
        path = self.path(record.name)
        digest = record.digest()
        text = yaml.safe_dump({**record.fields(), "sha256": digest}, sort_keys=False)
        number = 1 + max(map(_number, self._past(record.name)), default=0)
        write_whole(self._history(record.name) / f"{number:06d}-{digest[:12]}.yaml", text.encode())
        write_whole(path, text.encode())
        return path

    def load(self, name: str) -> RecordT:
        """Read what is stored under a name.

        Raises:
            OpenArmError: CONFIG_INVALID, when there is none, it is damaged, saying how, or of another robot.
        """
        path = self.path(name)
        if not path.is_file():
            known = ", ".join(self.names()) or "none"
            raise OpenArmError(
                Code.CONFIG_INVALID, f"no {self.kind.noun} of {name!r} in {self.folder}; stored are: {known}"
            )
        record = self._read(path)
        if text := _other_robot(record):
            raise OpenArmError(Code.CONFIG_INVALID, f"{path} {text}")
        return record

    def find(self, name: str) -> Found[RecordT] | None:
        """Return what is stored of this process's robot under a name, or the newest good one before it; None of none.

        Raises:
            OpenArmError: CONFIG_INVALID, when the file is damaged and the history has no good one.
        """
        path, fault = self.path(name), ""
        try:
            if path.is_file() and not _other_robot(record := self._read(path)):
                return Found(record)
        except OpenArmError as error:
            fault = error.message
        if good := self._good(name):
            older, record = good[-1]
            return Found(record, f"{fault}; the last good one, {older.name}, is used" if fault else "")
        if fault:
            raise OpenArmError(
                Code.CONFIG_INVALID, f"{fault}; remove it, then `{self.kind.command}` makes a new {self.kind.noun}"
            )
        return None

    def history(self, name: str) -> tuple[RecordT, ...]:
        """Return all good records of a name that are of this process's robot, oldest first."""
        return tuple(record for _, record in self._good(name))

    def rollback(self, name: str) -> RecordT:
        """Go back to the record before the present one; the present one leaves the history.

        Raises:
            OpenArmError: CONFIG_INVALID, when there is none before it.
        """
        past, good = self._past(name), self._good(name)
        if len(good) < 2:
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"going back needs a {self.kind.noun} of {name!r} before the present one; stored: {len(good)}",
            )
        path, before = good[-2]
        write_whole(self.path(name), path.read_bytes())
        for later in past[past.index(path) + 1 :]:
            with contextlib.suppress(OpenArmError):
                if _other_robot(self._read(later)):
                    continue
            later.unlink()
        return before

    def state(self) -> tuple[tuple[str, int, int], ...]:
        """Return what changes when a file does: names, sizes and times of the files."""
        out: list[tuple[str, int, int]] = []
        for name in self.names():
            try:
                status = self.path(name).stat()
            except FileNotFoundError:
                continue  # between the listing and now
            out.append((name, status.st_mtime_ns, status.st_size))
        return tuple(out)

    def _history(self, name: str) -> Path:
        return self.folder / "history" / checked_name(name)

    def _good(self, name: str) -> list[tuple[Path, RecordT]]:
        """Return the records of the history that are not damaged and of this robot, oldest first."""
        out: list[tuple[Path, RecordT]] = []
        for path in self._past(name):
            with contextlib.suppress(OpenArmError):
                if not _other_robot(record := self._read(path)):
                    out.append((path, record))
        return out

    def _past(self, name: str) -> list[Path]:
        return sorted(self._history(name).glob("*.yaml"), key=_number)

    def _read(self, path: Path) -> RecordT:
        """Read and check one file of any robot.

        Raises:
            OpenArmError: CONFIG_INVALID, when it is not as it was written.
        """
        data = {"robot": "", **load_yaml(path)}
        stated = data.pop("sha256", None)
        record = validate(self.kind, data, str(path))
        if stated != record.digest():
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"{path} is damaged or was edited: its contents do not have the hash that it states",
            )
        return record


def checked_name(name: str) -> str:
    """Return a name when it is one.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for anything else, above all what a file system reads as a path.
    """
    if not _NAME.fullmatch(name):
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"name {name!r}: expected lower-case letters, digits and _, beginning with a letter, at most 64",
        )
    return name


def now() -> str:
    """Return date and time for the record."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def default_folder() -> Path:
    """Return the default folder of calibrations: OPENARM_CALIBRATIONS, or the user's data folder."""
    given = os.environ.get("OPENARM_CALIBRATIONS", "")
    if given:
        return Path(given).expanduser()
    base = os.environ.get("XDG_DATA_HOME", "")
    return (Path(base) if base else Path.home() / ".local" / "share") / "openarm" / "calibrations"


def _other_robot(record: Record) -> str:
    return other_robot(record.robot or DEFAULT)


def _number(path: Path) -> int:
    head = path.name.partition("-")[0]
    return int(head) if head.isdigit() else 0
