# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate import` and `export`: data of other tools and robots, and calibrations for them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from openarm_bringup.calibration.foreign import imported
from openarm_bringup.calibration.foreign_options import NOTHING, Foreign
from openarm_bringup.calibration.source import store_in
from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError


def import_(source: Path, *, given: Foreign = NOTHING) -> Outcome:
    """Solve data of another tool or robot: pairs of poses, poses with images or corners, or a bag.

    Read are samples of easy_handeye2 and moveit_calibration; YAML, JSON, OpenCV's FileStorage, .npz and .npy with poses
    in any usual form; tables (CSV, TUM, text); a folder with a file for each pose; rosbag2 (folder, .mcap, .db3).

    Args:
        source: File, folder or bag.
    """
    return imported(source, given)


def export(
    *,
    format: Literal["easy_handeye2", "static_transform", "urdf", "camera_info"],
    camera: str = "",
    frame: Literal["", "link", "optical"] = "",
    child: str = "",
    out: Path | None = None,
    store: Path | None = None,
) -> Outcome:
    """Write a stored calibration for another tool, on stdout or to a file.

    Args:
        format: YAML of easy_handeye2, a node of a launch file, link and fixed joint of a URDF, or camera_info.
        camera: Camera; needed when several are stored.
        frame: Frame of the camera that is placed: link (x forward) or optical (z forward; of easy_handeye2).
        child: Name of that frame; as of this suite's cameras when not given.
        out: File to write.
        store: Folder of stored calibrations.
    """
    from openarm_calibration.foreign.export import exported
    from openarm_common.robot.description import RobotDescription

    opened = store_in(store)
    names = opened.names()
    if not camera and len(names) != 1:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{len(names)} calibrations in {opened.folder}: {', '.join(names) or 'none'}; give one by --camera",
        )
    item = opened.load(camera or names[0])
    robot = RobotDescription.load()
    # of a robot that is not known, a fixed camera is on its base
    fixed = item.parent in robot.links and all(joint.type == "fixed" for joint in robot.chain(item.parent))
    optical = frame == "optical" or (not frame and format == "easy_handeye2")
    in_hand = not (fixed or item.parent in ("base", "base_link", "world"))
    text = exported(item, format, optical=optical, child=child, in_hand=in_hand)
    data = {"camera": item.camera, "format": format, "text": text}
    if out is None:
        return Outcome(True, f"{item.camera} as {format}", data=data, text=text.rstrip("\n"))
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OpenArmError(Code.ENVIRONMENT, f"can't write {out}: {error.strerror}") from error
    return Outcome(True, f"wrote {out}", data=data | {"written": str(out)})
