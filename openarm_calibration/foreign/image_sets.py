# SPDX-License-Identifier: Apache-2.0
"""Samples from images, or corners in them, and poses of a robot: board and convention of the poses are found."""

from __future__ import annotations

import re
from dataclasses import astuple, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from openarm_calibration.board.board import Board
from openarm_calibration.board.circles import SymmetricCircles
from openarm_calibration.board.detect import detect_undistorted, guess_pose
from openarm_calibration.board.detection import BoardDetection, plane_fit
from openarm_calibration.board.orientation import fronts
from openarm_calibration.board.squares import Chessboard
from openarm_calibration.foreign.conventions import Convention
from openarm_calibration.foreign.explain import BOARD_FRAMES, Hypothesis, Poses, decided, search, table
from openarm_calibration.foreign.pose_robot import joints_of_pose, robot_of_poses
from openarm_calibration.foreign.pose_source import Source
from openarm_calibration.handeye.consensus import agreed
from openarm_calibration.handeye.problem import Setup
from openarm_calibration.handeye.transforms import inverses
from openarm_calibration.sampling.samples import Sample, SampleSet, SessionHead
from openarm_common import se3
from openarm_common.camera.depth_view import check_size
from openarm_common.camera.lens import Lens
from openarm_common.camera.pictures import decode_picture, to_bytes
from openarm_common.config import validate
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array, Bytes

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
#: Largest image file, bytes.
_LARGEST = 64 * 2**20
#: Of settling in which way boards are read.
_ROUNDS = 4
#: Corners with numbers that a view needs.
_FEWEST_CORNERS = 6


@dataclass(frozen=True)
class Names:
    """Of the camera and of the frames that poses are of."""

    camera: str = "camera"
    base: str = "base"
    tip: str = "tip"


@dataclass(frozen=True)
class ImageSet:
    """Samples of images or corners, the conventions that were tried, and what became of each image."""

    samples: SampleSet
    tried: tuple[Hypothesis, ...]
    rows: list[dict[str, Any]]

    @property
    def text(self) -> str:
        """Lines for a terminal."""
        lines = [f"  {row['image']}  {row['sample'] or row['reason']}" for row in self.rows]
        return "\n".join(["images, and the sample of each", *lines, "", table(self.tried)])


def image_of(path: Path, lens: Lens) -> Bytes:
    """Read an image in grey; errors as `grey_of`."""
    try:
        if path.stat().st_size > _LARGEST:
            raise OpenArmError(Code.BAD_IMAGE, f"{path} is larger than {_LARGEST // 2**20} MiB")
        data = path.read_bytes()
    except OSError as error:
        raise OpenArmError(Code.BAD_IMAGE, f"can't read {path}: {error.strerror}") from error
    return grey_of(data, lens, str(path))


def grey_of(data: bytes, lens: Lens, where: str) -> Bytes:
    """Decode an image file in grey.

    Args:
        data: Content of a PNG, JPEG or the like.
        lens: Camera whose size it must have.
        where: Subject of the error.

    Raises:
        OpenArmError: BAD_IMAGE, when it is none, damaged, or of another size than the intrinsics.
    """
    picture = to_bytes(decode_picture(data, where))
    check_size(where, picture.shape, lens.intrinsics)
    to_grey = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}
    return picture if picture.ndim == 2 else cv2.cvtColor(picture, to_grey[picture.shape[2]]).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class _View:
    """A board in an image: its marks without distortion, T_camera_board (4, 4), and the rectified image as PNG."""

    detection: BoardDetection
    pose: Array
    png: bytes = b""


def image_set(
    source: Source, folder: Path | None, board: Board, lens: Lens, robot: Poses, setup: Setup, names: Names
) -> ImageSet:
    """Make samples of images, or of corners, and poses.

    Args:
        source: Poses of the robot, one for each image, and corners where there are no images.
        folder: Images, in the order of their names where the source names none.
        board: Board in the images.
        lens: Lens of the camera.
        robot: The same poses, and what is stated of them.
        setup: in_hand or to_hand.
        names: Names of camera and frames.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when images and poses do not fit together; DEGENERATE, with too few boards, or
            when no convention, or several, explain the poses.
    """
    if folder is not None:
        files = _files(source, folder)
        looks = [(file.name, partial(_look, file, board, lens)) for file in files]
    else:
        assert source.corners is not None
        corners = source.corners
        looks = [
            (label, partial(_marks, corners.rows[k], label, board, lens)) for k, label in enumerate(corners.labels)
        ]
    rows: list[dict[str, Any]] = []
    found: dict[int, list[_View]] = {}
    for k, (name, look) in enumerate(looks):
        row = {"image": name, "sample": "", "reason": ""}
        try:
            found[k] = look()
            row["sample"] = f"s{len(found):03d}"
        except OpenArmError as error:
            row["reason"] = error.message
        rows.append(row)
    if len(found) < 3:
        why = next((str(row["reason"]) for row in rows if row["reason"]), "")
        raise OpenArmError(
            Code.DEGENERATE,
            f"too few poses: the board is in {len(found)} of {len(looks)} images, at least 3 are needed"
            + (f"; such as: {why}" if why else ""),
        )
    kept = list(found)
    used = replace(robot, rows=robot.rows[kept], names=tuple(rows[k]["image"] for k in kept))
    views, board_poses, tried = _read_alike([found[k] for k in kept], used, setup)
    chosen = decided(tried, (setup,), used, board_poses)
    samples = _samples(dict(zip(kept, views, strict=True)), chosen.robot, robot.rows, board, lens, setup, names)
    return ImageSet(samples, tried, rows)


def _read_alike(
    ways: list[list[_View]], robot: Poses, setup: Setup
) -> tuple[list[_View], Poses, tuple[Hypothesis, ...]]:
    """Return boards read so that most of them agree, their poses, and the conventions that were tried.

    Args:
        ways: Views of each image, one for each way to read its board.
        robot: Its poses.
        setup: in_hand or to_hand.
    """
    views, rounds = [way[0] for way in ways], 0
    while True:
        board = Poses(np.array([view.pose.ravel() for view in views]), BOARD_FRAMES, "matrix", "m")
        tried = search(robot, board, (setup,))
        best = next((one for one in tried if one.given), tried[0])
        A = best.robot.poses(robot.rows)
        assert A is not None  # it was tried
        B = inverses(A) if best.setup == "in_hand" else A
        common = agreed(B, np.array([view.pose for view in views]))
        expected = se3.inverse(common.X) @ B @ common.Z
        turned = [
            min(way, key=lambda view, T=T: se3.angle_between(view.pose[:3, :3], T[:3, :3]))
            for way, T in zip(ways, expected, strict=True)
        ]
        rounds += 1
        if turned == views or rounds == _ROUNDS:
            return views, board, tried
        views = turned


def _look(file: Path, board: Board, lens: Lens) -> list[_View]:
    """Return the board in an image, in each way in which it can be read; as it stands upright first."""
    image = image_of(file, lens)
    detection, straight = detect_undistorted(board, image, lens)
    C, _ = guess_pose(board.points[detection.ids], detection.pixels, board.radius, lens.intrinsics)
    png = cv2.imencode(".png", straight)[1].tobytes()
    out = [_View(detection, C, png)]
    grid = isinstance(board, Chessboard | SymmetricCircles) and board.ambiguity
    if grid and len(detection.ids) == len(board.points):
        out += [_read_as(board, order, lens, png) for order in _orders(board, detection.pixels)]
    return out


def _marks(corners: Array, label: str, board: Board, lens: Lens) -> list[_View]:
    """Return the board of a list of corners px, in each way in which it can be read; as it is listed first.

    Args:
        corners: (m, 2), or (m, 3) with their numbers; NaN beyond those that there are.
        label: Label of the record.
        board: Board that the corners belong to.
        lens: Lens of the camera.
    """
    if corners.shape[1] == 3:
        seen = corners[np.isfinite(corners).all(axis=1)]
        ids = seen[:, 0].astype(np.int64)
        known = set(range(len(board.points)))
        if len(ids) < _FEWEST_CORNERS or len({*ids.tolist()} & known) < len(ids):
            raise OpenArmError(
                Code.NOTHING_DETECTED,
                f"{label} has {len(ids)} corners with numbers {ids.min(initial=0)} to {ids.max(initial=0)}; expected"
                f" {_FEWEST_CORNERS} or more, each once, of 0 to {len(board.points) - 1} ({board.label})",
            )
        pixels = lens.undistorted(np.ascontiguousarray(seen[:, 1:]))
        T, residual = guess_pose(board.points[ids], pixels, board.radius, lens.intrinsics)
        return [_View(BoardDetection(ids, pixels, residual), T)]
    if len(corners) != len(board.points):
        raise OpenArmError(
            Code.NOTHING_DETECTED, f"{label} has {len(corners)} corners, {board.label} has {len(board.points)}"
        )
    pixels = lens.undistorted(corners)
    orders = [pixels]
    if isinstance(board, Chessboard | SymmetricCircles):
        plane, (rows, columns) = board.points[:, :2], (board.rows, board.columns)
        by_columns = np.ascontiguousarray(pixels.reshape(columns, rows, 2).transpose(1, 0, 2).reshape(-1, 2))
        listed = min(pixels, by_columns, key=lambda order: plane_fit(plane, fronts(plane, order, rows, columns)[0])[0])
        orders = _orders(board, listed)
    return [_read_as(board, order, lens) for order in orders]


def _orders(board: Any, pixels: Array) -> list[Array]:
    """Return the orders of marks (n, 2) in which they are the image of the board's front; as they are first."""
    orders = fronts(board.points[:, :2], pixels, board.rows, board.columns)
    return sorted(orders, key=lambda order: not np.array_equal(order, pixels))


def _read_as(board: Board, pixels: Array, lens: Lens, png: bytes = b"") -> _View:
    """Return the view of all marks (n, 2) of a board."""
    T, residual = guess_pose(board.points, pixels, board.radius, lens.intrinsics)
    return _View(BoardDetection(np.arange(len(pixels)), pixels, residual), T, png)


def _samples(
    found: dict[int, _View], convention: Convention, rows: Array, board: Board, lens: Lens, setup: Setup, names: Names
) -> SampleSet:  # fmt: skip
    """Return the samples, whose robot is that of poses."""
    A = convention.poses(rows)
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
    for k, view in found.items():
        t_ns = (k + 1) * 10**9
        name = f"s{len(samples) + 1:03d}"
        samples.add(Sample(name, t_ns, t_ns, joints_of_pose(A[k]), 0.0, view.detection, view.pose, view.png))
    return samples


def _files(source: Source, folder: Path) -> list[Path]:
    """Return the image of each pose."""
    if not folder.is_dir():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--images {folder} is no folder")
    there = sorted(
        (path for path in folder.iterdir() if path.suffix.lower() in IMAGES and path.is_file()),
        key=lambda path: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)],
    )
    count = len(source.robot.rows)
    if not source.images:
        if len(there) != count:
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"{folder} has {len(there)} images for {count} poses; expected as many, in the order of their"
                " names, or the name of its image in each line of the table",
            )
        return there
    by_name = {path.name: path for path in there} | {path.stem: path for path in there}
    wanted = [Path(name).name for name in source.images]
    missing = [name for name in wanted if name not in by_name]
    if missing:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{folder} has no image {missing[0]!r} ({len(missing)} of {len(wanted)} are missing); images:"
            f" {', '.join(path.name for path in there[:5]) or 'none'}",
        )
    return [by_name[name] for name in wanted]
