# SPDX-License-Identifier: Apache-2.0
"""Files of poses as other programs write them: OpenCV's FileStorage, NumPy's arrays, tables, a file for each pose."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from openarm_calibration.board.board import read_board
from openarm_calibration.foreign.conventions import checked_form, read
from openarm_calibration.foreign.explain import ROBOT_FRAMES, Poses
from openarm_calibration.foreign.image_sets import Names, image_set
from openarm_calibration.foreign.pose_source import Column, read_source
from openarm_calibration.handeye.problem import project
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.handeye.solve import solve
from openarm_common.camera.lens import Lens
from openarm_common.camera.lens_files import read_lens
from openarm_common.errors import Code
from tests.openarm_calibration import foreign_files as files
from tests.refusals import refuses

pytestmark = pytest.mark.requirement("P-28", "A-36", "M-05")
KNOWN = files.truth("to_hand", 8)
A, C = KNOWN.A, KNOWN.C


def poses(column: Column | None, form: str = "matrix") -> np.ndarray:
    """The poses of a column, in the form that it tells, or else in this one."""
    assert column is not None
    found = read(checked_form(column.rotation or form), column.rows)
    assert found is not None
    return found


def storage(path: Path) -> Path:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("calibration_time", "Sun")
    file.write("camera_matrix", files.K.matrix)
    for k, (a, c) in enumerate(zip(A, C, strict=True)):
        file.write(f"T_gripper2base_{k}", a)
        file.write(f"T_target2cam_{k}", c)
    file.release()
    return path


def storage_of_parts(path: Path) -> Path:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for k, (a, c) in enumerate(zip(A, C, strict=True)):
        file.write(f"R_gripper2base_{k}", a[:3, :3])
        file.write(f"t_gripper2base_{k}", a[:3, 3:])
        file.write(f"rvec_target2cam_{k}", cv2.Rodrigues(c[:3, :3])[0])
        file.write(f"tvec_target2cam_{k}", c[:3, 3:])
    file.release()
    return path


def arrays_of_parts(path: Path) -> Path:
    np.savez(path, R_gripper2base=A[:, :3, :3], t_gripper2base=A[:, :3, 3:], R_target2cam=C[:, :3, :3],
             t_target2cam=C[:, :3, 3], camera_matrix=files.K.matrix)  # fmt: skip
    return path


def arrays(path: Path) -> Path:
    np.savez(path, robot=A, board=C)
    return path


def a_file_each(path: Path) -> Path:
    path.mkdir()
    for k, (a, c) in enumerate(zip(A, C, strict=True)):
        turn = Rotation.from_matrix(a[:3, :3]).as_quat().tolist()
        robot = {
            "position": dict(zip("xyz", a[:3, 3].tolist(), strict=True)),
            "orientation": dict(zip("xyzw", turn, strict=True)),
        }
        board = {"rvec": cv2.Rodrigues(c[:3, :3])[0].tolist(), "tvec": c[:3, 3:].tolist()}
        (path / f"{k}.json").write_text(json.dumps({"hand": robot, "eye": board, "stamp": k}))
    return path


def matrices_each(path: Path) -> Path:
    for name, T in (("robot", A), ("camera", C)):
        (path / name).mkdir(parents=True)
        for k, one in enumerate(T):
            np.savetxt(path / name / f"pose{k}.txt", one)
    return path


def lines_of_either(path: Path) -> Path:
    lines = []
    for a, c in zip(files.numbers(A, "rotvec"), files.numbers(C, "rotvec"), strict=True):
        lines += [f"{who},{','.join(map(repr, row.tolist()))}\n" for who, row in (("hand", a), ("eye", c))]
    path.write_text("".join(lines))
    return path


def one_line_each(path: Path) -> Path:
    np.savetxt(path, np.hstack([files.numbers(A, "matrix"), files.numbers(C, "matrix")]), delimiter=",")
    return path


def named_columns(path: Path) -> Path:
    names = [f"{who}_{part}" for who in ("tcp", "marker") for part in ("tx", "ty", "tz", "qx", "qy", "qz", "qw")]
    rows = np.hstack([np.arange(8)[:, None], files.numbers(A, "xyzw"), files.numbers(C, "xyzw")])
    np.savetxt(path, rows, delimiter=";", header=";".join(["id", *names]), comments="")
    return path


@pytest.mark.parametrize(
    ("write", "name", "forms"),
    [
        (storage, "a.yml", ("matrix", "matrix")), (storage, "a.xml", ("matrix", "matrix")),
        (storage, "a.json", ("matrix", "matrix")), (storage_of_parts, "b.yml", ("matrix", "rotvec")),
        (arrays_of_parts, "c.npz", ("matrix", "matrix")), (arrays, "d.npz", ("matrix", "matrix")),
        (a_file_each, "folder", ("xyzw", "rotvec")), (matrices_each, "folders", ("matrix", "matrix")),
        (lines_of_either, "e.csv", ("rotvec", "rotvec")), (one_line_each, "f.csv", ("matrix", "matrix")),
        (named_columns, "g.csv", ("xyzw", "xyzw")),
        (lambda path: files.easy_handeye2(path, KNOWN), "h.samples", ("xyzw", "xyzw")),
        (lambda path: files.moveit_yaml(path, KNOWN), "i.yaml", ("matrix", "matrix")),
        (lambda path: files.moveit_json(path, KNOWN), "j.json", ("matrix", "matrix")),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_pairs_of_poses_are_found_in_what_programs_write(
    tmp_path: Path, write: Callable[[Path], Path], name: str, forms: tuple[str, str]
) -> None:
    source = read_source(write(tmp_path / name))
    expected = np.linalg.inv(A) if name.endswith(".samples") else A  # as easy_handeye2 does for a fixed camera
    assert poses(source.robot, forms[0]) == pytest.approx(expected, abs=1e-8)
    assert poses(source.board, forms[1]) == pytest.approx(C, abs=1e-8)
    assert len(source.robot.labels) == len(A)


def test_two_files_of_tum_and_two_arrays_are_pairs(tmp_path: Path) -> None:
    times = 1.7e9 + np.arange(8)[:, None]
    for name, T in (("one", A), ("two", C)):
        rows = np.hstack([times, files.numbers(T, "xyzw")])
        np.savetxt(tmp_path / f"{name}.txt", rows, header="timestamp tx ty tz qx qy qz qw")
        np.save(tmp_path / f"{name}.npy", T)
    for ending, form in (("txt", "xyzw"), ("npy", "matrix")):
        source = read_source(tmp_path / f"one.{ending}", tmp_path / f"two.{ending}")
        assert poses(source.robot, form) == pytest.approx(A, abs=1e-8)
        assert poses(source.board, form) == pytest.approx(C, abs=1e-8)


def test_columns_are_named_by_the_command_line_and_units_by_a_header(tmp_path: Path) -> None:
    rows = files.numbers(A, "wxyz")[:, [3, 4, 5, 6, 0, 1, 2]]
    np.savetxt(tmp_path / "a.txt", np.hstack([rows, np.zeros((8, 1))]))
    source = read_source(tmp_path / "a.txt", columns="qw qx qy qz x y z -")
    assert poses(source.robot) == pytest.approx(A, abs=1e-8)
    degrees = files.numbers(A, "xyz_deg", "mm")
    head = "image,X [mm],Y [mm],Z [mm],roll (deg),pitch (deg),yaw (deg)"
    text = "\n".join(f"{k}.png," + ",".join(map(repr, row)) for k, row in enumerate(degrees.tolist()))
    (tmp_path / "b.csv").write_text(f"{head}\n{text}\n")
    source = read_source(tmp_path / "b.csv")
    assert (source.robot.rotation, source.robot.unit) == ("rpy_deg", "mm")
    assert source.images == tuple(f"{k}.png" for k in range(8))


def test_records_belong_together_by_their_numbers_and_half_of_one_is_left_out(tmp_path: Path) -> None:
    """The board was not found in the third, its pose is not a number in the sixth; and the files differ in order."""
    records = {f"pose_{k}": {"hand": a.tolist(), "eye": c.tolist()} for k, (a, c) in enumerate(zip(A, C, strict=True))}
    records["pose_2"]["eye"] = None
    records["pose_5"]["eye"][0][3] = float("nan")
    (tmp_path / "a.json").write_text(json.dumps(records))
    source = read_source(tmp_path / "a.json")
    whole = [0, 1, 3, 4, 6, 7]
    assert poses(source.robot) == pytest.approx(A[whole])
    assert poses(source.board) == pytest.approx(C[whole])
    assert source.left_out == ("pose_2", "pose_5")
    for name, T, order in (("b", A, range(8)), ("c", C, (3, 1, 0, 7, 2, 4, 5, 6))):
        (tmp_path / f"{name}.json").write_text(json.dumps({f"T{k}": T[k].tolist() for k in order}))
    source = read_source(tmp_path / "b.json", tmp_path / "c.json")
    assert (poses(source.robot) == pytest.approx(A), poses(source.board) == pytest.approx(C)) == (True, True)


def semicolons(T: np.ndarray) -> str:
    """As a spreadsheet of a country with decimal commas writes it."""
    lines = [";".join(f"{v:.9f}".replace(".", ",") for v in row) for row in files.numbers(T, "xyzw")]
    return "sep=;\nx;y;z;qx;qy;qz;qw\n" + "\n".join(lines)


def blocks(T: np.ndarray) -> str:
    return "\n\n".join("\n".join(" ".join(map(repr, row)) for row in one) for one in T.tolist())


def of_a_robot(T: np.ndarray) -> str:
    return "".join(f"p[{', '.join(map(repr, row))}]\n" for row in files.numbers(T, "rotvec").tolist())


def echoed(T: np.ndarray) -> str:
    """As `ros2 topic echo` prints messages."""
    out = ""
    for x, y, z, *q in files.numbers(T, "xyzw").tolist():
        turn = "".join(f"    {name}: {v}\n" for name, v in zip("xyzw", q, strict=True))
        place = f"  position:\n    x: {x}\n    y: {y}\n    z: {z}\n"
        out += f"header:\n  frame_id: base\npose:\n{place}  orientation:\n{turn}---\n"
    return out


@pytest.mark.parametrize(
    ("write", "name", "form"),
    [
        (semicolons, "a.csv", "xyzw"),
        (blocks, "b.txt", "matrix"),
        (of_a_robot, "c.txt", "rotvec"),
        (echoed, "d.yaml", "xyzw"),
        (lambda T: "\n".join(json.dumps({"pose": one}) for one in T.tolist()), "e.jsonl", "matrix"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_spreadsheets_robots_and_consoles_write_is_read(tmp_path: Path, write, name: str, form: str) -> None:
    (tmp_path / name).write_text(write(A), "utf-16" if name == "a.csv" else "utf-8")
    assert poses(read_source(tmp_path / name).robot, form) == pytest.approx(A, abs=1e-7)


def test_lines_of_two_tables_belong_together_by_times_and_numbers_and_never_by_their_place(tmp_path: Path) -> None:
    """One has a header, is recorded more often, or lacks a line; without times or numbers counts must be equal."""
    rows = files.numbers(A, "xyzw"), files.numbers(C, "xyzw")
    times = 10.0 + 0.5 * np.arange(8)[:, None]
    often = np.vstack([np.hstack([times + step, rows[0] + 0.0 * step]) for step in (0.0, 0.1, 0.2)])
    np.savetxt(
        tmp_path / "a.csv", often[np.argsort(often[:, 0])], delimiter=",", header="t,x,y,z,qx,qy,qz,qw", comments=""
    )
    np.savetxt(tmp_path / "b.csv", np.delete(np.hstack([times + 0.003, rows[1]]), 2, axis=0), delimiter=",")
    source = read_source(tmp_path / "a.csv", tmp_path / "b.csv")
    whole = np.delete(np.arange(8), 2)
    assert poses(source.robot, "xyzw") == pytest.approx(A[whole], abs=1e-8)
    assert poses(source.board, "xyzw") == pytest.approx(C[whole], abs=1e-8)
    np.savetxt(tmp_path / "c.csv", rows[0], delimiter=",", header="x,y,z,qx,qy,qz,qw", comments="")
    np.savetxt(tmp_path / "d.csv", rows[1], delimiter=",")
    source = read_source(tmp_path / "c.csv", tmp_path / "d.csv")
    assert poses(source.robot, "xyzw") == pytest.approx(A, abs=1e-8)
    assert poses(source.board, "xyzw") == pytest.approx(C, abs=1e-8)
    np.savetxt(tmp_path / "d.csv", rows[1][:7], delimiter=",")
    with refuses(Code.CONFIG_INVALID, "neither numbers of records nor times tell which belong together"):
        read_source(tmp_path / "c.csv", tmp_path / "d.csv")


def test_names_that_do_not_tell_whose_poses_they_are_are_refused_and_may_be_said(tmp_path: Path) -> None:
    """A and B are the robot's and the board's in one book, and the other way round in the next."""
    np.savez(tmp_path / "a.npz", A=C, B=A)
    with refuses(Code.CONFIG_INVALID, r"'A' \(8\), 'B' \(8\).*--roles ROBOT,BOARD"):
        read_source(tmp_path / "a.npz")
    source = read_source(tmp_path / "a.npz", roles="B,A")
    assert poses(source.robot) == pytest.approx(A)
    assert poses(source.board) == pytest.approx(C)
    with refuses(Code.INVALID_ARGUMENT, "--roles B,X: expected two names of"):
        read_source(tmp_path / "a.npz", roles="B,X")


def test_corners_without_pictures_come_with_the_poses(tmp_path: Path) -> None:
    corners = np.random.default_rng(0).uniform(0.0, 640.0, (8, 12, 2))
    records = [{"corners": pixels.tolist(), "T_base_hand": a.tolist()} for a, pixels in zip(A, corners, strict=True)]
    (tmp_path / "views.json").write_text(json.dumps({"K": files.K.matrix.tolist(), "views": records}))
    source = read_source(tmp_path / "views.json")
    assert source.board is None
    assert source.corners is not None
    assert source.corners.rows == pytest.approx(corners)
    assert poses(source.robot) == pytest.approx(A)


@pytest.mark.parametrize("name", ["views.json", "views.yml"])
@pytest.mark.requirement("A-45")
def test_corners_with_numbers_are_those_of_the_board_that_are_seen(tmp_path: Path, name: str) -> None:
    """As ChArUco's detection gives them: other ones and another count in each record, also as OpenCV writes them."""
    known, board = files.truth("in_hand", 11, seed=3), read_board("charuco:7x5:34mm:26mm:DICT_6X6_250")
    row, rng = np.array([files.K.fx, files.K.fy, files.K.cx, files.K.cy]), np.random.default_rng(1)
    seen = [rng.permutation(len(board.points))[: rng.integers(6, 20)] for _ in known.A]
    pixels = [project(board.points[ids], 0.0, c, row) for ids, c in zip(seen, known.C, strict=True)]
    path = tmp_path / name
    if path.suffix == ".json":
        views = zip(known.A, seen, pixels, strict=True)
        path.write_text(
            json.dumps([{"ids": i.tolist(), "corners": p.tolist(), "T_base_hand": a.tolist()} for a, i, p in views])
        )
    else:
        file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for k, (a, ids, at) in enumerate(zip(known.A, seen, pixels, strict=True)):
            file.startWriteStruct(f"view_{k}", cv2.FILE_NODE_MAP)
            file.write("charuco_ids", ids[:, None].astype(np.int32))
            file.write("charuco_corners", at[:, None].astype(np.float32))
            file.write("T_base_hand", a)
            file.endWriteStruct()
        file.release()
    source = read_source(path)
    robot = Poses(source.robot.rows, ROBOT_FRAMES, names=source.robot.labels)
    found = image_set(source, None, board, Lens(files.K), robot, "in_hand", Names())
    assert [len(sample.detection.ids) for sample in found.samples.samples] == [len(ids) for ids in seen]
    assert mount_error(solve(found.samples.problem()).estimate.X[0], known.X)[0] < 1e-4
    with refuses(Code.DEGENERATE, "each once, of 0 to 5"):
        image_set(source, None, read_board("charuco:4x3:34mm:26mm:DICT_6X6_250"), Lens(files.K), robot, "in_hand",
                  Names())  # fmt: skip


def test_a_table_in_latin_1_is_read(tmp_path: Path) -> None:
    rows = [
        ",".join(map(str, [f"Gr\u00f6\u00dfe {k}", *files.numbers(A[k : k + 1], "xyzw")[0]])) for k in range(len(A))
    ]
    (tmp_path / "a.csv").write_bytes("\n".join(rows).encode("latin-1"))
    source = read_source(tmp_path / "a.csv")
    assert source.images[0] == "Gr\u00f6\u00dfe 0"
    assert len(source.robot.rows) == len(A)


@pytest.mark.parametrize("spelling", ["chessboard:4x3:40mm", "chessboard:5x3:30mm", "symmetric_circles:5x4:30mm:12mm"])
def test_lists_of_corners_that_begin_at_either_end_are_read_alike(tmp_path: Path, spelling: str) -> None:
    """By rows or by columns, and turned by half in four of eleven views; the poses of the robot tell."""
    known, board = files.truth("in_hand", 11, seed=3), read_board(spelling)
    row = np.array([files.K.fx, files.K.fy, files.K.cx, files.K.cy])
    records = []
    for k, (a, c) in enumerate(zip(known.A, known.C, strict=True)):
        corners = project(board.points, board.radius, c, row).reshape(board.rows, board.columns, 2)
        corners = corners[::-1, ::-1] if k in (0, 4, 5, 9) else corners
        corners = corners.transpose(1, 0, 2) if spelling == "chessboard:5x3:30mm" else corners
        records.append({"image_points": corners.reshape(-1, 2).tolist(), "T_base_hand": a.tolist()})
    (tmp_path / "views.json").write_text(json.dumps(records))
    source = read_source(tmp_path / "views.json")
    robot = Poses(source.robot.rows, ROBOT_FRAMES, names=source.robot.labels)
    found = image_set(source, None, board, Lens(files.K), robot, "in_hand", Names())
    solution = solve(found.samples.problem())
    assert mount_error(solution.estimate.X[0], known.X)[0] < 1e-4


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.json", '{"a": 1}', "no poses that are repeated: read are 4x4"),
        ("b.csv", "1,2,3,4,5\n" * 3, "has 5 numbers a pose; expected 6 .*--columns"),
        ("c.csv", "1,2,3\n1,2\n", "c.csv:2 has 2 cells, expected 3"),
        ("d.csv", "1,2,3,4,5,6\n1,2,x,4,5,6\n", "d.csv:2: 'x' is no finite number"),
        ("e.xml", "<!DOCTYPE a><a/>", "has a document type"),
        ("f.npz", "PK", "holds no arrays of numbers that can be read"),
        ("g.npy", "\x93NUMPY", "holds no arrays"),
        ("h.json", json.dumps([[np.eye(4).tolist()] * 3] * 4), "has the poses .* say it by --roles ROBOT,BOARD"),
    ],
)
@pytest.mark.requirement("A-45")
def test_what_can_not_be_read_is_refused_with_what_is_and_what_to_type(tmp_path, name, text, words) -> None:
    (tmp_path / name).write_text(text)
    with refuses(Code.CONFIG_INVALID, words):
        read_source(tmp_path / name)


@pytest.mark.parametrize("name", ["a.yml", "a.xml", "a.json"])
def test_intrinsics_that_opencv_writes_are_read(tmp_path: Path, name: str) -> None:
    file = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", files.K.width)
    file.write("image_height", files.K.height)
    file.write("camera_matrix", files.K.matrix)
    file.write("distortion_coefficients", np.array([[-0.2, 0.05, 0.001, 0.0, 0.01]]))
    file.release()
    lens = read_lens(tmp_path / name)
    assert np.array_equal(lens.intrinsics.matrix, files.K.matrix)
    assert (lens.model, lens.coefficients) == ("plumb_bob", (-0.2, 0.05, 0.001, 0.0, 0.01))


def test_a_matrix_by_columns_is_told_by_its_zeros(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps({"camera": {"K": files.K.matrix.T.tolist(), "image_size": [640, 480]}}))
    assert np.array_equal(read_lens(tmp_path / "a.json").intrinsics.matrix, files.K.matrix)
    (tmp_path / "b.json").write_text(json.dumps({"K": files.K.matrix.tolist()}))
    with refuses(Code.CONFIG_INVALID, "image_width"):
        read_lens(tmp_path / "b.json")
