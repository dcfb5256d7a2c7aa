# SPDX-License-Identifier: Apache-2.0
"""Everything that is published of a map, under octomap_server's names."""

from __future__ import annotations

from typing import Any

from nav_msgs.msg import OccupancyGrid
from octomap_msgs.msg import Octomap
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from openarm_common.octree.blocks import CellSet
from openarm_common.ros.node import QOS_LATCHED
from openarm_octomap.mapper import MapSnapshot
from openarm_octomap.ros import convert


class MapPublisher:
    """Publishes snapshots; clouds, markers and projection only while they have subscribers.

    Args:
        node: Its node.
        frame: Base frame.
        full: Whether octomap_full is published too.
    """

    def __init__(self, node: Node, frame: str, *, full: bool) -> None:
        self._frame, self._full_wanted = frame, full
        self._binary = node.create_publisher(Octomap, "octomap_binary", QOS_LATCHED)
        self._full = node.create_publisher(Octomap, "octomap_full", QOS_LATCHED)
        self._changes = node.create_publisher(PointCloud2, "octomap_changes", QOS_LATCHED)
        self._pictures: list[tuple[Any, Any]] = [
            (node.create_publisher(PointCloud2, "octomap_point_cloud_centers", QOS_LATCHED), convert.centres_msg),
            (node.create_publisher(MarkerArray, "occupied_cells_vis_array", QOS_LATCHED), convert.markers_msg),
            (node.create_publisher(OccupancyGrid, "projected_map", QOS_LATCHED), convert.projected_msg),
        ]

    def wanted(self, *, everything: bool = False) -> set[str]:
        """Return what a snapshot must hold for the subscribers."""
        listening = [p for p, _ in self._pictures if everything or p.get_subscription_count()]
        wanted = {"states"} if listening or self._changes.get_subscription_count() else set[str]()
        return wanted | ({"full"} if self._full_wanted else set())

    def publish(self, snapshot: MapSnapshot, t_ns: int, changed: CellSet | None = None) -> None:
        """Publish a snapshot; without `changed` it is a new map, which all topics show at once.

        Args:
            snapshot: The map.
            t_ns: Stamp.
            changed: Cells whose state changed.
        """
        resolution = snapshot.lattice.resolution
        self._binary.publish(convert.octomap_msg(snapshot.binary, resolution, self._frame, t_ns))
        if snapshot.full is not None:
            self._full.publish(convert.octomap_msg(snapshot.full, resolution, self._frame, t_ns))
        if snapshot.states is None:
            return
        for publisher, message in self._pictures:
            if changed is None or publisher.get_subscription_count():
                publisher.publish(message(snapshot.lattice, snapshot.states, self._frame, t_ns))
        if changed is not None and self._changes.get_subscription_count():
            self._changes.publish(convert.changes_msg(snapshot.lattice, snapshot.states, changed, self._frame, t_ns))
