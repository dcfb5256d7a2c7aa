# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate import`: what is read of other tools and robots, and how it is solved."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from openarm_bringup.calibration.foreign_options import NOTHING, Foreign, Format, lens_given
from openarm_bringup.calibration.source import given_board, store_in
from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_calibration.sampling.samples import SampleSet

_ALLOWED: dict[str, tuple[str, ...]] = {
    "easy_handeye2": ("base", "tip"),
    "moveit": ("base", "tip"),
    "csv": ("base", "tip", "board", "images", "intrinsics", "rotation", "unit", "frames", "session"),
    "bag": ("base", "tip", "board", "intrinsics", "image_topic", "info_topic", "joint_topic", "urdf", "session"),
}


def format_of(path: Path) -> str:
    """Return the format of a file by its name and its beginning.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it is missing; CONFIG_INVALID, when it is nothing that is known.
    """
    if not path.exists():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"there is no {path}")
    if path.is_dir() or path.suffix == ".mcap":
        return "bag"
    if path.suffix in (".csv", ".tsv", ".txt"):
        return "csv"
    from openarm_common.config import parse_json, parse_yaml, read_text

    text = read_text(path)
    document = (
        parse_json(text, str(path), Code.CONFIG_INVALID) if path.suffix == ".json" else parse_yaml(text, str(path))
    )
    if isinstance(document, dict) and "samples" in document:
        return "easy_handeye2"
    if isinstance(document, list):
        return "moveit"
    raise OpenArmError(
        Code.CONFIG_INVALID,
        f"{path} is no samples of easy_handeye2 (a mapping with `samples`) or moveit_calibration (a list), no .csv and"
        " no bag",
    )


def imported(path: Path, form: Format, given: Foreign) -> Outcome:
    """Read, solve and, if asked to, store.

    Args:
        path: File or bag.
        form: Format; auto: by the file.
        given: Options of the command line.

    Raises:
        OpenArmError: What is wrong with file or options; DEGENERATE, when the poses determine nothing.
    """
    chosen = format_of(path) if form == "auto" else form
    every = sorted({name for names in _ALLOWED.values() for name in names})
    wrong = [name for name in every if name not in _ALLOWED[chosen] and getattr(given, name) != getattr(NOTHING, name)]
    if wrong:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"--{wrong[0].replace('_', '-')} is no option of the format {chosen}; its options:"
            f" {', '.join('--' + name.replace('_', '-') for name in _ALLOWED[chosen])}",
        )
    if chosen in ("easy_handeye2", "moveit"):
        return _of_pairs(path, chosen, given)
    if chosen == "csv":
        return _of_csv(path, given)
    return _of_bag(path, given)


def _of_pairs(path: Path, form: str, given: Foreign) -> Outcome:
    from openarm_calibration.foreign.image_sets import Names
    from openarm_calibration.foreign.pair_result import pair_result
    from openarm_calibration.foreign.pose_files import read_easy_handeye2, read_moveit
    from openarm_common.records import now

    read = read_easy_handeye2 if form == "easy_handeye2" else read_moveit
    file = read(path, given.camera_kind or "")
    names = Names(given.camera, given.base or file.base or "base", given.tip or file.tip or "tip")
    result = pair_result(file.pairs, names, created=now())
    message = f"{result.grade}: {'; '.join(result.reasons) or 'within all limits'}"
    data = {"format": form, **result.as_json()}
    if result.grade == "fail":
        kept = "; not stored" if given.save else ""
        return Outcome(False, message + kept, Code.DEGENERATE, data, result.text)
    if given.save:
        stored = store_in(given.store).save(result.calibration)
        return Outcome(True, f"{message}. Stored in {stored}", data=data | {"stored": str(stored)}, text=result.text)
    return Outcome(True, message, data=data, text=result.text)


def _of_csv(path: Path, given: Foreign) -> Outcome:
    from openarm_calibration.foreign.image_sets import Given, Names, image_set
    from openarm_calibration.foreign.pose_files import kind_of, read_table

    setup = kind_of(given.camera_kind or "", "a CSV")
    for name, value in (("images", given.images), ("board", given.board), ("intrinsics", given.intrinsics)):
        if not value:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"a CSV of poses needs --{name}; it has none of its own")
    assert given.images is not None
    found = image_set(
        read_table(path), given.images, given_board(given.board), lens_given(given.intrinsics), setup,
        Names(given.camera, given.base or "base", given.tip or "tip"),
        Given(given.rotation, given.unit, given.frames),
    )  # fmt: skip
    tried = [
        {"convention": one.convention.text, "translation": one.translation, "rotation": one.rotation}
        for one in found.tried
    ]
    return _solved(found.samples, given, found.text, {"format": "csv", "images": found.rows, "conventions": tried})


def _of_bag(path: Path, given: Foreign) -> Outcome:
    from openarm_bringup.bags.bag import open_bag
    from openarm_bringup.calibration.ros.foreign_bag import samples_of_foreign
    from openarm_calibration.sampling import stills

    board = given_board(given.board)
    with open_bag(path) as bag:
        samples, found = samples_of_foreign(bag, board, given)
    return _solved(samples, given, stills.summary(found), {"format": "bag", "stills": stills.rows(found)})


def _solved(samples: SampleSet, given: Foreign, text: str, data: dict[str, Any]) -> Outcome:
    """Write the session if asked to, solve, and report."""
    from openarm_calibration.handeye.offline import calibrate
    from openarm_calibration.report.report import summary
    from openarm_common.records import now

    digest = samples.save(given.session) if given.session is not None else samples.digest()
    if given.session is not None:
        data["session"] = str(given.session)
    try:
        result = calibrate(samples, session=digest, created=now())
    except OpenArmError as error:
        return Outcome(False, error.message, error.code, data, text)
    data |= result.as_json()
    text = f"{text}\n\n{summary(result)}"
    message = f"{result.verdict.grade}: {'; '.join(result.verdict.reasons) or 'within all limits'}"
    if result.verdict.grade == "fail":
        kept = "; not stored" if given.save else ""
        return Outcome(False, message + kept, Code.DEGENERATE, data, text)
    if given.save:
        stored = store_in(given.store).save(result.calibration)
        return Outcome(True, f"{message}. Stored in {stored}", data=data | {"stored": str(stored)}, text=text)
    return Outcome(True, message, data=data, text=text)
