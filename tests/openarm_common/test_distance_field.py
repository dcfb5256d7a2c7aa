# SPDX-License-Identifier: Apache-2.0
"""Distances shared between processes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_common.octree.distance_field import CameraMoment, DistanceFieldReader, DistanceFieldWriter
from openarm_common.octree.lattice import Lattice
from tests.refusals import refused, refuses

LATTICE = Lattice.from_bounds(0.02, (0.0, 0.0, 0.0), (0.2, 0.16, 0.12))
S = 1_000_000_000


def writer(path: Path) -> DistanceFieldWriter:
    return DistanceFieldWriter(path, LATTICE, 0.4, "base", ["overhead", "wrist"])


def publish(w: DistanceFieldWriter, value: float, now_ns: int, *cameras: str) -> int:
    w.begin()[...] = value
    return w.commit(7 * S, now_ns, {name: CameraMoment(6 * S, now_ns) for name in cameras})


def test_a_reader_sees_each_version_in_place(tmp_path: Path) -> None:
    """Everything that was written, without a copy; what is looked at is never half of the next."""
    w, reader = writer(tmp_path / "f"), DistanceFieldReader(tmp_path / "f")
    assert publish(w, 0.1, 5 * S, "overhead") == 1
    field = reader.latest()
    assert (field.version, field.t_ns, field.frame, field.lattice, field.reach) == (1, 7 * S, "base", LATTICE, 0.4)
    assert field.cameras == {"overhead": CameraMoment(6 * S, 5 * S), "wrist": CameraMoment(0, 0)}
    assert not field.distances.flags.writeable
    assert not field.distances.flags.owndata
    publish(w, 0.2, 6 * S, "wrist")
    assert reader.intact(field)
    assert (field.distances == np.float32(0.1)).all()
    newer = reader.latest()
    assert newer.version == 2
    assert newer.cameras["overhead"] == CameraMoment(6 * S, 5 * S)
    w.begin()
    assert not reader.intact(field)
    assert reader.intact(newer)


def test_another_process_reads_it(tmp_path: Path) -> None:
    w = writer(tmp_path / "f")
    w.begin()[...] = np.arange(LATTICE.cells, dtype=np.float32).reshape(LATTICE.shape)
    w.commit(1, 2, {})
    code = (
        "import sys; from pathlib import Path\n"
        "from openarm_common.octree.distance_field import DistanceFieldReader as R\n"
        "f = R(Path(sys.argv[1])).latest(); print(f.version, f.distances[3, 2, 1], f.lattice.shape)"
    )
    out = subprocess.run([sys.executable, "-c", code, str(tmp_path / "f")], capture_output=True, text=True, check=True)
    assert out.stdout.split(None, 2) == ["1", f"{3 * 48 + 2 * 6 + 1}.0", "(10, 8, 6)\n"]


def test_readers_wait_for_the_first_version_and_follow_a_new_writer(tmp_path: Path) -> None:
    path = tmp_path / "f"
    reader = DistanceFieldReader(path)
    refused("is the node octomap running", reader.latest)
    first = writer(path)
    refused("no version yet", reader.latest)
    publish(first, 0.1, S)
    old = reader.latest()
    second = writer(path)  # the first one was killed
    publish(second, 0.3, 2 * S)
    assert reader.latest().distances[0, 0, 0] == np.float32(0.3)
    assert old.distances[0, 0, 0] == np.float32(0.1)
    first.close()  # takes nothing away that belongs to the second
    assert path.exists()
    second.close()
    second.close()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.requirement("P-33")
def test_a_stale_field_or_camera_is_refused_by_name(tmp_path: Path) -> None:
    w, reader = writer(tmp_path / "f"), DistanceFieldReader(tmp_path / "f")
    publish(w, 0.1, 10 * S, "overhead")
    field = reader.latest()
    field.require_fresh(11 * S, 1.5, ["overhead"])
    refused("'wrist' has not contributed", field.require_fresh, 11 * S, 1.5)
    with refuses(Code.STALE_DATA, r"field is 2\.0 s old, expected at most 1\.5 s"):
        field.require_fresh(12 * S, 1.5)
    publish(w, 0.1, 14 * S, "wrist")
    refused(r"'overhead' last contributed to the map 4\.0 s ago", reader.latest().require_fresh, 14 * S, 1.5)


def test_points_and_spheres(tmp_path: Path) -> None:
    """A gap is never more than it is."""
    w, reader = writer(tmp_path / "f"), DistanceFieldReader(tmp_path / "f")
    centres = LATTICE.centres(np.argwhere(np.ones(LATTICE.shape, bool))).reshape(*LATTICE.shape, 3)
    obstacle = centres[2, 3, 4]
    w.begin()[...] = np.linalg.norm(centres - obstacle, axis=-1)
    w.commit(1, 1, {})
    field = reader.latest()
    np.testing.assert_allclose(
        field.at([obstacle, obstacle + np.array([0.04, 0, 0]), (9.0, 0, 0)]), [0.0, 0.04, 0.4], atol=1e-6
    )
    rng = np.random.default_rng(0)
    for _ in range(100):
        points, radii = rng.uniform(0.0, 0.12, (5, 3)), rng.uniform(0.0, 0.03, 5)
        outside = np.maximum(np.abs(points - obstacle) - 0.01, 0.0)  # of the occupied cell
        truth = (np.linalg.norm(outside, axis=1) - radii).min()
        gap = field.clearance(points, radii)
        assert truth - 2.1 * 0.02 * np.sqrt(3) <= gap <= truth + 1e-6
    assert field.clearance(np.array([[5.0, 5.0, 5.0]]), np.array([0.1])) == np.inf


def test_no_room_and_other_files_are_named(tmp_path: Path) -> None:
    huge = Lattice(0.02, (0, 0, 0), (40000, 40000, 40000))
    refused(r"a distance field of .* MiB can't be made", DistanceFieldWriter, tmp_path / "f", huge, 0.4, "base", [])
    refused("room for 8", DistanceFieldWriter, tmp_path / "f", LATTICE, 0.4, "base", [f"c{i}" for i in range(9)])
    assert list(tmp_path.iterdir()) == []
    for content in (b"", b"x", b"\0" * 8192):
        (tmp_path / "g").write_bytes(content)
        refused("NOT_READY", DistanceFieldReader(tmp_path / "g").latest)


@pytest.mark.requirement("R-23")
def test_a_field_of_another_user_or_that_others_may_write_is_refused_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "f"
    publish(writer(path), 0.1, 5 * S, "overhead")
    (tmp_path / "link").symlink_to(path)
    refused("can't be opened", DistanceFieldReader(tmp_path / "link").latest)
    refused(r"can't be opened|belongs to", DistanceFieldReader(tmp_path).latest)
    path.chmod(0o666)
    refused(r"-rw-rw-rw-.*only user", DistanceFieldReader(path).latest)
    path.chmod(0o600)
    assert DistanceFieldReader(path).latest().version == 1
    monkeypatch.setattr(os, "getuid", lambda: os.geteuid() + 1)
    with refuses(Code.ENVIRONMENT, f"belongs to user {os.geteuid()} .*only user {os.geteuid() + 1}"):
        DistanceFieldReader(path).latest()


@pytest.mark.parametrize(
    ("name", "value"),
    [("resolution", np.nan), ("reach", -1.0), ("shape", (10**6, 10**6, 10**6)), ("shape", (-1, 1, 1)), ("current", 7)],
)
def test_a_header_that_does_not_fit_the_file_is_refused(tmp_path: Path, name: str, value: object) -> None:
    path = tmp_path / "f"
    w = writer(path)
    publish(w, 0.1, 5 * S, "overhead")
    w._head[name] = value
    refused("is no distance field", DistanceFieldReader(path).latest)


def test_a_field_from_the_future_is_stale(tmp_path: Path) -> None:
    publish(writer(tmp_path / "f"), 0.1, 50 * S, "overhead", "wrist")
    with refuses(Code.STALE_DATA, r"45\.0 s in the future"):
        DistanceFieldReader(tmp_path / "f").latest().require_fresh(5 * S, 3.0)
