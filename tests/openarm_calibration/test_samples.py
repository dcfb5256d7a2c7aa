# SPDX-License-Identifier: Apache-2.0
"""Gate, sample set, session file, verdict."""

from __future__ import annotations

import contextlib
import json
import math
import re
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from openarm_calibration.handeye.left_out import side_by_side
from openarm_calibration.handeye.limits import Limits
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.handeye.solve import SolveConfig, solve
from openarm_calibration.handeye.verdict import assess, estimate_delay
from openarm_calibration.sampling.gate import GateConfig, match
from openarm_calibration.sampling.samples import SampleSet, load_session
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer
from tests.refusals import refuses

MS = 1_000_000
NAMES = ("openarm_right_joint1", "openarm_right_joint2")


def buffer(until_ms: int = 1000, speed: float = 0.0) -> RobotStateBuffer:
    out = RobotStateBuffer(RobotDescription.load())
    for t in range(0, until_ms + 1, 10):
        out.add_joint_state(t * MS, NAMES, (0.1, 0.2 + speed * t * 1e-3))
    return out


@pytest.mark.requirement("A-44", "A-72")
def test_an_image_6_ms_after_the_last_joint_state_is_rejected_and_4_ms_is_not() -> None:
    """And 20 ms; an image between two joint states is interpolated."""
    for late, accepted in ((4, True), (6, False), (20, False)):
        if accepted:
            assert match(buffer(), (1000 + late) * MS, NAMES, GateConfig()).t_joints_ns == 1000 * MS
        else:
            with refuses(Code.STALE_DATA, rf"nearest is -{late}.0 ms away"):
                match(buffer(), (1000 + late) * MS, NAMES, GateConfig())
    between = match(buffer(1000, 0.001), 503 * MS, NAMES, GateConfig())
    assert between.joints[NAMES[1]] == pytest.approx(0.2 + 0.001 * 0.503)


@pytest.mark.requirement("A-44")
def test_a_moving_robot_is_rejected_with_the_joint_and_its_speed() -> None:
    with refuses(Code.MOVING, r"openarm_right_joint2 at 0\.10\d rad/s, at most 0\.005"):
        match(buffer(1000, 0.1), 900 * MS, NAMES, GateConfig())
    assert match(buffer(1000, 0.1), 900 * MS, NAMES, GateConfig(), moving=True).speed == pytest.approx(0.1, rel=0.1)


def test_one_joint_state_does_not_say_whether_the_robot_stands() -> None:
    with pytest.raises(OpenArmError, match=r"1 joint states in the 0.2 s before the image"):
        match(buffer(0), 0, NAMES, GateConfig())


@pytest.mark.parametrize("setup", ["in_hand", "to_hand"])
@pytest.mark.requirement("A-33", "A-34")
def test_a_session_solves_to_the_true_mount_and_again_from_its_file(session, setup, tmp_path: Path) -> None:
    """Wrist and overhead camera on the arm's own kinematics; bit-equal after saving and loading."""
    known = session(setup)
    solution = solve(known.samples.problem())
    offset, angle = mount_error(solution.estimate.X[0], known.X)
    assert offset < 0.3e-3
    assert angle < math.radians(0.03)
    path = tmp_path / "session.npz"
    digest = known.samples.save(path)
    again, read = load_session(path, known.description)
    assert read == digest
    assert [s.name for s in again.samples] == [s.name for s in known.samples.samples]
    np.testing.assert_array_equal(solve(again.problem()).estimate.X, solution.estimate.X)


def test_samples_are_removed_by_name_and_a_wrong_name_lists_them(session) -> None:
    samples = session(count=3).samples
    with pytest.raises(OpenArmError, match="no sample 's9'; samples: s001, s002, s003"):
        samples.remove("s9")
    assert samples.remove("s002").name == "s002"
    assert samples.remove("").name == "s003"
    assert len(samples) == 1


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        ("cut", "damaged"), ("text", "expected an .npz archive"), ("empty", "is empty"), ("pickle", "damaged"),
        ("missing", "does not exist"), ("folder", "Is a directory"),
    ],
)  # fmt: skip
def test_a_damaged_session_is_refused(session, tmp_path: Path, damage: str, words: str) -> None:
    known = session(count=3)
    path = tmp_path / "s.npz"
    known.samples.save(path)
    data = path.read_bytes()
    if damage == "cut":
        path.write_bytes(data[: len(data) // 2])
    elif damage == "text":
        path.write_text("hello")
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "pickle":
        np.savez(path, head=np.array([{}], dtype=object))
    else:
        path.unlink()
        if damage == "folder":
            path.mkdir()
    with refuses(Code.CONFIG_INVALID, words):
        load_session(path, known.description)


def rewritten(known, path: Path, change) -> Path:
    """A session file whose JSON and arrays were modified."""
    known.samples.save(path)
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    document = json.loads(bytes(arrays["head"]).decode())
    change(document, arrays)
    arrays["head"] = np.frombuffer(json.dumps(document).encode(), dtype=np.uint8)
    np.savez(path, **arrays)
    return path


def _renamed(joints: dict[str, float]) -> dict[str, float]:
    return {name.replace("openarm_right", "panda"): value for name, value in joints.items()}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d, a: d["samples"][1].update(joints=_renamed(d["samples"][1]["joints"])), "another robot: it lacks"),
        (lambda d, a: d["head"].update(parent="tool0"), "no link 'tool0'; links:"),
        (lambda d, a: d["head"].update(camera="../wrist"), "head:camera"),
        (lambda d, a: d["head"].update(board={"kind": "dots"}), "boards: circles, symmetric_circles"),
        (lambda d, a: d["head"].update(board={"kind": "circles", "rows": 7}), "marks that its board does not have"),
        (lambda d, a: a["pixels_1"].__setitem__((0, 0), math.nan), "all finite"),
        (lambda d, a: a["ids_1"].__setitem__(0, -1), "marks that its board does not have"),
        (lambda d, a: a["ids_1"].__setitem__(0, 1), "or twice"),
        (lambda d, a: a.update(pose_1=np.eye(3)), "pose"),
        (lambda d, a: a.pop("ids_2"), "ids_2"),
        (lambda d, a: d["samples"][0].update(t_image_ns="soon"), "soon"),
        (lambda d, a: d["samples"][0].update(name="s002"), "already"),
        (lambda d, a: d.pop("samples"), "samples"),
    ],
)
def test_a_changed_session_or_one_of_another_robot_is_refused_by_name(session, tmp_path, change, words: str) -> None:
    known = session(count=3)
    with pytest.raises(OpenArmError, match=words):
        load_session(rewritten(known, tmp_path / "s.npz", change), known.description)


@pytest.mark.requirement("N-09")
def test_a_delay_of_20_ms_is_estimated_to_1_ms(session) -> None:
    """Images that are 20 ms old at their stamps, of a moving arm; a standing one says nothing of it."""
    moving = session(count=15, delay=0.020, speed=0.3)
    delay, sigma = estimate_delay(moving.samples)
    assert delay == pytest.approx(0.020, abs=1e-3)
    assert sigma < 1e-3
    assert estimate_delay(session(count=5).samples) == (0.0, math.inf)


@pytest.mark.requirement("P-28")
def test_the_verdict_has_held_out_errors_and_reasons(session) -> None:
    """A good set passes; few samples, a wrong board size and a drift are reported."""
    known = session(px=0.05)
    problem = known.samples.problem()
    solution = solve(problem)
    good = assess(problem, solution, stored=known.X)
    assert good.grade == "pass", good.reasons
    repeatable, accurate = good.figures["sigma_translation"], good.figures["accuracy_translation"]
    limits = (accurate / 0.9, accurate / 5.0, repeatable / 5.0)  # what the lens leaves open is a warning at most
    grades = [assess(problem, solution, Limits(translation=limit)).grade for limit in limits]
    assert grades == ["pass", "warn", "fail"]
    assert accurate / 5.0 > repeatable / 3.0
    assert good.figures["leave_one_out"] < 0.5e-3
    assert 0.0 < good.figures["five_fold_px"] < 0.5
    assert abs(good.figures["scale"] - 1.0) < 0.003
    moved = known.X.copy()
    moved[0, 3] += 0.008
    drifted = assess(problem, solution, stored=moved)
    assert drifted.grade == "warn"
    assert any("8." in reason and "from what is stored" in reason for reason in drifted.reasons)
    some = known.samples.copy()
    for sample in known.samples.samples[5:]:
        some.remove(sample.name)
    few = some.problem()
    assert any("5 poses, 10 are wanted" in reason for reason in assess(few, solve(few)).reasons)
    table = side_by_side(problem, solution)
    assert set(table) == {"TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS", "SHAH", "LI", "REFINED"}


@pytest.mark.parametrize(("setup", "count"), [("in_hand", 10), pytest.param("to_hand", 15, marks=pytest.mark.long)])
@pytest.mark.requirement("A-32")
def test_wrong_intrinsics_fail_by_name_and_right_ones_do_not(session, setup: str, count: int) -> None:
    """A focal length 4 % off, as of another resolution or field of view."""
    samples = session(setup, count, px=0.1).samples
    solution = solve(samples.problem())
    right = assess(samples.problem(), solution)
    assert abs(right.figures["focal"] - 1.0) < 4.0 * right.figures["focal_sigma"] < 0.02
    assert not any("focal length" in reason for reason in right.reasons)
    width, height, fx, fy, cx, cy = samples.head.intrinsics
    wrong = (width, height, 1.04 * fx, 1.04 * fy, cx, cy)
    samples.head = samples.head.model_copy(update={"intrinsics": wrong})
    problem = samples.problem()
    verdict = assess(problem, solve(problem, SolveConfig(most_translation=0.1, most_rotation=0.2)))
    assert verdict.grade == "fail"
    assert any(re.match(r"the focal length seems -3\.\d+ % off", reason) for reason in verdict.reasons)
    far = (width, height, 1.2 * fx, 1.2 * fy, cx, cy)
    samples.head = samples.head.model_copy(update={"intrinsics": far})
    with pytest.raises(
        OpenArmError,
        match=r"the focal length seems -16\.\d+ % off.*poses that contradict each other.*the intrinsics",
    ):
        solve(samples.problem())


def test_joint_positions_in_degrees_are_named(session) -> None:
    known = session(count=8)
    wrong = SampleSet(known.samples.head, known.description)
    for sample in known.samples.samples:
        wrong.add(replace(sample, joints={name: math.degrees(q) for name, q in sample.joints.items()}))
    with pytest.raises(OpenArmError, match="the joint positions are in degrees where radians are expected"):
        solve(wrong.problem())


def _archive(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return path


def _array(shape: str) -> bytes:
    head = f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}, }}"
    head = head.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head.encode()


def test_an_archive_that_unpacks_to_gigabytes_is_refused_unread(tmp_path: Path) -> None:
    """Seventy million zeros are 70 kB packed; a header may claim any size."""
    zeros = _array("(70000000,)") + bytes(70_000_000)
    for path, part in (
        (_archive(tmp_path / "a.npz", head=zeros), r"unpacks to 67 MiB.*64 MiB"),
        (_archive(tmp_path / "b.npz", head=_array("(8, 10000000000)")), r"shape \(8, 10000000000\) in 128 bytes"),
        (_archive(tmp_path / "c.npz", head=b"no array"), "magic string is not correct"),
    ):
        tracemalloc.start()
        with refuses(Code.CONFIG_INVALID, part):
            load_session(path, RobotDescription.load())
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 20e6


def test_an_altered_session_is_read_or_refused_in_a_sentence(tmp_path: Path, session) -> None:
    path, rng = tmp_path / "s.npz", np.random.default_rng(7)
    session(count=4).samples.save(path)
    sound = path.read_bytes()
    for _ in range(150):
        data = bytearray(sound)
        for _ in range(int(rng.integers(1, 6))):
            data[int(rng.integers(len(data)))] = int(rng.integers(256))
        path.write_bytes(data[: len(data) - int(rng.integers(2) * rng.integers(len(data)))])
        with contextlib.suppress(OpenArmError):
            load_session(path, RobotDescription.load())
