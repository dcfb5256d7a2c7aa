# SPDX-License-Identifier: Apache-2.0
"""Stored calibrations, one of each camera.

A mount is `T_parent_link` of the camera (position in m, quaternion x, y, z, w; link frame x forward, z up).
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from pydantic import Field, field_validator

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.config import Config, validate
from openarm_common.errors import OpenArmError
from openarm_common.records import Found, Record, RecordStore
from openarm_common.robot.folder import robot_folder
from openarm_common.types import Array


class StoreConfig(Config):
    """Where calibrations are stored, and which mounts are in use."""

    cameras: str = Field(default="", description="YAML of the cameras; empty is that of the robot's folder")
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
    nominal: bool = Field(default=False, description="publish mounts and table of the configuration whatever is stored")
    scene: str = Field(default="demo", description="scene whose table it is, where no height of it was measured")


_FORMAT = 1


class StoredCalibration(Record):
    """The mount of one camera and where it comes from."""

    noun: ClassVar[str] = "calibration"
    command: ClassVar[str] = "openarm calibrate auto"

    format: int = Field(default=_FORMAT, ge=_FORMAT, le=_FORMAT, description="of this file")
    camera: str = Field(pattern=r"^[a-z][a-z0-9_]{0,63}$", description="name of the camera")
    parent: str = Field(min_length=1, description="link that carries the camera")
    position: tuple[float, float, float] = Field(description="of <camera>_link in the parent, m")
    quaternion_xyzw: tuple[float, float, float, float] = Field(description="of <camera>_link in the parent")
    intrinsics: Intrinsics | None = Field(
        default=None, description="of the camera, that this mount was found with; files of old have none"
    )
    sigma_translation: float = Field(default=0.0, ge=0.0, description="predicted error of the position, m")
    sigma_rotation: float = Field(default=0.0, ge=0.0, description="predicted error of the rotation, rad")
    mount_seed: int | None = Field(
        default=None, description="of the simulated mounts that were calibrated; None: real or nominal"
    )
    method: str = Field(default="REFINED", description="solver")
    board: str = Field(default="", description="that was observed")
    samples: int = Field(default=0, ge=0, description="that the result rests on")
    session: str = Field(default="", description="hash of the session file")
    zeros: str = Field(default="", description="label of the joint zeros that it was found with; empty: as described")
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

    @field_validator("intrinsics")
    @classmethod
    def _of_a_camera(cls, value: Intrinsics | None) -> Intrinsics | None:
        if value is not None and (fault := value.fault()):
            raise ValueError(fault)
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

    @property
    def name(self) -> str:
        """The camera."""
        return self.camera

    def __str__(self) -> str:
        """Return the mount, how exact it is, and when it was found."""
        x, y, z = (value * 1e3 for value in self.position)
        seed = "none" if self.mount_seed is None else str(self.mount_seed)
        return (
            f"{x:.2f}, {y:.2f}, {z:.2f} mm in {self.parent}, accurate to {self.sigma_translation * 1e3:.3f} mm,"
            f" {self.samples} samples, mount seed {seed}, {self.created or 'undated'}"
        )

    def fields(self) -> dict[str, Any]:
        """Return what is written and hashed; a file of old lacks intrinsics, zeros or robot, and keeps its hash."""
        absent = {key for key in ("intrinsics", "zeros") if not getattr(self, key)}
        return {key: value for key, value in super().fields().items() if key not in absent}


class CalibrationStore(RecordStore[StoredCalibration]):
    """A folder of calibrations, one of each camera.

    Args:
        calibrations: Folder of the calibrations; made at the first save.
    """

    def __init__(self, calibrations: Path) -> None:
        super().__init__(calibrations, StoredCalibration)

    def in_use(self, camera: str, mount_seed: int | None) -> StoredCalibration | None:
        """Return what is stored of a camera; None also for other mounts or robots, whose distance says nothing."""
        found = self.find(camera)
        return found.record if found is not None and found.record.mount_seed == mount_seed else None


def places(folder: Path, mount_seed: int | None) -> tuple[CalibrationStore, ...]:
    """List where calibrations of the mounts in use are searched; the first that has one wins.

    That is the folder itself; for simulated mounts also its subfolder of that seed, and what comes with the robot.
    """
    stores = [CalibrationStore(folder)]
    if mount_seed is not None:
        name = f"mount_seed_{mount_seed}"
        shipped = robot_folder() / "calibration"
        stores += [CalibrationStore(folder / name), CalibrationStore(shipped / name)]
    return tuple(stores)


def of_these_mounts(
    stores: Sequence[CalibrationStore], camera: str, parent: str, mount_seed: int | None
) -> tuple[Found[StoredCalibration] | None, tuple[str, ...]]:
    """Return the first calibration of a camera as it is mounted now, and why others that were met are not used.

    Args:
        stores: Stores, from `places`.
        camera: Name of the camera.
        parent: Link that carries it.
        mount_seed: Seed of the simulated mounts in use.
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
        calibration = found.record
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


def versions() -> dict[str, str]:
    """Return the versions of what computed the result."""
    out = {"opencv": cv2.__version__, "numpy": np.__version__}
    try:
        out["openarm-vision"] = version("openarm-vision")
    except PackageNotFoundError:
        out["openarm-vision"] = "checkout"
    return out
