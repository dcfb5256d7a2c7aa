# SPDX-License-Identifier: Apache-2.0
"""Frames from files: PCD, images, intrinsics, poses; hostile ones are refused in a sentence."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.lens import Lens
from openarm_common.errors import Code, OpenArmError
from openarm_perception.frames.cloud_fields import Cloud
from openarm_perception.frames.clouds import intrinsics_of
from openarm_perception.frames.images import is_depth, read_depth, read_frame, read_pose
from openarm_perception.frames.pcd import read_pcd, unpack_lzf, write_pcd
from openarm_perception.geometry.depth import Deprojector, DepthLimits
from tests.refusals import refused

LIMITS = DepthLimits(near=0.1, far=5.0)
LENS = Intrinsics(16, 12, 20.0, 21.0, 7.5, 5.0)


def cloud() -> Cloud:
    rng = np.random.default_rng(0)
    z = rng.uniform(0.5, 1.0, (12, 16)).astype(np.float32)
    z[2, 3] = np.nan
    rgb = rng.integers(0, 256, (12, 16, 3)).astype(np.uint8)
    label = rng.integers(0, 5, (12, 16))
    return Cloud(Deprojector(LIMITS).organised(z, LENS), rgb, label)


def pack_lzf(data: bytes) -> bytes:
    """Literal runs, and a reference to what was written before for each repeated eight bytes."""
    out, i = bytearray(), 0
    while i < len(data):
        before = data.rfind(data[i : i + 8], max(0, i - 4000), i + 7) if i >= 8 and len(data) - i >= 8 else -1
        if 0 <= before < i:
            offset = i - before - 1
            out += bytes([(6 << 5) | (offset >> 8), offset & 255])  # 6 + 2 bytes
            i += 8
        else:
            out += bytes([0, data[i]])
            i += 1
    return bytes(out)


def written(path: Path, form: str) -> Path:
    """The cloud in a form of PCD."""
    one = cloud()
    write_pcd(path, one)
    if form == "binary":
        return path
    data = path.read_bytes()
    begin = data.index(b"DATA binary\n") + len(b"DATA binary\n")
    head = data[:begin].replace(b"DATA binary\n", f"DATA {form}\n".encode())
    table = np.frombuffer(data[begin:], np.dtype([(n, "<f4") for n in "xyz"] + [("rgb", "<u4"), ("label", "<u4")]))
    if form == "ascii":
        rows = "\n".join(" ".join(repr(v.item()) for v in row) for row in table)
        path.write_bytes(b"# a comment\n" + head + rows.encode())
    else:
        raw = b"".join(table[name].tobytes() for name in table.dtype.names or ())
        packed = pack_lzf(raw)
        path.write_bytes(head + struct.pack("<II", len(packed), len(raw)) + packed)
    return path


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_every_form_of_pcd_is_read(tmp_path, form):
    one, read = cloud(), read_pcd(written(tmp_path / "a.pcd", form))
    assert np.array_equal(read.points, one.points, equal_nan=True)
    assert read.rgb is not None
    assert np.array_equal(read.rgb, one.rgb)
    assert np.array_equal(read.label, one.label)


def test_intrinsics_are_those_that_a_cloud_fits():
    z = np.random.default_rng(0).uniform(0.5, 2.0, (48, 64)).astype(np.float32)
    lens = Intrinsics(64, 48, 60.0, 61.0, 30.5, 25.0)
    points = Deprojector(LIMITS).organised(z, lens)
    found = intrinsics_of(points)
    assert (found.fx, found.fy, found.cx, found.cy) == pytest.approx((60.0, 61.0, 30.5, 25.0), abs=1e-3)
    refused("pinhole", intrinsics_of, np.random.default_rng(1).uniform(0.5, 1.0, (48, 64, 3)).astype(np.float32))
    refused("fewer than 100 points", intrinsics_of, np.full((48, 64, 3), np.nan, np.float32))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ((b"HEIGHT 12", b"HEIGHT 0"), "16 by 0 points"),
        ((b"HEIGHT 12", b"HEIGHT 999999999"), "at most"),
        ((b"HEIGHT 12", b"HEIGHT -12"), "whole numbers"),
        ((b"HEIGHT 12", b"HEIGHT 13"), "ends after"),
        ((b"FIELDS x y z", b"FIELDS a b c"), "x, y and z"),
        ((b"SIZE 4 4 4 4 4", b"SIZE 3 4 4 4 4"), "unknown type"),
        ((b"COUNT 1 1 1 1 1", b"COUNT 2 1 1 1 1"), "one each"),
        ((b"COUNT 1 1 1 1 1", b"COUNT 1 1"), "lengths"),
        ((b"DATA binary", b"DATA jpeg"), "ascii, binary"),
        ((b"DATA binary", b"DATA binary_compressed"), "expected"),
        ((b"DATA binary", b"DATA ascii"), "ends after"),
        ((b"DATA", b"DUTY"), "no line DATA"),
    ],
)
def test_other_pcd_files_are_refused(tmp_path, change, said):
    path = written(tmp_path / "a.pcd", "binary")
    data = path.read_bytes()
    assert change[0] in data
    path.write_bytes(data.replace(*change, 1))
    assert refused(said, read_pcd, path).code is Code.BAD_IMAGE


@given(st.binary(max_size=200), st.integers(0, 300))
@settings(max_examples=60, deadline=None)
def test_damaged_lzf_neither_reads_nor_writes_beyond(data, size):
    guarded = np.full(size + 16, 7, np.uint8)
    written_bytes = unpack_lzf(np.frombuffer(data, np.uint8), guarded[:size])
    assert -1 <= written_bytes <= size
    assert (guarded[size:] == 7).all()


@given(st.binary(min_size=8, max_size=300))
@settings(max_examples=30, deadline=None)
def test_lzf_comes_back(data):
    out = np.empty(len(data), np.uint8)
    assert unpack_lzf(np.frombuffer(pack_lzf(data), np.uint8), out) == len(data)
    assert out.tobytes() == data


def test_a_pose_is_a_pose(tmp_path):
    path = tmp_path / "pose"
    path.write_text("1 0 0 0.5\n0 -1 0 0\n0 0 -1 0.8\n0 0 0 1\n")
    assert read_pose(path)[:3, 3] == pytest.approx((0.5, 0.0, 0.8))
    path.write_text("1 0 0 512\n0 -1 0 -30\n0 0 -1 820\n0 0 0 1\n")
    refused("translation of 512 -30 820; .* where that is millimetres, write 0.512 -0.03 0.82 as its", read_pose, path)
    for text in (
        "1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n",
        "1 2 3 4\n" * 4,
        "a",
        "1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n",
    ):
        path.write_text(text)
        refused("four rows", read_pose, path)


def test_images_are_read_in_metres(tmp_path):
    z = np.full((12, 16), 6543, np.uint16)
    z[0, 0] = 0
    color = np.zeros((12, 16, 3), np.uint8)
    color[..., 2] = 200  # red, as OpenCV writes it
    cv2.imwrite(str(tmp_path / "z.png"), z)
    cv2.imwrite(str(tmp_path / "c.png"), color)
    (tmp_path / "k").write_text("fx: 20\nfy: 21\ncx: 7.5\ncy: 5")
    files = (tmp_path / "c.png", tmp_path / "z.png", tmp_path / "k")
    frame = read_frame(*files, 0.0001, LIMITS)
    assert np.isnan(frame.points[0, 0]).all()
    assert frame.points[5, 7, 2] == pytest.approx(0.6543)
    assert frame.rgb is not None
    assert frame.rgb[0, 0].tolist() == [200, 0, 0]
    for others, said in (
        ((files[1], files[1], files[2]), "a colour image; is it the depth"),
        ((files[0], files[0], files[2]), "one channel of 16 bits"),
        ((files[2], files[1], files[2]), "no image"),
        ((tmp_path / "none.png", files[1], files[2]), "can't be read"),
        ((tmp_path, files[1], files[2]), "can't be read"),
    ):
        refused(said, read_frame, *others, 0.0001, LIMITS)
    refused("depth scale", read_frame, *files, float("nan"), LIMITS)
    head = files[1].read_bytes()
    (tmp_path / "cut.png").write_bytes(head[: len(head) // 2])
    with pytest.raises(OpenArmError):
        read_frame(files[0], tmp_path / "cut.png", files[2], 0.001, LIMITS)
    huge = bytearray(head)
    huge[16:24] = struct.pack(">II", 60000, 60000)  # the size in the header, of which nothing is unpacked
    (tmp_path / "huge.png").write_bytes(bytes(huge))
    refused(r"60000x60000|no image", read_frame, files[0], tmp_path / "huge.png", files[2], 0.001, LIMITS)


@pytest.mark.requirement("M-02")
def test_depth_of_floats_is_in_metres_or_in_what_is_said(tmp_path):
    z = np.full((12, 16), 654.25, np.float32)
    cv2.imwrite(str(tmp_path / "z.tiff"), z)
    cv2.imwrite(str(tmp_path / "c.png"), np.zeros((12, 16), np.uint8))  # grey
    (tmp_path / "k").write_text("fx: 20\nfy: 21\ncx: 7.5\ncy: 5")
    files = (tmp_path / "c.png", tmp_path / "z.tiff", tmp_path / "k")
    assert read_frame(*files, 0.001, LIMITS).points[5, 7, 2] == pytest.approx(0.65425)
    assert read_frame(*files, None, DepthLimits(near=1.0, far=1000.0)).points[5, 7, 2] == pytest.approx(654.25)


@pytest.mark.parametrize("kind", ["<u2", ">u2", "<f2", "<f4", ">f8"])
@pytest.mark.requirement("M-02")
def test_an_array_is_a_depth_image(tmp_path, kind):
    z = np.full((12, 16), 0.75 if "f" in kind else 750, kind)
    np.save(tmp_path / "z.npy", z)
    assert is_depth(tmp_path / "z.npy")
    assert read_depth(tmp_path / "z.npy", Lens(LENS), None, LIMITS)[5, 7, 2] == pytest.approx(0.75)
    assert read_depth(tmp_path / "z.npy", Lens(LENS), 0.0005, DepthLimits(near=1e-5, far=5.0))[5, 7, 2] > 0.0


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (np.zeros((12, 16), np.int64), "1 channel.*int64; .* such as depth.astype"),
        (np.zeros((12, 16, 3), np.uint16), "3 channel"),
        (np.zeros((12, 15), np.uint16), "z.npy is 15x12 pixels, but .* are of 16x12"),
        (np.zeros((3, 2000, 2000), np.uint8), "pixels|channel"),
        (np.zeros(12), "has an array"),
        (np.array(["a"]), "has an array"),
    ],
)
def test_other_arrays_are_no_depth_images(tmp_path, array, said):
    np.save(tmp_path / "z.npy", array)
    assert refused(said, read_depth, tmp_path / "z.npy", Lens(LENS), None, LIMITS).code is Code.BAD_IMAGE
