# SPDX-License-Identifier: Apache-2.0
"""Whether the graph keeps real time on two cores, compared with a naive single-timer bridge in the same run.

    python benchmarks/graph_realtime.py [--robot NAME] [--quick] [--seconds S] [--runs N] [--json PATH]

Starts the graph `sim` with every node up, listens to colour, depth and points of its cameras, and
prints the worst of N runs for rtf, period, loss and latency, and the mean for cores. Then once the same graph with
`benchmarks/naive_bridge.py` in place of the bridge. Run it on an idle machine: the load before each run is printed.

    rtf                         simulated seconds a wall second
    joint_state_period_p99_ms   between two joint states as they are published (wall clock of the publisher)
    joint_state_period_mean_ms  its mean
    frames_lost                 images whose stamp was seen on any topic of the camera, but not on this one
    images_per_s                of the slowest camera's topic that is slowest
    image_to_points_p95_ms      from the publication of the joint state with the image's stamp to the arrival of points
    cpu_cores                   of all processes of the graph, without the listener

Budget, in cores, for two cameras of 640 x 480 at 30 Hz (a 100 Hz subscription costs an rclpy process 0.05 to 0.10):

    process                 work                                                             cores
    mujoco_bridge           physics 100 Hz x 5 steps, /joint_states /clock 100 Hz, /tf 50 Hz  0.20
    mujoco_cameras          60 frames a second of colour and depth                            0.50
    cloud                   60 clouds a second of 307,200 points                              0.25
    octomap                 both depth cameras at 2 Hz, self-filter, /joint_states 100 Hz     0.25
    motion                  /joint_states 100 Hz, map                                         0.15
    detector                idle without a subscriber to detections                           0.02
    grasp                   idle unless a grasp runs                                          0.02
    calibration_publisher   latched                                                           0.01
    sum                                                                                       1.40
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.report import Row, write_report
from openarm_bringup.supervision.graph import Graph, NodeSpec, Ready, load_graph
from openarm_bringup.supervision.session import running_graph
from openarm_common.camera.cameras import depth_cameras
from openarm_common.domain import reserve_domain
from openarm_common.robot.folder import choose_robot

SETTLE_S = 4.0


# --- the listener, a process of its own
def watch(seconds: float) -> dict[str, Any]:
    """Listen, and return what was heard: stamps and wall-clock times, ns."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from sensor_msgs.msg import CameraInfo, Image, JointState, PointCloud2

    from openarm_common.ros.node import QOS_COMMAND, QOS_SENSOR

    rclpy.init()
    node = rclpy.create_node("graph_realtime")
    joints: list[tuple[int, int]] = []  # stamp, published
    heard: dict[str, list[tuple[int, int]]] = {}  # stamp, arrived

    def stamp(raw: bytes) -> int:  # a header comes first: its stamp follows the four bytes of the encapsulation
        sec, nanosec = np.frombuffer(raw, np.uint32, count=2, offset=4).tolist()
        return sec * 1_000_000_000 + nanosec

    def on_joints(raw: bytes, info: Any) -> None:
        joints.append((stamp(raw), info["source_timestamp"]))

    def listen(kind: type, topic: str) -> None:
        got = heard.setdefault(topic, [])

        def on_message(raw: bytes, info: Any) -> None:
            got.append((stamp(raw), info["received_timestamp"]))

        node.create_subscription(kind, topic, on_message, QOS_SENSOR, raw=True)

    node.create_subscription(JointState, "/joint_states", on_joints, QOS_COMMAND, raw=True)
    for camera in depth_cameras():
        for kind in ("color", "depth"):
            listen(Image, f"/{camera}/{kind}/image_raw")
            listen(CameraInfo, f"/{camera}/{kind}/camera_info")
        listen(PointCloud2, f"/{camera}/depth/points")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    began: float | None = None
    while began is None or time.monotonic() - began < SETTLE_S + seconds:
        executor.spin_once(timeout_sec=0.1)
        if began is None and all(heard.values()):
            began = time.monotonic()
            print("hears all", flush=True)
    node.destroy_node()
    rclpy.try_shutdown()
    return {"joints": joints, "heard": heard}


# --- the measurement
def figures(data: dict[str, Any], seconds: float) -> dict[str, float]:
    """Figures of the last `seconds` of what was heard."""
    joints = np.array(data["joints"], dtype=np.int64)
    joints = joints[joints[:, 1] >= joints[-1, 1] - seconds * 1e9]
    first, last = joints[0, 0], joints[-1, 0] - 300_000_000  # what is still under way at the end is not lost
    wall = (joints[-1, 1] - joints[0, 1]) * 1e-9
    periods = np.diff(joints[:, 1]) * 1e-6
    heard = {topic: {s: t for s, t in got if first <= s <= last} for topic, got in data["heard"].items()}
    lost, images = 0, list[int]()
    for camera in depth_cameras():
        topics = [f"/{camera}/{kind}/{what}" for kind in ("color", "depth") for what in ("image_raw", "camera_info")]
        published = set().union(*(heard[topic].keys() for topic in topics))
        for topic in topics[::2]:
            lost += len(published - heard[topic].keys())
            images.append(len(heard[topic]))
    at = {int(s): int(t) for s, t in joints}
    points = [t - at[s] for c in depth_cameras() for s, t in heard[f"/{c}/depth/points"].items() if s in at]
    return {
        "rtf": float((joints[-1, 0] - joints[0, 0]) * 1e-9 / wall),
        "joint_state_period_p99_ms": float(np.percentile(periods, 99)),
        "joint_state_period_max_ms": float(periods.max()),
        "joint_state_period_mean_ms": float(periods.mean()),
        "frames_lost": float(lost),
        "images_per_s": min(images) / wall,
        "points_per_s": len(points) / wall,
        "image_to_points_p95_ms": float(np.percentile(points, 95)) * 1e-6 if points else float("inf"),
        "n": float(len(periods)),
    }


def cpu_seconds(pid: int) -> dict[str, float]:
    """CPU time of a process and of all below it, by what they run."""
    out: dict[str, float] = {}
    process = psutil.Process(pid)
    for one in [process, *process.children(recursive=True)]:
        try:
            times, line = one.cpu_times(), one.cmdline()
        except psutil.NoSuchProcess:
            continue
        module = next((after for flag, after in pairwise(line) if flag == "-m"), Path(line[0]).name if line else "?")
        name = one.name() if module.endswith("fork_server") else module
        out[f"{name}[{one.pid}]"] = times.user + times.system
    return out


async def measure(graph: Graph, seconds: float) -> dict[str, float]:
    """Run the graph and the listener once."""
    with tempfile.TemporaryDirectory() as folder:
        async with running_graph(graph, Path(folder)) as supervisor:
            await supervisor.wait_ready()
            env = os.environ | {"ROS_DOMAIN_ID": str(graph.domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
            listener = await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                "benchmarks.graph_realtime",
                "--watch",
                f"{folder}/heard.json",
                "--seconds",
                str(seconds),
                env=env,
                stdout=subprocess.PIPE,
            )
            assert listener.stdout is not None
            await asyncio.wait_for(listener.stdout.readline(), 60.0)
            await asyncio.sleep(SETTLE_S)
            pids = [supervisor.pid(name) for name in graph.nodes]
            before = [cpu_seconds(pid) for pid in pids]
            began = time.monotonic()
            await asyncio.sleep(seconds - 1.0)
            after, passed = [cpu_seconds(pid) for pid in pids], time.monotonic() - began
            await asyncio.wait_for(listener.wait(), 60.0)
        result = figures(json.loads(Path(folder, "heard.json").read_text()), seconds)
    used = {
        f"{node}: {key.partition('[')[0]}": (new[key] - old.get(key, 0.0)) / passed
        for node, old, new in zip(graph.nodes, before, after, strict=True)
        for key in new
    }
    for key, cores in sorted(used.items(), key=lambda item: -item[1]):
        print(f"    {cores:5.2f} cores  {key}")
    result["cpu_cores"] = sum(used.values())
    print("    " + ", ".join(f"{key} {value:.4g}" for key, value in result.items()), flush=True)
    return result


def naive(graph: Graph) -> Graph:
    """Return the graph with the peer in place of the bridge; what asks for actions it lacks is left out."""
    spec = NodeSpec(
        module="benchmarks.naive_bridge",
        ready=(Ready(message="/joint_states"),),
        large_messages=True,
        segment_mib=24,
        env={"PYTHONPATH": str(Path(__file__).parents[1]), "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")},
    )
    return graph.model_copy(update={"nodes": {**graph.nodes, "mujoco_bridge": spec}})


ROWS = (  # metric, unit, better, target (of rates: of what the cameras should say), worst of the runs
    ("rtf", "", "higher", 0.99, min),
    ("joint_state_period_p99_ms", "ms", "lower", 12.0, max),
    ("joint_state_period_max_ms", "ms", "lower", None, max),
    ("joint_state_period_mean_ms", "ms", "range", 10.0, max),
    ("frames_lost", "", "lower", 0.0, max),
    ("images_per_s", "1/s", "higher", 15.0, min),
    ("points_per_s", "1/s", "higher", 0.99, min),
    ("image_to_points_p95_ms", "ms", "lower", 60.0, max),
    ("cpu_cores", "", "lower", 1.8, max),
)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", help="name of a folder of models/robots")
    parser.add_argument("--quick", action="store_true", help="one run of 15 s")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each run")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--no-peer", action="store_true", help="leave the naive bridge out")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--watch", help=argparse.SUPPRESS)
    args = parser.parse_args()
    choose_robot(args.robot)
    points = sum(camera.rate for camera in depth_cameras().values())
    due = {"points_per_s": points}
    if args.watch:
        Path(args.watch).write_text(json.dumps(watch(args.seconds)))
        return
    seconds, runs = (15.0, 1) if args.quick else (args.seconds, args.runs)
    results: list[dict[str, float]] = []
    for run in range(runs):
        print(f"run {run + 1}: load {os.getloadavg()[0]:.2f}", flush=True)
        results.append(asyncio.run(measure(load_graph("sim", overrides={"domain": reserve_domain()}), seconds)))
    peer: dict[str, float] = {}
    if not args.no_peer:
        print(f"naive bridge: load {os.getloadavg()[0]:.2f}", flush=True)
        graph = naive(load_graph("sim", overrides={"domain": reserve_domain()}))
        peer = asyncio.run(measure(graph, seconds))
    rows = [
        Row(
            metric,
            worst(result[metric] for result in results),
            unit,
            better,
            target and target * due.get(metric, 1.0),
            "naive single-timer bridge" if peer else "",
            peer.get(metric),
            int(results[0]["n"]),
        )
        for metric, unit, better, target, worst in ROWS
    ]
    write_report(rows, args.json)


if __name__ == "__main__":
    main()
