# SPDX-License-Identifier: Apache-2.0
"""Octrees as bytes: hand-made trees, round trips, damage."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common.errors import OpenArmError
from openarm_common.octree.blocks import VoxelBlocks
from openarm_common.octree.codec import Payload, decode, encode_full, encode_states, read_file, write_file
from openarm_common.octree.lattice import Lattice
from tests.refusals import refused

LATTICE = Lattice.from_bounds(0.02, (-0.16, -0.16, -0.08), (0.16, 0.16, 0.24), align=8)


def full(log_odds: np.ndarray) -> Payload:
    """The full form of a box of log-odds."""
    blocks = VoxelBlocks(LATTICE)
    index = np.argwhere(~np.isnan(log_odds))
    cells = np.column_stack([np.zeros(len(index)), index + LATTICE.key_min]).astype(np.int32)
    blocks.paint(cells, log_odds[tuple(index.T)])
    return encode_full(blocks)


def states_of(seed: int) -> np.ndarray:
    """Random states with whole blocks of one kind, so that there is something to merge."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 3, tuple(n // 4 for n in LATTICE.shape)).astype(np.uint8)
    states = np.kron(coarse, np.ones((4, 4, 4), np.uint8))
    some = rng.random(states.shape) < rng.choice([0.0, 0.05, 0.5])
    states[some] = rng.integers(0, 3, np.count_nonzero(some))
    return states


@pytest.mark.requirement("A-57")
def test_one_voxel_is_thirty_two_bytes() -> None:
    """Sixteen inner nodes of two bytes; the voxel at (0, 0, 0) is child 7 of the root and child 0 from there on."""
    states = np.zeros(LATTICE.shape, np.uint8)
    states[8, 8, 8] = 2
    payload = encode_states(LATTICE, states)
    assert payload.nodes == 17
    assert payload.data.tobytes() == b"\x00\xc0" + b"\x03\x00" * 14 + b"\x02\x00"
    states[8, 8, 8] = 1
    assert encode_states(LATTICE, states).data.tobytes()[-2:] == b"\x01\x00"


def test_an_empty_map_has_no_bytes() -> None:
    """Readers remove the map then."""
    assert encode_states(LATTICE, np.zeros(LATTICE.shape, np.uint8)).data.size == 0
    assert full(np.full(LATTICE.shape, np.nan, np.float32)).data.size == 0
    values, outside = decode(b"", 0.02, binary=True).on(LATTICE)
    assert outside == 0
    assert np.isnan(values).all()


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
@pytest.mark.requirement("A-57")
def test_binary_round_trip(seed: int) -> None:
    states = states_of(seed)
    leaves = decode(encode_states(LATTICE, states).data, 0.02, binary=True)
    values, outside = leaves.on(LATTICE)
    assert outside == 0
    np.testing.assert_array_equal(np.where(np.isnan(values), 0, np.where(values > 0, 2, 1)), states)


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
@pytest.mark.requirement("A-57")
def test_full_round_trip(seed: int) -> None:
    rng = np.random.default_rng(seed)
    levels = np.array([np.nan, -2.0, -0.405, 0.442, 3.5], np.float32)
    log_odds = levels[(states_of(seed) + rng.integers(0, 3)) % 5]
    values, outside = decode(full(log_odds).data, 0.02, binary=False).on(LATTICE)
    assert outside == 0
    np.testing.assert_array_equal(values, log_odds)


def test_what_lies_outside_of_a_box_is_counted() -> None:
    states = np.ones(LATTICE.shape, np.uint8)
    leaves = decode(encode_states(LATTICE, states).data, 0.02, binary=True)
    half = Lattice(0.02, LATTICE.key_min, (8, 16, 16))
    values, outside = leaves.on(half)
    assert outside > 0
    assert not np.isnan(values).any()
    refused(r"cells of 0\.02 m, expected 0\.04 m", leaves.on, half.coarser(1))


@settings(max_examples=100)
@given(st.binary(max_size=400), st.booleans())
def test_random_bytes_are_read_or_refused_never_worse(data: bytes, binary: bool) -> None:
    try:
        leaves = decode(data, 0.02, binary=binary)
    except OpenArmError as error:
        assert "octree is damaged" in error.message  # noqa: PT017
    else:
        assert np.isfinite(leaves.arrays()[1]).all()


HEAD = b"# Octomap OcTree binary file\nid OcTree\nsize 17\nres 0.02\ndata\n"


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "not an octree file"),
        (b"P5\n640 480\ndata\n", "not an octree file"),
        (b"\x1f\x8b\x08" + HEAD, "not an octree file.*; unpack it: gunzip"),
        (HEAD[:-5], "not an octree file"),
        (
            HEAD.replace(b" binary", b"").replace(b"id OcTree", b"id CountingOcTree"),
            "'CountingOcTree', expected one of",
        ),
        (HEAD.replace(b" binary", b"").replace(b"id OcTree", b"id ColorOcTree") + b"\0" * 7, "ends after 7 bytes"),
        (HEAD.replace(b"res 0.02", b"res 0"), "res is 0"),
        (HEAD.replace(b"res 0.02", b"res nan"), "res is nan"),
        (HEAD.replace(b"res 0.02\n", b""), "a line such as 'res 0.05'"),
        (HEAD.replace(b"size 17", b"size many"), "header needs"),
        (struct.pack("<idI", 3, -0.02, 1), "res is -0.02"),
        (struct.pack("<idI", 3, 0.02, 3) + b"\x02\x00", "has 2 nodes, its header says 3"),
        (struct.pack("<idI", 4, 0.02, 2) + b"\x02\x00", "not an octree file"),
        (HEAD + b"\x00", "ends after 1 bytes"),
        (HEAD + b"\x00\xc0" + b"\x03\x00" * 14 + b"\x02\x00\x00", "goes on for 1 bytes after the tree's end"),
        (HEAD + b"\x03\x00" * 16, "deeper than 16"),
        (HEAD + b"\x02\x00", "has 2 nodes, its header says 17"),
    ],
)
def test_files_that_are_none_are_refused_with_the_reason(content: bytes, text: str, tmp_path: Path) -> None:
    path = tmp_path / "x.bt"
    path.write_bytes(content)
    refused(text, read_file, path)


def test_missing_files_and_wrong_suffixes_are_named(tmp_path: Path) -> None:
    refused("can't be read", read_file, tmp_path / "none.bt")
    payload = encode_states(LATTICE, states_of(1))
    refused(r"needs the suffix \.bt", write_file, tmp_path / "map.ot", payload, 0.02)
    refused("can't be written", write_file, tmp_path / "no" / "folder" / "map.bt", payload, 0.02)
    assert list(tmp_path.iterdir()) == []


def test_a_box_of_blocks_begins_and_ends_between_blocks() -> None:
    for key, n in ((4, 8), (8, 12)):
        refused("multiples of 8", VoxelBlocks, Lattice(0.02, (key, 0, 0), (n, 8, 8)))


@pytest.mark.parametrize("robot", ["openarm_v1", "Röbel 2"])
def test_a_file_says_in_a_comment_of_which_robot_it_is(tmp_path: Path, robot: str) -> None:
    payload = encode_states(LATTICE, states_of(1))
    write_file(tmp_path / "with.bt", payload, 0.02, robot)
    write_file(tmp_path / "without.bt", payload, 0.02)
    said, silent = (read_file(tmp_path / f"{name}.bt") for name in ("with", "without"))
    assert (said.robot, silent.robot) == (robot, "")
    assert said.raw.tobytes() == silent.raw.tobytes()
    lines = (tmp_path / "with.bt").read_bytes().partition(b"data\n")[0].decode().splitlines()
    assert lines[0] == "# Octomap OcTree binary file"  # all that readers require of comments
    assert [line for line in lines if not line.startswith("#")] == ["id OcTree", f"size {payload.nodes}", "res 0.02"]


#: A tree of the full form: child 1 of the root is a leaf of log-odds 2.5, child 7 an inner node with a leaf of -1.5.
FULL = ((2.5, (1, 7)), (2.5, ()), (-1.5, (0,)), (-1.5, ()))


@pytest.mark.parametrize(("tree", "extra"), [("OcTree", 0), ("1", 0), ("OcTreeStamped", 0), ("ColorOcTree", 3)])
def test_the_full_form_of_other_classes_is_read_for_its_occupancy(tree: str, extra: int) -> None:
    """ColorOcTreeNode::writeData puts three bytes of colour after the log-odds; OcTreeNodeStamped writes no time."""
    nodes = [
        struct.pack("<f", value) + bytes(range(200, 200 + extra)) + bytes([sum(1 << c for c in children)])
        for value, children in FULL
    ]
    leaves = decode(b"".join(nodes), 0.02, binary=False, tree=tree)
    cells, values = leaves.arrays()
    assert (leaves.nodes, leaves.tree) == (4, tree)
    assert {(*map(int, cell), value) for cell, value in zip(cells, values.tolist(), strict=True)} == {
        (15, 1, 0, 0, 2.5),
        (14, 2, 2, 2, -1.5),
    }


ONE = b"\x00\xc0" + b"\x03\x00" * 14 + b"\x02\x00"


@pytest.mark.parametrize(
    "head",
    [
        HEAD,
        HEAD.replace(b"\n", b"\r\n"),
        HEAD.replace(b"size 17\n", b""),
        HEAD.replace(b"id OcTree\n", b"id SemanticOcTree\n"),
        b"# Octomap OcTree binary file, of a robot\nres 0.02 size 17\n# data\ndate today\n\n  id\tOcTree\n data \n",
        struct.pack("<idI", 3, 0.02, 17),
    ],
)
def test_headers_of_other_programs_are_read(head: bytes, tmp_path: Path) -> None:
    """Keys in any order, with comments and unknown ones as octomap skips them; and the first form, without text."""
    (tmp_path / "x.bt").write_bytes(head + ONE)
    leaves = read_file(tmp_path / "x.bt")
    assert (leaves.resolution, leaves.nodes) == (0.02, 17)
    assert leaves.arrays()[0].tolist() == [[0, 32768, 32768, 32768]]
