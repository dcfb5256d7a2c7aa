# SPDX-License-Identifier: Apache-2.0
"""`openarm tf`: the tree of frames, and one frame in another."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import App

from openarm_bringup.commands.connect import Domain, graph_peer
from openarm_bringup.outcome import Outcome
from openarm_bringup.suggest import unknown
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from openarm_bringup.ros.peer import Frames
    from openarm_bringup.view.tree_picture import Row

    Edges = dict[str, tuple[str, NDArray[np.float64], bool]]

tf = App(name="tf", help="Show the tree of frames, or one frame in another.")

#: Joint frames are published on /tf at 50 Hz, the rest on /tf_static.
_LISTEN_S = 1.0
#: Frames that a message names.
_NAMED = 4


@tf.command
def echo(target: str, source: str, *, domain: Domain = None) -> Outcome:
    """Print the pose of a frame as it is now.

    Args:
        target: Frame in which the pose is expressed.
        source: Frame whose pose it is.
    """
    from openarm_common.se3 import inverse, quat_xyzw_from_matrix

    def connected(frames: Frames) -> bool:
        if not frames.names() >= {target, source}:
            return False
        return _to_root(frames.edges, target)[0] == _to_root(frames.edges, source)[0]

    frames = _listen(domain, connected)
    for name in (target, source):
        if name not in frames.names():
            raise unknown("frame", name, frames.names())
    (root, T_root_target), (other, T_root_source) = (_to_root(frames.edges, name) for name in (target, source))
    if root != other:
        message = f"{target!r} and {source!r} are not connected: they are in the trees of {root!r} and {other!r}"
        raise OpenArmError(Code.NO_TRANSFORM, message)
    T = inverse(T_root_target) @ T_root_source
    position, quaternion = T[:3, 3].tolist(), quat_xyzw_from_matrix(T[:3, :3]).tolist()
    data = {"target": target, "source": source, "position": position, "orientation": quaternion}
    text = "position    [m]  " + "  ".join(f"{value: .4f}" for value in position)
    text += "\norientation xyzw " + "  ".join(f"{value: .4f}" for value in quaternion)
    return Outcome(True, data=data, text=text)


@tf.command
def tree(*, out: Path | None = None, domain: Domain = None) -> Outcome:
    """Show the tree of frames, and draw it.

    Args:
        out: A .png, .svg or .pdf to draw it in.
    """
    from openarm_bringup.view.tree_picture import check, write

    if out is not None:
        check(out)
    frames = _listen(domain)
    edges, rows = frames.edges, _rows(frames.edges)
    text = "\n".join("  " * row.depth + row.name + ("" if row.fixed else "  (moves)") for row in rows)
    roots = [row.name for row in rows if row.depth == 0]
    data: dict[str, Any] = {"frames": {child: parent for child, (parent, _, _) in sorted(edges.items())}}
    data["clashes"] = frames.clashes
    if out is not None:
        write(rows, out)
        data["out"] = str(out)
    if frames.clashes:
        faults = "; ".join(_grouped(frames.clashes))
        advice = "a frame has one parent and one publisher: `openarm node list` shows the nodes"
        return Outcome(False, f"{faults}; {advice}", Code.NO_TRANSFORM, data, text)
    if len(roots) != 1:
        return Outcome(False, f"{len(roots)} roots: {', '.join(roots) or 'none'}", Code.NO_TRANSFORM, data, text)
    return Outcome(True, f"{len(rows)} frames" + (f", drawn in {out}" if out else ""), data=data, text=text)


def _listen(domain: int | None, enough: Callable[[Frames], object] = lambda _: False) -> Frames:
    with graph_peer(domain) as peer:
        frames = peer.frames(_LISTEN_S, enough)
    if not frames.edges:
        raise OpenArmError(Code.NO_TRANSFORM, "nothing on /tf and /tf_static: no discovered node publishes frames")
    return frames


def _to_root(edges: Edges, frame: str) -> tuple[str, NDArray[np.float64]]:
    """Return the root of the tree of a frame, and the pose of the frame in it, (4, 4)."""
    import numpy as np

    T, name = np.eye(4), frame
    for _ in range(len(edges) + 1):
        if name not in edges:
            return name, T
        name, T_parent, _ = edges[name]
        T = T_parent @ T
    raise OpenArmError(Code.NO_TRANSFORM, f"the frames from {frame!r} on form a loop")


def _grouped(clashes: Mapping[str, str]) -> list[str]:
    """Return one sentence for each fault, with the frames that have it."""
    frames: dict[str, list[str]] = {}
    for name, what in sorted(clashes.items()):
        frames.setdefault(what, []).append(name)
    lines: list[str] = []
    for what, names in frames.items():
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        lines.append(f"{'each of ' if len(names) > 1 else ''}{', '.join(names[:_NAMED])}{more} {what}")
    return lines


def _rows(edges: Edges) -> list[Row]:
    """Return the frames in the order in which a tree is written."""
    from openarm_bringup.view.tree_picture import Row

    children: dict[str, list[str]] = {}
    for child, (parent, _, _) in edges.items():
        children.setdefault(parent, []).append(child)
    rows: list[Row] = []

    def visit(name: str, depth: int) -> None:
        rows.append(Row(depth, name, edges[name][2] if name in edges else True))
        for child in sorted(children.get(name, [])):
            visit(child, depth + 1)

    for root in sorted(children.keys() - edges.keys()):
        visit(root, 0)
    return rows
