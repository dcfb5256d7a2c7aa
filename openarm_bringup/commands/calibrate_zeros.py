# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate zeros`: zeros of the joints with the mounts of the cameras, from sessions, bags or the graph."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from openarm_bringup.calibration.run import store_found
from openarm_bringup.calibration.source import ALL_SAMPLES, Source, opened, store_in, zeros_in
from openarm_bringup.commands.connect import Domain, join_graph, requires_node
from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_calibration.handeye.zero_sets import ZerosCalibration
    from openarm_calibration.store.store import CalibrationStore
    from openarm_common.robot.learned import StoredZeros


def zeros(
    *samples: Path,
    sigma: float | None = None,
    prior: tuple[str, ...] = (),
    level: float | None = None,
    page: Path | None = None,
    save: bool = False,
    force: bool = False,
    domain: Domain = None,
    source: Source = ALL_SAMPLES,
) -> Outcome:
    """Find the zeros of the joints with the mounts of all cameras, from samples of one robot.

    A graph takes stored zeros up when it is started; `openarm calibrate rollback zeros` goes back.

    Args:
        samples: Session files (.npz) and bags, of any cameras and arms; the samples of the running graph when none are
            given.
        sigma: Deviation of a zero before anything is seen, degrees; the likeliest one when not given.
        prior: The same of single joints, as joint=degrees; 0: its zero is right.
        level: Deviation of the tilt of the table that a board lies on, degrees: 0.05 where table and base were
            levelled by a spirit level; not known when not given.
        page: HTML file to write: each joint, and each sample without the zeros and with them.
        save: Store zeros and mounts, unless they predict left-out samples no better than the present ones.
        force: Store them all the same.
    """
    from openarm_calibration.handeye.zero_sets import calibrate_zeros
    from openarm_calibration.handeye.zeros import ZerosConfig
    from openarm_calibration.report.report import zeros_page
    from openarm_common.config import validate
    from openarm_common.records import now
    from openarm_common.resources import write_whole

    given = {
        "sigma": None if sigma is None else math.radians(sigma),
        "by_joint": dict(_prior(item) for item in prior),
        "level": None if level is None else math.radians(level),
    }
    config = validate(ZerosConfig, given, "--sigma, --prior and --level", Code.INVALID_ARGUMENT)
    if samples:
        read = [opened(path, source)[:2] for path in samples]
    else:
        with tempfile.TemporaryDirectory() as folder:
            read = [opened(_of_graph(Path(folder), domain), source)[:2]]
    found = calibrate_zeros([one for one, _ in read], config, hashes=[digest for _, digest in read], created=now())
    text, data = _text(found), found.as_json()
    if page is not None:
        data["page"] = str(page)
        write_whole(page, zeros_page(found).encode())
    failures = found.failures
    if not found.result.off:
        failures = ("the samples show no joint whose zero is off: nothing is to be corrected", *failures)
    if failures and not force:
        return Outcome(False, f"{'; '.join(failures)}; nothing was stored", Code.DEGENERATE, data, text)
    message = "; ".join((*failures, *found.warnings)) or "left-out samples are predicted better with the zeros"
    if not (save or force):
        return Outcome(True, f"{message}; --save stores zeros and mounts", data=data, text=text)
    if any(one.foreign for one, _ in read):
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            "these samples are of a robot that this suite does not have; change its URDF",
        )
    data["stored"] = [*store_found(found, store_in(source.store), zeros_in(source.store))]
    return Outcome(
        True, f"{message}. Stored in {', '.join(data['stored'])}; start the graph again", data=data, text=text
    )


def mounts_rolled_back(left: StoredZeros, mounts: CalibrationStore) -> list[str]:
    """Go back to the mounts that were stored before those of zeros that were left; say what became of each.

    Args:
        left: The zeros.
        mounts: Calibrations of the cameras.
    """
    from openarm_common.robot.zeros import zeros_label

    said = list[str]()
    for camera in left.cameras:
        found = mounts.find(camera)
        if found is None or found.record.zeros != zeros_label(left.offsets):
            continue
        try:
            mounts.rollback(camera)
            said.append(f"{camera}: the mount before")
        except OpenArmError as error:
            said.append(f"{camera}: calibrate it again: {error.message}")
    return said


def _prior(item: str) -> tuple[str, float]:
    name, equals, text = item.partition("=")
    try:
        return name, math.radians(float(text))
    except ValueError:
        what = "no number" if equals else "no ="
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"--prior {item}: {what}; expected joint=degrees, such as JOINT=0.1"
        ) from None


def _of_graph(folder: Path, domain: int | None) -> Path:
    join_graph(domain)
    from openarm_calibration.ros.client import CalibrationClient

    session = folder / "running.npz"
    with requires_node("calibration", "calibrate"), CalibrationClient() as client:
        saved = client.save_samples(str(session))
    if not saved.success:
        raise OpenArmError(Code(saved.code), saved.message)
    return session


def _text(found: ZerosCalibration) -> str:
    before, after = found.before, found.after
    lines = [
        *found.result.sentences(),
        f"left-out samples, without these zeros: {before.px:.2f} px, {before.metres * 1e3:.2f} mm",
        f"                  with them:           {after.px:.2f} px, {after.metres * 1e3:.2f} mm",
    ]
    for mount in found.mounts:
        x, y, z = (v * 1e3 for v in mount.position)
        lines.append(
            f"{mount.camera}: {x:.2f}, {y:.2f}, {z:.2f} mm in {mount.parent}, with these zeros known to"
            f" {mount.sigma_translation * 1e3:.2f} mm and {math.degrees(mount.sigma_rotation):.3f}°"
        )
    lines += [f"{outlier.name}: {outlier.reason}" for outlier in found.result.solution.outliers]
    return "\n".join(lines)
