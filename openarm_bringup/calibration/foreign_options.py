# SPDX-License-Identifier: Apache-2.0
"""Options of `openarm calibrate import`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cyclopts import Parameter

from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_calibration.foreign.optics import Lens

Format = Literal["auto", "easy_handeye2", "moveit", "csv", "bag"]
CameraKind = Literal["eye_in_hand", "eye_to_hand"]
Rotation = Literal["xyzw", "wxyz", "rotvec", "rotvec_deg", "rpy", "rpy_deg", "abc_deg", "matrix"]


@Parameter(name="*")
@dataclass(frozen=True)
class Foreign:
    """What a file of another tool does not say.

    Args:
        camera_kind: Whether the hand carries the camera (eye_in_hand) or the board (eye_to_hand); needed where the file
            does not say it.
        camera: Name of the camera in the result.
        base: Base frame of the robot.
        tip: Link that carries the camera, or the board.
        board: Of images: the board, such as charuco:7x5:34mm:26mm:DICT_6X6_250, its keys as YAML, or a YAML file.
        images: Of a CSV: folder of the images.
        intrinsics: Of images: camera_info YAML, or WIDTH,HEIGHT,FX,FY,CX,CY. A bag has its own.
        rotation: Of a CSV: xyzw, wxyz, rotvec, rotvec_deg, rpy, rpy_deg, abc_deg or matrix; found when not given.
        unit: Of a CSV: of positions; found when not given.
        frames: Of a CSV: T_base_tip is the pose of the tip in the base, T_tip_base the inverse; found when not given.
        image_topic: Of a bag: Image or CompressedImage; the only one when not given.
        info_topic: Of a bag: CameraInfo; that next to the images when not given.
        joint_topic: Of a bag: JointState; /joint_states when not given; "tf" takes the pose of the tip from /tf.
        urdf: Of a bag: file of the robot's description where /robot_description was not recorded.
        session: File (.npz) to write samples with images to, for the other commands.
        store: Folder of stored calibrations.
        save: Store the result, unless it fails.
    """

    camera_kind: CameraKind | None = None
    camera: str = "camera"
    base: str = ""
    tip: str = ""
    board: str = ""
    images: Path | None = None
    intrinsics: str = ""
    rotation: Rotation | None = None
    unit: Literal["m", "mm"] | None = None
    frames: Literal["T_base_tip", "T_tip_base"] | None = None
    image_topic: str = ""
    info_topic: str = ""
    joint_topic: str = ""
    urdf: Path | None = None
    session: Path | None = None
    store: Path | None = None
    save: bool = False


NOTHING = Foreign()


def lens_given(text: str) -> Lens:
    """Return the lens of an option `--intrinsics`.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it is none; CONFIG_INVALID and BAD_IMAGE, for a faulty file.
    """
    from openarm_calibration.foreign.optics import lens_of, read_camera_info

    if text.endswith((".yaml", ".yml")):
        return read_camera_info(Path(text).expanduser())
    try:
        width, height, fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError as error:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"--intrinsics {text!r}: expected a camera_info YAML, or WIDTH,HEIGHT,FX,FY,CX,CY in pixels",
        ) from error
    if not (width.is_integer() and height.is_integer()):
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--intrinsics {text}: width and height are no whole numbers")
    return lens_of((int(width), int(height)), (fx, 0, cx, 0, fy, cy, 0, 0, 1), "none", (), "--intrinsics")
