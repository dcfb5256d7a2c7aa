# SPDX-License-Identifier: Apache-2.0
"""The map: equal to liboctomap's, and quicker to clear."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code
from openarm_common.octree.codec import read_file, write_file
from openarm_common.robot.description import RobotDescription
from openarm_octomap.config import FieldConfig, FilterConfig, GridConfig
from openarm_octomap.grid import CloudScan, DepthScan, OccupancyGrid
from openarm_octomap.kernels import FREE, OCCUPIED, UNKNOWN
from openarm_octomap.mapper import Frame, Mapper
from tests.refusals import refused

K = Intrinsics.from_fovy(64, 48, 60.0)
#: Looks down from 1 m onto z = 0.
DOWN = se3.make(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 1.0))
SMALL = {"lower": (-0.4, -0.4, -0.08), "upper": (0.4, 0.4, 0.4)}


def liboctomap(**changes) -> GridConfig:
    """Log-odds and limits as liboctomap counts them, in float32; no view into the distance."""
    f = np.float32
    numbers = {
        "hit": float(f(math.log(0.7 / 0.3))),
        "miss": float(f(math.log(0.4 / 0.6))),
        "clamp_min": float(f(math.log(0.1192 / 0.8808))),
        "clamp_max": float(f(math.log(0.971 / 0.029))),
    }
    box = {"lower": (-1.6, -1.6, -1.6), "upper": (1.6, 1.6, 1.6)}
    return GridConfig(**(numbers | box | {"max_range": -1.0, "clear_without_return": False} | changes))


def scan(depth, T=DOWN, near=0.2, far=3.0, label=None, intrinsics=K) -> DepthScan:
    return DepthScan(depth, intrinsics, T, near, far, label)


def floor(millimetres: int = 990, **patches) -> np.ndarray:
    """A wall at one depth; `patch=(rows, columns, mm)`."""
    depth = np.full((48, 64), millimetres, np.uint16)
    for rows, columns, value in patches.values():
        depth[rows, columns] = value
    return depth


@pytest.fixture(scope="module")
def accumulated(reference) -> OccupancyGrid:
    """The ten frames of the reference."""
    grid = OccupancyGrid(liboctomap())
    k = Intrinsics(reference.WIDTH, reference.HEIGHT, reference.FOCAL, reference.FOCAL, 15.5, 11.5)
    for i, (depth, T) in enumerate(reference.frames()):
        image = DepthScan(depth, k, T, 0.05, 10.0)
        np.testing.assert_array_equal(image.points(), reference.points(depth, T))
        grid.integrate([image], i * 500_000_000)
    return grid


@pytest.mark.requirement("A-55", "A-56")
def test_cells_equal_liboctomap_after_ten_frames_with_clearing(accumulated, reference) -> None:
    """Voxel for voxel; cells that an early frame marked are free in the end."""
    theirs, outside = read_file(reference.data / "reference.bt").on(accumulated.lattice)
    assert outside == 0
    states = np.where(np.isnan(theirs), UNKNOWN, np.where(theirs > 0, OCCUPIED, FREE))
    assert np.count_nonzero(states == OCCUPIED) > 4000
    np.testing.assert_array_equal(accumulated.blocks.states(), states)


@pytest.mark.requirement("A-57")
def test_binary_file_equals_liboctomap_byte_for_byte(accumulated, reference, tmp_path) -> None:
    write_file(tmp_path / "map.bt", accumulated.binary(), 0.02)
    assert (tmp_path / "map.bt").read_bytes() == (reference.data / "reference.bt").read_bytes()


@pytest.mark.requirement("A-57")
def test_full_file_equals_liboctomap_byte_for_byte(accumulated, reference, tmp_path) -> None:
    """All log-odds are the same floats then."""
    write_file(tmp_path / "map.ot", accumulated.full(), 0.02)
    digest = hashlib.sha256((tmp_path / "map.ot").read_bytes()).hexdigest()
    assert digest == (reference.data / "reference.ot.sha256").read_text().strip()


def test_a_smaller_workspace_holds_the_same_cells_also_with_the_camera_outside(accumulated, reference) -> None:
    """The box cuts cells off; it changes none of those inside."""
    box = {"lower": (0.16, -0.4, 0.16), "upper": (0.8, 0.4, 0.64)}  # no camera of the reference is in it
    small = OccupancyGrid(liboctomap(**box))
    k = Intrinsics(reference.WIDTH, reference.HEIGHT, reference.FOCAL, reference.FOCAL, 15.5, 11.5)
    for i, (depth, T) in enumerate(reference.frames()):
        small.integrate([DepthScan(depth, k, T, 0.05, 10.0)], i)
    first = np.array(small.lattice.key_min) - accumulated.lattice.key_min
    cut = tuple(slice(a, a + n) for a, n in zip(first, small.lattice.shape, strict=True))
    assert small.counts()["occupied"] > 200
    np.testing.assert_array_equal(small.blocks.log_odds(), accumulated.blocks.log_odds()[cut])


def test_a_cloud_gives_the_same_map_as_its_image(accumulated, reference) -> None:
    grid = OccupancyGrid(liboctomap())
    for i, (depth, T) in enumerate(reference.frames()):
        grid.integrate([CloudScan(reference.points(depth, T), T[:3, 3])], i)
    np.testing.assert_array_equal(grid.blocks.log_odds(), accumulated.blocks.log_odds())


@pytest.fixture
def grid() -> OccupancyGrid:
    return OccupancyGrid(GridConfig(**SMALL))


@pytest.mark.requirement("A-55", "A-56")
def test_what_arrives_is_marked_and_what_leaves_is_cleared_in_one_frame_each(grid: OccupancyGrid) -> None:
    """Also after it stood there for a minute: clearing is as quick as marking."""
    empty, box = floor(), floor(box=(slice(20, 28), slice(28, 36), 890))
    at = [(0.0, 0.0, 0.11)]
    for i in range(120):
        grid.integrate([scan(empty)], i)
    assert grid.states_at(at) == [FREE]
    grid.integrate([scan(box)], 120)
    assert grid.states_at(at) == [OCCUPIED]
    for i in range(120):
        grid.integrate([scan(box)], 121 + i)
    grid.integrate([scan(empty)], 300)
    assert grid.states_at(at) == [FREE]


@pytest.mark.parametrize(("mark", "clear"), [(1, 1), (2, 3), (4, 2)])
def test_frames_to_mark_and_to_clear_are_what_they_say(mark: int, clear: int) -> None:
    grid = OccupancyGrid(GridConfig(frames_to_mark=mark, frames_to_clear=clear, **SMALL))
    empty, box = floor(), floor(box=(slice(20, 28), slice(28, 36), 890))
    for i in range(20):
        grid.integrate([scan(empty)], i)

    def frames_until(image, state) -> int:
        for n in range(1, 30):
            grid.integrate([scan(image)], 100)
            if grid.states_at([(0.0, 0.0, 0.11)]) == [state]:
                return n
        raise AssertionError("never")

    assert frames_until(box, OCCUPIED) == mark
    for _ in range(30):
        grid.integrate([scan(box)], 100)
    assert frames_until(empty, FREE) == clear


def test_two_cameras_in_one_update_a_hit_of_either_counts(grid: OccupancyGrid) -> None:
    """One looks past the box, the other at it."""
    both = [scan(floor(box=(slice(20, 28), slice(28, 36), 890))), scan(floor())]
    for order in (both, both[::-1]):
        grid.reset()
        grid.integrate(order, 0)
        assert grid.states_at([(0.0, 0.0, 0.11)]) == [OCCUPIED]


def test_views_into_the_distance_clear_and_a_switch_keeps_them_from_it() -> None:
    """No surface behind is needed; single dropouts clear nothing."""
    seen = floor(box=(slice(20, 28), slice(28, 36), 890))
    for switch, state in ((True, FREE), (False, OCCUPIED)):
        grid = OccupancyGrid(GridConfig(clear_without_return=switch, **SMALL))
        grid.integrate([scan(seen)], 0)
        grid.integrate([scan(np.zeros((48, 64), np.uint16))], 1)
        assert grid.states_at([(0.0, 0.0, 0.11)]) == [state]
    grid = OccupancyGrid(GridConfig(**SMALL))
    dropouts = floor()
    dropouts[::2, ::2] = 0
    assert grid.integrate([scan(dropouts)], 0).cleared == 0


def test_robot_pixels_clear_up_to_the_robot_and_mark_nothing(grid: OccupancyGrid) -> None:
    patch = (slice(20, 28), slice(28, 36))
    label = np.zeros((48, 64), np.uint8)
    label[patch] = 1
    grid.integrate([scan(floor(arm=(*patch, 790)), label=label)], 0)
    assert grid.states_at([(0.0, 0.0, 0.31), (0.0, 0.0, 0.21), (0.0, 0.0, 0.11)]).tolist() == [FREE, UNKNOWN, UNKNOWN]
    # where nothing is known of a view, it neither marks nor clears
    label[...] = 2
    before = grid.blocks.log_odds()
    grid.integrate([scan(floor(), label=label), scan(np.zeros((48, 64), np.uint16), label=label)], 1)
    np.testing.assert_array_equal(grid.blocks.log_odds(), before)


@pytest.mark.requirement("P-06")
def test_boxes_are_cleared_to_free_or_to_unknown_and_bad_ones_are_refused(grid: OccupancyGrid) -> None:
    grid.integrate([scan(floor(box=(slice(20, 28), slice(28, 36), 890)))], 0)
    point = [(0.0, 0.0, 0.11)]
    grid.clear_box((-0.05, -0.05, 0.05), (0.05, 0.05, 0.2))
    assert grid.states_at(point) == [FREE]
    grid.clear_box((-0.05, -0.05, 0.05), (0.05, 0.05, 0.2), UNKNOWN)
    assert grid.states_at(point) == [UNKNOWN]
    assert grid.clear_box((5, 5, 5), (6, 6, 6)) == 0
    refused("lower one first", grid.clear_box, (0, 0, 0), (1, -1, 1))
    refused("finite", grid.clear_box, (0, 0, 0), (1, math.inf, 1))


@pytest.mark.requirement("A-75")
def test_coarse_queries_keep_what_is_occupied(grid: OccupancyGrid) -> None:
    """A cell of 4, 8, 16 cm is occupied when a part of it is; centres lie on OctoMap's lattice of that edge."""
    grid.integrate([scan(floor(box=(slice(20, 28), slice(28, 36), 890)))], 0)
    fine = grid.lattice.centres(np.argwhere(grid.blocks.states() == OCCUPIED))
    for depth in (16, 15, 14, 13):
        lattice, states = grid.coarse(depth)
        assert lattice.resolution == pytest.approx(0.02 * 2 ** (16 - depth))
        assert states.shape == lattice.shape
        assert (grid.states_at(fine, depth) == OCCUPIED).all()
        cells = {tuple(c) for c in lattice.indices(fine)}
        assert len(cells) == np.count_nonzero(states == OCCUPIED)


def test_each_query_says_what_unknown_counts_as() -> None:
    mapper = Mapper(RobotDescription.load(), GridConfig(**SMALL), FilterConfig(enabled=False), FieldConfig())
    mapper.update([Frame("overhead", 0, scan(floor(box=(slice(20, 28), slice(28, 36), 890))), {})])
    occupied, free, unknown = (0.0, 0.0, 0.11), (0.0, 0.0, 0.3), (0.0, 0.0, -0.03)
    assert mapper.query([occupied, free, unknown], 0.0, "occupied").blocked.tolist() == [True, False, True]
    assert mapper.query([occupied, free, unknown], 0.0, "free").blocked.tolist() == [True, False, False]
    assert mapper.query([free], 64 * 0.02, "free").blocked.tolist() == [True]  # the coarse cell holds the box


def test_frames_from_before_a_reset_are_left_out() -> None:
    """Of an update that is overtaken by the reset; later ones are put into the map."""
    mapper = Mapper(RobotDescription.load(), GridConfig(**SMALL), FilterConfig(enabled=False), FieldConfig())
    frames, edition = [Frame("overhead", 0, scan(floor()), {})], mapper.edition
    mapper.reset()
    report = mapper.update(frames, edition=edition)
    assert (report.outdated, mapper.counts(0)["occupied"]) == (True, 0)
    report = mapper.update(frames, edition=mapper.edition)
    assert not report.outdated
    assert mapper.counts(0)["occupied"] > 0


def test_decay_forgets_what_was_not_observed() -> None:
    grid = OccupancyGrid(GridConfig(decay_s=2.0, **SMALL))
    s = 1_000_000_000
    grid.integrate([scan(floor(box=(slice(20, 28), slice(28, 36), 890)))], 5 * s)
    assert grid.decay(6 * s).size == 0
    assert grid.oldest_s(6 * s) == pytest.approx(1.0)
    # an occluded view: everything behind the hand at 30 cm is not seen any more
    grid.integrate([scan(floor(300))], 7 * s)
    occupied = grid.counts()["occupied"]
    assert grid.decay(int(7.5 * s)).size == occupied > 0
    assert grid.counts()["occupied"] == 0


def test_load_replaces_the_map(tmp_path) -> None:
    saved, grid = OccupancyGrid(liboctomap(**SMALL)), OccupancyGrid(liboctomap(**SMALL))
    saved.integrate([scan(floor(box=(slice(20, 28), slice(28, 36), 890)))], 0)
    grid.clear_box((-0.1, -0.1, 0.2), (0.1, 0.1, 0.3), OCCUPIED)
    write_file(tmp_path / "map.ot", saved.full(), 0.02)
    assert grid.load(read_file(tmp_path / "map.ot")) == 0
    assert grid.counts()["occupied"] > 0
    np.testing.assert_array_equal(grid.blocks.log_odds(), saved.blocks.log_odds())
    np.testing.assert_array_equal(grid.blocks.states(), saved.blocks.states())


@pytest.mark.parametrize(
    ("depth", "intrinsics", "T", "code"),
    [
        (np.zeros((48, 64), np.uint8), K, DOWN, Code.BAD_IMAGE),
        (np.zeros((1, 1), np.uint16), K, DOWN, Code.BAD_IMAGE),
        (np.zeros((48, 64, 1), np.uint16), K, DOWN, Code.BAD_IMAGE),
        (np.zeros((48, 64), np.uint16), Intrinsics(64, 48, 0.0, 0.0, 31.5, 23.5), DOWN, Code.BAD_IMAGE),
        (np.zeros((48, 64), np.uint16), K, DOWN * np.nan, Code.NO_TRANSFORM),
    ],
)
@pytest.mark.requirement("B-30")
def test_scans_that_do_not_fit_are_refused_by_name(depth, intrinsics, T, code) -> None:
    assert refused(None, DepthScan, depth, intrinsics, T, 0.2, 3.0).code is code


@settings(max_examples=30)
@given(st.data())
@pytest.mark.requirement("B-28")
def test_no_image_harms_the_map(data) -> None:
    """NaN, infinities, zeros, huge and negative depths, 1×1: states stay states, log-odds stay in their limits."""
    h, w = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 9))
    value = st.one_of(st.sampled_from([0.0, math.nan, math.inf, -math.inf, -1.0, 1e30, 1e-30]), st.floats(width=32))
    depth = np.array(data.draw(st.lists(value, min_size=h * w, max_size=h * w)), np.float32).reshape(h, w)
    f = data.draw(st.sampled_from([1e-3, 1.0, 50.0, 1e6]))
    p = [data.draw(st.sampled_from([0.0, 0.3, -5.0, 900.0])) for _ in range(3)]
    grid = GRID
    grid.integrate([scan(depth, se3.make(None, p), intrinsics=Intrinsics(w, h, f, f, 0.0, 0.0))], 0)
    known = np.isfinite(grid.blocks.log_odds())
    assert np.abs(grid.blocks.log_odds()[known]).max(initial=0.0) <= 2.0
    np.testing.assert_array_equal(grid.blocks.states() == UNKNOWN, ~known)
    assert not np.any([grid._through, grid._hits])
    assert (grid._table == -1).all()


GRID = OccupancyGrid(GridConfig(lower=(-0.2, -0.2, -0.2), upper=(0.2, 0.2, 0.2)))


def test_points_that_are_not_finite_mark_nothing(grid: OccupancyGrid) -> None:
    """A NaN is no voxel at the base of the robot."""
    points = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [1e9, 0, 0]], np.float32)
    update = grid.integrate([CloudScan(points, np.array([0.1, 0.0, 0.3]))], 0)
    assert (update.valid, update.ends, grid.counts()["occupied"]) == (0, 0, 0)


@pytest.mark.long
def test_a_map_of_another_robot_is_refused_and_leaves_the_map_as_it_was(tmp_path, nearer) -> None:
    other, mine = (
        Mapper(RobotDescription.load(name), GridConfig(**SMALL), FilterConfig(enabled=False), FieldConfig())
        for name in ("openarm_v1", nearer)
    )
    other.clear_box((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1), OCCUPIED)
    nodes = other.save(tmp_path / "map.ot")
    assert other.load(tmp_path / "map.ot").nodes == nodes
    refused(r"map\.ot is of robot 'openarm_v1', expected 'nearer'", mine.load, tmp_path / "map.ot")
    assert not np.any(mine.snapshot({"states"}).states == OCCUPIED)
    text = (tmp_path / "map.ot").read_bytes().replace(b"# robot openarm_v1\n", b"")
    (tmp_path / "foreign.ot").write_bytes(text)  # as other programs write it
    assert mine.load(tmp_path / "foreign.ot").nodes == nodes


@pytest.mark.parametrize("line", (Path(__file__).parent / "data/resampled.sha256").read_text().splitlines())
def test_a_map_of_other_cells_is_what_liboctomap_says_of_all_of_their_parts(reference, line: str) -> None:
    edge, digest = line.split()
    half = reference.CELLS / 2 * int(edge) * 1e-3
    grid = OccupancyGrid(GridConfig(resolution=int(edge) * 1e-3, lower=(-half,) * 3, upper=(half,) * 3))
    grid.load(read_file(reference.data / "reference.bt"))
    assert hashlib.sha256(grid.blocks.states().tobytes()).hexdigest() == digest
