# SPDX-License-Identifier: Apache-2.0
"""Readers of files, and sound files to alter for them."""

from __future__ import annotations

import functools
import json
import random
import struct
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import yaml

from benchmarks.fuzz.alter import (
    HOSTILE,
    TEXTS,
    altered_archive,
    altered_bytes,
    altered_json,
    altered_xml,
    altered_yaml,
)
from benchmarks.fuzz.judge import Tally
from openarm_common.resources import config_dir, models_dir
from openarm_common.robot.description import RobotDescription

Alter = Callable[[bytes, random.Random], bytes]
#: The bag of the repository.
BAG = Path(__file__).parents[2] / "tests/data/demo_pick"
#: Joint states of the bag are used that are not further from an image.
_NEAR_NS = 60_000_000


@dataclass(frozen=True)
class Reader:
    """One way in for files.

    Args:
        name: Of the file that is written; its suffix matters to some readers.
        sound: What is altered.
        alter: How.
        read: Takes the path of the altered file.
    """

    name: str
    sound: tuple[bytes, ...]
    alter: Alter
    read: Callable[[Path], object]

    def attempt(self, folder: Path, rng: random.Random) -> Callable[[], object]:
        """Write one altered file; return the work of reading it."""
        path = folder / self.name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            path.unlink()
        path.write_bytes(self.alter(rng.choice(self.sound), rng))
        return functools.partial(self.read, path)


# --- bags
def _bags(folder: Path) -> list[Reader]:
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


def _contents(folder: Path) -> list[Reader]:
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


# --- maps
def _maps(folder: Path) -> list[Reader]:
    from openarm_octomap.config import FieldConfig, FilterConfig, GridConfig
    from openarm_octomap.kernels import FREE
    from openarm_octomap.mapper import Mapper

    def mapper() -> Mapper:
        return Mapper(RobotDescription.load(), GridConfig(), FilterConfig(enabled=False), FieldConfig())

    one = mapper()
    one.clear_box((0.2, -0.3, 0.0), (0.6, 0.3, 0.4), FREE)
    one.save(folder / "map.bt")
    one.save(folder / "map.ot")
    target = mapper()
    binary, full = ((folder / f"map{suffix}").read_bytes() for suffix in (".bt", ".ot"))
    head, _, tree = full.partition(b"\ndata\n")
    nodes = np.frombuffer(tree, np.uint8).reshape(-1, 5)
    colored = np.insert(nodes, [4, 4, 4], 200, axis=1).tobytes()
    first = struct.pack("<idI", 3, 0.02, len(nodes)) + binary.partition(b"\ndata\n")[2]

    def sized(data: bytes, rng: random.Random) -> bytes:
        edge = rng.choice((b"0.0001", b"0.0007", b"0.01", b"0.025", b"0.04", b"0.05", b"3", b"100"))
        return altered_bytes(data.replace(b"res 0.02", b"res " + edge), rng) if rng.random() < 0.8 else data

    files: list[tuple[str, bytes, Alter]] = [
        ("altered.bt", binary, altered_bytes), ("altered.ot", full, altered_bytes), ("wrong.bt", full, altered_bytes),
        ("color.ot", head.replace(b"id OcTree", b"id ColorOcTree") + b"\ndata\n" + colored, altered_bytes),
        ("first.bt", first, altered_bytes), ("sized.bt", binary, sized), ("sized.ot", full, sized),
    ]  # fmt: skip
    return [Reader(name, (sound,), way, target.load) for name, sound, way in files]


# --- clouds
def _clouds(folder: Path) -> list[Reader]:
    from openarm_common.camera.cameras import Intrinsics
    from openarm_common.config import load_config
    from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig
    from openarm_perception.frames.cloud_fields import Cloud
    from openarm_perception.frames.clouds import read_cloud
    from openarm_perception.frames.found import find
    from openarm_perception.frames.pcd import write_pcd
    from openarm_perception.geometry.depth import Deprojector, DepthLimits
    from tests.openarm_perception.test_cloud_files import FORMS, Ply, vertices

    limits, lens = DepthLimits(near=0.1, far=3.0), Intrinsics(40, 30, 35.0, 35.0, 19.5, 14.5)
    z = np.full((30, 40), 0.7, np.float32)
    z[10:20, 15:25] = 0.62
    points = Deprojector(limits).organised(z, lens)
    flat = points.reshape(1, -1, 3)
    rgb = np.full(points.shape, 90, np.uint8)
    colors = ColorDetector(load_config(config_dir() / "params" / "detector.yaml", ColorDetectorConfig))

    def read(axes: Literal["optical", "base"], path: Path) -> None:
        cloud = read_cloud(path, limits, axes=axes)
        find(cloud.frame, limits, colors, cloud.T_base_camera)

    write_pcd(folder / "image.pcd", Cloud(points, rgb, None))
    write_pcd(folder / "strewn.pcd", Cloud(flat, rgb.reshape(1, -1, 3), None))
    np.save(folder / "a.npy", points)
    rows = [f"{x:.4f} {y:.4f} {d:.4f}" for x, y, d in flat[0].tolist()]
    (folder / "a.xyz").write_text("\n".join(rows))
    head = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1200\nHEIGHT 1\nDATA ascii\n"
    (folder / "ascii.pcd").write_bytes(head + "\n".join(rows).encode())
    face, cells = [("vertex_indices", "uchar", "int")], [[[k] if k % 9 else []] for k in range(1200)]
    plys: list[bytes] = []
    for form in FORMS:
        info = ("num_cols 40", "num_rows 30")
        for ply in (vertices(Ply(form).element("face", face, cells[:300]), flat[0]),
                    vertices(Ply(form, *info), flat[0]).element("range_grid", face, cells)):  # fmt: skip
            plys.append(ply.write(folder / "a.ply").read_bytes())

    def early(data: bytes, rng: random.Random) -> bytes:
        """Where the header is, or anywhere."""
        return altered_bytes(data[:500], rng) + data[500:] if rng.random() < 0.5 else altered_bytes(data, rng)

    sound = {
        "altered.ply": tuple(plys), "altered.npy": ((folder / "a.npy").read_bytes(),),
        "altered.xyz": ((folder / "a.xyz").read_bytes(),),
        "altered.pcd": tuple((folder / f"{name}.pcd").read_bytes() for name in ("image", "strewn", "ascii")),
    }  # fmt: skip
    return [
        Reader(name, files, early, functools.partial(read, axes))
        for axes in ("optical", "base")
        for name, files in sound.items()
    ]


# --- text
def _yaml(folder: Path) -> list[Reader]:
    from trajectory_msgs.msg import JointTrajectory

    from openarm_bringup.messages import fill
    from openarm_bringup.supervision.graph import load_graph
    from openarm_bringup.supervision.params import read_params
    from openarm_calibration.board.board import read_board
    from openarm_calibration.store.store import CalibrationStore
    from openarm_calibration.store.table import StoredTable, TableStore
    from openarm_common.camera.cameras import load_cameras
    from openarm_common.config import load_config, parse_yaml
    from openarm_common.scene.scene import load_scene
    from openarm_evaluation.detector.yolo_text import read_classes
    from openarm_grasp.requests.orders import load_bins
    from openarm_perception.detection.detector import ColorDetectorConfig
    from openarm_sim_bridge.faults.faults import FAULTS, parse_fault

    robot = models_dir() / "robots/openarm_v1"

    def of(*folders: Path) -> tuple[bytes, ...]:
        return tuple(path.read_bytes() for folder in folders for path in sorted(folder.glob("*.yaml")))

    def stored(path: Path) -> object:
        CalibrationStore(path.parent).load("wrist")
        return CalibrationStore(path.parent).history("wrist")

    def measured(path: Path) -> object:
        return TableStore(path.parents[1]).load("table")

    TableStore(folder).save_level(StoredTable(height=0.4, configured=0.4))
    faults = [
        yaml.safe_dump({"name": name, "parameters": model().model_dump(mode="json")}).encode()
        for name, model in FAULTS.items()
        if not any(field.is_required() for field in model.model_fields.values())
    ]

    def fault(path: Path) -> None:
        for name in rng_names:
            parse_fault(name, path.read_text("utf-8", "replace"))

    rng_names = tuple(FAULTS)[:4]
    words = b"joint_names: [a, b]\npoints: [{positions: [0.1, 0.2], time_from_start: {sec: 1, nanosec: 5}}]\n"
    params = b"/**:\n  ros__parameters: {a: 1, b: {c: [1, 2]}}\nnode:\n  ros__parameters: {d: text}\n"
    bins = b"bins: {left: [0.3, 0.2], right: [0.3, -0.2]}\nclasses: {red: left}\nrest: right\n"
    return [
        Reader("scene.yaml", of(models_dir() / "scenes", robot / "scenes"), altered_yaml, load_scene),
        Reader("graph.yaml", of(config_dir() / "graphs"), altered_yaml, lambda path: load_graph(str(path))),
        Reader("params.yaml", (params,), altered_yaml, lambda path: read_params(path, "node")),
        Reader("cameras.yaml", ((robot / "cameras.yaml").read_bytes(),), altered_yaml, load_cameras),
        Reader(
            "detector.yaml", ((config_dir() / "params/detector.yaml").read_bytes(),), altered_yaml,
            lambda path: load_config(path, ColorDetectorConfig),
        ),
        Reader("store/wrist.yaml", of(robot / "calibration/mount_seed_1"), altered_yaml, stored),
        Reader("tables/table/table.yaml", ((folder / "table/table.yaml").read_bytes(),), altered_yaml, measured),
        Reader("bins.yaml", (bins,), altered_yaml, load_bins),
        Reader(
            "board.yaml", (b"kind: circles\nrows: 11\ncolumns: 4\n", b"kind: charuco\n"), altered_yaml,
            lambda path: read_board(path.read_text("utf-8", "replace")),
        ),
        Reader("fault.yaml", tuple(faults) or (b"{}",), altered_yaml, fault),
        Reader("dataset.yaml", (b"train: images\nnames: [a, b]\n", b"names: {0: a, 1: b}\n"), altered_yaml,
               lambda path: read_classes(path.parent)),
        Reader(
            "message.yaml", (words,), altered_yaml,
            lambda path: fill(JointTrajectory(), parse_yaml(path.read_text("utf-8", "replace"), "the message")),
        ),
    ]  # fmt: skip


def _json(folder: Path) -> list[Reader]:
    from openarm_bringup.bags import golden
    from openarm_evaluation.campaign import agree
    from openarm_evaluation.campaign.campaign import read_rows
    from openarm_evaluation.campaign.options import CampaignOptions
    from openarm_evaluation.campaign.report import summarise

    grasp = {"label": "red", "arm": "left", "attempts": 1, "placed": True, "place_error_mm": 1.0, "sim_s": 9.0}
    row = {
        "set": "nominal", "seed": 0, "scene_hash": "a", "outcome": "placed", "code": "OK", "grasps": [grasp],
        "detector": "color", "kind": "demo", "expected": ["placed"], "as_expected": True, "placed": True,
        "false_success": False, "attempts": 1,
    }  # fmt: skip
    rows = b"".join(json.dumps({**row, "seed": seed}).encode() + b"\n" for seed in range(3))
    options = CampaignOptions(seeds=(0, 1, 2))
    settings = options.settings()
    known = json.loads(json.dumps([{**row, "seed": seed} for seed in range(3)]))

    def line(data: bytes, rng: random.Random) -> bytes:
        lines = data.splitlines(keepends=True)
        at = rng.randrange(len(lines))
        lines[at] = altered_json(lines[at], rng) + b"\n"
        return b"".join(lines)

    def compared(path: Path) -> None:
        agree.text_of(agree.compare(agree.rows_of(path.parent), known))

    def resumed(path: Path) -> None:
        (path.parent / "rows.jsonl").write_bytes(rows)
        summarise(read_rows(path.parent, options))

    def cut_off(path: Path) -> None:
        (path.parent / "settings.json").unlink(missing_ok=True)
        summarise(read_rows(path.parent, options))

    return [
        Reader("golden.json", ((BAG / "golden.json").read_bytes(),), altered_json,
               lambda path: golden.compare(golden.read(path), {"frames": 1.0})),
        Reader("campaign/rows.jsonl", (rows,), line, compared),
        Reader("resumed/settings.json", (json.dumps(settings).encode(),), altered_json, resumed),
        Reader("again/rows.jsonl", (rows,), line, cut_off),
    ]  # fmt: skip


# --- poses of other tools
def _poses(folder: Path) -> list[Reader]:
    from openarm_bringup.calibration.foreign import imported
    from openarm_bringup.calibration.foreign_options import Foreign
    from tests.openarm_calibration import foreign_files as files
    from tests.openarm_calibration import test_pose_source as written

    sound: dict[str, bytes] = {}
    known = files.truth("to_hand", 6)
    files.easy_handeye2(folder / "a.samples", known)
    files.moveit_yaml(folder / "b.yaml", known)
    files.moveit_json(folder / "c.json", known)
    for write, name in (
        (written.storage, "d.yml"), (written.storage_of_parts, "e.xml"), (written.arrays_of_parts, "f.npz"),
        (written.lines_of_either, "g.csv"), (written.named_columns, "h.txt"), (written.one_line_each, "i.tsv"),
    ):  # fmt: skip
        write(folder / name)
    np.save(folder / "j.npy", known.A)
    for path in folder.iterdir():
        sound[path.name] = path.read_bytes()
    ways: dict[str, Alter] = {
        ".json": altered_json, ".xml": altered_xml, ".yaml": altered_yaml, ".yml": altered_yaml,
        ".samples": altered_yaml,
    }  # fmt: skip

    def read(path: Path) -> None:
        imported(path, Foreign(camera_kind="eye_to_hand"))

    return [
        Reader(name, (data,), way, read)
        for name, data in sorted(sound.items())
        for way in (ways.get(Path(name).suffix, altered_bytes), altered_bytes)
    ]


# --- archives, networks, robots
def _npz(folder: Path) -> list[Reader]:
    from openarm_calibration.sampling.samples import load_session
    from tests.openarm_calibration.known_session import make_session

    sound: list[bytes] = []
    for setup in ("in_hand", "to_hand"):
        make_session(setup, count=3).samples.save(folder / f"{setup}.npz")
        sound.append((folder / f"{setup}.npz").read_bytes())
    robot = RobotDescription.load()

    def read(path: Path) -> None:
        samples, _ = load_session(path, robot)
        samples.problem()

    return [Reader("session.npz", tuple(sound), altered_archive, read)]


def _onnx(folder: Path) -> list[Reader]:
    from openarm_perception.detection.network import NetworkConfig, NetworkDetector
    from tests.openarm_perception.onnx_file import write_network
    from tests.openarm_perception.onnx_layouts import READ

    image = np.zeros((120, 160, 3), np.uint8)

    def read(path: Path) -> None:
        NetworkDetector(NetworkConfig(model=str(path))).detect(image)

    def alter(data: bytes, rng: random.Random) -> bytes:
        """Where structure is: at both ends, and in what is text."""
        way = rng.random()
        if way < 0.3:
            return altered_bytes(data[:4000], rng) + data[4000:]
        if way < 0.6:
            return data[:-6000] + altered_bytes(data[-6000:], rng)
        if way < 0.75 and b"names" in data:
            at = data.rindex(b"names")
            return data[:at] + altered_bytes(data[at : at + 200], rng) + data[at + 200 :]
        return altered_bytes(data, rng)

    def other(_: bytes, rng: random.Random) -> bytes:
        """A file of any layout, with other outputs, metadata or inputs."""
        output, more = READ[rng.choice(list(READ))]
        arrays: dict[str, np.ndarray] = dict(output) if isinstance(output, dict) else {"output0": output}
        for name in rng.sample(list(arrays), rng.randrange(len(arrays) + 1)):
            one = arrays[name]
            arrays[name] = rng.choice((
                one[:, :-1], one[..., :-1], one[0], one[:, :0], one.swapaxes(1, -1), one.repeat(2, axis=-1), one - 1,
                one * one.dtype.type(90), *(np.full_like(one, value) for value in (1, 127)),
                *(np.full_like(one, value) for value in (np.inf, np.nan) if one.dtype.kind == "f"),
            ))  # fmt: skip
        metadata = {"names": "{0: 'box', 1: 'ball'}", "task": "detect", **more.get("metadata", {})}
        for key in rng.sample(list(metadata), rng.randrange(len(metadata) + 1)):
            texts = (*map(str, HOSTILE), *(text.decode("latin-1") for text in TEXTS), "pose", "obb", "['a']")
            metadata[key] = rng.choice(texts)
        shapes = [(1, 3, 0, 320), (1, 3, 2**40, 2**40), ("n", 3, "h", "w"), (3,), (), *[(1, 3, 256, 320)] * 9]
        options = {**more, "names": "", "metadata": metadata, "shape": rng.choice(shapes)}
        return write_network(folder / "other.onnx", arrays, **options).read_bytes()

    sound = ((models_dir() / "detector/shapes_320x256.onnx").read_bytes(),)
    return [Reader("altered.onnx", sound, alter, read), Reader("altered.onnx", (b"",), other, read)]


def _robots(folder: Path) -> list[Reader]:
    robot = RobotDescription.load()
    mesh = (
        b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
        b"facet normal 0 0 1\nouter loop\nvertex 0 0 1\nvertex 1 0 1\nvertex 0 1 1\nendloop\nendfacet\nendsolid\n"
    )
    obj = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 3 4\nf 1 2 4\nf 2 3 4\n"
    facets = np.random.default_rng(0).random((2, 12), np.float32)
    binary = bytes(80) + (2).to_bytes(4, "little") + b"".join(facet.tobytes() + bytes(2) for facet in facets)
    small = (
        '<robot name="a"><link name="b"><collision><geometry><mesh filename="FILE" scale="1 1 1"/></geometry>'
        '</collision><collision><origin xyz="0 0 1" rpy="0 0 0"/><geometry><box size="1 1 1"/></geometry></collision>'
        "</link></robot>"
    )

    def srdf(path: Path) -> object:
        return RobotDescription.from_urdf(robot.urdf, path.read_text("utf-8", "replace"))

    def meshed(path: Path) -> object:
        urdf = path.with_suffix(".urdf")
        urdf.write_text(small.replace("FILE", path.name))
        return RobotDescription.from_files(urdf)

    def described(path: Path) -> None:
        one = RobotDescription.from_files(path)
        one.link_poses(dict.fromkeys(one.joints, 0.1))

    (folder / "robot").mkdir()
    (folder / "robot/mesh.obj").write_bytes(obj)
    return [
        Reader(
            "robot/robot.urdf",
            (robot.urdf.encode(), small.replace("FILE", "mesh.obj").encode()),
            altered_xml,
            described,
        ),
        Reader("robot.srdf", (robot.srdf.encode(),), altered_xml, srdf),
        Reader("mesh.stl", (mesh, binary), altered_bytes, meshed),
        Reader("mesh.obj", (obj,), altered_bytes, meshed),
    ]


#: By kind: makes the readers, with a folder for sound files.
def _pictures(folder: Path) -> list[Reader]:
    """Intrinsics, images, and compressed depth."""
    import cv2

    from openarm_common.camera.cameras import Intrinsics
    from openarm_common.camera.lens import Lens
    from openarm_common.camera.lens_files import camera_info, read_lens
    from openarm_common.camera.pictures import decode_depth, decode_picture

    lens = Lens(Intrinsics(64, 48, 60.0, 61.0, 31.5, 23.5), "plumb_bob", (-0.1, 0.01, 0.001, -0.001, 0.0))
    info = camera_info("camera", lens).encode()
    kalibr = b"cam0:\n  intrinsics: [60, 61, 31.5, 23.5]\n  distortion_model: radtan\n  resolution: [64, 48]\n"
    kalibr += b"  distortion_coeffs: [-0.1, 0.01, 0.0, 0.0]\n"
    rows = b"60 0 31.5\n0 61 23.5\n0 0 1\n"
    storage = (
        b"%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n"
    )
    storage += b"   dt: d\n   data: [ 60., 0., 31.5, 0., 61., 23.5, 0., 0., 1. ]\n"
    rng = np.random.default_rng(0)
    depth = rng.integers(400, 900, (48, 64)).astype(np.uint16)
    png, jpeg = (
        cv2.imencode(form, rng.integers(0, 255, (48, 64, 3)).astype(np.uint8))[1].tobytes() for form in (".png", ".jpg")
    )
    tiff = cv2.imencode(".tiff", depth.astype(np.float32))[1].tobytes()
    deep = cv2.imencode(".png", depth)[1].tobytes()
    head = struct.pack("<iff", 1, 1e4, -990.0)
    # runs of RVL: 3072 zeros, and zeros with differences
    rvl = struct.pack("<ii", 64, 48) + b"".join(struct.pack("<I", int(word)) for word in rng.integers(0, 2**32, 2000))

    def of(path: Path) -> object:
        return read_lens(path, (64, 48))

    def picture(path: Path) -> object:
        return decode_picture(path.read_bytes(), "the image")

    def depths(path: Path) -> object:
        data = path.read_bytes()
        return [decode_depth(data, encoding, "the image") for encoding in ("16UC1", "32FC1")]

    return [
        Reader("lens/info.yaml", (info, kalibr, storage), altered_yaml, of),
        Reader("lens/info.yml", (info, kalibr, storage, rows), altered_bytes, of),
        Reader("pictures/image", (png, jpeg, tiff, deep), altered_bytes, picture),
        Reader("pictures/depth", (head + deep, head + rvl), altered_bytes, depths),
    ]


KINDS: Mapping[str, Callable[[Path], list[Reader]]] = {
    "bags": _bags,
    "contents": _contents,
    "maps": _maps,
    "clouds": _clouds,
    "pictures": _pictures,
    "yaml": _yaml,
    "json": _json,
    "npz": _npz,
    "onnx": _onnx,
    "robots": _robots,
    "poses": _poses,
}


def read_altered(kind: str, count: int, seed: int) -> Tally:
    """Read altered files of a kind.

    Args:
        kind: Of `KINDS`.
        count: How many.
        seed: The same files for the same seed.
    """
    rng, tally = random.Random(f"{kind}{seed}"), Tally(kind)
    with tempfile.TemporaryDirectory() as folder:
        sound = Path(folder, "sound")
        sound.mkdir()
        readers = KINDS[kind](sound)
        for k in range(count):
            tally.take(readers[k % len(readers)].attempt(Path(folder), rng))
    return tally
