# SPDX-License-Identifier: Apache-2.0
"""Options of `openarm calibrate import`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_common.camera.lens import Lens

CameraKind = Literal["eye_in_hand", "eye_to_hand"]
Unit = Literal["m", "cm", "mm", "inch"]


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
        with_: Second file, of the board's poses or corners, where the first has those of the robot alone.
        columns: Names of a table's columns, such as "image x y z qx qy qz qw" (rx ry rz, roll pitch yaw, m00 to m33);
            robot_x, board_x, ... of pairs, - for one to leave out; those of the second file behind a ";".
        roles: Names of the robot's and of the board's poses in the file, such as A,B; found by name when not given.
        board: Board in images and corners, such as charuco:7x5:34mm:26mm:DICT_6X6_250, its keys, or a YAML file.
        images: Folder of images, one for each pose.
        intrinsics: Camera of images and corners: camera_info YAML, OpenCV's YAML, XML or JSON, or
            WIDTH,HEIGHT,FX,FY,CX,CY. A bag has its own.
        rotation: Robot's rotations: xyzw, wxyz, matrix, columns, rotvec, rpy, abc, or axes such as XYZ (moving) or zyz
            (fixed), with _deg for degrees; found when not given.
        unit: Unit of the robot's positions; found when not given.
        frames: T_base_tip is the pose of the tip in the base (when not given), T_tip_base the inverse.
        board_rotation: Rotations of the board's poses, as --rotation.
        board_unit: Unit of the board's positions.
        board_frames: T_camera_board is the pose of the board in the camera (when not given), T_board_camera the
            inverse.
        fix: Place of the camera along an axis of its parent, such as z=0.12 (m): an arm of four axes does not tell it.
        image_topic: Image or CompressedImage of a bag; the only one when not given.
        info_topic: CameraInfo of a bag; that next to the images when not given.
        joint_topic: JointState of a bag; /joint_states when not given; "tf" takes the pose of the tip from /tf.
        urdf: File of the robot's description where a bag has no /robot_description.
        session: File (.npz) to write samples with images to, for the other commands.
        store: Folder of stored calibrations.
        save: Store the result, unless it fails.
    """

    camera_kind: CameraKind | None = None
    camera: str = "camera"
    base: str = ""
    tip: str = ""
    with_: Annotated[Path | None, Parameter(name="--with")] = None
    columns: str = ""
    roles: str = ""
    board: str = ""
    images: Path | None = None
    intrinsics: str = ""
    rotation: str = ""
    unit: Unit | None = None
    frames: Literal["T_base_tip", "T_tip_base"] | None = None
    board_rotation: str = ""
    board_unit: Unit | None = None
    board_frames: Literal["T_camera_board", "T_board_camera"] | None = None
    fix: str = ""
    image_topic: str = ""
    info_topic: str = ""
    joint_topic: str = ""
    urdf: Path | None = None
    session: Path | None = None
    store: Path | None = None
    save: bool = False

    @property
    def fixed(self) -> dict[str, float]:
        """Places that are given by `fix`, m.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when it is something else.
        """
        if not self.fix:
            return {}
        found = re.fullmatch(r"([xyz])=(-?\d*\.?\d+)", self.fix)
        if found is None:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"--fix {self.fix}: expected an axis and metres, such as z=0.12")
        return {found[1]: float(found[2])}


NOTHING = Foreign()


def lens_given(text: str) -> Lens:
    """Return the lens of an option `--intrinsics`.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it is none; CONFIG_INVALID and BAD_IMAGE, for a faulty file.
    """
    from openarm_common.camera.lens import lens_of
    from openarm_common.camera.lens_files import read_lens

    if text.endswith((".yaml", ".yml", ".json", ".xml")):
        return read_lens(Path(text).expanduser())
    try:
        width, height, fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError as error:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"--intrinsics {text!r}: expected a camera_info YAML (or OpenCV's YAML, XML, JSON), or"
            " WIDTH,HEIGHT,FX,FY,CX,CY in pixels",
        ) from error
    if not (width.is_integer() and height.is_integer()):
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--intrinsics {text}: width and height are no whole numbers")
    return lens_of((int(width), int(height)), (fx, 0, cx, 0, fy, cy, 0, 0, 1), "none", (), "--intrinsics")
