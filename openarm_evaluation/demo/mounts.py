# SPDX-License-Identifier: Apache-2.0
"""Camera mounts of the simulated robot: calibrated once for each mount seed, and how far off they are on paper.

Where the mounts really are is for reports and judges alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from openarm_bringup.calibration.run import GRAPH, CalibrationListeners, CalibrationOptions, run_calibration
from openarm_bringup.supervision.environment import zeros_name
from openarm_bringup.supervision.graph import load_graph
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.store.store import of_these_mounts, places
from openarm_common.camera.cameras import load_cameras, true_mount, uncertain_cameras
from openarm_common.errors import Code, OpenArmError
from openarm_common.records import default_folder
from openarm_common.robot.learned import LearnedStore, StoredZeros


def uncalibrated(mount_seed: int) -> tuple[str, ...]:
    """Cameras that have no calibration for mounts of this seed, neither stored nor with the suite."""
    stores = places(default_folder(), mount_seed)
    return tuple(
        camera.name
        for camera in (load_cameras()[name] for name in uncertain_cameras())
        if of_these_mounts(stores, camera.name, camera.parent, mount_seed)[0] is None
    )


def calibrate_once(mount_seed: int, on_note: Callable[[str], None]) -> None:
    """Calibrate the cameras that are not yet, in a graph of its own, and store the result for next time.

    The zeros of the joints are determined and stored with the first ones.

    Raises:
        OpenArmError: Reason why it did not work; DEGENERATE, when a result was not good enough to be stored.
    """
    cameras = uncalibrated(mount_seed)
    if not cameras:
        return
    on_note(f"no calibration of mount seed {mount_seed} yet: {', '.join(cameras)} are calibrated first, once")
    store = default_folder() / f"mount_seed_{mount_seed}"
    listeners = CalibrationListeners(on_camera=lambda camera: on_note(f"calibrating {camera}"))
    zeros = not LearnedStore(default_folder(), StoredZeros).history(zeros_name(load_graph(GRAPH)))
    options = CalibrationOptions(
        cameras, mount_seed=mount_seed, save=True, zeros=zeros, zeros_store=default_folder(), store=store
    )
    run = run_calibration(options, listeners)
    if run.error is not None:
        raise run.error
    for camera, row in run.rows().items():
        if not row["success"] or row["grade"] == "fail":
            code = Code.DEGENERATE if row["success"] else Code(row["code"])
            raise OpenArmError(code, f"calibration of {camera}: {row['message']}")
    left = uncalibrated(mount_seed)
    if left:
        raise OpenArmError(Code.INTERNAL, f"{', '.join(left)} are stored in {store}, but not found there")


def errors(mount_seed: int, *, nominal: bool) -> dict[str, dict[str, float]]:
    """How far off the mounts of the configuration and those in use are, mm and degrees, by camera.

    Args:
        mount_seed: Seed of the true mounts.
        nominal: Whether the mounts of the configuration are in use, whatever is stored.
    """
    stores = places(default_folder(), mount_seed)
    out: dict[str, dict[str, float]] = {}
    for camera in (load_cameras()[name] for name in uncertain_cameras()):
        true = true_mount(camera, mount_seed)
        found, _ = of_these_mounts(stores, camera.name, camera.parent, mount_seed)
        used = camera.T_parent_link if nominal or found is None else found.record.T_parent_link
        row: dict[str, float] = {}
        for name, mount in (("nominal", camera.T_parent_link), ("used", used)):
            offset, angle = mount_error(mount, true)
            row |= {f"{name}_mm": offset * 1e3, f"{name}_deg": math.degrees(angle)}
        out[camera.name] = row
    return out
