# SPDX-License-Identifier: Apache-2.0
"""What a flight recorder keeps in memory, and the folder that its recordings are written to."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String

from openarm_bringup.bags.bag import Message, Topic, open_bag
from openarm_bringup.bags.recordings import Recordings
from openarm_bringup.bags.ring import Ring
from openarm_bringup.bags.ros.listener import from_profile
from openarm_bringup.doctor.graph import check_recordings
from openarm_bringup.supervision.runs import RECORDINGS, recordings
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED

pytestmark = pytest.mark.requirement("R-24")
CHATTER = Topic("/chatter", "std_msgs/msg/String", from_profile(QOS_COMMAND))
LATCHED = Topic("/latched", "std_msgs/msg/String", from_profile(QOS_LATCHED))


def ring_of(seconds: float = 10.0, limit: int = 10**6, publishers: int = 1) -> Ring:
    ring = Ring(seconds, limit, lambda topic: publishers)
    ring.put(CHATTER)
    ring.put(LATCHED)
    return ring


def say(ring: Ring, second: float, text: str, topic: Topic = CHATTER) -> None:
    ring.put(Message(topic.name, round(second * 1e9), serialize_message(String(data=text))))


def said(ring: Ring, topic: Topic = CHATTER) -> list[str]:
    messages = [m for m in ring.moment().messages() if m.topic == topic.name]
    return [deserialize_message(m.data, String).data for m in messages]


def noise(size: int, seed: int) -> str:
    return "".join(map(chr, random.Random(seed).choices(range(33, 127), k=size)))


def test_messages_are_kept_for_a_time() -> None:
    ring, short = ring_of(seconds=10.0), ring_of()
    for second in range(100):
        for one in [ring, *([short] if second >= 89 else [])]:
            say(one, second, str(second))
    assert ring.bytes == short.bytes, "what was dropped takes no memory"
    assert said(ring) == [str(second) for second in range(89, 100)]
    assert ring.moment().seconds == pytest.approx(10.0)
    assert ring.moment().topics == [CHATTER], "topics without a message are left out"


def test_messages_take_no_more_memory_than_is_allowed_and_come_back_as_they_were() -> None:
    ring, texts = ring_of(limit=100_000), [noise(10_000, seed) for seed in range(50)]
    for number, text in enumerate(texts):
        say(ring, 0.01 * number, text)
        assert ring.bytes <= 100_000
    kept = said(ring)
    assert len(kept) >= 8
    assert kept == texts[-len(kept) :]
    for number in range(50):
        say(ring, 1.0 + 0.01 * number, "x" * 10_000)
    assert len(said(ring)) > 50, "what can be packed takes little"


@pytest.mark.parametrize(("publishers", "kept"), [(1, ["c"]), (2, ["a", "b", "c"])])
def test_what_is_latched_is_kept_for_ever_with_the_first_stamp(publishers: int, kept: list[str]) -> None:
    """/tf_static has two publishers, each of which says something else, and says it once."""
    ring = ring_of(publishers=publishers)
    for second, text in enumerate("abac"):
        say(ring, second, text, LATCHED)
    for second in range(100):
        say(ring, second, str(second))
    assert sorted(said(ring, LATCHED)) == kept
    assert said(ring, LATCHED)[-1] == "c", "the newest is the last"
    latched = [m for m in ring.moment().messages() if m.topic == LATCHED.name]
    assert {m.t_ns for m in latched} == {89 * 10**9}
    ring.clear()
    assert not ring.moment().packed


def test_recordings_are_numbered_complete_and_the_oldest_give_way(tmp_path: Path) -> None:
    ring, folder = ring_of(), tmp_path / RECORDINGS
    assert check_recordings(tmp_path).level == "ok"
    say(ring, 1.0, "hello")
    keeper = Recordings(folder, most=2, limit=10**6)
    paths = [keeper.reserve(code) for code in ("GRASP_LOST", "TOO_WIDE", "NO_PLAN")]
    assert [path.name for path in paths] == ["01_GRASP_LOST", "02_TOO_WIDE", "03_NO_PLAN"]
    assert recordings(folder) == [], "a path that exists is complete"
    for path in paths:
        keeper.write(path, ring.moment(), {"reason": path.name})
    assert recordings(folder) == paths[1:]
    assert sorted(path.name for path in folder.iterdir()) == ["02_TOO_WIDE", "03_NO_PLAN"]
    with open_bag(paths[2]) as bag:
        assert (bag.counts, bag.custom["reason"], bag.mended) == ({"/chatter": 1}, "03_NO_PLAN", None)
    finding = check_recordings(tmp_path)
    assert (finding.level, "02_TOO_WIDE, 03_NO_PLAN" in finding.observed) == ("note", True)
    again = Recordings(folder, most=20, limit=1)
    assert again.reserve("NO_PLAN").name == "04_NO_PLAN", "numbers go on after a restart"
    again.write(folder / "04_NO_PLAN", ring.moment(), {})
    assert [path.name for path in recordings(folder)] == ["04_NO_PLAN"], "within the bytes, the newest in any case"


def test_a_full_disk_is_named_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Usage:
        free = 10**12

    monkeypatch.setattr("openarm_bringup.bags.bag.shutil.disk_usage", lambda _: Usage)
    ring, keeper = ring_of(), Recordings(tmp_path / "new", most=2, limit=10**6)
    say(ring, 1.0, "hello")
    path = keeper.reserve("NO_PLAN")

    def full(*_: object) -> None:
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("openarm_bringup.bags.bag.BagWriter.write", full)
        with pytest.raises(OpenArmError, match="No space left") as caught:
            keeper.write(path, ring.moment(), {})
    assert caught.value.code is Code.ENVIRONMENT
    assert list((tmp_path / "new").iterdir()) == []
    Usage.free = 10**6
    with pytest.raises(OpenArmError, match="the disk has only 0 MiB left") as caught:
        keeper.reserve("NO_PLAN")
    assert caught.value.code is Code.ENVIRONMENT
