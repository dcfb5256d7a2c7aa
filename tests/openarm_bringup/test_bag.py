# SPDX-License-Identifier: Apache-2.0
"""Bags: what is written is read; what was cut short is mended; what is no bag is refused by name."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String

from openarm_bringup.bags.bag import BagWriter, open_bag
from openarm_bringup.bags.definitions import definition
from openarm_bringup.bags.ros.listener import from_profile
from openarm_bringup.bags.ros.player import to_profile
from openarm_bringup.messages import interface
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_SENSOR
from tests.openarm_bringup.mcap_files import chunks_of


def write(path: Path, count: int, size: int = 10) -> Path:
    with BagWriter(path, {"seed": "7"}, compress=False) as bag:
        bag.add_topic("/chatter", "std_msgs/msg/String", from_profile(QOS_COMMAND))
        for i in range(count):
            bag.write("/chatter", 1_000_000_000 + i * 10_000_000, serialize_message(String(data=f"{i:0{size}d}")))
    return path


def test_what_is_written_is_read_in_order(tmp_path: Path) -> None:
    with open_bag(write(tmp_path / "bag", 50)) as bag:
        assert bag.mended is None
        assert (bag.counts, bag.custom["seed"]) == ({"/chatter": 50}, "7")
        assert bag.duration_s == pytest.approx(0.49)
        said = [deserialize_message(record.data, String).data for record in bag.records()]
        assert said == [f"{i:010d}" for i in range(50)]
        assert next(bag.records(start_s=0.4)).t_ns == 1_400_000_000


def test_who_is_behind_writes_plain_chunks_and_packs_again_later(tmp_path: Path) -> None:
    sizes: list[int] = []
    with BagWriter(tmp_path / "bag", {}) as bag:
        bag.add_topic("/chatter", "std_msgs/msg/String", from_profile(QOS_COMMAND))
        for t_ns, behind in enumerate((False, True, False)):
            bag.hasten(behind)
            bag.write("/chatter", t_ns, serialize_message(String(data=f"{t_ns}" * 2_000_000)))
            sizes.append((tmp_path / "bag" / "bag.mcap").stat().st_size)
    packed, plain, again = sizes[0], sizes[1] - sizes[0], sizes[2] - sizes[1]
    assert packed < 50_000 > again
    assert plain > 1_900_000
    with open_bag(tmp_path / "bag") as bag:
        assert [deserialize_message(r.data, String).data[0] for r in bag.records()] == ["0", "1", "2"]


@pytest.mark.parametrize("lost", [1, 30, 700_000])
def test_a_recording_that_was_cut_short_keeps_what_is_whole(tmp_path: Path, lost: int) -> None:
    """As SIGKILL or a full disk leave it: no end, no metadata."""
    path = write(tmp_path / "bag", 400, size=10_000)  # 4 MB: four chunks
    (path / "metadata.yaml").unlink()
    file = path / "bag.mcap"
    os.truncate(file, file.stat().st_size - lost)
    with open_bag(path) as bag:
        assert bag.mended is not None
        said = [int(deserialize_message(record.data, String).data.lstrip("0") or "0") for record in bag.records()]
        assert said == list(range(len(said)))
        assert len(said) > 200
    with open_bag(path) as bag:
        assert bag.mended is None, "mended once and for all"


@pytest.mark.parametrize(("compress", "share"), [(True, 0.9), (False, 0.5), (False, 0.95)])
def test_a_cut_recording_of_several_topics_comes_in_the_order_of_stamps(
    tmp_path: Path, compress: bool, share: float
) -> None:
    """A recorder takes one topic after the other: its file is not in that order, and has no index where it was cut."""
    with BagWriter(tmp_path / "bag", {}, compress=compress) as bag:
        for topic in ("/a", "/b"):
            bag.add_topic(topic, "std_msgs/msg/String", from_profile(QOS_COMMAND))
        for i in range(300):
            for topic, t_ns in (("/b", 2 * i + 1), ("/a", 2 * i)):
                bag.write(topic, t_ns, serialize_message(String(data=f"{t_ns:010}" * 1000)))
    (tmp_path / "bag" / "metadata.yaml").unlink()
    file = tmp_path / "bag" / "bag.mcap"
    os.truncate(file, int(file.stat().st_size * share))
    for mended in (True, False):
        with open_bag(tmp_path / "bag") as bag:
            assert (bag.mended is not None) == mended
            stamps = [record.t_ns for record in bag.records()]
            assert stamps == sorted(stamps)
            assert len(stamps) > 400 * share
            assert set(bag.topics) == {"/a", "/b"}


@pytest.mark.parametrize("compress", [True, False])
def test_a_last_chunk_whose_content_never_reached_the_disk_is_given_up(tmp_path: Path, compress: bool) -> None:
    """As a loss of power leaves it: of its full length, and empty."""
    path = tmp_path / "bag"
    with BagWriter(path, {}, compress=compress) as writer:
        writer.add_topic("/a", "std_msgs/msg/String", from_profile(QOS_COMMAND))
        for i in range(400):  # 4 MB: four chunks
            writer.write("/a", i, serialize_message(String(data=f"{i:010}" * 1000)))
    (path / "metadata.yaml").unlink()
    file = path / "bag.mcap"
    with file.open("r+b") as data:
        start, end = chunks_of(file)[-1]
        data.seek(start + 100)
        data.write(bytes(end - start - 100))
        data.truncate()
    with open_bag(path) as bag:
        assert bag.mended is not None
        assert len(list(bag.records())) > 200


def test_a_bag_that_was_cut_short_later_is_distinguished_from_an_unfinished_recording(tmp_path: Path) -> None:
    file = write(tmp_path / "bag", 400, size=10_000) / "bag.mcap"
    os.truncate(file, file.stat().st_size // 2)
    with pytest.raises(OpenArmError, match="copy the bag again, or open this file"), open_bag(tmp_path / "bag"):
        pass
    with open_bag(file) as bag:
        assert bag.mended is not None
        assert 100 < sum(bag.counts.values()) < 300


def test_a_recording_that_goes_on_is_read_as_far_as_it_is_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with BagWriter(path, {}) as writer:
        writer.add_topic("/a", "std_msgs/msg/String", from_profile(QOS_COMMAND))
        for i in range(400):
            writer.write("/a", i, serialize_message(String(data=f"{i:010}" * 1000)))
            if i == 300:
                before = (path / "bag.mcap").read_bytes()
                with open_bag(path) as bag:
                    assert len(list(bag.records())) > 200
                assert (path / "bag.mcap").read_bytes() == before
    with open_bag(path) as bag:
        assert bag.mended is None
        assert len(list(bag.records())) == 400


@pytest.mark.parametrize(
    ("content", "said"),
    [(b"", "is empty"), (b"\x89MCAP0\r\n" + bytes(3), "before anything whole"), (b"nonsense" * 9, "not an MCAP file")],
)
def test_empty_truncated_and_foreign_files_are_refused(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "bag.mcap"
    path.write_bytes(content)
    with pytest.raises(OpenArmError, match=said) as refused, open_bag(path):
        pass
    assert refused.value.code == Code.INVALID_ARGUMENT
    assert path.read_bytes() == content, "a file that is refused is left as it was"


def test_folders_that_are_no_bag_and_bags_that_exist_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OpenArmError, match="there is no bag"), open_bag(tmp_path / "missing"):
        pass
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(OpenArmError, match=r"found notes\.txt"), open_bag(tmp_path):
        pass
    with pytest.raises(OpenArmError, match="never overwritten"):
        BagWriter(write(tmp_path / "bag", 1), {})


def test_a_definition_has_constants_arrays_and_bounds() -> None:
    assert "float64[] position" in definition(interface("sensor_msgs/msg/JointState"))
    assert "int64 CUBE=1" in definition(interface("visualization_msgs/msg/Marker"))
    with pytest.raises(OpenArmError, match="no_such_msgs"):
        interface("no_such_msgs/msg/Thing")


@pytest.mark.parametrize("profile", [QOS_COMMAND, QOS_LATCHED, QOS_SENSOR])
def test_quality_of_service_survives_the_bag(profile: object) -> None:
    back = to_profile(from_profile(profile))  # type: ignore[arg-type]
    assert (back.reliability, back.durability) == (profile.reliability, profile.durability)  # type: ignore[attr-defined]
