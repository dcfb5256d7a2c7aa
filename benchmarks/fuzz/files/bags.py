# SPDX-License-Identifier: Apache-2.0
"""Bags, and the messages in them."""

from __future__ import annotations

import functools
import random
from collections.abc import Callable
from pathlib import Path

from benchmarks.fuzz.alter import altered_bytes, altered_yaml
from benchmarks.fuzz.files.reader import BAG, Reader

#: Joint states of the bag are used that are not further from an image.
_NEAR_NS = 60_000_000


def bags(folder: Path) -> list[Reader]:
    """Make readers of bags."""
    from rclpy.serialization import serialize_message
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.rosbag2.storage_mcap import zstd
    from rosbags.typesys import Stores, get_typestore
    from sensor_msgs.msg import JointState
    from std_srvs.srv import SetBool

    from openarm_bringup.bags.bag import BagWriter, open_bag
    from openarm_bringup.bags.ros.listener import from_profile
    from openarm_bringup.bags.ros.messages import messages_of
    from openarm_common.ros.node import QOS_COMMAND
    from tests.openarm_bringup.mcap_files import Topic, channels, chunk, end, head, messages, unchunked

    def read(path: Path) -> None:
        with open_bag(path) as bag:
            for topic in bag.topics:
                bag.why_not(topic)
            messages_of(bag, bag.topics)

    sound: list[bytes] = []
    for name, compress in (("packed", True), ("plain", False)):
        with BagWriter(folder / name, {"graph": "sim"}, compress=compress) as bag:
            bag.add_topic("/joint_states", "sensor_msgs/msg/JointState", from_profile(QOS_COMMAND))
            for k in range(40):
                message = JointState(name=[f"joint{i}" for i in range(7)], position=[0.1 * k] * 7)
                bag.write("/joint_states", k * 10**7, serialize_message(message))
        sound.append((folder / name / f"{name}.mcap").read_bytes())
    whole = (folder / "packed" / "metadata.yaml").read_bytes()
    joints = [(k * 10**7, serialize_message(JointState(name=["a"], position=[0.1 * k]))) for k in range(40)]
    topics = [
        Topic("/joint_states", "sensor_msgs/msg/JointState", joints),
        Topic("/json", "Log", [(5, b"{}")] * 9, "json", "jsonschema", b"{}"),
        Topic("/proto", "Image", [(6, b"\xff")], "protobuf", "protobuf", b"\x0a\xff"),
        Topic("/s/_service_event", "std_srvs/srv/SetBool_Event", [(7, serialize_message(SetBool.Event()))],
              text=b"bool data\n---\nbool success\nstring message\n"),
    ]  # fmt: skip
    foreign = unchunked(folder / "foreign.mcap", topics).read_bytes()
    chunked = head() + chunk([channels(topics), *messages(topics)], (0, 10**9)) + end()
    with Writer(folder / "db", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        types = get_typestore(Stores.ROS2_JAZZY)
        connection = writer.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=types)
        for t_ns, data in joints:
            writer.write(connection, t_ns, data)
    database = (folder / "db" / "db.db3").read_bytes()

    def altered_head(data: bytes, rng: random.Random) -> bytes:
        """Where the tables are defined."""
        return altered_bytes(data[:4096], rng) + data[4096:]

    def cut(data: bytes, rng: random.Random) -> bytes:
        return altered_bytes(data[: rng.randrange(len(data) // 3, len(data))], rng)

    def about(path: Path) -> None:
        (path.parent / "packed.mcap").write_bytes(sound[0])
        read(path.parent)

    def parts(path: Path) -> None:
        (path.parent / "part_1.mcap").write_bytes(foreign)
        read(path.parent)

    return [
        Reader("altered.mcap", tuple(sound), altered_bytes, read),
        Reader("cut.mcap", tuple(sound), cut, read),
        Reader("about/metadata.yaml", (whole,), altered_yaml, about),
        Reader("foreign.mcap", (foreign, chunked), altered_bytes, read),
        Reader("cut_foreign.mcap", (foreign, chunked), cut, read),
        Reader("parts/part_0.mcap", (foreign, sound[0]), altered_bytes, parts),
        Reader("altered.db3", (database,), altered_bytes, read),
        Reader("head.db3", (database,), altered_head, read),
        Reader("any", (b"#ROSBAG V2.0\n", b"PK\x03\x04", b"ply\n", zstd.compress(database)), altered_bytes, read),
    ]


def contents(folder: Path) -> list[Reader]:
    """Bags whose messages are altered, read by what computes with them."""
    from openarm_bringup.bags.bag import Bag, BagWriter, open_bag
    from openarm_bringup.bags.ros.bag import numbers_of
    from openarm_bringup.bags.ros.listener import from_profile
    from openarm_bringup.calibration.ros.samples import samples_of
    from openarm_calibration.board.board import CircleGrid
    from openarm_common.ros.node import QOS_COMMAND

    used = (
        "/joint_states", "/tf_static", "/robot_description", "/overhead/color/image_raw", "/overhead/color/camera_info",
        "/overhead/depth/image_raw", "/overhead/depth/camera_info",
    )  # fmt: skip
    with open_bag(BAG) as bag:
        images = [record.t_ns for record in bag.records(["/overhead/color/image_raw"])]
        records = [
            record
            for record in bag.records(used)
            if record.topic != used[0] or any(abs(record.t_ns - t_ns) < _NEAR_NS for t_ns in images)
        ]
        kinds = {record.topic: record.type for record in records}
    numbers = iter(range(10**9))

    def write(_: bytes, rng: random.Random) -> bytes:
        path = folder / f"bag{next(numbers)}"
        chosen = rng.choice(used)
        with BagWriter(path, {}, compress=False) as bag:
            for topic, kind in kinds.items():
                bag.add_topic(topic, kind, from_profile(QOS_COMMAND))
            for record in sorted(records, key=lambda record: record.t_ns):
                data = record.data
                if record.topic == chosen:
                    # where the fields are; in the pixels it would change nothing
                    data = altered_bytes(data[:400], rng) + data[400:]
                bag.write(record.topic, record.t_ns, data)
        return str(path).encode()

    def read(use: Callable[[Bag], object], path: Path) -> None:
        with open_bag(Path(path.read_text())) as bag:
            use(bag)

    def sampled(bag: Bag) -> None:
        samples_of(bag, "overhead", CircleGrid(), "openarm_right_link7", None)

    return [Reader("path", (b"",), write, functools.partial(read, use)) for use in (numbers_of, sampled)]
