# SPDX-License-Identifier: Apache-2.0
"""Samples from a folder of images and a table of poses: the board is found, the convention of the poses is found."""

from __future__ import annotations

import io
import re
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_calibration.board.board import Board
from openarm_calibration.board.detect import detect, guess_pose
from openarm_calibration.board.detection import BoardDetection
from openarm_calibration.foreign.conventions import Convention, Tried, candidates, guess, is_ambiguous, table
from openarm_calibration.foreign.optics import Lens
from openarm_calibration.foreign.pose_files import Table
from openarm_calibration.foreign.pose_robot import joints_of_pose, robot_of_poses
from openarm_calibration.handeye.problem import Setup
from openarm_calibration.sampling.samples import Sample, SampleSet, SessionHead
from openarm_common.config import validate
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
#: Largest image file, bytes.
_LARGEST = 64 * 2**20


@dataclass(frozen=True)
class Names:
    """Of the camera and of the frames that poses are of."""

    camera: str = "camera"
    base: str = "base"
    tip: str = "tip"


@dataclass(frozen=True)
class Given:
    """What is known of the convention of the poses; None: to be found."""

    rotation: Any = None
    unit: Any = None
    frames: Any = None


@dataclass(frozen=True)
class ImageSet:
    """Samples of images, the conventions that were tried, and what became of each image."""

    samples: SampleSet
    tried: tuple[Tried, ...]
    rows: list[dict[str, Any]]

    @property
    def text(self) -> str:
        """Lines for a terminal."""
        lines = [f"  {row['image']}  {row['sample'] or row['reason']}" for row in self.rows]
        return "\n".join(["images, and the sample of each", *lines, "", table(self.tried)])


def image_of(path: Path, lens: Lens) -> NDArray[np.uint8]:
    """Read an image in grey; errors as `grey_of`."""
    try:
        if path.stat().st_size > _LARGEST:
            raise OpenArmError(Code.BAD_IMAGE, f"{path} is larger than {_LARGEST // 2**20} MiB")
        data = path.read_bytes()
    except OSError as error:
        raise OpenArmError(Code.BAD_IMAGE, f"can't read {path}: {error.strerror}") from error
    return grey_of(data, lens, str(path))


def grey_of(data: bytes, lens: Lens, where: str) -> NDArray[np.uint8]:
    """Decode an image file in grey.

    Args:
        data: PNG, JPEG and the like.
        lens: Whose size it must have, which its header is asked for before anything is unpacked.
        where: Begins the error.

    Raises:
        OpenArmError: BAD_IMAGE, when it is none, damaged, or of another size than the intrinsics.
    """
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as header:
            size = header.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise OpenArmError(Code.BAD_IMAGE, f"{where} is no image that can be read: {type(error).__name__}") from error
    k = lens.intrinsics
    if size != (k.width, k.height):
        raise OpenArmError(
            Code.BAD_IMAGE, f"{where} has {size[0]}x{size[1]} pixels, the intrinsics are of {k.width}x{k.height}"
        )
    grey = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if grey is None or grey.shape != (k.height, k.width):  # pyright: ignore[reportUnnecessaryComparison]
        raise OpenArmError(Code.BAD_IMAGE, f"{where} is damaged")
    return grey.astype(np.uint8)


def found_in(board: Board, image: NDArray[np.uint8], lens: Lens) -> tuple[BoardDetection, Array]:
    """Return the marks of a board without the lens's distortion, and T_camera_board (4, 4) by them.

    Args:
        board: To find.
        image: (h, w) grey, as the camera took it.
        lens: Of the camera.

    Raises:
        OpenArmError: NOTHING_DETECTED; BAD_IMAGE.
    """
    seen = detect(board, image)
    detection = BoardDetection(seen.ids, lens.undistorted(seen.pixels), seen.residual)
    return detection, guess_pose(board.points[seen.ids], detection.pixels, board.radius, lens.intrinsics)[0]


def image_set(
    poses: Table, folder: Path, board: Board, lens: Lens, setup: Setup, names: Names, given: Given
) -> ImageSet:
    """Make samples of images and poses.

    Args:
        poses: Of the robot, one for each image.
        folder: Of the images; in the order of their names where the table has no names.
        board: In the images.
        lens: Of the camera.
        setup: in_hand or to_hand.
        names: Of camera and frames.
        given: What is known of the poses.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when images and poses do not fit together; DEGENERATE, with too few boards, or
            when several conventions explain the poses.
    """
    files = _files(poses, folder)
    choices = candidates(poses.rows, given.rotation, given.unit, given.frames)
    rows: list[dict[str, Any]] = []
    found: list[tuple[int, BoardDetection, Array, bytes]] = []
    for k, file in enumerate(files):
        row = {"image": file.name, "sample": "", "reason": ""}
        try:
            image = image_of(file, lens)
            detection, C = found_in(board, image, lens)
            found.append((k, detection, C, cv2.imencode(".png", lens.rectified(image))[1].tobytes()))
            row["sample"] = f"s{len(found):03d}"
        except OpenArmError as error:
            row["reason"] = error.message
        rows.append(row)
    if len(found) < 3:
        why = next((str(row["reason"]) for row in rows if row["reason"]), "")
        raise OpenArmError(
            Code.DEGENERATE,
            f"too few poses: the board is in {len(found)} of {len(files)} images, at least 3 are needed"
            + (f"; such as: {why}" if why else ""),
        )
    kept = [k for k, *_ in found]
    tried = guess(poses.rows[kept], np.array([C for _, _, C, _ in found]), setup, choices)
    if is_ambiguous(tried):
        raise OpenArmError(
            Code.DEGENERATE,
            f"{tried[0].convention.text} and {tried[1].convention.text} explain the poses about as well; give"
            f" --rotation, --unit or --frames, or more images\n{table(tried)}",
        )
    samples = _samples(found, tried[0].convention, poses, board, lens, setup, names)
    return ImageSet(samples, tried, rows)


def _samples(
    found: list[tuple[int, BoardDetection, Array, bytes]], convention: Convention, poses: Table, board: Board,
    lens: Lens, setup: Setup, names: Names,
) -> SampleSet:  # fmt: skip
    """Return the samples, whose robot is that of poses."""
    A = convention.poses(poses.rows)
    assert A is not None  # it was tried
    in_hand = setup == "in_hand"
    head = {
        "camera": names.camera, "setup": setup, "parent": names.tip if in_hand else names.base, "carrier": names.tip,
        "base": names.base, "intrinsics": astuple(lens.intrinsics), "board": board.model_dump(),
    }  # fmt: skip
    samples = SampleSet(
        validate(SessionHead, head, "import", Code.INVALID_ARGUMENT),
        robot_of_poses(names.base, names.tip),
        foreign=True,
    )
    for k, detection, C, png in found:
        t_ns = (k + 1) * 10**9
        name = f"s{len(samples) + 1:03d}"
        samples.add(Sample(name, t_ns, t_ns, joints_of_pose(A[k]), 0.0, detection, C, png))
    return samples


def _files(poses: Table, folder: Path) -> list[Path]:
    """Return the image of each pose."""
    if not folder.is_dir():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--images {folder} is no folder")
    there = sorted(
        (path for path in folder.iterdir() if path.suffix.lower() in IMAGES and path.is_file()),
        key=lambda path: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)],
    )
    if not poses.names:
        if len(there) != len(poses.rows):
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"{folder} has {len(there)} images for {len(poses.rows)} poses; expected as many, in the order of their"
                " names, or the name of its image in each line of the table",
            )
        return there
    by_name = {path.name: path for path in there} | {path.stem: path for path in there}
    wanted = [Path(name).name for name in poses.names]
    missing = [name for name in wanted if name not in by_name]
    if missing:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{folder} has no image {missing[0]!r} ({len(missing)} of {len(wanted)} are missing); images:"
            f" {', '.join(path.name for path in there[:5]) or 'none'}",
        )
    return [by_name[name] for name in wanted]
