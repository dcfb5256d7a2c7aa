# SPDX-License-Identifier: Apache-2.0
"""Whether a recording loses nothing, and whether it gives the same numbers each time it is replayed.

    python -m benchmarks.replay_twice [--quick] [--seconds S] [--rate R] [--bag BAG] [--json PATH]

Starts the graph `sim`, asks it for a grasp, and records both cameras meanwhile (60 s; --bag takes a recording instead).
Then, twice each: `openarm check`, in a process of its own, and `openarm replay` into the graph `replay`, whose
detections, clouds and map are listened to. What carries the same stamp in both replays is compared, every field and
every point. Which frames a node takes is a matter of its pace: those of one replay alone are counted, and so are the
cells of the map, which takes two frames a second. Exit code 1 when anything was lost, or differs that has the same
stamp. Run it on an idle machine, or with a rate at which the nodes keep up.

    recorded, recorded_lost     messages in the bag, and published but not in the bag
    check_numbers, check_differ numbers of `openarm check`, and how many of them differ between two runs
    NAME_twice, NAME_once       messages of a topic with a stamp in both replays, and in only one
    NAME_differ                 of those in both, how many differ in anything
    map_cells, map_cells_differ occupied and free cells at the end, and how many differ between two replays
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import contextlib
import hashlib
import json
import os
import signal
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Row, write_report
from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.session import running_graph
from openarm_common.domain import release_domain, reserve_domain
from openarm_common.octree.codec import decode
from openarm_common.octree.lattice import Lattice
from openarm_octomap.config import GridConfig
from openarm_octomap.grid import OccupancyGrid

OPENARM = Path(sys.executable).with_name("openarm")
CAMERAS = ("overhead", "wrist")
MAP = "/octomap_binary"
#: Every frame is worked on, so that two replays have as many frames as possible in common.
SETS = ("detector.max_rate=30.0", "wrist_detector.max_rate=30.0")


# --- the listener, a process of its own
def listen(path: Path) -> None:
    """Listen until SIGINT, then write digests by topic and stamp, and the last map."""
    import rclpy
    from octomap_msgs.msg import Octomap
    from rclpy.executors import ExternalShutdownException
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import PointCloud2
    from vision_msgs.msg import Detection3DArray

    from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_SENSOR

    rclpy.init()
    node = rclpy.create_node("replay_twice")
    heard: dict[str, dict[int, str]] = {}
    newest: list[Octomap] = []

    def take(kind: type, topic: str, qos: Any) -> None:
        digests = heard.setdefault(topic, {})

        def on_message(raw: bytes) -> None:  # a header comes first: its stamp follows four bytes of encapsulation
            sec, nanosec = np.frombuffer(raw, np.uint32, count=2, offset=4).tolist()
            # the bytes between fields are whatever was in memory: of small messages every field is compared instead
            content = raw if kind is PointCloud2 else repr(deserialize_message(raw, kind)).encode()
            digests[sec * 1_000_000_000 + nanosec] = hashlib.sha256(content).hexdigest()

        node.create_subscription(kind, topic, on_message, qos, raw=True)

    take(Detection3DArray, "/detections_3d", QOS_COMMAND)
    take(Detection3DArray, "/wrist/detections_3d", QOS_COMMAND)
    for camera in CAMERAS:
        take(PointCloud2, f"/{camera}/depth/points", QOS_SENSOR)
    node.create_subscription(Octomap, MAP, lambda message: newest.__setitem__(slice(None), [message]), QOS_LATCHED)
    while not all(node.count_publishers(topic) for topic in (*heard, MAP)):
        rclpy.spin_once(node, timeout_sec=0.05)
    print("listens", flush=True)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    (last,) = newest
    octree = {"data": base64.b64encode(np.array(last.data, np.int8).tobytes()).decode(), "resolution": last.resolution}
    path.write_text(json.dumps({"heard": heard, "map": octree}))
    node.destroy_node()
    rclpy.try_shutdown()


# --- the measurement
async def run(env: Mapping[str, str], *arguments: object) -> dict[str, Any]:
    """Run `openarm` and return its JSON."""
    process = await asyncio.create_subprocess_exec(
        OPENARM, *map(str, arguments), "--json", env=env, stdout=asyncio.subprocess.PIPE
    )
    said = json.loads((await process.communicate())[0])
    print(f"    {said['message']}", flush=True)
    return said


async def record(bag: Path, seconds: float) -> dict[str, Any]:
    """Record both cameras of the graph `sim` while it grasps."""
    domain = reserve_domain()
    env = os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    try:
        async with running_graph(load_graph("sim", overrides={"domain": domain}), bag.parent / "sim") as supervisor:
            await supervisor.wait_ready()
            recording = asyncio.create_task(run(env, "record", bag, "--profile", "camera", "--duration", seconds))
            await run(env, "pick", "red")
            return await recording
    finally:
        release_domain(domain)


async def replay(bag: Path, folder: Path, rate: float) -> dict[str, Any]:
    """Replay into a graph without a robot and return what was heard of it."""
    domain, out = reserve_domain(), folder / "heard.json"
    env = os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    try:
        graph = load_graph("replay", overrides={"domain": domain}, sets=SETS)
        async with running_graph(graph, folder) as supervisor:
            await supervisor.wait_ready()
            listener = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "benchmarks.replay_twice", "--listen", str(out)),
                env=env,
                stdout=asyncio.subprocess.PIPE,
            )
            assert listener.stdout is not None
            await asyncio.wait_for(listener.stdout.readline(), 60.0)
            said = await run(env, "replay", bag, "--rate", rate, "--until-idle")
            listener.send_signal(signal.SIGINT)
            await asyncio.wait_for(listener.wait(), 60.0)
            if not said["success"]:
                raise SystemExit(said["message"])
    finally:
        release_domain(domain)
    return json.loads(out.read_text())


def cells(octree: Mapping[str, Any], lattice: Lattice) -> NDArray[np.float32]:
    """Whether each cell is occupied or free, as log-odds; NaN where unknown."""
    data = base64.b64decode(octree["data"])
    return decode(data, octree["resolution"], binary=True).on(lattice)[0]


def compare(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, int]:
    """Count what two replays have in common, and what differs."""
    figures: dict[str, int] = {}
    for topic, digests in first["heard"].items():
        others, name = second["heard"][topic], topic.strip("/").replace("/", "_")
        both = digests.keys() & others.keys()
        figures[f"{name}_twice"] = len(both)
        figures[f"{name}_once"] = len(digests.keys() ^ others.keys())
        figures[f"{name}_differ"] = sum(digests[stamp] != others[stamp] for stamp in both)
    lattice = OccupancyGrid(GridConfig()).lattice
    a, b = cells(first["map"], lattice), cells(second["map"], lattice)
    figures["map_cells"] = int(np.count_nonzero(~np.isnan(a) | ~np.isnan(b)))
    figures["map_cells_differ"] = int(np.count_nonzero((a != b) & ~(np.isnan(a) & np.isnan(b))))
    return figures


async def measure(seconds: float, rate: float, bag: Path | None) -> dict[str, int]:
    """Record, check twice, replay twice."""
    figures: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if bag is None:
            bag = folder / "bag"
            recorded = await record(bag, seconds)
            figures |= {"recorded": recorded["messages"], "recorded_lost": recorded["lost"]}
        checks = [await run(os.environ, "check", bag, "--update", "--golden", folder / f"{i}.json") for i in (1, 2)]
        first, second = (one["numbers"] for one in checks)
        figures["check_numbers"] = len(first)
        figures["check_differ"] = sum(first.get(key) != second.get(key) for key in first.keys() | second.keys())
        replays: list[dict[str, Any]] = []
        for i in (1, 2):
            (folder / f"replay{i}").mkdir()
            replays.append(await replay(bag, folder / f"replay{i}", rate))
        figures |= compare(*replays)
    return figures


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a recording of 15 s")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the recording")
    parser.add_argument("--rate", type=float, default=1.0, help="of the replays")
    parser.add_argument("--bag", type=Path, help="an existing recording")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--listen", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.listen:
        listen(args.listen)
        return
    print(f"load {os.getloadavg()[0]:.2f}", flush=True)
    figures = asyncio.run(measure(15.0 if args.quick else args.seconds, args.rate, args.bag))
    exact = [name for name in figures if name.endswith(("_lost", "_differ")) and name != "map_cells_differ"]
    rows = [
        Row(name, float(value), "", "lower" if name in exact else "higher", 0.0 if name in exact else None, n=1)
        for name, value in figures.items()
    ]
    write_report(rows, args.json)
    sys.exit(1 if any(figures[name] for name in exact) else 0)


if __name__ == "__main__":
    main()
