# SPDX-License-Identifier: Apache-2.0
"""Run by test_small_shm in a mount namespace of its own: the whole graph on a /dev/shm of 64 MB, every image counted.

An image is lost when its CameraInfo (small, same stamp) arrived and it did not. Prints one line of JSON.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import sys
import tempfile
import threading
from pathlib import Path

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from vision_msgs.msg import Detection3DArray

from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.session import running_graph
from openarm_common.domain import reserve_domain

STREAMS = ("/overhead/color", "/overhead/depth", "/wrist/color", "/wrist/depth")
SENSOR = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


class Counter:
    """Counts stamps; each stream in a participant of its own, as in a graph."""

    def __init__(self, domain: int) -> None:
        self.images: dict[str, set[int]] = {name: set() for name in STREAMS}
        self.infos: dict[str, set[int]] = {name: set() for name in STREAMS}
        self.others = 0
        self._contexts: list[Context] = []
        for number, name in enumerate(STREAMS):
            context = Context()
            rclpy.init(context=context, domain_id=domain)
            self._contexts.append(context)
            node = rclpy.create_node(f"counter_{number}", context=context)
            node.create_subscription(Image, f"{name}/image_raw", self._adder(self.images[name]), SENSOR)
            node.create_subscription(CameraInfo, f"{name}/camera_info", self._adder(self.infos[name]), SENSOR)
            if number == 0:
                for camera in ("overhead", "wrist"):
                    node.create_subscription(PointCloud2, f"/{camera}/depth/points", self._other, SENSOR)
                node.create_subscription(Image, "/detection_image", self._other, SENSOR)
                node.create_subscription(Detection3DArray, "/detections_3d", self._other, 10)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            threading.Thread(target=self._spin, args=(executor,), daemon=True).start()

    def _adder(self, stamps: set[int]):
        return lambda message: stamps.add(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)

    def _other(self, _: object) -> None:
        self.others += 1

    @staticmethod
    def _spin(executor: SingleThreadedExecutor) -> None:
        try:
            executor.spin()
        except ExternalShutdownException:
            return

    def close(self) -> None:
        for context in self._contexts:
            context.try_shutdown()

    def result(self) -> dict[str, int]:
        lost = total = 0
        for name in STREAMS:
            images, infos = self.images[name], self.infos[name]
            # Discovery of the two is not simultaneous: count from where both had begun to where both ended.
            first, last = max(min(images), min(infos)), min(max(images), max(infos))
            expected = {stamp for stamp in infos if first <= stamp <= last}
            lost += len(expected - images)
            total += len(expected)
        return {"images": total, "lost": lost, "others": self.others}


async def main(seconds: float) -> None:
    graph = load_graph("sim", overrides={"domain": reserve_domain()})
    with tempfile.TemporaryDirectory() as folder:
        async with running_graph(graph, Path(folder)) as supervisor:
            await supervisor.wait_ready()
            counter = Counter(graph.domain or 0)
            await asyncio.sleep(seconds)  # the measurement itself
            usage = shutil.disk_usage("/dev/shm")
            counter.close()
        result = counter.result()
    result |= {"total_mib": usage.total // 2**20, "used_mib": usage.used // 2**20}
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    asyncio.run(main(float(sys.argv[1])))
