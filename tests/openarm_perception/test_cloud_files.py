# SPDX-License-Identifier: Apache-2.0
"""Clouds of others: every form of PLY, arrays, text; not organised, in millimetres, along other axes."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code
from openarm_perception.frames.cloud_fields import Cloud
from openarm_perception.frames.clouds import read_cloud
from openarm_perception.frames.pcd import read_pcd, write_pcd
from openarm_perception.frames.plain import read_npy, read_xyz
from openarm_perception.frames.ply import read_ply, walk
from openarm_perception.geometry.depth import Deprojector, DepthLimits
from tests.refusals import refused

LIMITS = DepthLimits(near=0.1, far=3.0)
RNG = np.random.default_rng(2)
POINTS = RNG.uniform(-1.0, 1.0, (6, 3)).astype(np.float32)
RGB = RNG.integers(0, 256, (6, 3)).astype(np.uint8)
VERTEX = [*((axis, "float") for axis in "xyz"), ("nx", "double"), *((c, "uchar") for c in ("red", "green", "blue"))]
CODES = {"float": "f", "double": "d", "uchar": "B", "int": "i", "ushort": "H", "char": "b"}
FACES = [[0, 1, 2], [], [3, 4, 5, 0]]


class Ply:
    """A file of elements: name, properties (name, type) or (name, type of the length, type), rows."""

    def __init__(self, form: str, *info: str) -> None:
        self.form, self.order = form, ">" if "big" in form else "<"
        self.head = [f"format {form} 1.0", "comment made here", *(f"obj_info {text}" for text in info)]
        self.data = b""

    def element(self, name: str, properties: list[tuple[str, ...]], rows: list[list]) -> Ply:
        self.head.append(f"element {name} {len(rows)}")
        for one, *kinds in properties:
            self.head.append(f"property {'list ' if len(kinds) > 1 else ''}{' '.join(kinds)} {one}")
        for row in rows:
            flat: list[tuple[str, float]] = []
            for (_, *kinds), value in zip(properties, row, strict=True):
                flat += [(kinds[0], len(value))] if len(kinds) > 1 else []
                flat += [(kinds[-1], v) for v in (value if len(kinds) > 1 else [value])]
            if self.form == "ascii":
                self.data += " ".join(repr(value) for _, value in flat).encode() + b"\n"
            else:
                self.data += b"".join(struct.pack(self.order + CODES[kind], value) for kind, value in flat)
        return self

    def write(self, path: Path) -> Path:
        path.write_bytes("\n".join(["ply", *self.head, "end_header", ""]).encode() + self.data)
        return path


def vertices(ply: Ply, points: np.ndarray = POINTS) -> Ply:
    rows = [[*map(float, p), 0.5, *map(int, c)] for p, c in zip(points, np.resize(RGB, points.shape), strict=True)]
    return ply.element("vertex", VERTEX, rows)


FORMS = ("ascii", "binary_little_endian", "binary_big_endian")


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("faces_first", [False, True])
def test_the_vertices_of_every_form_of_ply_are_read(tmp_path: Path, form: str, faces_first: bool) -> None:
    ply = Ply(form)
    faces: list[tuple[str, ...]] = [("quality", "double"), ("vertex_indices", "ushort", "int")]
    rows = [[0.25, face] for face in FACES]
    ply = vertices(ply.element("face", faces, rows)) if faces_first else vertices(ply).element("face", faces, rows)
    read = read_ply(ply.write(tmp_path / "a.ply"))
    np.testing.assert_array_equal(read.points, POINTS[None])
    np.testing.assert_array_equal(read.rgb, RGB[None])
    assert not read.organised


GRID = np.array([[-1, 4, 0], [2, -1, 1]])


@pytest.mark.parametrize("form", FORMS)
def test_a_ply_is_organised_where_it_says_so(tmp_path: Path, form: str) -> None:
    """By the numbers of points in an image, by an image of all vertices, or by the camera of PCL."""
    info = ("num_cols 3", "num_rows 2")
    cells = [[[int(k)] if k >= 0 else []] for k in GRID.ravel()]
    gridded = vertices(Ply(form, *info)).element("range_grid", [("vertex_indices", "uchar", "int")], cells)
    read = read_ply(gridded.write(tmp_path / "grid.ply"))
    np.testing.assert_array_equal(read.points, np.where((GRID >= 0)[..., None], POINTS[GRID], np.nan))
    assert read.rgb is not None
    np.testing.assert_array_equal(read.rgb[GRID >= 0], RGB[GRID[GRID >= 0]])
    read = read_ply(vertices(Ply(form, *info)).write(tmp_path / "all.ply"))
    np.testing.assert_array_equal(read.points, POINTS.reshape(2, 3, 3))
    camera: list[tuple[str, ...]] = [("view_px", "float"), ("viewportx", "int"), ("viewporty", "int")]
    read = read_ply(vertices(Ply(form)).element("camera", camera, [[0.0, 2, 3]]).write(tmp_path / "camera.ply"))
    np.testing.assert_array_equal(read.points, POINTS.reshape(3, 2, 3))


@pytest.mark.parametrize("form", FORMS)
def test_a_grid_of_one_row_is_no_image_and_may_be_missing(tmp_path: Path, form: str) -> None:
    """Writers announce it and leave it out, or the other way round; and one line is empty before a text."""
    ply = vertices(Ply(form, "num_cols 6", "num_rows 1"))
    ply.head.append("element range_grid 6\nproperty list uchar int vertex_indices")
    ply.data = (b"\n" if form == "ascii" else b"") + ply.data
    np.testing.assert_array_equal(read_ply(ply.write(tmp_path / "a.ply")).points, POINTS[None])


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ((b"ply\n", b"plx\n"), "no 'ply'"),
        ((b"end_header", b"end_footer"), "no 'ply'"),
        ((b"format", b"farmat"), "has the format ''"),
        ((b"property float z", b"property half z"), "'property half z'; expected a property of the types char"),
        ((b"property float z", b"property float w"), "vertices with x y w"),
        ((b"vertex 6", b"vertex 999999999"), "at most|1 to 8000000"),
        ((b"vertex 6", b"vertex -6"), "a whole number at its end"),
        ((b"vertex 6", b"vertex 7"), "ends after|has 42 values for 7"),
        ((b"double nx", b"float nx\nelement vertex 6"), "two elements of one name"),
        ((b"float z\n", b"float z\nproperty list uchar int more\n"), "lists among the properties of its vertices"),
    ],
)
def test_other_ply_files_are_refused(tmp_path: Path, form: str, change: tuple[bytes, bytes], said: str) -> None:
    path = vertices(Ply(form)).write(tmp_path / "a.ply")
    data = path.read_bytes()
    assert change[0] in data
    path.write_bytes(data.replace(*change, 1))
    assert refused(said, read_ply, path).code is Code.BAD_IMAGE


@given(
    st.binary(max_size=60),
    st.lists(st.tuples(st.integers(1, 8), st.sampled_from([0, 1, 2, 4])), min_size=1, max_size=4),
)
@settings(max_examples=100, deadline=None)
def test_lists_that_end_too_early_are_noticed(data: bytes, properties: list[tuple[int, int]]) -> None:
    """No read is beyond the data, whatever length a list says."""
    sizes, lengths = (np.array(column, np.int64) for column in zip(*properties, strict=True))
    first = np.empty(5, np.int64)
    used = walk(np.frombuffer(data, np.uint8), sizes, lengths, False, first)
    assert -1 <= used <= len(data)
    if used >= 0:
        assert first.max() <= len(data)


def test_arrays_and_text_are_read(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.hstack([POINTS, RGB]).astype(np.float64))
    read = read_npy(tmp_path / "a.npy")
    np.testing.assert_array_equal(read.points, POINTS[None])
    np.testing.assert_array_equal(read.rgb, RGB[None])
    np.save(tmp_path / "a.npy", POINTS.reshape(2, 3, 3))
    assert read_npy(tmp_path / "a.npy").organised
    rows = "\n".join(f"{x!r}, {y!r}; {z!r}" for x, y, z in POINTS.tolist())
    (tmp_path / "a.xyz").write_text(f"// X Y Z\n# all\n\n{rows}\n")
    np.testing.assert_array_equal(read_xyz(tmp_path / "a.xyz").points, POINTS[None])
    for array in (np.zeros((4, 2)), np.zeros(12), np.array(["a"]), np.zeros((0, 3)), np.zeros((2, 3), np.complex128)):
        np.save(tmp_path / "a.npy", array)
        refused("expected", read_npy, tmp_path / "a.npy")
    np.save(tmp_path / "a.npy", np.array([{}]), allow_pickle=True)
    refused(r"a \.npy file of numpy.save", read_npy, tmp_path / "a.npy")
    (tmp_path / "a.xyz").write_text("1 2 3\n1 2\n")
    refused("of another length", read_xyz, tmp_path / "a.xyz")
    (tmp_path / "a.xyz").write_text("a cloud\n")
    refused("has 0 points|points of 0 numbers", read_xyz, tmp_path / "a.xyz")


@pytest.mark.parametrize("separator", [" ", ";", "\t", "; "])
def test_decimal_commas_and_a_count_of_points_are_noticed(tmp_path: Path, separator: str) -> None:
    """As spreadsheets and PTS files have them."""
    rows = "\n".join(separator.join(f"{v:.6f}".replace(".", ",") for v in p) for p in POINTS)
    (tmp_path / "a.txt").write_text(f"{len(POINTS)}\n{rows}\n")
    np.testing.assert_allclose(read_xyz(tmp_path / "a.txt").points, POINTS[None], atol=1e-6)


def test_normals_are_no_colours_and_records_are_read_by_name(tmp_path: Path) -> None:
    normals = np.tile((0.6, 0.0, -0.8), (6, 1))
    np.save(tmp_path / "a.npy", np.hstack([POINTS, normals]))
    assert read_npy(tmp_path / "a.npy").rgb is None
    np.save(tmp_path / "a.npy", np.hstack([POINTS, normals, RGB]))
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy").rgb, RGB[None])
    records = np.zeros(6, [("t", "U4"), ("z", "f8"), ("y", "f4"), ("x", "f4"), ("intensity", "u2")])
    for i, axis in enumerate("xyz"):
        records[axis] = POINTS[:, i]
    np.save(tmp_path / "a.npy", records)
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy").points, POINTS[None])


@pytest.mark.parametrize("shape", [(3, 200), (3, 48, 64), (48, 64)])
def test_arrays_that_are_no_rows_of_points_are_refused_with_a_way_out(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.save(tmp_path / "a.npy", np.ones(shape))
    refused(r"transpose an array \(3, n\).*a depth image needs --info", read_npy, tmp_path / "a.npy")


def test_a_pcd_that_is_not_organised_is_read(tmp_path: Path) -> None:
    write_pcd(tmp_path / "a.pcd", Cloud(POINTS[None], RGB[None], None))
    read = read_pcd(tmp_path / "a.pcd")
    np.testing.assert_array_equal(read.points, POINTS[None])
    np.testing.assert_array_equal(read.rgb, RGB[None])


LENS = Intrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)


def view() -> np.ndarray:
    """A slanted plane with a step, organised, without some pixels."""
    v, u = np.mgrid[:60, :80]
    z = (0.8 + 0.002 * v + 0.1 * ((u > 30) & (u < 50))).astype(np.float32)
    z[RNG.random(z.shape) < 0.05] = np.nan
    return Deprojector(LIMITS).organised(z, LENS)


def strewn(points: np.ndarray) -> np.ndarray:
    """The points that were measured, (1, n, 3), in any order."""
    flat = points.reshape(-1, 3)
    flat = flat[np.isfinite(flat[:, 2])]
    return flat[RNG.permutation(len(flat))][None]


Write = Callable[[np.ndarray], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def to(points: np.ndarray) -> Path:
        rgb = np.zeros(points.shape, np.uint8)
        rgb[..., 0] = np.nan_to_num(np.clip(points[..., 2] * 100, 0, 255))  # the colour says which point it is of
        write_pcd(tmp_path / "a.pcd", Cloud(points.astype(np.float32), rgb, None))
        return tmp_path / "a.pcd"

    return to


def test_the_points_of_an_image_are_in_the_same_pixels_again(write: Write) -> None:
    points = view()
    read = read_cloud(write(strewn(points)), LIMITS)
    lens = read.frame.intrinsics
    assert (lens.width, lens.height) == (80, 60)
    assert (lens.fx, lens.cx, lens.cy) == pytest.approx((70.0, 39.5, 29.5), abs=1e-2)
    np.testing.assert_allclose(read.frame.points, points, atol=1e-5)
    assert "projected into one of 80x60" in read.note
    assert read.T_base_camera is None


def test_strewn_points_fill_an_image_without_holes(write: Write) -> None:
    """And each pixel has the nearest of its points, with its colour."""
    rays = RNG.uniform(-0.4, 0.4, (20_000, 2))
    z = np.where(RNG.random(20_000) < 0.5, 1.0, 2.0)
    read = read_cloud(write(np.column_stack([rays * z[:, None], z])[None]), LIMITS)
    depth = read.frame.points[..., 2]
    assert np.isnan(depth).mean() < 0.04
    assert 2000 < depth.size < 20_000
    assert np.nanmean(depth == 1.0) > 0.8  # of the few points of a pixel any is at 1 m
    assert read.frame.rgb is not None
    assert (read.frame.rgb[..., 0][depth == 1.0] == 100).all()
    assert (read.frame.rgb[..., 0][depth == 2.0] == 200).all()


@pytest.mark.parametrize("organised", [False, True])
def test_axes_and_unit_are_those_that_are_asked_for_and_others_are_named(write: Write, organised: bool) -> None:
    points = view() if organised else strewn(view())
    body = np.stack([points[..., 2], -points[..., 0], -points[..., 1]], axis=-1)
    plain = read_cloud(write(points), LIMITS).frame
    refused("x forward type --cloud-frame body", read_cloud, write(body), LIMITS)
    turned = read_cloud(write(body), LIMITS, axes="body").frame
    np.testing.assert_allclose(turned.points, plain.points, atol=1e-5)
    refused("with z forward type --cloud-frame optical", read_cloud, write(points), LIMITS, axes="body")
    refused("of millimetres type --unit mm", read_cloud, write(points * 1000.0), LIMITS)
    np.testing.assert_allclose(
        read_cloud(write(points * 1000.0), LIMITS, unit="mm").frame.points, plain.points, atol=1e-4
    )
    refused("type --unit m", read_cloud, write(points), LIMITS, unit="mm")


def test_a_cloud_with_z_up_is_seen_from_above(write: Write) -> None:
    x, y = np.meshgrid(np.arange(-0.4, 0.4, 0.005), np.arange(1.0, 1.6, 0.005))
    z = np.where((np.abs(x) < 0.1) & (np.abs(y - 1.3) < 0.1), 0.5, 0.4)
    flat = np.stack([x, y, z], axis=-1).reshape(1, -1, 3)
    refused("where z is up, and no camera at the origin, --cloud-frame base", read_cloud, write(flat), LIMITS)
    read = read_cloud(write(flat), LIMITS, axes="base")
    assert read.T_base_camera is not None
    again = read.frame.points.astype(np.float64) @ read.T_base_camera[:3, :3].T + read.T_base_camera[:3, 3]
    height = np.round(again[np.isfinite(again[..., 2]), 2], 4)
    assert set(height.tolist()) == {0.4, 0.5}
    top = again[np.isclose(again[..., 2], 0.5, atol=1e-4)]
    assert np.abs(top[:, :2] - (0.0, 1.3)).max() < 0.1 + 0.01
    like = read_cloud(write(flat + np.array([0.0, 0.0, 0.02])), LIMITS, axes="base", like=read)
    assert like.frame.points.shape == read.frame.points.shape


def test_a_point_in_the_camera_is_none(write: Write) -> None:
    """As drivers fill up organised clouds."""
    points = view()
    read = read_cloud(write(np.nan_to_num(points)), LIMITS)
    np.testing.assert_array_equal(read.frame.points, points)
    assert read.note == ""


def test_an_organised_cloud_of_no_pinhole_camera_is_projected(write: Write) -> None:
    """As of a lidar: a point per angle."""
    a, b = np.meshgrid(np.linspace(-0.9, 0.9, 120), np.linspace(-0.6, 0.6, 90))
    z = np.full(a.shape, 1.5)
    read = read_cloud(write(np.stack([np.tan(a) * z, np.tan(b) * z, z], axis=-1)), LIMITS)
    assert "the image of no pinhole camera" in read.note
    assert np.nanmax(np.abs(read.frame.points[..., 2] - 1.5)) < 1e-5
    assert read.frame.points.shape[:2] != a.shape


def test_other_files_are_named_with_a_way_out(tmp_path: Path, write: Write) -> None:
    refused(r"is a file \.las.*pdal translate a.las a.ply", read_cloud, tmp_path / "a.las", LIMITS)
    refused(r"is a mesh; sample points", read_cloud, tmp_path / "a.stl", LIMITS)
    refused(r"np.save\('a.npy', np.load\('a.npz'\)", read_cloud, tmp_path / "a.npz", LIMITS)
    refused(r"--unit cm, else --far 1\d\d", read_cloud, write(strewn(view()) * 100.0), LIMITS)
    read_cloud(write(strewn(view()) * 100.0), DepthLimits(near=0.1, far=200.0))
    far = write(strewn(view()) + np.array([5e5, 5e6, 200.0]))
    refused('pdal translate a.pcd a_near.ply .*"1 0 0 -5000.. 0 1 0 -5000000 0 0 1 -2', read_cloud, far, LIMITS)
    refused("at least 100", read_cloud, write(POINTS[None]), LIMITS)
    refused("can't be read|can't read", read_cloud, tmp_path / "none.ply", LIMITS)
    (tmp_path / "empty.ply").touch()
    refused("is empty", read_cloud, tmp_path / "empty.ply", LIMITS)


@pytest.mark.requirement("M-09")
def test_colours_of_16_bits_and_names_in_capitals_are_read(tmp_path: Path) -> None:
    """As of LAS files that were converted."""
    properties = [*((axis, "float") for axis in "XYZ"), *((name, "ushort") for name in ("Red", "Green", "Blue"))]
    file = Ply("binary_little_endian").element(
        "vertex",
        properties,
        [[*point, *(int(c) * 257 for c in color)] for point, color in zip(POINTS, RGB, strict=True)],
    )
    cloud = read_ply(file.write(tmp_path / "a.ply"))
    assert cloud.rgb is not None
    assert np.array_equal(cloud.rgb.reshape(-1, 3), RGB)
