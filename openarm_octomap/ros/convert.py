# SPDX-License-Identifier: Apache-2.0
"""The map as messages."""

from __future__ import annotations

import array

import numpy as np
from geometry_msgs.msg import Point, Pose
from nav_msgs.msg import OccupancyGrid as OccupancyGridMsg
from numpy.typing import NDArray
from octomap_msgs.msg import Octomap
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common.octree.blocks import CellSet
from openarm_common.octree.codec import TREE_ID, Payload
from openarm_common.octree.lattice import Lattice
from openarm_common.ros.convert import cloud_from_fields, cloud_from_points, header
from openarm_octomap.kernels import FREE, OCCUPIED

#: Colours of cells from the bottom of the workspace to its top.
_BOTTOM, _TOP = np.array([0.12, 0.35, 0.75]), np.array([0.95, 0.65, 0.20])


def octomap_msg(payload: Payload, resolution: float, frame: str, t_ns: int) -> Octomap:
    """Return an octree as octomap_server publishes it.

    Args:
        payload: The octree.
        resolution: Edge of a cell, m.
        frame: Base frame.
        t_ns: Stamp.
    """
    message = Octomap(header=header(frame, t_ns), binary=payload.binary, id=TREE_ID, resolution=resolution)
    # an array of the field's own type is taken as it is; a list costs a thousand times more
    message.data = array.array("b", payload.data.tobytes())
    return message


def centres_msg(lattice: Lattice, states: NDArray[np.uint8], frame: str, t_ns: int) -> PointCloud2:
    """Return centres of the occupied cells.

    Args:
        lattice: Cells of the map.
        states: (nx, ny, nz).
        frame: Base frame.
        t_ns: Stamp.
    """
    points = lattice.centres(np.argwhere(states == OCCUPIED)).astype(np.float32)
    return cloud_from_points(points, frame, t_ns)


def changes_msg(lattice: Lattice, states: NDArray[np.uint8], changed: CellSet, frame: str, t_ns: int) -> PointCloud2:
    """Return cells whose state changed, with a field `state`: 0 unknown, 1 free, 2 occupied.

    Args:
        lattice: Cells of the map.
        states: (nx, ny, nz).
        changed: The cells.
        frame: Base frame.
        t_ns: Stamp.
    """
    flat = changed.indices()
    index = np.stack(np.unravel_index(flat, lattice.shape), axis=-1)
    rows = np.empty((flat.size, 4), np.float32)
    rows[:, :3] = lattice.centres(index)
    rows[:, 3] = states.reshape(-1)[flat]
    return cloud_from_fields(("x", "y", "z", "state"), rows, frame, t_ns)


def markers_msg(lattice: Lattice, states: NDArray[np.uint8], frame: str, t_ns: int) -> MarkerArray:
    """Return the occupied cells as cubes, coloured by height.

    Args:
        lattice: Cells of the map.
        states: (nx, ny, nz).
        frame: Base frame.
        t_ns: Stamp.
    """
    marker = Marker(header=header(frame, t_ns), ns="occupied", type=Marker.CUBE_LIST, action=Marker.ADD)
    marker.scale.x = marker.scale.y = marker.scale.z = lattice.resolution
    centres = lattice.centres(np.argwhere(states == OCCUPIED))
    height = np.clip((centres[:, 2] - lattice.lower[2]) / (lattice.upper[2] - lattice.lower[2]), 0.0, 1.0)
    layers = {
        float(u): ColorRGBA(**dict(zip("rgba", (*(_BOTTOM + u * (_TOP - _BOTTOM)).tolist(), 1.0), strict=True)))
        for u in np.unique(height)
    }
    marker.points = [Point(x=x, y=y, z=z) for x, y, z in centres.tolist()]
    marker.colors = [layers[u] for u in height.tolist()]
    if not marker.points:
        marker.action = Marker.DELETE
    return MarkerArray(markers=[marker])


def projected_msg(lattice: Lattice, states: NDArray[np.uint8], frame: str, t_ns: int) -> OccupancyGridMsg:
    """The map seen from above: 100 where a column has an occupied cell, 0 where it has a free one only, else -1.

    Args:
        lattice: Cells of the map.
        states: (nx, ny, nz).
        frame: Base frame.
        t_ns: Stamp.
    """
    occupied, free = (states == OCCUPIED).any(axis=2), (states == FREE).any(axis=2)
    cells = np.where(occupied, 100, np.where(free, 0, -1)).astype(np.int8)
    message = OccupancyGridMsg(header=header(frame, t_ns))
    message.info.map_load_time = message.header.stamp
    message.info.resolution = lattice.resolution
    message.info.width, message.info.height = lattice.shape[0], lattice.shape[1]
    x, y, z = lattice.lower.tolist()
    message.info.origin = Pose(position=Point(x=x, y=y, z=z))
    message.data = array.array("b", np.ascontiguousarray(cells.T).tobytes())  # rows run along x
    return message
