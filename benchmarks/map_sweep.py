# SPDX-License-Identifier: Apache-2.0
"""Whether the robot, or what it holds, gets into the map while an arm sweeps before the cameras.

    python -m benchmarks.map_sweep [--seconds S] [--seed N] [--noise] [--json PATH]

Starts the graph `sim`, asks for the red cube to be picked and kept, then moves the arm among random postures; each
request says what the hand holds. Every octree that is published meanwhile is held against the simulator's truth: above
the table, an occupied cell that is not within two cells of an object on the table is a part of the robot, of the held
cube, or a trace of them.

With --noise depth is as noisy as a D435's, flying pixels at the edges of the arm among it.

    sweep_ghost_cells   of all octrees together
    sweep_maps          octrees looked at
    sweep_moved_m       way of the hand
"""

from __future__ import annotations

import argparse
import asyncio
import os
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import rclpy
from numpy.typing import NDArray
from octomap_msgs.msg import Octomap
from openarm_interfaces.msg import ObjectStateArray
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from sensor_msgs.msg import JointState
from visualization_msgs.msg import Marker, MarkerArray

from benchmarks.report import Row, write_report
from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.session import in_thread, running_graph
from openarm_common.domain import reserve_domain
from openarm_common.errors import OpenArmError
from openarm_common.octree.codec import decode
from openarm_common.octree.lattice import Lattice
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import pose_to_matrix, xyz
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, reliable
from openarm_common.scene.scene import load_scene
from openarm_grasp.ros.client import GraspClient
from openarm_motion.collision.solids import Box
from openarm_motion.ros.client import MotionClient

ARM, LABEL = "right", "red"
#: Lowest height above the table that counts, m: two cells, in which the table itself may be.
_ABOVE = 0.04


class Watcher:
    """Octrees, joint states and ground truth of the graph, heard in a thread of its own; a context manager."""

    def __init__(self) -> None:
        self.maps: list[Octomap] = []
        self.truth: ObjectStateArray | None = None
        self.joints: dict[str, float] = {}
        self.held: list[Box] = []
        self.way_m = 0.0
        self._description = RobotDescription.load()
        self._last: NDArray[np.float64] | None = None
        self._context = Context()
        rclpy.init(args=[], context=self._context)
        node = rclpy.create_node("map_sweep", context=self._context)
        node.create_subscription(Octomap, "/octomap_binary", self.maps.append, QOS_LATCHED)
        node.create_subscription(ObjectStateArray, "/sim/ground_truth/objects", self._on_truth, reliable(5))
        node.create_subscription(MarkerArray, "/motion/attached_objects", self._on_held, QOS_LATCHED)
        node.create_subscription(JointState, "/joint_states", self._on_joints, QOS_COMMAND)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._spin, daemon=True)

    def __enter__(self) -> Watcher:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._context.try_shutdown()
        self._thread.join(5.0)

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return  # the normal end

    def _on_truth(self, message: ObjectStateArray) -> None:
        self.truth = message

    def _on_held(self, message: MarkerArray) -> None:
        added = [marker for marker in message.markers if marker.action == Marker.ADD]
        self.held = [Box(marker.ns, pose_to_matrix(marker.pose), np.array(xyz(marker.scale))) for marker in added]

    def _on_joints(self, message: JointState) -> None:
        self.joints = dict(zip(message.name, message.position, strict=True))
        hand = self._description.link_pose(self._description.tcp_link(ARM), self.joints)[:3, 3]
        if self._last is not None:
            self.way_m += float(np.linalg.norm(hand - self._last))
        self._last = hand


def ghosts(message: Octomap, truth: ObjectStateArray, table_top: float) -> int:
    """Occupied cells above the table that no standing object explains."""
    lattice = Lattice.from_bounds(message.resolution, (-0.48, -1.0, table_top + _ABOVE), (1.28, 1.0, 1.36))
    leaves = decode(np.frombuffer(message.data, np.uint8), message.resolution, binary=message.binary)
    centres = lattice.centres(np.argwhere(leaves.on(lattice)[0] > 0))
    for item in truth.objects:
        T = pose_to_matrix(item.pose)
        half = np.array(xyz(item.size)) / 2
        if item.label == LABEL:
            continue  # it is in the hand
        local = (centres - T[:3, 3]) @ T[:3, :3]
        centres = centres[(np.abs(local) > half + 2 * message.resolution).any(axis=1)]
    return len(centres)


def sweep(seconds: float, seed: int) -> dict[str, float]:
    """Pick, sweep, and count."""
    rng = np.random.default_rng(seed)
    table_top = load_scene("demo").table.top_z
    counts: list[int] = []
    with Watcher() as watcher, GraspClient() as grasp, MotionClient() as motion:
        grasp.pick(LABEL, arm=ARM, phase="pick").raise_for_code()
        names = RobotDescription.load().arm_joints(ARM)
        home = np.array([watcher.joints[name] for name in names])
        watcher.maps.clear()
        watcher.way_m = 0.0
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            goal = home + rng.uniform(-0.4, 0.4, len(home))
            try:
                motion.move_to_joints(
                    ARM, goal, attached=watcher.held
                )  # out of limits or not free: the next one will do
            except OpenArmError:
                continue
            while watcher.maps and watcher.truth is not None:
                counts.append(ghosts(watcher.maps.pop(0), watcher.truth, table_top))
        held = next(item for item in watcher.truth.objects if item.label == LABEL) if watcher.truth else None
        return {
            "ghosts": float(sum(counts)),
            "maps": float(len(counts)),
            "way": watcher.way_m,
            "held_m": held.pose.position.z - table_top if held is not None else 0.0,
        }


async def run(seconds: float, seed: int, *, noise: bool) -> dict[str, float]:
    """The graph, and the sweep next to it."""
    sets = (f"mujoco_bridge.depth_noise.enabled={str(noise).lower()}",)
    graph = load_graph("sim", overrides={"domain": reserve_domain()}, sets=sets)
    os.environ |= {"ROS_DOMAIN_ID": str(graph.domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    result: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        async with running_graph(graph, Path(folder)) as supervisor:
            await supervisor.wait_ready()
            await in_thread(lambda: result.update(sweep(seconds, seed)), "sweep")
    return result


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="of the sweep, wall clock")
    parser.add_argument("--seed", type=int, default=0, help="of the postures")
    parser.add_argument("--noise", action="store_true", help="depth as noisy as a D435's")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    result = asyncio.run(run(args.seconds, args.seed, noise=args.noise))
    n = int(result["maps"])
    rows = [
        Row("sweep_ghost_cells", result["ghosts"], "", "lower", 0.0, n=n),
        Row("sweep_maps", result["maps"], "", "higher", None, n=n),
        Row("sweep_moved_m", result["way"], "m", "higher", None, n=n),
        Row("sweep_held_m", result["held_m"], "m", "higher", 0.0, n=n),
    ]
    write_report(rows, args.json)


if __name__ == "__main__":
    main()
