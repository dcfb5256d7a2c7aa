# SPDX-License-Identifier: Apache-2.0
"""Stored calibrations: one YAML a camera, checked by its own hash, with history and rollback.

A mount is `T_parent_link` of the camera (position in m, quaternion x, y, z, w; link frame x forward, z up). Files are
written to another name and renamed, so that a reader gets an old or a new one, never a part. A damaged file is
refused, and the newest good one of the history takes its place.
"""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import Field, field_validator

from openarm_common import se3
from openarm_common.config import Config, load_yaml, validate
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import config_dir, write_whole
from openarm_common.types import Array


class StoreConfig(Config):
    """Where calibrations are stored, and which mounts are in use."""

    cameras: str = Field(default="", description="YAML of the cameras; empty is config/params/cameras.yaml")
    store: str = Field(
        default="",
        description="folder of stored calibrations; empty: OPENARM_CALIBRATIONS or ~/.local/share/openarm/calibrations",
    )
    mount_seed: int = Field(
        default=-1,
        ge=-1,
        description="of the simulated mounts in use; -1 or none: real ones, or simulated without an error",
    )

    @field_validator("mount_seed", mode="before")
    @classmethod
    def _none_is_no_seed(cls, value: Any) -> Any:
        return -1 if value is None or value == "none" else value

    @property
    def seed(self) -> int | None:
        """The mount seed; None without one."""
        return None if self.mount_seed < 0 else self.mount_seed


class PublisherConfig(StoreConfig):
    """Parameters of the node `calibration_publisher`."""

    period: float = Field(default=0.5, gt=0.0, le=60.0, description="of the checks of the store, s of wall clock")
    nominal: bool = Field(default=False, description="publish the mounts of the configuration whatever is stored")


_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")
_FORMAT = 1


class StoredCalibration(Config):
    """The mount of one camera and where it comes from."""

    format: int = Field(default=_FORMAT, ge=_FORMAT, le=_FORMAT, description="of this file")
    camera: str = Field(pattern=r"^[a-z][a-z0-9_]{0,63}$", description="name of the camera")
    parent: str = Field(min_length=1, description="link that carries the camera")
    position: tuple[float, float, float] = Field(description="of <camera>_link in the parent, m")
    quaternion_xyzw: tuple[float, float, float, float] = Field(description="of <camera>_link in the parent")
    sigma_translation: float = Field(default=0.0, ge=0.0, description="predicted error of the position, m")
    sigma_rotation: float = Field(default=0.0, ge=0.0, description="predicted error of the rotation, rad")
    mount_seed: int | None = Field(
        default=None, description="of the simulated mounts that were calibrated; None: real or nominal"
    )
    method: str = Field(default="REFINED", description="solver")
    board: str = Field(default="", description="that was observed")
    samples: int = Field(default=0, ge=0, description="that the result rests on")
    session: str = Field(default="", description="hash of the session file")
    created: str = Field(default="", description="when, as ISO 8601")
    versions: dict[str, str] = Field(default_factory=dict, description="of the software")

    @field_validator("position", "quaternion_xyzw")
    @classmethod
    def _finite(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if not np.isfinite(value).all():
            raise ValueError("expected finite numbers")
        if len(value) == 4 and abs(float(np.linalg.norm(value)) - 1.0) > 1e-3:
            raise ValueError("expected a unit quaternion")
        return value

    @property
    def T_parent_link(self) -> Array:
        """Mount, (4, 4)."""
        return se3.make(se3.matrix_from_quat_xyzw(self.quaternion_xyzw), self.position)

    @classmethod
    def of_mount(cls, camera: str, parent: str, T_parent_link: Array, **provenance: Any) -> StoredCalibration:
        """Make one of a mount (4, 4).

        Args:
            camera: Its name.
            parent: Link that carries it.
            T_parent_link: (4, 4).
            provenance: Other fields.
        """
        mount = {
            "position": T_parent_link[:3, 3].tolist(),
            "quaternion_xyzw": se3.quat_xyzw_from_matrix(T_parent_link[:3, :3]).tolist(),
        }
        return validate(cls, {"camera": camera, "parent": parent, **mount, **provenance}, f"calibration of {camera!r}")

    def digest(self) -> str:
        """Return the hash of all fields."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Found:
    """What the store has for a camera: the calibration, and what was wrong with the file when it is an older one."""

    calibration: StoredCalibration
    warning: str = ""


class CalibrationStore:
    """A folder of calibrations.

    Args:
        folder: Where; made at the first save.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, camera: str) -> Path:
        """Return the file of a camera.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for a name that could lead elsewhere.
        """
        return self.folder / f"{checked_name(camera)}.yaml"

    def cameras(self) -> tuple[str, ...]:
        """Return the names of the cameras that have a file, damaged or not."""
        return tuple(sorted(p.stem for p in self.folder.glob("*.yaml") if _NAME.fullmatch(p.stem)))

    def save(self, calibration: StoredCalibration) -> Path:
        """Make it the camera's calibration; the one before stays in the history.

        Raises:
            OpenArmError: ENVIRONMENT, when the folder can't be written.
        """
        path = self.path(calibration.camera)
        digest = calibration.digest()
        text = yaml.safe_dump({**calibration.model_dump(mode="json"), "sha256": digest}, sort_keys=False)
        number = 1 + max(map(_number, self._past(calibration.camera)), default=0)
        write_whole(self._history(calibration.camera) / f"{number:06d}-{digest[:12]}.yaml", text.encode())
        write_whole(path, text.encode())
        return path

    def load(self, camera: str) -> StoredCalibration:
        """Read the camera's calibration.

        Raises:
            OpenArmError: CONFIG_INVALID, when there is none or it is damaged, saying how.
        """
        path = self.path(camera)
        if not path.is_file():
            known = ", ".join(self.cameras()) or "none"
            raise OpenArmError(
                Code.CONFIG_INVALID, f"no calibration of {camera!r} in {self.folder}; stored cameras: {known}"
            )
        return read(path)

    def find(self, camera: str) -> Found | None:
        """Return the camera's calibration, or the newest good one before it; None when nothing was ever stored.

        Raises:
            OpenArmError: CONFIG_INVALID, when the file is damaged and the history has no good one.
        """
        if not self.path(camera).is_file() and not self._past(camera):
            return None
        try:
            return Found(self.load(camera))
        except OpenArmError as error:
            good = self._good(camera)
            if not good:
                raise
            older, calibration = good[-1]
            return Found(calibration, f"{error.message}; the last good one, {older.name}, is used")

    def in_use(self, camera: str, mount_seed: int | None) -> StoredCalibration | None:
        """Return what is stored of a camera; None also for other mounts, whose distance says nothing."""
        found = self.find(camera)
        return found.calibration if found is not None and found.calibration.mount_seed == mount_seed else None

    def history(self, camera: str) -> tuple[StoredCalibration, ...]:
        """Return all good calibrations of a camera, oldest first."""
        return tuple(calibration for _, calibration in self._good(camera))

    def rollback(self, camera: str) -> StoredCalibration:
        """Go back to the calibration before the present one; the present one leaves the history.

        Raises:
            OpenArmError: CONFIG_INVALID, when there is none before it.
        """
        past, good = self._past(camera), self._good(camera)
        if len(good) < 2:
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"going back needs a calibration of {camera!r} before the present one; stored: {len(good)}",
            )
        path, before = good[-2]
        write_whole(self.path(camera), path.read_bytes())
        for later in past[past.index(path) + 1 :]:
            later.unlink()
        return before

    def state(self) -> tuple[tuple[str, int, int], ...]:
        """Return what changes when a file does: names, sizes and times of the files."""
        out: list[tuple[str, int, int]] = []
        for camera in self.cameras():
            try:
                status = self.path(camera).stat()
            except FileNotFoundError:
                continue  # between the listing and now
            out.append((camera, status.st_mtime_ns, status.st_size))
        return tuple(out)

    def _history(self, camera: str) -> Path:
        return self.folder / "history" / checked_name(camera)

    def _good(self, camera: str) -> list[tuple[Path, StoredCalibration]]:
        """Return the calibrations of the history that are not damaged, oldest first."""
        out: list[tuple[Path, StoredCalibration]] = []
        for path in self._past(camera):
            with contextlib.suppress(OpenArmError):
                out.append((path, read(path)))
        return out

    def _past(self, camera: str) -> list[Path]:
        return sorted(self._history(camera).glob("*.yaml"), key=_number)


def checked_name(camera: str) -> str:
    """Return a camera's name when it is one.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for anything else, above all what a file system reads as a path.
    """
    if not _NAME.fullmatch(camera):
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"camera name {camera!r}: expected lower-case letters, digits and _, beginning with a letter, at most 64",
        )
    return camera


def read(path: Path) -> StoredCalibration:
    """Read and check one file.

    Raises:
        OpenArmError: CONFIG_INVALID, when it is not as it was written.
    """
    data = load_yaml(path)
    stated = data.pop("sha256", None)
    calibration = validate(StoredCalibration, data, str(path))
    if stated != calibration.digest():
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"{path} is damaged or was edited: its contents do not have the hash that it states; calibrate and save"
            " again, or roll back",
        )
    return calibration


def places(folder: Path, mount_seed: int | None) -> tuple[CalibrationStore, ...]:
    """List where calibrations of the mounts in use are searched; the first that has one wins.

    That is the folder itself; for simulated mounts also its subfolder of that seed, and what comes with the suite.
    """
    stores = [CalibrationStore(folder)]
    if mount_seed is not None:
        name = f"mount_seed_{mount_seed}"
        stores += [CalibrationStore(folder / name), CalibrationStore(config_dir() / "calibration" / name)]
    return tuple(stores)


def of_these_mounts(
    stores: Sequence[CalibrationStore], camera: str, parent: str, mount_seed: int | None
) -> tuple[Found | None, tuple[str, ...]]:
    """Return the first calibration of a camera as it is mounted now, and why others that were met are not used.

    Args:
        stores: As `places` lists them.
        camera: Name of the camera.
        parent: Link that carries it.
        mount_seed: Of the simulated mounts in use.
    """
    faults: list[str] = []
    for store in stores:
        try:
            found = store.find(camera)
            if found is None:
                continue
        except OpenArmError as error:
            faults.append(error.message)
            continue
        calibration = found.calibration
        if calibration.mount_seed != mount_seed:
            stated, used = ("none" if seed is None else seed for seed in (calibration.mount_seed, mount_seed))
            faults.append(
                f"the calibration of {camera!r} is of mount seed {stated}, the mounts in use are of mount seed {used};"
                " calibrate again"
            )
        elif calibration.parent != parent:
            faults.append(
                f"the calibration of {camera!r} is for parent {calibration.parent!r}, the camera is on {parent!r};"
                " calibrate again"
            )
        else:
            return found, (*faults, *([found.warning] if found.warning else []))
    return None, tuple(faults)


def now() -> str:
    """Return date and time for the record."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def default_folder() -> Path:
    """Return the default folder of calibrations: OPENARM_CALIBRATIONS, or the user's data folder."""
    given = os.environ.get("OPENARM_CALIBRATIONS", "")
    if given:
        return Path(given).expanduser()
    base = os.environ.get("XDG_DATA_HOME", "")
    return (Path(base) if base else Path.home() / ".local" / "share") / "openarm" / "calibrations"


def _number(path: Path) -> int:
    head = path.name.partition("-")[0]
    return int(head) if head.isdigit() else 0
