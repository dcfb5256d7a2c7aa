# SPDX-License-Identifier: Apache-2.0
"""`openarm perceive`: what is on the table in a frame of a depth camera: recorded, in a bag, or of the graph."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from openarm_bringup.commands.connect import Domain, join_graph
from openarm_bringup.outcome import Outcome, as_text
from openarm_common.errors import Code, OpenArmError

#: Share of a cloud that a camera does not see below a table, but for noise.
_HIDDEN = 0.005
#: Columns of the table, wider than terminals: nothing of it is cut.
_WIDE = 400


def perceive(
    *files: Path,
    info: str = "",
    color: str = "",
    depth: str = "",
    camera: str = "",
    start: float = 0.0,
    frames: int = 1,
    out: Path | None = None,
    depth_scale: float | None = None,
    rectified: Literal["auto", "yes", "no"] = "auto",
    registered: Literal["auto", "yes", "no"] = "auto",
    pose: Path | None = None,
    background: Path | None = None,
    near: float = 0.1,
    far: float = 3.0,
    unit: Literal["m", "cm", "mm"] = "m",
    cloud_frame: Literal["optical", "opengl", "body", "base", "base_y"] = "optical",
    domain: Domain = None,
    timeout: float = 10.0,
) -> Outcome:
    """Find what stands on the table in a frame of a depth camera: two images, a cloud, a bag, or topics.

    The table is found; with --pose it is level. Distortion is removed. Depth of topics is aligned with colour by both
    camera_infos and /tf_static; depth of files must be aligned.

    Args:
        files: Colour image (PNG, JPEG) and depth image (PNG or .npy of 16 bits, 0 where nothing was measured, TIFF or
            .npy of floats); or a cloud (.pcd, .ply, .npy, .xyz); or a bag (folder of rosbag2, .mcap, .db3); or
            nothing, for a camera of the running graph.
        info: Intrinsics of images, with distortion: YAML of a CameraInfo, of OpenCV or Kalibr, JSON, or three rows of
            three numbers. Of a bag or graph: topic of the colour image's CameraInfo, or such a file.
        color: Topic of the colour image in a bag or graph, also compressed; by the names of drivers when not given.
        depth: Topic of the depth image in a bag or graph, likewise.
        camera: Namespace of the camera in a bag or graph, such as /camera/camera, or a part of it; the only one when
            not given.
        start: Start in a bag: only from this long after its first message on, s.
        frames: Number of frames of a bag, of a camera that stands still, 15 a second at most: objects have ids across
            them. Table and pictures are those of the last one.
        out: Folder for pictures, the label image and a page.
        depth_scale: Metres of a count of depth, of every encoding: 0.0001 for a D405, 0.0002 for TUM, 0.001 for floats
            in mm; 0.001 for integers and 1 for floats when not given.
        rectified: Whether the images of a bag or graph are without distortion, whatever their CameraInfo says; auto: by
            the names of their topics, such as image_rect.
        registered: Whether the depth of a bag or graph lies on the pixels of the colour image, whatever its frame is
            called; auto: by the name of its topic, such as depth_registered.
        pose: Text file with the camera's pose (optical frame), four rows of four numbers, in a frame whose z is up.
        background: Depth image, or cloud, of the empty table or box from the same place.
        near: Nearest depth that counts, m.
        far: Farthest depth that counts, m.
        unit: Unit of the coordinates of a cloud.
        cloud_frame: Axes of a cloud: optical (x right, y down, z forward), opengl (y up, z backward, as the RealSense
            Viewer writes it) or body (x forward, z up), each of the camera that took it; or base (z up) or base_y (y
            up), the origin anywhere, which are looked at from above.
        timeout: Longest wait for a camera of the running graph, s.
    """
    from openarm_bringup.bags.files import is_recording
    from openarm_common.camera.lens import Lens
    from openarm_common.camera.lens_files import read_lens
    from openarm_common.config import load_config
    from openarm_common.resources import config_dir
    from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig
    from openarm_perception.frames.clouds import is_cloud, read_cloud
    from openarm_perception.frames.found import find, followed
    from openarm_perception.frames.images import is_depth, read_depth, read_frame, read_pose
    from openarm_perception.geometry.depth import UNLIMITED, DepthLimits
    from openarm_world import Objects

    if not 0.0 < near < far <= 1000.0:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"--near {near:g} and --far {far:g} m; expected 0 < near < far <= 1000"
        )
    limits = DepthLimits(near=near, far=far)
    first_ns, sequence = 0, iter(())
    for file in files:
        if not file.exists():
            raise OpenArmError(Code.INVALID_ARGUMENT, f"there is no file or bag {file}")
    cloud = None
    bag = len(files) == 1 and not is_cloud(files[0]) and (files[0].is_dir() or is_recording(files[0]))
    of_topics = bag or not files
    if frames < 1 or (frames > 1 and not bag):
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--frames {frames}: expected 1, or more of a bag")
    if not of_topics and (color or depth or camera or (rectified, registered) != ("auto", "auto")):
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            "--color, --depth, --camera, --rectified and --registered are for topics of a bag or of the running graph",
        )
    if of_topics:
        from openarm_bringup.ros.camera_frame import frame_of_graph, frames_of_bag
        from openarm_perception.ros.frames import CameraChoice

        lens = read_lens(Path(info)) if info and Path(info).is_file() else None
        topic = "" if lens else info
        chosen = CameraChoice(camera, color, depth, topic, lens, depth_scale, rectified, registered)
        if not bag:
            join_graph(domain)
        if bag:
            sequence = frames_of_bag(files[0], chosen, start, frames)
            first_ns, frame = next(sequence)
        else:
            frame = frame_of_graph(chosen, timeout)
    elif len(files) == 1 and is_cloud(files[0]):
        if info:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{files[0]} is a cloud, which needs no --info")
        cloud = read_cloud(files[0], limits, unit, cloud_frame)
        frame = cloud.frame
    elif len(files) != 2 or not info:
        missing = "--info" if len(files) == 2 else "depth image" if len(files) == 1 else "such number of files"
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"no {missing}; expected COLOUR DEPTH --info INTRINSICS, a cloud (.pcd, .ply, .npy, .xyz), or a bag",
        )
    else:
        frame = read_frame(*files, Path(info), depth_scale, UNLIMITED)
    empty = None
    if background is not None and is_cloud(background) and not is_depth(background):
        empty = read_cloud(background, limits, unit, cloud_frame, cloud).frame.points
    elif background is not None:
        empty = read_depth(background, frame.lens or Lens(frame.intrinsics), depth_scale, UNLIMITED)
    if pose is not None and cloud is not None and cloud.T_base_camera is not None:
        raise OpenArmError(Code.INVALID_ARGUMENT, "--pose is that of a camera; expected none with --cloud-frame base")
    T_base_camera = read_pose(pose) if pose is not None else None if cloud is None else cloud.T_base_camera
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"--out {out} is no folder to write to: {error}") from error
    colors = ColorDetector(load_config(config_dir() / "params" / "detector.yaml", ColorDetectorConfig))
    found, objects, seen = find(frame, limits, colors, T_base_camera, empty), Objects(), list[dict[str, object]]()
    if frames > 1:
        objects, found = followed(objects, found, first_ns)
        seen.append(found.as_seen(0.0))
    for t_ns, later in sequence:
        t = (t_ns - first_ns) * 1e-9
        try:
            objects, found = followed(objects, find(later, limits, colors, T_base_camera, empty), t_ns)
        except OpenArmError as error:  # something in front of the camera hides the table
            seen.append({"t": round(t, 3), "clusters": [], "message": error.message})
        else:
            seen.append(found.as_seen(t))
    written = () if out is None else found.write(out)
    count = len(found.segmentation.clusters)
    first, last = found.depths
    message = f"{count} on a plane with {found.segmentation.support.share:.0%} of what was measured, {first:.2f} to"
    dense, thin = (value * 1e3 for value in found.spacing)
    message += f" {last:.2f} m away, points {dense:.1f} to {thin:.1f} mm apart: things under {found.least * 1e3:.0f} mm"
    message += " across are left out"
    if hint := found.unit_hint():
        message += f"; {hint}"
    if cloud is not None and cloud.note:
        message += f"; {cloud.note}"
        if cloud.T_base_camera is None and found.hidden() > _HIDDEN:
            message += (
                f"; {found.hidden():.0%} of the points lie below that plane: where z is up type --cloud-frame base"
            )
    if out is not None:
        message += f"; the page is {out / 'index.html'}"
    data = {**found.as_json(), "written": [str(path) for path in written]}
    if seen:
        message += f"; {objects.next_id - 1} objects in {len(seen)} frames"
        data["frames"] = seen
    return Outcome(True, message, data=data, text=_table(found.rows()))


def _table(rows: list[tuple[str, ...]]) -> str:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False)
    for name in ("#", "object", "colour", "shape", "edges [mm]", "± [mm]", "x y z [m]", "pixels", "why it is no prism"):
        table.add_column(Text(name), no_wrap=True)  # as a string, [mm] would be markup
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    lines = as_text(table, _WIDE).splitlines() if rows else []
    return "".join(f"{line.rstrip()}\n" for line in lines)
