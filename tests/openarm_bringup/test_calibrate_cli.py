# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate` typed as a user would, with what can be wrong."""

from __future__ import annotations

import json
import re
from base64 import b64decode
from pathlib import Path
from xml.etree import ElementTree

import pytest
from openarm_interfaces.action import AutoCalibrate

from openarm_bringup.calibration import run as calibration
from openarm_calibration.handeye import zero_sets
from openarm_calibration.store.table import StoredTable, TableStore
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL
from openarm_common.errors import Code, OpenArmError
from openarm_common.records import RecordStore
from openarm_common.robot.learned import keep_hand
from openarm_common.robot.servo_store import StoredServos
from openarm_common.robot.zeros import HandReach
from openarm_common.ros.convert import matrix_to_pose
from tests.openarm_bringup.commands import answer_of, calibrate, calibrate_fails
from tests.openarm_calibration.known_session import make_session

pytestmark = pytest.mark.usefixtures("own_store")


@pytest.fixture(scope="module")
def session_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("session") / "wrist.npz"
    make_session("in_hand", 10).samples.save(path)
    return path


@pytest.mark.requirement("P-28")
def test_solve_check_save_report_list_rollback(capsys, session_file: Path, tmp_path: Path) -> None:
    """From a session file to a stored calibration and a page, and back."""
    assert calibrate(capsys, "list")[1].startswith("0 stored")
    code, out, _ = calibrate(capsys, "save", str(session_file))
    assert code == 0
    assert all(part in out for part in ("repeatable   to", "accurate     to", "DANIILIDIS", "Stored in"))
    assert calibrate(capsys, "save", str(session_file), "--algorithm", "park", "--force")[0] == 0
    code, out, _ = calibrate(capsys, "list")
    assert "2 in its history" in out
    assert "mount seed 1" in out
    assert calibrate(capsys, "rollback", "wrist")[0] == 0
    calibrate_fails(capsys, 1, "going back needs a calibration of", "rollback", "wrist")
    page = tmp_path / "report.html"
    assert calibrate(capsys, "report", str(session_file), str(page))[0] == 0
    text = page.read_text()
    drawn = re.findall(r"<figcaption>(\S+ \S+ \S+)", text)
    assert drawn == ["poses of the", "marks in the", "residuals of the"]
    figures = [b64decode(data) for data in re.findall(r"data:image/svg\+xml;base64,([^\"]+)", text)]
    assert [ElementTree.fromstring(figure).tag for figure in figures] == ["{http://www.w3.org/2000/svg}svg"] * 3
    assert text.count('class="gauge"') == 7
    assert text.count('class="bar"') == 2 * 10
    assert "http" not in text.replace("http-equiv", "")
    code, data = answer_of(capsys, "calibrate", "check", str(session_file))
    assert (code, data["grade"]) == (0, "pass")
    assert data["figures"]["drift"] < 1e-6


@pytest.mark.parametrize(
    ("name", "board"),
    [
        ("board.png", "circles"),
        ("board.pdf", "charuco:9x6:30mm:22mm:DICT_6X6_250"),
        ("board.xml", "{kind: marker, id: 3}"),
    ],
)
@pytest.mark.requirement("A-43")
def test_boards_are_written(capsys, tmp_path: Path, name: str, board: str) -> None:
    path = tmp_path / "new" / name
    code, out, _ = calibrate(capsys, "board", str(path), "--board", board)
    assert code == 0
    assert path.stat().st_size > 500
    assert "mm" in out


@pytest.mark.long
def test_wrong_intrinsics_are_found_with_the_mount(capsys, tmp_path: Path) -> None:
    """A camera_info 3 % off fails by name; with free intrinsics the right ones and the true mount come out."""
    known = make_session("in_hand", 10)
    head = known.samples.head
    width, height, fx, fy, cx, cy = head.intrinsics
    known.samples.head = head.model_copy(update={"intrinsics": (width, height, 1.03 * fx, 1.03 * fy, cx, cy)})
    path = tmp_path / "wrong.npz"
    known.samples.save(path)
    calibrate_fails(capsys, 1, "are these its intrinsics?", "solve", str(path))
    report = tmp_path / "report.json"
    code, out, err = calibrate(capsys, "solve", str(path), "--free-intrinsics", "--json", str(report))
    assert code == 0, err
    assert "fx " in out
    data = json.loads(report.read_text())
    assert data["grade"] == "pass", data["reasons"]
    assert data["intrinsics"]["fx"] == pytest.approx(fx, rel=2e-3)
    true = (known.X @ se3.inverse(T_LINK_OPTICAL))[:3, 3]
    assert data["calibration"]["position"] == pytest.approx(true, abs=1e-3)


@pytest.mark.requirement("A-45")
def test_a_stored_file_that_would_run_something_is_reported_and_not_run(capsys, tmp_path: Path) -> None:
    """Also one that is cut short, and one whose name is a trick."""
    store = tmp_path / "store"
    store.mkdir(exist_ok=True)
    (store / "wrist.yaml").write_text("!!python/object/apply:os.system ['touch " + str(tmp_path / "ran") + "']")
    (store / "overhead.yaml").write_text("format: 1\ncamera: over")
    (store / "..wrist.yaml").write_text("camera: ..wrist")
    code, out, err = calibrate(capsys, "list")
    assert code == 1
    assert "wrist.yaml" in err
    assert "overhead.yaml" in err
    assert "Traceback" not in out + err
    assert not (tmp_path / "ran").exists()


def test_all_that_is_stored_is_listed_under_the_name_by_which_it_goes_back(capsys, tmp_path: Path) -> None:
    """Hands that were learned on two days, of the real robot and of a simulated one; servos; the table."""
    store, simulated = tmp_path / "store", "simulated_openarm_hand_seed_3"
    first = HandReach(closed=0.0016, opened=0.038, effort=6.0, learned="2026-11-29T10:00:00+00:00")
    second = first.model_copy(update={"opened": 0.036, "learned": "2026-11-30T10:00:00+00:00"})
    for of, reach in (("zeros", first), ("zeros", second), (simulated, first)):
        keep_hand(store, of, "left", reach)
    servo = dict.fromkeys(("stiffness", "damping", "friction", "armature", "latency"), (1.0,) * 7)
    RecordStore(store, StoredServos).save(StoredServos(arm="right", **servo))
    TableStore(store).save(StoredTable(height=0.46, configured=0.45))
    code, out, _ = calibrate(capsys, "list")
    assert code == 0
    assert "hands: left 3.2 to 72.0 mm, learned 2026-11-30T10:00:00+00:00  (3 in its history)" in out
    assert f"hands/{simulated}: left 3.2 to 76.0 mm, learned 2026-11-29T10:00:00+00:00  (2 in its history)" in out
    assert "servos/right: gains 1, 1, 1, 1, 1, 1, 1 N m/rad, dynamics seed none, undated  (1 in its history)" in out
    code, listed = answer_of(capsys, "calibrate", "list")
    assert listed["hands"]["zeros"]["hands"]["left"] == second.model_dump()
    assert listed["table"]["height"] == 0.46
    code, answer = answer_of(capsys, "calibrate", "rollback", "hands")
    assert answer["message"] == (
        "now in use: hands: left 3.2 to 76.0 mm, learned 2026-11-29T10:00:00+00:00; start the graph again"
    )
    assert calibrate(capsys, "rollback", "hands")[1].startswith("now in use: hands: as described")
    assert calibrate(capsys, "rollback", f"hands/{simulated}")[0] == 0
    calibrate_fails(capsys, 1, "going back needs a height of 'table' before the present one", "rollback", "table")
    calibrate_fails(capsys, 2, "did you mean servos/right", "rollback", "servos")
    (store / "hands" / "zeros.yaml").write_text("hands: 3")
    code, out, err = calibrate(capsys, "list")
    assert code == 1
    assert "hands: as described" in out
    assert "the last good one" in err


@pytest.mark.parametrize(
    ("argv", "code", "words"),
    [
        (["board"], 2, "out"),
        (["board", "b.gif"], 2, "written as .png, .pdf, .xml"),
        (["board", "b.png", "--board", "circles:4x10"], 2, "odd"),
        (["board", "b.png", "--board", "dots"], 2, "charuco:7x5:34mm:26mm:DICT_5X5_100"),
        (["board", "b.png", "--board", "charuco:7x5:DICT_9X9"], 2, "DICT_6X6_250"),
        (["board", "b.png", "--dpi", "7"], 2, "expected 50 to 2400"),
        (["solve"], 2, "samples"),
        (["solve", "nowhere.npz"], 1, "does not exist"),
        (["solve", "SESSION", "--algorithm", "tsay"], 2, "algorithms: REFINED, TSAI"),
        (["solve", "SESSION", "--algorithm", "park", "--free-intrinsics"], 2, "only REFINED finds intrinsics"),
        (["solve", "SESSION", "--exclude", "s999"], 2, "samples: s001"),
        (["solve", __file__], 1, "is no session file"),
        (["solve", "SESSION", "--store", "SESSION"], 2, "is a file, expected a folder"),
        (["list", "--store", "SESSION"], 2, "is a file, expected a folder"),
        (["report", "SESSION", "/proc/nowhere/page.html"], 1, "can't write /proc/nowhere/page.html"),
        (["report", "SESSION", "page.doc"], 2, "written as .html"),
        (["rollback", "../wrist"], 2, "no stored calibration '../wrist'; there are none"),
        (["table", "--camera", "rear"], 2, "unknown; cameras: overhead, wrist"),
        (["frobnicate"], 2, "frobnicate"),
        (["together", "SESSION"], 2, "1 sessions given"),
        (["together", "SESSION", "SESSION"], 2, "one session for each camera"),
        (["auto", "--poses", "2"], 2, "expected 4 to 100"),
        (["auto", "--camera", "sideways"], 2, "cameras: overhead, wrist"),
        (["auto", "--camera", "spectator"], 2, "cameras: overhead, wrist"),
        (["auto", "--mount-seed", "-3"], 2, "expected 0 or more, or none"),
        (["auto", "--mount-seed", "one"], 2, "expected 0 or more, or none"),
        (["auto", "--poses", "101"], 2, "expected 4 to 100"),
        (["auto", "--store", "SESSION"], 2, "is a file, expected a folder"),
        (["auto", "--set", "nonsense"], 2, "expected node.param=value"),
        (["auto", "--running"], 2, "--camera NAME"),
        (["auto", "--carrier", "openarm_left_link7"], 2, "are for --running"),
        (["auto", "--running", "--camera", "wrist", "--session", "a.txt"], 2, "ends in .npz"),
        (["sample", "--remove", "last", "--advice"], 2, "exclude each other"),
        (["sample", "--session", "samples.txt"], 2, "ends in .npz"),
        (["sample", "--domain", "233"], 2, "expected 0 to 232"),
        (["auto", "--running", "--camera", "wrist", "--domain", "-1"], 2, "expected 0 to 232"),
    ],
)
def test_wrong_calls_say_what_is_wrong(
    capsys, session_file: Path, tmp_path: Path, monkeypatch, argv: list[str], code: int, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    calibrate_fails(capsys, code, words, *(str(session_file) if word == "SESSION" else word for word in argv))
    assert list(tmp_path.glob("b.*")) == []


@pytest.mark.requirement("A-41")
def test_a_degenerate_session_is_exit_code_1_with_advice(capsys, session_file: Path) -> None:
    names = [f"s{k:03d}" for k in range(3, 11)]
    left_out = [word for name in names for word in ("--exclude", name)]
    calibrate_fails(capsys, 1, "DEGENERATE: too few poses: 2", "solve", str(session_file), *left_out)


@pytest.mark.requirement("B-14")
def test_sessions_of_both_cameras_are_solved_together(capsys, session_file: Path, tmp_path: Path) -> None:
    other = tmp_path / "overhead.npz"
    make_session("to_hand", 12).samples.save(other)
    code, data = answer_of(capsys, "calibrate", "together", str(session_file), str(other), "--save")
    assert code == 0, data["message"]
    assert list(data["cameras"]) == ["wrist", "overhead"]
    listed = calibrate(capsys, "list")[1]
    assert "overhead: " in listed
    assert "wrist: " in listed


def result(camera: str, **more) -> AutoCalibrate.Result:
    fields = {
        "success": True, "code": "OK", "message": "pass: within all limits", "grade": "pass",
        "mount": matrix_to_pose(se3.make(None, (0.1, 0.2, 0.3))), "sigma_translation": 1e-5, "sigma_rotation": 1e-5,
        "samples": 10, "delay": 0.02, "delay_sigma": 1e-4, "duration": 40.0,
    }  # fmt: skip
    return AutoCalibrate.Result(**{**fields, **more})


@pytest.mark.parametrize(
    ("results", "error", "code", "words"),
    [
        ({"overhead": result("overhead"), "wrist": result("wrist")}, None, 0, "calibrated overhead, wrist"),
        ({"wrist": result("wrist", grade="fail", message="fail: scale")}, None, 1, "wrist: fail: scale"),
        (
            {"wrist": result("wrist", success=False, code="NO_PLAN", message="none", grade="")},
            None, 1, "NO_PLAN: wrist: none",
        ),
        ({"overhead": result("overhead")}, OpenArmError(Code.CANCELLED, "stopped"), 1, "CANCELLED: stopped"),
    ],
)  # fmt: skip
@pytest.mark.requirement("B-15")
def test_auto_takes_the_fixed_camera_first_and_reports_the_results(
    capsys, tmp_path: Path, monkeypatch, results, error, code: int, words: str
) -> None:
    """Exit code and sentence follow the worst camera; pages are written of the sessions that there are."""
    asked: list[calibration.CalibrationOptions] = []

    def run_it(options, listeners):
        asked.append(options)
        make_session("in_hand", 12).samples.save(tmp_path / "wrist.npz")
        sessions = [tmp_path / "wrist.npz"] if "wrist" in results else []
        return calibration.CalibrationRun(tmp_path, results, sessions, error=error)

    monkeypatch.setattr(calibration, "run_calibration", run_it)
    got, data = answer_of(capsys, "calibrate", "auto", "--mount-seed", "3", "--poses", "12", "--save")
    assert got == code
    assert words in f"{data['code']}: {data['message']}"
    assert (asked[0].cameras, asked[0].mount_seed, asked[0].poses) == (("overhead", "wrist"), 3, 12)
    assert asked[0].save
    rows = data["cameras"]
    assert list(rows) == list(results)
    assert all(row["delay"] == {"seconds": 0.02, "sigma": 1e-4} for row in rows.values())
    assert (tmp_path / "wrist.html").is_file() == ("wrist" in results)


@pytest.mark.long
@pytest.mark.requirement("B-15", "R-11")
def test_auto_reports_mounts_as_they_are_with_the_zeros_and_stores_both(capsys, tmp_path: Path, monkeypatch) -> None:
    """What the node says of each camera alone is replaced; a page of each board and one of the zeros are written."""
    monkeypatch.setattr(zero_sets, "_FOLDS", 2)
    zeros = {f"openarm_{arm}_joint{k}": 2e-3 * (-1) ** k for arm in ("right", "left") for k in range(2, 7)}

    def run_it(options, listeners):
        assert options.zeros
        run = calibration.CalibrationRun(tmp_path, {name: result(name) for name in ("overhead", "wrist")})
        for name, setup, arm in (("overhead", "to_hand", "right"), ("overhead_left_arm", "to_hand", "left"),
                                 ("wrist", "in_hand", "right")):  # fmt: skip
            known = make_session(setup, 9, 0.02, arm=arm, zeros=zeros, spread=0.5, lying=setup == "in_hand")
            known.samples.save(tmp_path / f"{name}.npz")
            run.sessions.append(tmp_path / f"{name}.npz")
        run.found = calibration.together(run.sessions, options.level)
        run.stored = calibration.store_found(run.found, *options.stores())
        return run

    monkeypatch.setattr(calibration, "run_calibration", run_it)
    got, data = answer_of(capsys, "calibrate", "auto", "--mount-seed", "1", "--save")
    assert got == 0
    assert {path.stem for path in tmp_path.glob("*.html")} == {"overhead", "overhead_left_arm", "wrist", "zeros"}
    for name, row in data["cameras"].items():
        assert row["path"] in data["stored"]
        assert row["samples"] == {"overhead": 18, "wrist": 9}[name]
        assert 1e-5 < row["hand"] < 1e-3
        assert row["message"].startswith(f"{row['grade']}: ")
        assert re.search(f"{row['sigma_translation'] * 1e3:.3f}", (tmp_path / f"{name}.html").read_text())
    assert all(abs(data["zeros"]["offsets"][name] - zero) < 5e-4 for name, zero in zeros.items())
    assert len(data["stored"]) == 3
