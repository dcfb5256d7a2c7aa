# SPDX-License-Identifier: Apache-2.0
"""`openarm perceive`: what is on the table in a frame of a depth camera: recorded, in a bag, or of the graph."""

from __future__ import annotations

from pathlib import Path

from openarm_bringup.commands.connect import Domain, join_graph
from openarm_bringup.outcome import Outcome, as_text
from openarm_common.errors import Code, OpenArmError

#: Columns of the table, wider than most terminals: its numbers are all there.
_WIDE = 150


def perceive(
    color: Path | None = None,
    depth: Path | None = None,
    *,
    info: Path | None = None,
    camera: str = "",
    start: float = 0.0,
    out: Path | None = None,
    depth_scale: float = 0.001,
    pose: Path | None = None,
    background: Path | None = None,
    near: float = 0.1,
    far: float = 3.0,
    domain: Domain = None,
    timeout: float = 10.0,
) -> Outcome:
    """Find what stands on the table in a frame of a depth camera: two images, an organised cloud, a bag, or topics.

    The table is found; with --pose it is level. Depth is aligned with colour. Images of files are rectified. Without a
    file, it is the next frame of a camera of the running graph, such as a RealSense (its `aligned_depth_to_color`).

    Args:
        color: Colour image (PNG, JPEG); or an organised cloud (.pcd) or a bag (folder or .mcap), which need nothing
            else; or nothing, for a camera of the running graph.
        depth: Depth image: PNG of 16 bits, 0 where nothing was measured.
        info: Intrinsics of both: YAML of a CameraInfo, or of fx, fy, cx, cy, or three rows of three numbers.
        camera: Namespace of the camera in a bag or graph, such as /camera/camera, or a part of it; the only one when
            not given.
        start: Of a bag, only from this long after its first message on, s.
        out: Folder for pictures, the label image and a page.
        depth_scale: Metres of a count of the depth image.
        pose: Text file with the camera's pose (optical frame), four rows of four numbers, in a frame whose z is up.
        background: Depth image, or cloud, of the empty table or box from the same place.
        near: Nearest depth that counts, m.
        far: Farthest depth that counts, m.
        timeout: Longest wait for a camera of the running graph, s.
    """
    from openarm_common.config import load_config
    from openarm_common.resources import config_dir
    from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig
    from openarm_perception.frames.found import find
    from openarm_perception.frames.images import read_cloud, read_depth, read_frame, read_pose
    from openarm_perception.geometry.depth import DepthLimits

    if not 0.0 < near < far <= 1000.0:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"--near {near:g} and --far {far:g} m; expected 0 < near < far <= 1000"
        )
    limits = DepthLimits(near=near, far=far)
    alone = color is None or color.is_dir() or color.suffix.lower() in (".pcd", ".mcap")
    if alone and (depth is not None or info is not None):
        what = "the running graph" if color is None else f"{color} is a cloud or a bag"
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{what}; expected no depth image and no --info")
    if color is None:
        join_graph(domain)
        from openarm_bringup.ros.camera_frame import frame_of_graph

        frame = frame_of_graph(camera, limits, depth_scale, timeout)
    elif color.suffix.lower() == ".pcd":
        frame = read_cloud(color, limits)
    elif alone:
        from openarm_bringup.ros.camera_frame import frame_of_bag

        frame = frame_of_bag(color, camera, limits, depth_scale, start)
    elif depth is None or info is None:
        missing = "depth image" if depth is None else "--info"
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"no {missing}; expected COLOUR DEPTH --info INTRINSICS, a cloud that ends in .pcd, or a bag",
        )
    else:
        frame = read_frame(color, depth, info, depth_scale, limits)
    empty = None
    if background is not None and background.suffix.lower() == ".pcd":
        empty = read_cloud(background, limits).points
    elif background is not None:
        empty = read_depth(background, frame.intrinsics, depth_scale, limits)
    T_base_camera = None if pose is None else read_pose(pose)
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"--out {out} is no folder") from error
    colors = ColorDetector(load_config(config_dir() / "params" / "detector.yaml", ColorDetectorConfig))
    found = find(frame, colors, T_base_camera, empty)
    written = () if out is None else found.write(out)
    count = len(found.segmentation.clusters)
    message = f"{count} on a plane with {found.segmentation.support.share:.0%} of what was measured"
    if out is not None:
        message += f"; the page is {out / 'index.html'}"
    data = {**found.as_json(), "written": [str(path) for path in written]}
    return Outcome(True, message, data=data, text=_table(found.rows()))


def _table(rows: list[tuple[str, ...]]) -> str:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False)
    for name in ("#", "colour", "shape", "edges [mm]", "x y z [m]", "pixels"):
        table.add_column(name, no_wrap=True)
    table.add_column("why it is no prism", no_wrap=True, overflow="ellipsis")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    lines = as_text(table, _WIDE).splitlines() if rows else []
    return "".join(f"{line.rstrip()}\n" for line in lines)
