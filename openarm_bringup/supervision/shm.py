# SPDX-License-Identifier: Apache-2.0
"""Shared memory in /dev/shm, of Fast DDS and of the suite: what a graph needs of it, and leaving nothing behind."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import NoReturn

from openarm_bringup.supervision.graph import Graph
from openarm_common.errors import Code, OpenArmError
from openarm_common.ports import in_domain, unicast

SHM = Path("/dev/shm")

#: MiB of /dev/shm that a participant takes in addition to its large segment, measured.
_PLAIN_MIB = 1.2
_LARGE_EXTRA_MIB = 2.2
#: Largest factor by which segments grow, and the share of the free space that a graph may then take.
_GROWTH, _SHARE = 4, 0.25

#: Argument of the image that a process ends with.
_LEAVE = "--leave"
#: Time after which a segment without a lock is not just being made, s.
_UNBORN_S = 5.0

_PORT = re.compile(r"fastrtps_port(\d+)")
#: Segments and ports of Fast DDS, and distance fields (`openarm_common.octree.distance_field.field_path`).
_SEGMENT = re.compile(r"fastrtps_[0-9a-f]{16}")
_OURS = re.compile(rf"{_SEGMENT.pattern}|{_PORT.pattern}|openarm_field_[A-Za-z0-9_.-]+")


def shm_need_mib(graph: Graph, extra_participants: int = 1) -> float:
    """Return how much of /dev/shm the graph and `extra_participants` (probe, clients) take, MiB."""
    need = extra_participants * _PLAIN_MIB
    for spec in graph.nodes.values():
        need += spec.shared_mib
        need += spec.segment_mib + _LARGE_EXTRA_MIB if spec.large_messages else _PLAIN_MIB
    return need


def shm_free_mib(path: Path = SHM) -> float:
    """Return the free space of /dev/shm, MiB."""
    return shutil.disk_usage(path).free / 2**20


def check_shm(graph: Graph, free_mib: float | None = None) -> None:
    """Refuse to start a graph whose images would be lost for lack of shared memory.

    Raises:
        OpenArmError: ENVIRONMENT, with both figures and what to do.
    """
    need, free = shm_need_mib(graph, extra_participants=4), shm_free_mib() if free_mib is None else free_mib
    if free >= need:
        return
    raise OpenArmError(
        Code.ENVIRONMENT,
        f"graph {graph.name} needs {need:.0f} MiB of {SHM}, {free:.0f} MiB are free; stop other graphs, remove what "
        "dead processes left (`fastdds shm clean`), give a container more (`--shm-size=256m`), or lower `segment_mib` "
        "in the graph",
    )


def clean_shm() -> str:
    """Remove the segments of dead processes (those in use are locked and stay); return the output of the tool."""
    env = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}"}
    tool = shutil.which("fastdds", path=env["PATH"])
    if tool is None:
        return "fastdds is not installed; segments of killed processes stay in /dev/shm"
    done = subprocess.run([tool, "shm", "clean"], env=env, capture_output=True, text=True, timeout=20, check=False)
    return " ".join((done.stdout + done.stderr).split())


def with_larger_segments(graph: Graph, free_mib: float | None = None) -> Graph:
    """Return the graph with larger segments where /dev/shm has space for them.

    A segment is how long a subscriber may be delayed before images are lost to it: a quarter of a second of two cameras
    in the least that a graph asks for. Fast DDS itself can take longer, when it meets many new participants.
    """
    free = shm_free_mib() if free_mib is None else free_mib
    times = min(_GROWTH, int(_SHARE * free / shm_need_mib(graph)))
    if times < 2:
        return graph
    nodes = {
        name: spec.model_copy(update={"segment_mib": times * spec.segment_mib}) if spec.large_messages else spec
        for name, spec in graph.nodes.items()
    }
    return graph.model_copy(update={"nodes": nodes})


def mapped_by(pid: int, shm: Path = SHM) -> set[str]:
    """Return the names of segments, ports and distance fields that a process has mapped; none when it has ended."""
    try:
        lines = Path(f"/proc/{pid}/maps").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return set()
    names = {line.rpartition("/")[2] for line in lines if f"{shm}/" in line}
    return {name for name in names if _OURS.fullmatch(name)}


def names_of(domain: int, shm: Path = SHM) -> set[str]:
    """Return the names of all that a graph in a ROS domain may have left in /dev/shm.

    These are the ports of Fast DDS, and distance fields; one that is not finished has a random suffix.
    """
    field = re.compile(rf"openarm_field_{domain}([a-z0-9_]{{8}})?")
    names = [entry.name for entry in shm.iterdir()]
    ports = {name for name in names if (port := _PORT.fullmatch(name)) and in_domain(int(port[1]), domain)}
    return ports | {name for name in names if field.fullmatch(name)}


def without_reader(domain: int, shm: Path = SHM) -> list[int]:
    """Return the UDP ports of participants whose ports in shared memory are there, and read by no process."""
    names = [name for name in names_of(domain, shm) if not _locked(shm / f"{name}_el")]
    ports = [int(port[1]) for name in names if (port := _PORT.fullmatch(name))]
    return [one for port in ports if unicast(port) for one in (port - 1, port)]


def unborn(shm: Path = SHM) -> list[str]:
    """Return the names of this user's segments that a full /dev/shm has kept from being made: they never got a lock."""
    return [path.name for path in shm.iterdir() if _SEGMENT.fullmatch(path.name) and _is_unborn(path)]


def _is_unborn(path: Path) -> bool:
    try:
        about = path.stat()
    except FileNotFoundError:
        return False
    old = time.time() - about.st_mtime > _UNBORN_S
    return old and about.st_uid == os.geteuid() and not path.with_name(f"{path.name}_el").exists()


def unused(names: Iterable[str], shm: Path = SHM) -> list[str]:
    """Return those of the named segments, ports and fields that exist and are no longer in use.

    In use is what is locked, or mapped by any visible process.
    """
    wanted = {name for name in names if (shm / name).exists()}
    if not wanted:
        return []
    pids = [int(entry) for entry in os.listdir("/proc") if entry.isdigit()]
    in_use: set[str] = set().union(*(mapped_by(pid, shm) for pid in pids))
    return [name for name in sorted(wanted - in_use) if not _locked(shm / f"{name}_el")]


def sweep(names: Iterable[str], shm: Path = SHM) -> list[str]:
    """Remove those of the named segments, ports and fields that are no longer in use; return them.

    A process that sends to one that has just died opens its port again, without the lock by which `fastdds shm clean`
    knows a port; such ports would stay for ever.
    """
    removed = unused(names, shm)
    _remove(removed, shm)
    return removed


def _remove(names: Iterable[str], shm: Path) -> None:
    for name in names:
        for part in (name, f"{name}_el", f"{name}_sl", f"sem.{name}_mutex"):
            (shm / part).unlink(missing_ok=True)


def discard(names: Iterable[str], shm: Path = SHM) -> list[str]:
    """Remove those of the named segments whose owner has died, for its successor to have room; return them."""
    dead = [n for n in sorted(names) if _SEGMENT.fullmatch(n) and (shm / n).exists() and not _locked(shm / f"{n}_el")]
    _remove(dead, shm)
    return dead


def leave(names: Iterable[str], code: int) -> NoReturn:
    """End this process with an exit code and remove what it had in /dev/shm; its participants stay until then.

    Fast DDS 2.14 can't always take a participant down: its event thread may wait for ever for the discovery data, which
    are held by a thread that removes an endpoint of another process and waits for the event thread; the interpreter
    then waits for both. A new image of the process has none of these threads.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.execv(sys.executable, [sys.executable, "-m", __name__, _LEAVE, str(code), *names])


def _locked(path: Path) -> bool:
    try:
        with path.open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except (BlockingIOError, PermissionError):
        return True
    return False


def main() -> None:
    """`python -m openarm_bringup.supervision.shm DOMAIN`: clean up after a graph whose supervisor is dead."""
    if sys.argv[1] == _LEAVE:
        os.closerange(3, os.sysconf("SC_OPEN_MAX"))  # locks of the image before
        sweep(sys.argv[3:])
        sys.exit(int(sys.argv[2]))
    clean_shm()
    sweep({*names_of(int(sys.argv[1])), *unborn()})


if __name__ == "__main__":
    main()
