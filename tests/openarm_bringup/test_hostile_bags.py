# SPDX-License-Identifier: Apache-2.0
"""Recordings of others: bounded in time and memory, and one sentence for every damage."""

from __future__ import annotations

import struct
import time
import tracemalloc
from pathlib import Path

import pytest
import yaml
from rclpy.serialization import serialize_message
from rosbags.rosbag2.storage_mcap import zstd
from std_msgs.msg import String

from openarm_bringup.bags import mcap
from openarm_bringup.bags.bag import BagWriter, open_bag
from openarm_bringup.bags.ros.listener import from_profile
from openarm_bringup.bags.ros.messages import messages_of
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import QOS_COMMAND
from tests.openarm_bringup.mcap_files import chunks_of


def _write(path: Path, data: list[bytes], *, compress: bool = True, kind: str = "std_msgs/msg/String") -> Path:
    with BagWriter(path, {}, compress=compress) as bag:
        bag.add_topic("/chatter", kind, from_profile(QOS_COMMAND))
        for i, message in enumerate(data):
            bag.write("/chatter", i, message)
    return path


def _refused(path: Path) -> str:
    with pytest.raises(OpenArmError) as caught, open_bag(path) as bag:
        list(bag.records())
    assert caught.value.code is Code.INVALID_ARGUMENT
    assert len(caught.value.message) < 600
    return caught.value.message


def test_a_chunk_that_unpacks_to_more_than_a_recording_holds_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zeros of 40 MiB, packed to a few kB: what is unpacked is bounded before its size is compared."""
    path = _write(tmp_path / "bag", [bytes(40 * 2**20)])
    assert (path / "bag.mcap").stat().st_size < 100_000
    monkeypatch.setattr(mcap, "MAX_UNPACKED", 2**20)
    tracemalloc.start()
    assert "unpack to more than 1048576 bytes" in _refused(path)
    assert tracemalloc.get_traced_memory()[1] < 8e6
    tracemalloc.stop()


def test_messages_and_files_that_are_compressed_one_by_one_are_read_within_bounds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The two other ways of rosbag2 to compress, with which `ros2 bag record --compression-mode` writes."""
    plain = serialize_message(String(data="hello" * 100))
    by_message = _write(tmp_path / "message", [zstd.compress(plain)], compress=False)
    by_file = _write(tmp_path / "file", [plain], compress=False)
    packed = zstd.compress((by_file / "file.mcap").read_bytes())
    (by_file / "file.mcap").unlink()
    (by_file / "file.mcap.zst").write_bytes(packed)
    for path, mode in ((by_message, "MESSAGE"), (by_file, "FILE")):
        document = yaml.safe_load((path / "metadata.yaml").read_text())
        about = document["rosbag2_bagfile_information"]
        about |= {"compression_format": "zstd", "compression_mode": mode}
        if mode == "FILE":
            about["relative_file_paths"] = ["file.mcap.zst"]
        (path / "metadata.yaml").write_text(yaml.safe_dump(document))
        with open_bag(path) as bag:
            assert [record.data for record in bag.records()] == [plain]
    (by_file / "file.mcap.zst").write_bytes(zstd.compress(bytes(20 * 2**20)))
    assert "file.mcap.zst unpacks to more than 200 times its size" in _refused(by_file)
    monkeypatch.setattr(mcap, "MAX_UNPACKED", 100)
    assert "unpack to more than 100 bytes" in _refused(by_message)


def _unfinished(path: Path, count: int) -> Path:
    """A bag of one chunk that was never finished, without an index, of many messages."""
    data = serialize_message(String(data="x"))
    path = _write(path, [data], compress=False) / "bag.mcap"
    start, end = chunks_of(path)[0]
    chunk = path.read_bytes()[start:end]
    head, (first, last, _, _, name) = chunk[:9], mcap._OF_CHUNK.unpack_from(chunk, 9)
    at = 9 + mcap._OF_CHUNK.size + name + 8
    records = chunk[at:]
    message = records[records.rindex(struct.pack("<BQ", 5, 22 + len(data))) :]
    content = records + (count - 1) * message
    middle = mcap._OF_CHUNK.pack(first, last, len(content), 0, name) + struct.pack("<Q", len(content))
    whole = path.read_bytes()[:start] + head[:1] + struct.pack("<Q", len(middle) + len(content)) + middle + content
    path.write_bytes(whole)
    (path.parent / "metadata.yaml").unlink()
    return path


def test_an_unfinished_chunk_of_many_messages_is_mended(tmp_path: Path) -> None:
    with open_bag(_unfinished(tmp_path / "bag", 10_000)) as bag:
        assert bag.counts == {"/chatter": 10_000}


@pytest.mark.long
def test_an_unfinished_chunk_of_many_messages_is_mended_in_linear_time(tmp_path: Path) -> None:
    """Four times the messages take four times as long, not sixteen times; the better of two, of this process alone."""

    def seconds(count: int) -> float:
        path, took = _unfinished(tmp_path / str(count) / "bag", count), list[float]()
        for _ in range(2):
            began = time.process_time()
            with open_bag(path) as bag:
                assert bag.counts == {"/chatter": count}
            took.append(time.process_time() - began)
        return min(took)

    assert seconds(400_000) < 8.0 * seconds(100_000)


def test_a_message_that_is_not_of_its_type_is_named(tmp_path: Path) -> None:
    with (
        open_bag(_write(tmp_path / "bag", [b"\0\1\0\0\xff\xff\xff\xff"])) as bag,
        pytest.raises(OpenArmError, match=r"message of /chatter at 0 ns that is no std_msgs/msg/String \(8 bytes\)"),
    ):
        messages_of(bag, ["/chatter"])


def test_a_topic_whose_type_has_other_fields_now_is_named_and_not_misread() -> None:
    """The bag of the repository is older than some fields of GraspStatus."""
    changed = "openarm_interfaces/msg/GraspStatus"
    with open_bag(Path(__file__).parents[1] / "data" / "demo_pick") as bag:
        assert [topic for topic in bag.topics if bag.why_not(topic)] == ["/grasp/status"]
        assert bag.why_not("/grasp/status").startswith(f"/grasp/status was recorded with other fields of {changed}")
        with pytest.raises(OpenArmError, match="read it with the version that made it"):
            messages_of(bag, ["/grasp/status"])
