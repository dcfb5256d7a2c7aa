# SPDX-License-Identifier: Apache-2.0
"""Shared memory: unused segments are removed, used ones stay."""

from __future__ import annotations

import fcntl
import mmap
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from openarm_bringup.supervision.environment import node_arguments, node_environment, of_one_type, write_profile
from openarm_bringup.supervision.graph import Graph, NodeSpec
from openarm_bringup.supervision.shm import (
    mapped_by,
    names_of,
    shm_need_mib,
    sweep,
    unborn,
    unused,
    with_larger_segments,
    without_reader,
)
from openarm_common.domain import release_domain, reserve_domain


def make(folder: Path, name: str, *, lock: bool) -> Path:
    (folder / name).write_bytes(b"x" * 4096)
    (folder / f"sem.{name}_mutex").touch()
    if lock:
        (folder / f"{name}_el").touch()
    return folder / name


def test_sweep_removes_only_what_is_neither_mapped_nor_locked(tmp_path: Path) -> None:
    dead = make(tmp_path, "fastrtps_port7411", lock=False)
    zombie = make(tmp_path, "fastrtps_port7413", lock=True)
    locked = make(tmp_path, "fastrtps_port7415", lock=True)
    mapped = make(tmp_path, "fastrtps_0123456789abcdef", lock=False)
    stranger = make(tmp_path, "fastrtps_port9999", lock=False)
    with (
        (tmp_path / "fastrtps_port7415_el").open("rb") as lock,
        mapped.open("r+b") as file,
        mmap.mmap(file.fileno(), 4096),
    ):
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert mapped_by(os.getpid(), tmp_path) == {mapped.name}
        names = {*names_of(0, tmp_path), mapped.name, "fastrtps_port7599"}
        assert sweep(names, tmp_path) == [dead.name, zombie.name]
    assert sorted(p.name for p in tmp_path.iterdir() if not p.name.startswith("sem.")) == sorted(
        [locked.name, f"{locked.name}_el", mapped.name, stranger.name]
    )
    assert not (tmp_path / f"sem.{dead.name}_mutex").exists()


def test_ports_of_a_domain(tmp_path: Path) -> None:
    for port in (7400, 7649, 7650, 24161):
        make(tmp_path, f"fastrtps_port{port}", lock=False)
    assert names_of(0, tmp_path) == {"fastrtps_port7400", "fastrtps_port7649"}
    assert names_of(67, tmp_path) == {"fastrtps_port24161"}


def test_ports_that_no_process_reads_are_those_of_discovery_and_of_messages(tmp_path: Path) -> None:
    for name in ("fastrtps_port7400", "fastrtps_port7411", "fastrtps_port7413", "fastrtps_port7415"):
        make(tmp_path, name, lock=not name.endswith("3"))
    with (tmp_path / "fastrtps_port7415_el").open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert sorted(without_reader(0, tmp_path)) == [7410, 7411, 7412, 7413]


def test_the_distance_field_of_a_killed_map_goes_and_that_of_a_living_one_stays(tmp_path: Path) -> None:
    """Also one that was never finished; those of other domains and of tests are not touched."""
    dead = [make(tmp_path, f"openarm_field_4{rest}", lock=False).name for rest in ("", "ab_12xyz")]
    others = [make(tmp_path, f"openarm_field_{name}", lock=False).name for name in ("43", "4_of_a_test", "toy")]
    assert names_of(4, tmp_path) == set(dead)
    living = tmp_path / others[0]
    with living.open("r+b") as file, mmap.mmap(file.fileno(), 4096):
        assert mapped_by(os.getpid(), tmp_path) == {living.name}
        assert sweep(names_of(4, tmp_path) | names_of(43, tmp_path), tmp_path) == sorted(dead)
    assert sorted(p.name for p in tmp_path.glob("openarm_*")) == sorted(others)


def test_what_a_full_memory_has_kept_from_being_made_is_removed_and_what_is_being_made_is_not(tmp_path: Path) -> None:
    unborn_one, made, young = (make(tmp_path, f"fastrtps_{d * 16}", lock=d == "b") for d in "abc")
    port = make(tmp_path, "fastrtps_port7411", lock=False)
    for old in (unborn_one, made, port):
        os.utime(old, (1e9, 1e9))
    assert unborn(tmp_path) == [unborn_one.name]
    with unborn_one.open("r+b") as file, mmap.mmap(file.fileno(), 4096):
        assert sweep(unborn(tmp_path), tmp_path) == []
    assert sweep(unborn(tmp_path), tmp_path) == [unborn_one.name]
    assert young.exists()


def test_mapped_by_a_process_that_has_ended_is_nothing() -> None:
    assert mapped_by(2**22 + 1) == set()


@pytest.fixture
def graph() -> Graph:
    nodes = {
        "eye": NodeSpec(
            module="toy.eye", large_messages=True, segment_mib=8, shared_mib=5, params={"a.b": 1, "none": None}
        ),
        "arm": NodeSpec(command=("python", "arm.py"), remaps={"/a": "/b"}, env={"MODE": "slow"}),
    }
    return Graph(name="toy", domain=9, nodes=nodes)


def test_only_publishers_of_large_messages_get_the_large_segment(graph: Graph, tmp_path: Path) -> None:
    eye = node_environment(graph, "eye", tmp_path, {"ROS_LOCALHOST_ONLY": "1"})
    arm = node_environment(graph, "arm", tmp_path, {})
    profile = Path(eye["FASTRTPS_DEFAULT_PROFILES_FILE"]).read_text()
    assert re.search(r"<segment_size>8388608</segment_size>", profile)
    assert "<maxMessageSize>4194304</maxMessageSize>" in profile
    assert "segment_size" not in Path(arm["FASTRTPS_DEFAULT_PROFILES_FILE"]).read_text()
    assert all(
        "<leaseDuration><sec>4</sec>" in Path(env["FASTRTPS_DEFAULT_PROFILES_FILE"]).read_text() for env in (eye, arm)
    )
    own = node_environment(graph, "arm", tmp_path, {"FASTRTPS_DEFAULT_PROFILES_FILE": "/mine.xml"})
    assert own["FASTRTPS_DEFAULT_PROFILES_FILE"] == "/mine.xml"
    assert eye["ROS_DOMAIN_ID"] == arm["ROS_DOMAIN_ID"] == "9"
    assert eye["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    assert "ROS_LOCALHOST_ONLY" not in eye
    assert arm["MODE"] == "slow"
    assert shm_need_mib(graph) == pytest.approx(8 + 5 + 2.2 + 1.2 + 1.2)


def test_no_message_may_be_larger_than_its_segment(tmp_path: Path) -> None:
    """Fast DDS takes no shared memory at all then, and images are lost on the way through sockets."""
    for segment, largest in ((2, 2), (4, 4), (24, 4)):
        spec = NodeSpec(module="toy.eye", large_messages=True, segment_mib=segment)
        profile = write_profile(spec, tmp_path / f"{segment}.xml").read_text()
        sizes = [int(found) // 2**20 for found in re.findall(r"<(?:segment_size|maxMessageSize)>(\d+)", profile)]
        assert sizes == [segment, largest]


def test_segments_grow_where_there_is_room(graph: Graph) -> None:
    need = shm_need_mib(graph)
    sizes = [with_larger_segments(graph, times * 4 * need + 1).nodes["eye"].segment_mib for times in (0, 1, 2, 3, 9)]
    assert sizes == [8, 8, 16, 24, 32]
    assert with_larger_segments(graph, 1000 * need).nodes["arm"] == graph.nodes["arm"]


def test_command_line_of_a_node_carries_name_remaps_and_parameters(graph: Graph, tmp_path: Path) -> None:
    eye, arm = node_arguments(graph, "eye", tmp_path), node_arguments(graph, "arm", tmp_path)
    assert eye[1:3] == ["-m", "toy.eye"]
    assert "__node:=eye" in eye
    assert "/a:=/b" in arm
    assert "--params-file" not in arm
    written = Path(eye[eye.index("--params-file") + 1]).read_text()
    assert "a.b: 1" in written
    assert "none" not in written


#: A process that the interpreter would not end.
LEAVING = """
import os, threading
import rclpy
from openarm_bringup.supervision import shm

rclpy.init()
node = rclpy.create_node("leaving")
threading.Thread(target=threading.Event().wait).start()
print(*(left := shm.mapped_by(os.getpid())))
shm.leave(left, 3)
"""


@pytest.mark.long
@pytest.mark.requirement("P-34")
def test_a_process_whose_threads_hang_leaves_with_its_exit_code_and_nothing_of_it_stays() -> None:
    domain = reserve_domain()
    try:
        env = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
        done = subprocess.run(
            [sys.executable, "-c", LEAVING], env=env, capture_output=True, text=True, timeout=60, check=False
        )
    finally:
        release_domain(domain)
    assert done.returncode == 3, done.stderr
    names = done.stdout.split()
    assert len(names) >= 2
    assert unused(names) == []  # Fast DDS shares some ports with participants of other domains


@pytest.mark.parametrize(
    ("value", "written"),
    [
        ([0.0, 1, -2.5], "[0.0, 1.0, -2.5]"),
        ([1, 2], "[1, 2]"),
        (["a", 1], "['a', 1]"),
        ([True, False], "[True, False]"),
        (3, "3"),
    ],
)
def test_a_list_with_a_whole_number_among_others_is_of_one_type(value: object, written: str) -> None:
    """Of [0.0, 1] rcl says "sequence should be of same type", and the node does not start."""
    assert str(of_one_type(value)) == written
