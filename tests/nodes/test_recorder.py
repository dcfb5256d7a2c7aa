# SPDX-License-Identifier: Apache-2.0
"""A bag is recorded from a live graph and replayed into another: every message, in order, as it was offered."""

from __future__ import annotations

import os
import re
import threading
from pathlib import Path

import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import SetBool

from openarm_bringup.bags.bag import open_bag
from openarm_bringup.bags.ros.listener import Thinner
from openarm_bringup.bags.ros.player import Player
from openarm_bringup.bags.ros.recorder import Recorder
from openarm_bringup.commands.record import replay
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.images import array_to_image
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_SENSOR
from tests.openarm_bringup.mcap_files import Topic, unchunked
from tests.refusals import refused


@pytest.fixture(autouse=True)
def known_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The graph is this process."""
    monkeypatch.setattr("openarm_bringup.bags.ros.recorder._KNOWN_S", 0.3)
    monkeypatch.setattr("openarm_bringup.bags.ros.player._MEET_S", 0.1)


def record(ros, path: Path, count: int, patterns: tuple[str, ...] = (".*",)) -> Recorder:
    chatter = ros.node.create_publisher(String, "/chatter", QOS_COMMAND)
    latched = ros.node.create_publisher(String, "/robot_description", QOS_LATCHED)
    images = ros.node.create_publisher(Image, "/overhead/color/image_raw", QOS_SENSOR)
    latched.publish(String(data="<robot/>"))
    picture = np.arange(64 * 48 * 3, dtype=np.uint8).reshape(48, 64, 3)
    with Recorder(int(os.environ["ROS_DOMAIN_ID"]), path, patterns, {}) as recorder:
        publishers = [chatter, latched, images] if patterns == (".*",) else [chatter]
        ros.spin_until(lambda: all(p.get_subscription_count() for p in publishers), what="the recorder subscribes")
        # A best-effort message is lost while its reader has not met the publisher, though that has met the reader.
        readers = recorder._listener.readers
        ros.spin_until(lambda: all(reader.get_publisher_count() for reader in readers), what="it meets the publishers")
        for i in range(count):
            chatter.publish(String(data=str(i)))
            images.publish(array_to_image(picture, "rgb8", "optical", i * 33_333_333))
        chatter.wait_for_all_acked()
        wanted = 2 * count + 1 if len(publishers) == 3 else count
        ros.spin_until(lambda: sum(recorder.recorded.counts.values()) >= wanted, what="everything is written")
    return recorder


def test_what_is_recorded_is_replayed(ros, tmp_path: Path) -> None:
    recorder = record(ros, tmp_path / "bag", 40)
    assert recorder.recorded.counts["/chatter"] == 40
    assert recorder.recorded.counts["/overhead/color/image_raw"] == 40
    assert not recorder.recorded.lost
    for publisher in list(ros.node.publishers):
        if publisher.topic_name in ("/chatter", "/robot_description"):
            ros.node.destroy_publisher(publisher)

    heard: list[str] = []
    described: list[str] = []
    ros.node.create_subscription(String, "/talk", lambda m: heard.append(m.data), 100)
    with open_bag(tmp_path / "bag") as bag:
        assert bag.counts["/robot_description"] == 1
        with Player(bag, ["/chatter", "/robot_description"], {"/chatter": "/talk"}, clock=True) as player:
            talk = player._publishers["/chatter"]
            ros.spin_until(lambda: ros.node.count_publishers("/talk") == 1, what="the subscriber knows the player")
            ros.spin_until(talk.get_subscription_count, what="the player knows the subscriber")
            work = threading.Thread(target=player.play, args=(0.0, 0.0, 0.0, threading.Event()))
            work.start()
            ros.spin_until(lambda: len(heard) == 40, what="all 40 messages are replayed")
            ros.node.create_subscription(String, "/robot_description", lambda m: described.append(m.data), QOS_LATCHED)
            ros.spin_until(lambda: described == ["<robot/>"], what="a late subscriber gets the latched message")
            work.join()
            (offered,) = ros.node.get_publishers_info_by_topic("/robot_description")
            assert offered.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            assert player.published == 41
            player.play(0.0, 3600.0, 0.0, threading.Event())
            assert player.published == 42, "what is latched is of any later time, too"
    assert heard == [str(i) for i in range(40)]


def test_a_bag_takes_the_place_of_the_robot_and_of_nothing_else(ros, tmp_path: Path) -> None:
    assert record(ros, tmp_path / "bag", 3).recorded.counts["/chatter"] == 3
    with open_bag(tmp_path / "bag") as bag:
        player = Player(bag, None, {}, clock=True)

        def sees(topic: str, *others: str) -> None:
            """Wait until the player knows who publishes a topic beside itself."""
            known = player._node.get_publishers_info_by_topic
            ros.spin_until(lambda: {i.node_name for i in known(topic)} == {"openarm_player", *others}, what=topic)

        for topic in ("/overhead/color/image_raw", "/chatter", "/robot_description"):
            sees(topic, "probe")
        with pytest.raises(OpenArmError, match="published by probe already") as refused:
            player._yield_to_graph()
        assert refused.value.code == Code.BUSY
        for publisher in list(ros.node.publishers):
            if publisher.topic_name == "/overhead/color/image_raw":
                ros.node.destroy_publisher(publisher)
        sees("/overhead/color/image_raw")
        with player:
            assert {"/chatter", "/robot_description"} <= set(player.left)
            player.play(0.0, 0.0, 0.0, threading.Event())
            assert player.published == 3


def test_patterns_choose_topics(ros, tmp_path: Path) -> None:
    assert record(ros, tmp_path / "bag", 3, ("/chat.*",)).topics == ["/chatter"]
    with pytest.raises(OpenArmError, match="no regular expression"):
        Recorder(0, tmp_path / "other", ("(",), {})


def test_what_never_came_is_counted_as_lost(ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recorder that is held up while more is published than its reader keeps."""
    held, go_on = threading.Event(), threading.Event()

    def hold(self: Thinner, topic: str, data: bytes) -> bool:
        held.set()
        return go_on.wait(120.0)

    monkeypatch.setattr(Thinner, "keeps", hold)
    chatter = ros.node.create_publisher(String, "/chatter", QOS_COMMAND)
    with Recorder(int(os.environ["ROS_DOMAIN_ID"]), tmp_path / "bag", ("/chatter",), {}) as recorder:
        ros.spin_until(chatter.get_subscription_count, what="the recorder subscribes")
        chatter.publish(String(data="0"))
        ros.spin_until(held.is_set, what="the recorder takes the first")
        for i in range(1, 500):
            chatter.publish(String(data=str(i)))
            chatter.wait_for_all_acked()
        go_on.set()
        recorded = recorder.recorded
        ros.spin_until(lambda: recorded.counts.total() + recorded.lost.total() == 500, what="all is accounted for")
    assert 0 < recorded.lost["/chatter"] < 500
    with open_bag(tmp_path / "bag") as bag:
        assert bag.custom["lost"] == str(recorded.lost["/chatter"])
        assert bag.counts["/chatter"] == 500 - recorded.lost["/chatter"]


def head(t_ns: int) -> bytes:
    """The beginning of a message with a header."""
    return bytes(4) + (t_ns // 10**9).to_bytes(4, "little") + (t_ns % 10**9).to_bytes(4, "little")


def test_frames_are_thinned_as_a_whole() -> None:
    thin = Thinner(2.0)
    stamps = [round(i * 1e9 / 30) for i in range(300)]
    kept = []
    for t in stamps:
        answers = {thin.keeps(f"/wrist/{kind}", head(t)) for kind in ("color/image_raw", "depth/camera_info")}
        assert len(answers) == 1
        kept += [t] if answers.pop() else []
    assert len(kept) == 20
    assert thin.keeps("/joint_states", bytes(12))


def test_a_stream_that_lasts_less_than_a_period_is_kept() -> None:
    thin = Thinner(1.0)
    depth, colour = "/overhead/depth/image_raw", "/overhead/color/image_raw"
    kept = {depth: [], colour: []}
    for t in range(0, 3_000_000_000, 100_000_000):
        for topic in (depth, colour) if 300_000_000 <= t < 700_000_000 else (depth,):
            kept[topic] += [t] if thin.keeps(topic, head(t)) else []
    assert kept == {depth: [0, 1_000_000_000, 2_000_000_000], colour: [300_000_000]}


def test_replay_refuses_what_makes_no_sense(ros, tmp_path: Path) -> None:
    record(ros, tmp_path / "bag", 1)
    for keywords, said in (
        ({"rate": -1.0}, "0 or more"),
        ({"topics": ("/none",)}, "topics: /chatter"),
        ({"remap": ("/a=/b",)}, "expected /from:=/to"),
    ):
        with pytest.raises(OpenArmError, match=said):
            replay(tmp_path / "bag", **keywords)


def test_topics_that_can_not_be_published_are_left_out_of_a_replay_and_refused_by_name(ros, tmp_path: Path) -> None:
    """Of a service whose package is installed, events are published; other types, names and encodings are named."""
    event = serialize_message(SetBool.Event(request=[SetBool.Request(data=True)]))
    topics = [
        Topic("/s/_service_event", "std_srvs/srv/SetBool_Event", [(1, event)]),
        Topic("/other/_service_event", "no_such_srvs/srv/Do_Event", [(2, event)]),
        Topic("/two words", "std_msgs/msg/String", [(3, serialize_message(String()))]),
        Topic("/json", "Log", [(4, b"{}")], "json", "jsonschema"),
    ]
    path = unchunked(tmp_path / "a.mcap", topics)
    left = {
        "/other/_service_event": "the package 'no_such_srvs' is not installed",
        "/two words": "no name of a topic",
        "/json": "1 message of json (jsonschema)",
    }
    outcome = replay(path, rate=0.0)
    assert outcome.success
    assert outcome.data["messages"] == 1
    assert outcome.data["left_out"].keys() == left.keys()
    for topic, why in left.items():
        assert why in outcome.data["left_out"][topic]
        assert why in outcome.message
        refused(re.escape(why), replay, path, topics=(topic,))
    nothing = replay(unchunked(tmp_path / "b.mcap", topics[1:2]), rate=0.0)
    assert (nothing.success, nothing.code) == (False, Code.NOTHING_DETECTED)
    assert left["/other/_service_event"] in nothing.message


def test_a_topic_whose_type_has_changed_since_is_left_out_of_a_replay(ros) -> None:
    changed = "recorded with other fields of openarm_interfaces/msg/GraspStatus"
    with open_bag(Path(__file__).parents[1] / "data" / "demo_pick") as bag:
        player = Player(bag, None, {}, clock=True)
        player.close()
        with pytest.raises(OpenArmError, match=changed):
            Player(bag, ["/grasp/status", "/robot_description"], {}, clock=True)
    assert list(player.left_out) == ["/grasp/status"]
    assert changed in player.left_out["/grasp/status"]
