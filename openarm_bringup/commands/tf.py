# SPDX-License-Identifier: Apache-2.0
"""`openarm tf`: the tree of frames, and one frame in another."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import App

from openarm_bringup.commands.pick import meet_graph
from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Edges = dict[str, tuple[str, NDArray[np.float64], bool]]

app = App(name="tf", help="Show the tree of frames, or one frame in another.")

#: Joint frames are told on /tf at 50 Hz, the rest on /tf_static.
_LISTEN_S = 1.0
_ROW, _INDENT, _MARGIN = 22, 26, 16


@app.command
def echo(target: str, source: str, *, domain: int | None = None) -> Outcome:
    """Print where a frame is, as it is now.

    Args:
        target: Frame in which it is told.
        source: Frame that is told of.
        domain: ROS_DOMAIN_ID of the graph; found by itself when one graph runs on this machine.
    """
    from openarm_common.se3 import inverse, quat_xyzw_from_matrix

    edges = _listen(domain)
    T = inverse(_to_root(edges, target)) @ _to_root(edges, source)
    position, quaternion = T[:3, 3].tolist(), quat_xyzw_from_matrix(T[:3, :3]).tolist()
    data = {"target": target, "source": source, "position": position, "orientation": quaternion}
    text = "position    [m]  " + "  ".join(f"{value: .4f}" for value in position)
    text += "\norientation xyzw " + "  ".join(f"{value: .4f}" for value in quaternion)
    return Outcome(True, data=data, text=text)


@app.command
def tree(*, out: Path | None = None, domain: int | None = None) -> Outcome:
    """Show the tree of frames, and draw it.

    Args:
        out: A .png to draw it in.
        domain: ROS_DOMAIN_ID of the graph.
    """
    if out is not None and out.suffix != ".png":
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--out {out}: expected a name that ends in .png")
    edges = _listen(domain)
    rows = _rows(edges)
    text = "\n".join("  " * depth + name + ("" if static else "  (moves)") for depth, name, static in rows)
    roots = [name for depth, name, _ in rows if depth == 0]
    data: dict[str, Any] = {"frames": {child: parent for child, (parent, _, _) in sorted(edges.items())}}
    if out is not None:
        _draw(rows, out)
        data["out"] = str(out)
    if len(roots) != 1:
        return Outcome(False, f"{len(roots)} roots: {', '.join(roots) or 'none'}", Code.NO_TRANSFORM, data, text)
    return Outcome(True, f"{len(rows)} frames" + (f", drawn in {out}" if out else ""), data=data, text=text)


def _listen(domain: int | None) -> Edges:
    meet_graph(domain)
    from openarm_bringup.peer_client import Peer

    with Peer() as peer:
        edges = peer.frames(_LISTEN_S)
    if not edges:
        raise OpenArmError(Code.NO_TRANSFORM, "nothing on /tf and /tf_static; is a graph running?")
    return edges


def _to_root(edges: Edges, frame: str) -> NDArray[np.float64]:
    import numpy as np

    from openarm_bringup.message_client import unknown

    known = edges.keys() | {parent for parent, _, _ in edges.values()}
    if frame not in known:
        raise unknown("frame", frame, known)
    T, name = np.eye(4), frame
    for _ in range(len(edges) + 1):
        if name not in edges:
            return T
        name, T_parent, _ = edges[name]
        T = T_parent @ T
    raise OpenArmError(Code.NO_TRANSFORM, f"the frames from {frame!r} on form a loop")


def _rows(edges: Mapping[str, tuple[str, Any, bool]]) -> list[tuple[int, str, bool]]:
    """Depth, name and whether it is fixed, in the order in which a tree is written."""
    children: dict[str, list[str]] = {}
    for child, (parent, _, _) in edges.items():
        children.setdefault(parent, []).append(child)
    rows: list[tuple[int, str, bool]] = []

    def visit(name: str, depth: int) -> None:
        rows.append((depth, name, edges[name][2] if name in edges else True))
        for child in sorted(children.get(name, [])):
            visit(child, depth + 1)

    for root in sorted(children.keys() - edges.keys()):
        visit(root, 0)
    return rows


def _draw(rows: list[tuple[int, str, bool]], out: Path) -> None:
    import cv2
    import numpy as np

    depth = max(row[0] for row in rows)
    picture = np.full((_ROW * len(rows) + 2 * _MARGIN, _INDENT * depth + 440, 3), 255, np.uint8)
    last: dict[int, int] = {}
    for i, (level, name, static) in enumerate(rows):
        x, y = _MARGIN + _INDENT * level, _MARGIN + _ROW * i + _ROW // 2
        last[level] = y
        if level:
            corner = (x - _INDENT + 4, y)
            cv2.line(picture, (corner[0], last[level - 1] + 5), corner, (190, 190, 190), 1)
            cv2.line(picture, corner, (x - 4, y), (190, 190, 190), 1)
        colour = (60, 60, 60) if static else (160, 70, 20)
        cv2.circle(picture, (x + 4, y), 4, colour, -1, cv2.LINE_AA)
        cv2.putText(picture, name, (x + 14, y + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
    legend = "blue: moves with the joints (/tf); grey: fixed"
    x = picture.shape[1] - 10 - math.ceil(7.2 * len(legend))
    cv2.putText(picture, legend, (max(x, 10), 20), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (120, 120, 120), 1, cv2.LINE_AA)
    if not cv2.imwrite(str(out), picture):
        raise OpenArmError(Code.INVALID_ARGUMENT, f"can't write {out}")
