# SPDX-License-Identifier: Apache-2.0
"""What the page gets: JSON for what is small, and frames of a JSON head and raw arrays for what is large.

A frame is a uint32 (little-endian) with the length of its head, the head (JSON, padded with spaces so that what
follows begins at a multiple of four), and the arrays one after the other. Positions are metres in the base frame.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.octree.codec import Leaves
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.meshes import read_mesh
from openarm_common.robot.urdf import Primitive
from openarm_common.types import Array, Bytes, Floats
from openarm_perception.geometry.depth import Deprojector

_KEY_ZERO = 1 << 15
_GREY = (0.6, 0.6, 0.6, 1.0)
#: Added to cell indices of a cloud: 2^20 in each direction.
_OFFSET = 1 << 20


def frame(head: Mapping[str, Any], *arrays: NDArray[Any] | bytes) -> bytes:
    """One binary message."""
    text = json.dumps(head, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    body = [part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes() for part in arrays]
    return b"".join([len(text).to_bytes(4, "little"), text, *body])


def robot_shapes(description: RobotDescription) -> dict[str, Any]:
    """The robot as the page draws it: names of the links, and shapes with the index of their link.

    Poses are `T_link_shape`, 16 numbers by columns; `size` is that of `openarm_common.robot.urdf.Primitive`. A mesh has
    its scale for a size, and the index of its file in `robot_meshes`.
    """
    links, files = list(description.links), _mesh_files(description)
    shapes = [_shape(i, shape) for i, link in enumerate(description.links.values()) for shape in link.visual]
    for i, link in enumerate(description.links.values()):
        for mesh in link.meshes:
            rest = {"size": mesh.scale, "pose": _columns(mesh.T_link_mesh), "color": mesh.rgba or _GREY}
            shapes.append({"link": i, "kind": "mesh", "mesh": files.index(mesh.file), **rest})
    return {"links": links, "shapes": shapes}


def robot_meshes(description: RobotDescription) -> bytes:
    """Triangles of the robot's visual meshes, a frame: their number by file, and three corners (x, y, z) of each.

    Raises:
        OpenArmError: CONFIG_INVALID, for a file that can't be read.
    """
    soups: list[Floats] = []
    for file in _mesh_files(description):
        vertices, triangles = read_mesh(Path(file.removeprefix("file://")), np.ones(3))
        soups.append(vertices[triangles].astype(np.float32))
    return frame({"kind": "meshes", "counts": [len(soup) for soup in soups]}, *soups)


def _mesh_files(description: RobotDescription) -> list[str]:
    return list(dict.fromkeys(mesh.file for link in description.links.values() for mesh in link.meshes))


def _shape(link: int, shape: Primitive) -> dict[str, Any]:
    pose = _columns(shape.T_link_primitive)
    return {"link": link, "kind": shape.kind, "size": shape.size, "pose": pose, "color": shape.rgba or _GREY}


def _columns(T: Array) -> list[float]:
    return np.round(T.T.ravel(), 6).tolist()


def link_poses(description: RobotDescription, q: Mapping[str, float]) -> Floats:
    """`T_base_link` (n, 16) of all links by columns, in their order; unknown joints are at 0."""
    at = {name: 0.0 for name, joint in description.joints.items() if joint.type != "fixed"} | dict(q)
    poses = description.link_poses(at)
    return np.array([poses[link].T.ravel() for link in description.links], np.float32)


def occupied_cells(leaves: Leaves) -> Floats:
    """Centre and edge (n, 4) of the occupied leaves of a map."""
    cells, log_odds = leaves.arrays()
    cells = cells[log_odds > 0.0]
    edge = leaves.resolution * (1 << cells[:, 0])
    lower = (cells[:, 1:] << cells[:, :1]) - _KEY_ZERO
    centre = lower * leaves.resolution + edge[:, None] / 2.0
    return np.column_stack([centre, edge]).astype(np.float32)


def thin_cloud(
    deprojector: Deprojector,
    depth: NDArray[Any],
    rgb: Bytes,
    intrinsics: Intrinsics,
    T_base_optical: NDArray[np.float64],
    edge: float = 0.01,
    stride: int = 2,
) -> tuple[Floats, Bytes]:
    """Points (n, 3) of a depth image in the base frame, thinned, and their colours (n, 3).

    Args:
        deprojector: Deprojector with the limits of the camera.
        depth: (h, w), uint16 mm or float32 m.
        rgb: (h, w, 3) of the same frame.
        intrinsics: Intrinsics of both.
        T_base_optical: Pose of the camera.
        edge: One point is kept for each cell of this edge, m.
        stride: Step between the pixels that are used, along rows and columns.

    Raises:
        OpenArmError: BAD_IMAGE, when sizes differ or the depth has an unknown type.
    """
    if rgb.shape[:2] != depth.shape:
        raise OpenArmError(Code.BAD_IMAGE, f"colour is {rgb.shape[:2]}, depth {depth.shape}; expected one size")
    few, colors = np.ascontiguousarray(depth[::stride, ::stride]), rgb[::stride, ::stride]
    optics = (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)
    points = deprojector.organised(few, Intrinsics(few.shape[1], few.shape[0], *(value / stride for value in optics)))
    valid = np.isfinite(points[..., 2])
    T = T_base_optical.astype(np.float32)
    base = points[valid] @ T[:3, :3].T + T[:3, 3]
    cell = np.floor(base / np.float32(edge)).astype(np.int64) + _OFFSET
    _, first = np.unique((cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2], return_index=True)
    return base[first], colors[valid][first]


def jpeg(rgb: NDArray[Any], quality: int = 80) -> bytes:
    """An RGB image (h, w, 3) as JPEG."""
    done, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise OpenArmError(Code.BAD_IMAGE, f"an image of {rgb.shape} could not be written as JPEG")
    return data.tobytes()


def box(label: str, T_base_box: NDArray[np.float64], size: Sequence[float], **more: Any) -> dict[str, Any]:
    """A box with edges `size` as the page draws it, the pose by columns."""
    pose = np.round(T_base_box.T.ravel(), 5).tolist()
    return {"label": label, "pose": pose, "size": [round(float(edge), 5) for edge in size], **more}
