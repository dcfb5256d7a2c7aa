# SPDX-License-Identifier: Apache-2.0
"""The peer of the map: the same clouds in liboctomap, by the program liboctomap_peer.cpp."""

from __future__ import annotations

import shutil
import subprocess
import sysconfig
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from openarm_common.types import Array, Floats

#: liboctomap's numbers, so that its map and ours can be compared cell by cell.
THEIRS = {
    "hit": float(np.float32(np.log(0.7 / 0.3))),
    "miss": float(np.float32(np.log(0.4 / 0.6))),
    "clamp_min": float(np.float32(np.log(0.1192 / 0.8808))),
    "clamp_max": float(np.float32(np.log(0.971 / 0.029))),
    "max_range": -1.0,
    "clear_without_return": False,
}


@dataclass(frozen=True)
class Peer:
    """What liboctomap did.

    Attributes:
        ms: CPU time of insertion and encoding together, ms.
        memory_mb: Of its tree in the end, as it says itself, MB.
        map: .bt file.
    """

    ms: float
    memory_mb: float
    map: Path


def insert(clouds: Sequence[tuple[Floats, Array]], folder: Path, resolution: float, every: int) -> Peer | None:
    """Insert clouds with liboctomap; None where it can't be compiled.

    Args:
        clouds: Points (n, 3) and the origin (3,) of their rays, m.
        folder: For its files.
        resolution: Edge of a cell, m.
        every: Clouds after which the binary form is written, as a node would.
    """
    prefix = Path(sysconfig.get_paths()["purelib"]) / "cmeel.prefix"
    system = Path("/usr/include/octomap/octomap.h").is_file()
    if shutil.which("g++") is None or not (system or (prefix / "include/octomap/octomap.h").is_file()):
        print("liboctomap: no g++ or no headers (Debian: apt-get install g++ liboctomap-dev); left out")
        return None
    where = [] if system else [f"-I{prefix}/include", f"-L{prefix}/lib", f"-Wl,-rpath,{prefix}/lib"]
    source, program = Path(__file__).with_name("liboctomap_peer.cpp"), folder / "peer"
    # without contraction to fused operations, which make liboctomap differ from itself by a few cells
    flags = ["-O3", "-march=native", "-ffp-contract=off", "-std=c++17"]
    subprocess.run(["g++", *flags, str(source), "-o", str(program), *where, "-loctomap", "-loctomath"], check=True)
    with (folder / "frames").open("wb") as file:
        np.array([len(clouds)], np.int32).tofile(file)
        for points, origin in clouds:
            origin.astype(np.float32).tofile(file)
            np.array([len(points)], np.int32).tofile(file)
            points.tofile(file)
    arguments = [str(program), str(folder / "frames"), str(folder / "peer.bt"), str(every), repr(resolution)]
    answer = subprocess.run(arguments, check=True, capture_output=True, text=True).stdout.split()
    insertion, encoding, memory = map(float, answer)
    return Peer(insertion + encoding, memory, folder / "peer.bt")
