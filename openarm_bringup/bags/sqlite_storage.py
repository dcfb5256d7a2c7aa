# SPDX-License-Identifier: Apache-2.0
"""Reads databases of rosbag2's storage `sqlite3` (.db3) of any version, without executing anything that they hold.

Views, virtual tables and computed columns run what the file says, so they are refused; triggers and default values do
not run when a table is read. A damaged tree may lead to the same page again and again: steps are bounded by the size.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from rosbags.rosbag2.errors import ReaderError

from openarm_bringup.bags import mcap
from openarm_bringup.bags.storage import Channel, Row, channel, custom_of

MAGIC = b"SQLite format 3\0"
#: Tables of rosbag2; older versions have fewer.
_TABLES = ("topics", "messages", "message_definitions", "metadata")
#: Steps of SQLite's machine for a byte of the file: a row takes about twenty, and has at least eight bytes.
_STEPS, _LOOK = 5, 100_000


class SqliteStorage:
    """A database that is open for reading; see `Storage`.

    Args:
        path: File. Messages that are still in its `-wal` file are read too.

    Raises:
        ReaderError: And others of `DAMAGE`, for content that is no recording.
    """

    def __init__(self, path: Path) -> None:
        self.given_up: int | None = None
        self._steps = 0
        logs = (path.with_name(path.name + suffix) for suffix in ("-wal", "-journal"))
        logged = sum(log.stat().st_size for log in logs if log.exists())
        self._most_steps = _STEPS * (path.stat().st_size + logged) + 10 * _LOOK
        # A file without a log next to it is read without any lock, which would need a folder that can be written.
        uri = f"{path.resolve().as_uri()}?mode=ro{'' if logged else '&immutable=1'}"
        self._database = sqlite3.connect(uri, uri=True, check_same_thread=False)
        try:
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, mcap.MAX_UNPACKED)
            self._database.set_progress_handler(self._bounded, _LOOK)
            self._database.execute("PRAGMA trusted_schema = OFF")
            self._columns = self._tables()
            self._open()
        except BaseException as error:
            self._database.close()
            if logged and isinstance(error, sqlite3.OperationalError):
                raise ReaderError(
                    f"{path.name} was not closed, and its log next to it can't be used here ({error}); copy the whole"
                    f" folder to where you can write, and type: sqlite3 {path.name} 'SELECT COUNT(*) FROM messages'"
                ) from error
            if isinstance(error, sqlite3.DatabaseError):
                raise ReaderError(
                    f"{error}; save what is whole in it with: sqlite3 {path.name} .recover | sqlite3 saved.db3"
                ) from error
            raise

    def _bounded(self) -> int:
        self._steps += _LOOK
        return int(self._steps > self._most_steps)

    def _rows(self, query: str, values: Collection[object] = ()) -> Iterator[tuple[Any, ...]]:
        self._steps = 0
        return self._database.execute(query, tuple(values))

    def _tables(self) -> Mapping[str, tuple[str, ...]]:
        """Return the columns of each table of rosbag2 that there is."""
        found: dict[str, tuple[str, ...]] = {}
        for name, kind, text in self._rows("SELECT name, type, sql FROM sqlite_master"):
            if name not in _TABLES:
                continue
            columns = list(self._rows(f"PRAGMA table_xinfo({name})"))
            if kind != "table" or str(text).upper().startswith("CREATE VIRTUAL") or any(c[6] for c in columns):
                raise ReaderError(f"its {name} is computed, expected a plain table")
            found[name] = tuple(str(column[1]) for column in columns)
        if not {"topics", "messages"} <= found.keys():
            raise ReaderError("it has no tables topics and messages, as a recording of rosbag2 has")
        return found

    def _open(self) -> None:
        counts: dict[int, int] = {}
        stamps: list[int] = []
        for topic, count, first_ns, last_ns in self._rows(
            "SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages GROUP BY topic_id"
        ):
            counts[_integer(topic)] = count
            stamps += [_integer(first_ns), _integer(last_ns)]
        self.start_ns, self.end_ns = (min(stamps), max(stamps)) if stamps else (0, -1)
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in self._columns:
            for kind, encoding, text in self._rows(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ):
                definitions.setdefault(str(kind), (str(encoding), str(text)))
        qos = "offered_qos_profiles" if "offered_qos_profiles" in self._columns["topics"] else "''"
        self.channels: list[Channel] = []
        for number, topic, kind, encoding, offered in self._rows(
            f"SELECT id, name, type, serialization_format, {qos} FROM topics ORDER BY id"
        ):
            schema, text = definitions.get(str(kind), ("", ""))
            self.channels.append(
                channel(
                    _integer(number), str(topic), str(kind), counts.get(number, 0), encoding=str(encoding),
                    schema=schema, text=text.encode(), qos=str(offered),
                )
            )  # fmt: skip
        self.custom: Mapping[str, str] = {}
        if "metadata" in self._columns:
            for (text,) in self._rows("SELECT metadata FROM metadata ORDER BY id DESC LIMIT 1"):
                self.custom = custom_of(str(text))

    def rows(self, channels: Collection[Channel], start_ns: int | None) -> Iterator[Row]:
        """Messages of channels in the order of their stamps, from a stamp on."""
        wanted = {one.number: one for one in channels}
        # Their data are fetched one by one: without an index, SQLite would sort them with all that they hold.
        order = self._rows(
            "SELECT rowid, topic_id, timestamp FROM messages WHERE timestamp >= ? ORDER BY timestamp, rowid",
            (-(2**63) if start_ns is None else min(start_ns, 2**63 - 1),),
        )
        for row, topic, t_ns in order:
            if topic in wanted:
                ((data,),) = self._database.execute("SELECT data FROM messages WHERE rowid = ?", (row,))
                if not isinstance(data, bytes):
                    raise ReaderError(f"the data of its message {row} are {type(data).__name__}, expected a blob")
                yield Row(_integer(t_ns), wanted[topic], data)

    def close(self) -> None:
        """Let go of the file."""
        self._database.close()


def _integer(value: object) -> int:
    if not isinstance(value, int):
        raise ReaderError(f"it has {type(value).__name__} for a number or a stamp, expected an integer")
    return value
