# SPDX-License-Identifier: Apache-2.0
"""Robots: URDF, SRDF, meshes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.fuzz.alter import altered_bytes, altered_xml
from benchmarks.fuzz.files.reader import Reader
from openarm_common.robot.description import RobotDescription


def robots(folder: Path) -> list[Reader]:
    """Make readers of robots."""
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
