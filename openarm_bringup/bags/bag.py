# SPDX-License-Identifier: Apache-2.0
"""Bags: standard rosbag2 folders with MCAP files, written and read by rosbags without deserialising messages.

Stamps of a bag are when a message was received, ns of the system clock. The text of a message definition is made from
the installed Python class, so that every installed type can be recorded, also a user's own.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import yaml
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_mcap import McapWriter, zstd
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from openarm_bringup.bags.definitions import changed_type, definition, nested_types
from openarm_bringup.bags.mcap import DAMAGE, is_closed, mend, unpack
from openarm_bringup.messages import interface
from openarm_common.config import MAX_YAML_BYTES, load_yaml
from openarm_common.errors import Code, OpenArmError, said

#: This much of the disk is left free, so that the bag can still be closed.
SPARE_BYTES = 200 * 2**20
#: Of zstd. Clouds come out smaller at 1 than at its default of 3, in half the time.
_LEVEL = 1
#: By which a file of messages may have been compressed.
_LARGEST_RATIO = 200


def check_room(folder: Path) -> int:
    """Refuse to fill a disk to the end; return how many bytes may be written until it is checked again.

    Raises:
        OSError: When less than `SPARE_BYTES` are free.
    """
    free = shutil.disk_usage(folder).free
    if free < SPARE_BYTES:
        raise OSError(f"the disk has only {free // 2**20} MiB left")
    return SPARE_BYTES // 8


class Topic(NamedTuple):
    """A topic that is recorded, with the quality of service that its publishers offer."""

    name: str
    type: str
    qos: Qos


class Message(NamedTuple):
    """As it was received: `data` is CDR, the stamp that of the middleware, ns of the system clock."""

    topic: str
    t_ns: int
    data: bytes


@dataclass(frozen=True)
class Record:
    """A message as it is in a bag: `data` is CDR."""

    topic: str
    type: str
    t_ns: int
    data: bytes


class BagWriter:
    """Writes a bag; a context manager.

    Args:
        path: Folder of the bag, which must not exist.
        custom: Kept in the metadata: versions, graph, parameters.
        compress: Whether chunks are compressed (zstd).

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the folder exists or can't be made.
    """

    def __init__(self, path: Path, custom: Mapping[str, str], *, compress: bool = True) -> None:
        if path.exists():
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"{path} exists; give the bag another name, a bag is never overwritten"
            )
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._writer = Writer(path, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
        if compress:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._compress = compress
        for key, value in custom.items():
            self.remember(key, value)
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> BagWriter:
        try:
            self._writer.open()
        except OSError as error:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"can't make the bag {self._writer.path}: {error}") from error
        if self._compress:
            storage = self._storage()
            self._pack = partial(storage.compressor, level=_LEVEL)  # pyright: ignore[reportCallIssue]  # zstd.compress
            self.hasten(False)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, OSError):
            self._writer.abort()  # a full disk takes no index either; `open_bag` mends the file
        else:
            self._writer.close()

    def remember(self, key: str, value: str) -> None:
        """Keep something in the metadata, which are written at the end."""
        self._writer.set_custom_data(key, value)

    def add_topic(self, topic: str, kind: str, qos: Qos) -> None:
        """Say what a topic is, before its first message.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when no installed package has its type.
        """
        self._learn(kind)
        self._connections[topic] = self._writer.add_connection(
            topic, kind, typestore=self._types, offered_qos_profiles=[qos]
        )

    def _learn(self, kind: str) -> None:
        """Register a type, such as `sensor_msgs/msg/Image`, and all that it is made of."""
        if kind not in self._types.types:
            message = interface(kind)
            for inner in nested_types(message):
                self._learn(inner)
            self._types.register(get_types_from_msg(definition(message), kind))

    def hasten(self, now: bool) -> None:
        """Leave out compression from here on, or take it up again; a file may hold chunks of both kinds."""
        if self._compress:
            storage = self._storage()
            storage.compression, storage.compressor = ("", bytes) if now else ("zstd", self._pack)

    def _storage(self) -> McapWriter:
        assert isinstance(self._writer.storage, McapWriter)  # it is open
        return self._writer.storage

    def write(self, topic: str, t_ns: int, data: bytes) -> None:
        """Append a message.

        Raises:
            OSError: When the disk is full.
        """
        self._writer.write(self._connections[topic], t_ns, data)


class Bag:
    """A bag that is open for reading; made by `open_bag`.

    Attributes:
        path: As it was given.
        topics: Type and offered quality of service of each topic.
        counts: Messages by topic.
        custom: What was kept with it.
        start_ns: Of the first message.
        duration_s: To the last message.
        mended: How many bytes of an unfinished file were given up; None for a bag that was closed in order.
    """

    def __init__(self, path: Path, reader: Reader, mended: int | None) -> None:
        self.path = path
        self.mended = mended
        self._reader = reader
        # Messages that are compressed one by one are unpacked here, where their size is bounded.
        storage = reader.storage
        self._packed = storage.metadata.compression_mode == "message"
        storage.metadata = storage.metadata._replace(compression_mode=None)
        self.topics: dict[str, tuple[str, Qos | None]] = {}
        self.counts: dict[str, int] = {}
        for connection in reader.connections:
            profiles: Sequence[Qos] = getattr(connection.ext, "offered_qos_profiles", [])
            self.topics[connection.topic] = (connection.msgtype, profiles[0] if profiles else None)
            self.counts[connection.topic] = self.counts.get(connection.topic, 0) + connection.msgcount
        self._definitions = {connection.topic: connection.msgdef for connection in reader.connections}
        self.custom: Mapping[str, str] = reader.storage.metadata.custom or {}
        self.start_ns = reader.start_time
        self.duration_s = max(0, reader.duration - 1) * 1e-9

    def why_not(self, topic: str) -> str:
        """Return why the messages of a topic are not of the installed type of that name; empty when they are.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when no installed package has the type.
        """
        kind, _ = self.topics[topic]
        changed = changed_type(self._definitions[topic], kind)
        return f"{topic} was recorded with other fields of {changed} than the installed ones" if changed else ""

    def records(self, topics: Sequence[str] | None = None, start_s: float = 0.0) -> Iterator[Record]:
        """Messages in the order in which they were received.

        Args:
            topics: Only these; None takes all.
            start_s: Only from this long after the first on.
        """
        chosen = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if not chosen:
            return
        start = self.start_ns + round(start_s * 1e9) if start_s else None
        try:
            for connection, t_ns, data in self._reader.messages(chosen, start=start):
                content = unpack(data) if self._packed else bytes(data)
                yield Record(connection.topic, connection.msgtype, t_ns, content)
        except DAMAGE as error:
            raise damaged(self.path, error) from error


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a rosbag2 folder or an MCAP file for reading.

    A recording that was cut short (SIGKILL, full disk) lacks its end: everything whole in it is kept, the end is
    written again and the metadata made from the file.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it is missing, empty, truncated beyond use, or something else.
    """
    if not path.exists():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"there is no bag at {path}")
    source, mended = path, None
    if path.is_dir():
        files = sorted(path.glob("*.mcap"))
        if not (path / "metadata.yaml").exists():
            if len(files) != 1:
                raise OpenArmError(
                    Code.INVALID_ARGUMENT,
                    f"{path} is not a bag: expected metadata.yaml or one .mcap file, found "
                    f"{', '.join(p.name for p in sorted(path.iterdir())[:5]) or 'nothing'}",
                )
            source = files[0]
        elif cut := [file for file in files if not is_closed(file)]:
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"{cut[0]} was cut short after it had been recorded; copy the bag again, or open this file by itself: "
                "all that is whole in it is kept",
            )
    if source.is_file() and source.suffix == ".mcap":
        mended = mend(source)
    elif source.is_file():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{path} is not a bag: expected a folder of rosbag2 or an .mcap file")
    with ExitStack() as stack:
        try:
            if source.is_dir():
                source = _unpacked(source, stack)
            reader = Reader(source)
            reader.open()
            stack.callback(_close, reader)
            bag = Bag(path, reader, mended)
        except (*DAMAGE, OSError) as error:
            raise damaged(path, error) from error
        yield bag


def _close(reader: Reader) -> None:
    with suppress(*DAMAGE):  # what damaged metadata say of it, the reader tidies up
        reader.close()


def _unpacked(path: Path, stack: ExitStack) -> Path:
    """Return the folder of a bag whose files are not compressed as a whole; one that is gets unpacked, within bounds.

    Raises:
        OpenArmError: CONFIG_INVALID, for metadata that is no YAML.
        ReaderError: When a file unpacks to much more than a recording does.
    """
    size = (path / "metadata.yaml").stat().st_size
    if size > MAX_YAML_BYTES:
        raise ReaderError(f"metadata.yaml has {size} bytes, expected at most {MAX_YAML_BYTES}")
    packed = sorted(path.glob("*.zst"))
    if not packed:
        return path
    folder = Path(stack.enter_context(TemporaryDirectory()))
    document = load_yaml(path / "metadata.yaml")
    about = document["rosbag2_bagfile_information"]
    about |= {"compression_format": "", "compression_mode": ""}
    about["relative_file_paths"] = [name.removesuffix(".zst") for name in about["relative_file_paths"]]
    (folder / "metadata.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    for file in packed:
        most = _LARGEST_RATIO * file.stat().st_size + 2**20
        with zstd.open(file, "rb") as source, (folder / file.stem).open("wb") as target:
            while block := source.read(2**20):
                target.write(block)
                if target.tell() > most:
                    raise ReaderError(f"{file.name} unpacks to more than {_LARGEST_RATIO} times its size")
    return folder


def damaged(path: Path, error: Exception) -> OpenArmError:
    """Return the error of a bag whose content is not what its format says, in one sentence."""
    return OpenArmError(Code.INVALID_ARGUMENT, f"{path} can't be read as a bag: {type(error).__name__}: {said(error)}")
