# SPDX-License-Identifier: Apache-2.0
"""Recordings of other programs: every storage, layout and encoding is read in order, or named with a way out."""

from __future__ import annotations

import io
import os
import sqlite3
import struct
import tarfile
import time
import zipfile
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.interfaces import Qos, QosDurability, QosReliability
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import zstd
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from openarm_bringup.bags.bag import Bag, BagWriter, open_bag
from openarm_bringup.bags.definitions import event_definition
from openarm_bringup.bags.files import is_recording
from openarm_bringup.bags.ros.listener import from_profile
from openarm_bringup.bags.ros.messages import messages_of
from openarm_bringup.calibration.source import ALL_SAMPLES, opened
from openarm_bringup.commands.perceive import perceive
from openarm_bringup.commands.record import replay
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_SENSOR
from tests.openarm_bringup.mcap_files import Topic, channels, chunk, end, head, messages, unchunked
from tests.refusals import refused

STRING = "std_msgs/msg/String"
FOREIGN = (
    Topic("/json", "foxglove.Log", [(3, b"{}")] * 2, "json", "jsonschema", b"{}"),
    Topic("/proto", "foxglove.Image", [(4, b"\xff")], "protobuf", "protobuf", b"\x0a\xff\xfe"),
    Topic("/ros1", "std_msgs/String", [(5, b"\x01\0\0\0x")], "ros1", "ros1msg", b"string data"),
    Topic("/flat", "X", [(6, b"")] * 3, "flatbuffer", "flatbuffer", b"\xff"),
    Topic("/plain", "", [], "json", ""),
)


def cdr(text: str) -> bytes:
    return serialize_message(String(data=text))


def strings(name: str, stamps: Sequence[int], kind: str = STRING) -> Topic:
    return Topic(name, kind, [(t, cdr(f"{name} {t}")) for t in stamps], text=b"string data\n")


def said(bag: Bag) -> list[str]:
    """What all messages say, in the order in which they are read; also that the counts hold."""
    records = list(bag.records())
    assert len(records) == sum(bag.counts.values())
    return [deserialize_message(record.data, String).data for record in records]


def refusal(path: Path) -> str:
    with pytest.raises(OpenArmError) as caught, open_bag(path) as bag:
        list(bag.records())
    assert caught.value.code is Code.INVALID_ARGUMENT
    return caught.value.message


def rosbag2(path: Path, storage: StoragePlugin, stamps: Sequence[int], qos: Sequence[Qos] = ()) -> Path:
    types = get_typestore(Stores.ROS2_JAZZY)
    with Writer(path, version=8, storage_plugin=storage) as writer:
        writer.set_custom_data("graph", "other")
        connection = writer.add_connection("/a", STRING, typestore=types, offered_qos_profiles=qos)
        for t in stamps:
            writer.write(connection, t, cdr(f"/a {t}"))
    return path


# --- SQLite
@pytest.mark.requirement("M-07")
@pytest.mark.parametrize("alone", [True, False])
def test_a_database_without_metadata_is_read_alone_and_in_its_folder(tmp_path: Path, alone: bool) -> None:
    written = rosbag2(tmp_path / "bag", StoragePlugin.SQLITE3, range(9), [from_profile(QOS_LATCHED)])
    folder = written.rename(tmp_path / "bag %2 #?")
    (folder / "metadata.yaml").unlink()
    with open_bag(next(folder.glob("*.db3")) if alone else folder) as bag:
        assert said(bag) == [f"/a {t}" for t in range(9)]
        kind, qos = bag.topics["/a"]
        assert (kind, qos and qos.durability, bag.duration_s) == (STRING, QosDurability.TRANSIENT_LOCAL, 8e-9)
        assert bag.why_not("/a") == ""
        assert bag.custom["graph"] == "other", "kept in the database, too"
        assert [record.t_ns for record in bag.records(["/a"], 5e-9)] == [5, 6, 7, 8]


_OLD = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT);"
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
    f"INSERT INTO topics VALUES(1, '/a', '{STRING}', 'cdr');"
)


def old_database(path: Path, stamps: Sequence[int], *, log: bool = False) -> sqlite3.Connection:
    """As rosbag2 of Dashing writes it; with a log, it stays open and the messages are in the log."""
    database = sqlite3.connect(path)
    if log:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA wal_autocheckpoint = 0")
    database.executescript(_OLD)
    for t in stamps:
        database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)", (t, cdr(f"/a {t}")))
    database.commit()
    return database


def test_an_old_database_without_index_is_read_in_the_order_of_stamps(tmp_path: Path) -> None:
    old_database(tmp_path / "old.db3", [5, 3, 9, 1]).close()
    with open_bag(tmp_path / "old.db3") as bag:
        assert said(bag) == ["/a 1", "/a 3", "/a 5", "/a 9"]
        assert bag.topics["/a"] == (STRING, None)


def test_messages_that_are_still_in_the_log_beside_a_database_are_read(tmp_path: Path) -> None:
    """As `ros2 bag record --storage-preset-profile resilient` leaves them when it is killed."""
    database = old_database(tmp_path / "live.db3", range(50), log=True)
    (tmp_path / "killed").mkdir()
    for name in ("live.db3", "live.db3-wal"):
        (tmp_path / "killed" / name).write_bytes((tmp_path / name).read_bytes())
    database.close()
    with open_bag(tmp_path / "killed") as bag:
        assert said(bag) == [f"/a {t}" for t in range(50)]


_ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x AS id, x AS metadata FROM c"


@pytest.mark.parametrize(
    ("script", "match"),
    [
        ("CREATE TABLE x(y)", "has no tables topics and messages"),
        (f"{_OLD} CREATE VIEW metadata AS {_ENDLESS}", "its metadata is computed"),
        (
            f"{_OLD} DROP TABLE messages; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp,"
            " data AS (zeroblob(900000000)))",
            "its messages is computed",
        ),
        (
            f"{_OLD} DROP TABLE messages; CREATE VIRTUAL TABLE messages USING fts4(topic_id, timestamp, data)",
            "computed",
        ),
        (f"{_OLD} INSERT INTO messages VALUES(1, 1, 'x', x'00')", "expected an integer"),
        (f"{_OLD} INSERT INTO messages VALUES(1, 1, 5, 7)", "expected a blob"),
    ],
)
def test_databases_that_are_no_recording_or_would_run_something_are_refused(
    tmp_path: Path, script: str, match: str
) -> None:
    database = sqlite3.connect(tmp_path / "hostile.db3")
    database.executescript(script)
    database.close()
    began = time.process_time()
    assert match in refusal(tmp_path / "hostile.db3")
    assert time.process_time() - began < 2.0


def test_a_database_whose_pages_lead_to_each_other_without_end_is_refused(tmp_path: Path) -> None:
    """Four pages whose 401 entries all are the next page, and a page of messages: 1e11 rows."""
    path, size = tmp_path / "tree.db3", 4096
    database = old_database(path, range(3000))
    (root,) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
    database.close()
    data = bytearray(path.read_bytes())
    start = (root - 1) * size
    places = struct.unpack_from(">5H", data, start + 12)
    children = [struct.unpack_from(">I", data, start + place)[0] for place in places]
    for page, following in pairwise([root, *children]):
        cells = b"".join(struct.pack(">IB", following, k % 120) for k in range(400))
        head = struct.pack(">BHHHBI", 5, 0, 400, size - len(cells), 0, following)
        pointers = struct.pack(">400H", *(size - len(cells) + 5 * k for k in range(400)))
        data[(page - 1) * size : page * size] = (head + pointers).ljust(size - len(cells), b"\0") + cells
    path.write_bytes(data)
    began = time.process_time()
    assert "interrupted" in refusal(path)
    assert time.process_time() - began < 2.0


def test_a_damaged_database_is_refused_with_what_saves_the_rest(tmp_path: Path) -> None:
    old_database(tmp_path / "a.db3", range(2000)).close()
    data = (tmp_path / "a.db3").read_bytes()
    (tmp_path / "a.db3").write_bytes(data[: len(data) // 2])
    assert "sqlite3 a.db3 .recover | sqlite3 saved.db3" in refusal(tmp_path / "a.db3")


# --- MCAP
def test_channels_of_other_encodings_are_left_out_and_named(tmp_path: Path) -> None:
    path = unchunked(tmp_path / "mixed.mcap", [strings("/a", [1, 7]), *FOREIGN], profile="")
    with open_bag(path) as bag:
        assert said(bag) == ["/a 1", "/a 7"]
        assert bag.left_out == {
            "/json": "2 messages of json (jsonschema)",
            "/proto": "1 message of protobuf (protobuf)",
            "/ros1": "1 message of ros1 (ros1msg)",
            "/flat": "3 messages of flatbuffer (flatbuffer)",
            "/plain": "0 messages of json (no schema)",
        }
    with pytest.raises(OpenArmError, match=r"not in .*: /json; topics: /a; left out .*/json: 2 messages of json"):
        replay(path, topics=("/json",))
    with pytest.raises(OpenArmError, match=r"left out .*/json: 2 messages of json \(jsonschema\)"):
        perceive(path)


def test_a_file_without_any_message_of_ros_2_is_refused_with_what_is_in_it(tmp_path: Path) -> None:
    text = refusal(unchunked(tmp_path / "foreign.mcap", FOREIGN))
    assert "has no messages of ROS 2: /json: 2 messages of json (jsonschema); /proto: 1 message of protobuf" in text
    assert "ros2 bag record" in text


@pytest.mark.parametrize("whole", range(1, 10))
def test_of_a_file_without_chunks_that_was_cut_all_whole_messages_are_read(tmp_path: Path, whole: int) -> None:
    topics = [strings("/a", range(9))]
    records = messages(topics)
    path = tmp_path / "cut.mcap"
    start = head() + channels(topics) + b"".join(records[:whole])
    path.write_bytes(start + (records[whole][:-1] if whole < 9 else b""))
    before = path.read_bytes()
    for _ in range(2):
        with open_bag(path) as bag:
            assert said(bag) == [f"/a {t}" for t in range(whole)]
            assert bag.mended == len(before) - len(start)
    assert path.read_bytes() == before, "it is left as it was"


def test_messages_inside_and_outside_of_chunks_come_in_the_order_of_stamps(tmp_path: Path) -> None:
    """Without index and summary, and not written in order: a reader that trusts an index would lose most of them."""
    topics = [strings("/a", [6, 2, 9]), strings("/b", [1, 8, 3])]
    one, two, *rest, last = messages(topics)
    body = channels(topics) + one + chunk([two, *rest], (1, 9)) + last
    (tmp_path / "odd.mcap").write_bytes(head("") + body + end())
    with open_bag(tmp_path / "odd.mcap") as bag:
        assert said(bag) == ["/b 1", "/a 2", "/b 3", "/a 6", "/b 8", "/a 9"]
        assert (bag.start_ns, bag.duration_s) == (1, 8e-9)


def test_names_of_types_without_msg_or_with_colons_are_understood(tmp_path: Path) -> None:
    topics = [strings("/a", [1], "std_msgs/String"), strings("/b", [2], "std_msgs::msg::String")]
    with open_bag(unchunked(tmp_path / "a.mcap", topics)) as bag:
        assert {kind for kind, _ in bag.topics.values()} == {STRING}
        assert said(bag) == ["/a 1", "/b 2"]


def test_a_topic_of_two_types_is_read_as_what_most_of_it_is(tmp_path: Path) -> None:
    other = Topic("/a", "std_msgs/msg/Bool", [(2, b"\0\1\0\0\1")], text=b"bool data\n")
    with open_bag(unchunked(tmp_path / "a.mcap", [other, strings("/a", [1, 3])])) as bag:
        assert said(bag) == ["/a 1", "/a 3"]
        assert bag.left_out == {"/a": "1 message of std_msgs/msg/Bool"}


@pytest.mark.parametrize(
    ("kind", "match"),
    [
        ("std_srvs/srv/SetBool", "is no message"),
        ("std_msgs/msg/__name__", "__name__"),
        (".x/msg/A", "not the name of a type"),
        ("std_msgs/msg/Strin", "did you mean"),
        ("no_such_msgs/msg/A", "the package 'no_such_msgs' is not installed"),
        ("a/b/c/d", "not the name of a type"),
    ],
)
def test_types_that_are_no_installed_messages_say_why(tmp_path: Path, kind: str, match: str) -> None:
    path = unchunked(tmp_path / "a.mcap", [strings("/a", [1], kind)])
    refused(match, replay, path, topics=("/a",))
    with open_bag(path) as bag:
        assert sum(1 for _ in bag.records()) == 1


def test_a_type_that_changed_within_a_recording_is_named(tmp_path: Path) -> None:
    changed = strings("/a", [2])._replace(text=b"string text\n")
    with open_bag(unchunked(tmp_path / "a.mcap", [changed, strings("/a", [1])])) as bag:
        assert "other fields of std_msgs/msg/String" in bag.why_not("/a")


def test_messages_of_other_fields_are_not_misread(tmp_path: Path) -> None:
    """Their bytes may make a message of the installed type, too: here the first of two texts."""
    two = Topic("/a", STRING, [(1, cdr("one") + b"two\0")], text=b"string data\nchar[4] more\n")
    same = strings("/b", [1])._replace(text=b"string data\nchar[4] more\n")
    with open_bag(unchunked(tmp_path / "a.mcap", [two, same])) as bag:
        refused("other fields of std_msgs/msg/String .*read it with the version that made it", messages_of, bag, ["/a"])
        assert [message.data for message in messages_of(bag, ["/b"])["/b"]] == ["/b 1"]


def test_several_publishers_of_a_topic_are_replayed_with_what_serves_all_subscribers(tmp_path: Path) -> None:
    types = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for k, profile in enumerate((QOS_LATCHED, QOS_SENSOR)):
            offered = [from_profile(profile)]
            connection = writer.add_connection("/a", STRING, typestore=types, offered_qos_profiles=offered)
            writer.write(connection, k, cdr(f"/a {k}"))
    with open_bag(tmp_path / "bag") as bag:
        assert said(bag) == ["/a 0", "/a 1"]
        _, qos = bag.topics["/a"]
        assert qos is not None
        assert (qos.reliability, qos.durability) == (QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL)


# --- folders
def _split(folder: Path, names: Sequence[str]) -> Path:
    folder.mkdir()
    for k, name in enumerate(names):
        unchunked(folder / name, [strings("/a", [10 * k + 1, 10 * k + 5])])
    return folder


def test_a_split_recording_without_metadata_is_read_in_order(tmp_path: Path) -> None:
    folder = _split(tmp_path / "bag", [f"run_{k}.mcap" for k in (*range(8, 12),)])
    with open_bag(folder) as bag:
        assert said(bag) == [f"/a {t}" for t in (1, 5, 11, 15, 21, 25, 31, 35)]


@pytest.mark.parametrize("names", [("monday.mcap", "tuesday.mcap"), ("bag_101500.mcap", "bag_113000.mcap")])
def test_several_recordings_in_a_folder_are_named(tmp_path: Path, names: tuple[str, ...]) -> None:
    text = refusal(_split(tmp_path / "bag", names))
    assert f"several recordings and no metadata.yaml: {names[0]}, {names[1]}; name one of them" in text


def test_a_folder_of_bags_names_them(tmp_path: Path) -> None:
    _split(tmp_path / "one", ["one_0.mcap"])
    assert "bags in it: one; name one of them" in refusal(tmp_path)


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("version", range(1, 11))
def test_metadata_of_all_versions_are_read_by_the_names_of_their_files(
    tmp_path: Path, version: int, storage: StoragePlugin
) -> None:
    """Old ones have a folder before the name, later ones no hash or quality of service; a storage may be empty."""
    folder = rosbag2(tmp_path / "bag", storage, range(5))
    document = yaml.safe_load((folder / "metadata.yaml").read_text())
    about = document["rosbag2_bagfile_information"]
    about |= {"version": version, "storage_identifier": ""}
    prefix = "old_name/" if version < 4 else "/home/somebody/bags/old_name/"
    about["relative_file_paths"] = [prefix + name for name in about["relative_file_paths"]]
    for topic in about["topics_with_message_count"]:
        del topic["topic_metadata"]["type_description_hash"], topic["topic_metadata"]["offered_qos_profiles"]
    (folder / "metadata.yaml").write_text(yaml.safe_dump(document))
    for path in (folder, folder / "metadata.yaml"):
        with open_bag(path) as bag:
            assert said(bag) == [f"/a {t}" for t in range(5)]
            assert bag.custom == {"graph": "other"}


@pytest.mark.parametrize("suffix", [".zst", ".zstd"])
def test_a_file_that_is_compressed_as_a_whole_is_read_with_metadata_and_alone(tmp_path: Path, suffix: str) -> None:
    folder = rosbag2(tmp_path / "bag", StoragePlugin.SQLITE3, range(5))
    packed = folder / f"bag.db3{suffix}"
    packed.write_bytes(zstd.compress((folder / "bag.db3").read_bytes()))
    (folder / "bag.db3").unlink()
    document = yaml.safe_load((folder / "metadata.yaml").read_text())
    document["rosbag2_bagfile_information"] |= {
        "compression_format": "zstd", "compression_mode": "FILE", "relative_file_paths": [packed.name],
    }  # fmt: skip
    (folder / "metadata.yaml").write_text(yaml.safe_dump(document))
    for path in (folder, packed):
        with open_bag(path) as bag:
            assert said(bag) == [f"/a {t}" for t in range(5)]


def test_messages_that_are_compressed_one_by_one_are_read_without_metadata(tmp_path: Path) -> None:
    topic = Topic("/a", STRING, [(1, zstd.compress(cdr("hello")))], text=b"string data\n")
    with open_bag(unchunked(tmp_path / "a.mcap", [topic])) as bag:
        assert said(bag) == ["hello"]


def test_metadata_without_files_and_files_that_are_missing_say_what_to_do(tmp_path: Path) -> None:
    folder = rosbag2(tmp_path / "bag", StoragePlugin.MCAP, range(3))
    whole = (folder / "metadata.yaml").read_text()
    for text in ("{", "a: 1", "[]"):
        (folder / "metadata.yaml").write_text(text)
        assert "move it away to read the files of the folder without it" in refusal(folder)
    (folder / "metadata.yaml").write_text("")  # of a full disk
    with open_bag(folder) as bag:
        assert len(said(bag)) == 3
    document = yaml.safe_load(whole)
    document["rosbag2_bagfile_information"]["relative_file_paths"] = ["bag.mcap", "bag_1.mcap"]
    (folder / "metadata.yaml").write_text(yaml.safe_dump(document))
    assert "lacks bag_1.mcap, which metadata.yaml lists; copy the bag again, or move" in refusal(folder)
    (folder / "metadata.yaml").write_text(whole)
    (folder / "bag.mcap").rename(folder / "renamed.mcap")
    with open_bag(folder) as bag:
        assert len(said(bag)) == 3
    (folder / "renamed.mcap").unlink()
    assert "lacks bag.mcap" in refusal(folder)


def test_what_is_neither_file_nor_folder_is_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    assert "neither a file nor a folder" in refusal(tmp_path / "pipe.mcap")
    assert "found pipe.mcap" in refusal(tmp_path)


# --- what is no bag of ROS 2
def test_a_bag_of_ros_1_says_how_to_convert_it_in_every_command(tmp_path: Path) -> None:
    with Rosbag1Writer(tmp_path / "old.bag") as writer:
        types = get_typestore(Stores.ROS1_NOETIC)
        writer.write(writer.add_connection("/a", STRING, typestore=types), 1, b"\x01\0\0\0x")
    path = tmp_path / "old.bag"
    match = rf"is a bag of ROS 1; convert it: '?[^']*rosbags-convert'? --src {path} --dst {tmp_path / 'old'}$"
    for call in (perceive, replay, lambda given: opened(given, ALL_SAMPLES)):
        refused(match, call, path)


def _archive(kind: str) -> bytes:
    out = io.BytesIO()
    if kind == "zip":
        with zipfile.ZipFile(out, "w") as archive:
            archive.writestr("a.txt", "a")
    else:
        with tarfile.open(fileobj=out, mode=kind) as archive:
            archive.addfile(tarfile.TarInfo("a.txt"))
    return out.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("a.zip", _archive("zip"), "is a zip archive; unpack it: unzip {path} -d {folder}/a"),
        ("a.tar.gz", _archive("w:gz"), "is a gzip archive; unpack it: tar xzf {path}"),
        ("a.tar.xz", _archive("w:xz"), "is an xz archive; unpack it: tar xJf {path}"),
        ("a.tar.bz2", _archive("w:bz2"), "is a bzip2 archive; unpack it: tar xjf {path}"),
        ("a.tar", _archive("w:"), "is a tar archive; unpack it: tar xf {path}"),
        ("a.ply", b"ply\nformat ascii 1.0\n", "is a point cloud or mesh (PLY)"),
        ("a.mcap", b"ply\nformat ascii 1.0\n", "is a point cloud or mesh (PLY)"),
        ("a.npy", b"\x93NUMPY\x01\0" + bytes(np.zeros(9)), "is an array of NumPy"),
        ("a.db3", b"nonsense" * 9, "is not a database of SQLite (wrong magic at its start)"),
        ("a.txt", b"hello", "is not a bag: expected a folder of rosbag2, or a file of MCAP (.mcap) or SQLite (.db3)"),
        ("a.db3", b"", "is empty"),
    ],
    ids=["zip", "gzip", "xz", "bzip2", "tar", "ply", "renamed", "npy", "no database", "text", "empty"],
)
def test_other_files_are_named_by_their_content(tmp_path: Path, name: str, content: bytes, match: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    assert match.format(path=path, folder=tmp_path) in refusal(path)


def test_recordings_are_known_by_name_or_content(tmp_path: Path) -> None:
    for name in ("a.mcap", "a.db3", "a.db3.zstd", "a.mcap.zst", "a.bag", "a.mcap.gz", "a.ZIP"):
        (tmp_path / name).write_bytes(b"")
        assert is_recording(tmp_path / name)
    unchunked(tmp_path / "no_suffix", [strings("/a", [1])])
    assert is_recording(tmp_path / "no_suffix")
    (tmp_path / "session.npz").write_bytes(_archive("zip"))
    assert not is_recording(tmp_path / "session.npz")
    with open_bag(tmp_path / "no_suffix") as bag:
        assert said(bag) == ["/a 1"]


# --- events of services
EVENT = "std_srvs/srv/SetBool_Event"


def test_events_of_a_service_are_recorded_as_rosbag2_does_and_read(tmp_path: Path) -> None:
    event = serialize_message(SetBool.Event(request=[SetBool.Request(data=True)]))
    with BagWriter(tmp_path / "bag", {}) as writer:
        writer.add_topic("/s/_service_event", EVENT, from_profile(QOS_COMMAND))
        writer.write("/s/_service_event", 1, event)
    assert event_definition(EVENT).endswith("SRV: std_srvs/srv/SetBool\nbool data\n---\nbool success\nstring message\n")
    with open_bag(tmp_path / "bag") as bag:
        assert bag.why_not("/s/_service_event") == ""
        (record,) = bag.records()
        assert deserialize_message(record.data, SetBool.Event).request[0].data
        assert bag.topics["/s/_service_event"][0] == EVENT


@pytest.mark.parametrize(
    ("kind", "text", "changed"),
    [
        (EVENT, "bool data\n---\nbool success\nstring message\n", False),
        (EVENT, "bool data\n---\nbool success\n", True),
        (EVENT, "int8 data\n---\nbool success\nstring message\n", True),
        (
            "std_srvs/srv/Trigger_Event",
            f"{'=' * 80}\nSRV: std_srvs/srv/Trigger\n---\nbool success\nstring message",
            False,
        ),
    ],
)
def test_events_of_a_service_that_changed_are_named(tmp_path: Path, kind: str, text: str, changed: bool) -> None:
    message = serialize_message((Trigger if "Trigger" in kind else SetBool).Event())
    topic = Topic("/s/_service_event", kind, [(1, message)], text=text.encode())
    with open_bag(unchunked(tmp_path / "a.mcap", [topic])) as bag:
        assert bool(bag.why_not("/s/_service_event")) == changed
