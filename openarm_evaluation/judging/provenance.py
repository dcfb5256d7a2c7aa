# SPDX-License-Identifier: Apache-2.0
"""What a report says beside its results: versions, the machine, the scene; and how many rows are summed up."""

from __future__ import annotations

import hashlib
import math
import os
import platform
import statistics
import subprocess
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil

from openarm_common.config import Config

PACKAGES = (
    "openarm-vision",
    "mujoco",
    "ros-jazzy-rclpy",
    "ros-jazzy-rmw-fastrtps-cpp",
    "numpy",
    "opencv-python-headless",
    "numba",
    "pin",
    "ompl",
    "ruckig",
)


def versions() -> dict[str, str]:
    """Return the versions of what decides a result, and the commit of a checkout."""
    found: dict[str, str] = {}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    found["python"] = platform.python_version()
    commit = _commit(Path(__file__).resolve().parents[2])
    if commit:
        found["commit"] = commit
    return found


def machine() -> dict[str, Any]:
    """Return the class of the machine: enough to compare figures, nothing that names it."""
    model = ""
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    return {
        "cpu": model or platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "system": f"{platform.system()} {platform.release()}",
        "renderer": os.environ.get("MUJOCO_GL", "egl"),
    }


def scene_hash(scene: Config) -> str:
    """Return what tells two scenes apart, 12 hexadecimal digits."""
    return hashlib.sha256(scene.model_dump_json().encode()).hexdigest()[:12]


def wilson_low(successes: int, n: int, z: float = 1.96) -> float:
    """Return the lower bound of the 95 % Wilson interval of a success rate; 0 for n = 0."""
    if n == 0:
        return 0.0
    rate = successes / n
    centre = rate + z * z / (2 * n)
    spread = z * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    return (centre - spread) / (1 + z * z / n)


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Sum up rows with placed, attempts, false_success, place_error_mm and sim_s; figures of nothing are None."""
    placed = [row for row in rows if row["placed"]]
    errors = [float(row["place_error_mm"]) for row in placed]
    times = sorted(float(row["sim_s"]) for row in placed)
    return {
        "n": len(rows),
        "success": len(placed),
        "first_attempt": sum(row["attempts"] == 1 for row in placed),
        "false_success": sum(bool(row["false_success"]) for row in rows),
        "wilson_low": round(wilson_low(len(placed), len(rows)), 3),
        "place_error_mm": {"median": round(statistics.median(errors), 2), "max": round(max(errors), 2)}
        if errors
        else None,
        "cycle_s": {"median": round(statistics.median(times), 2), "p95": round(_p95(times), 2)} if times else None,
    }


def _p95(ordered: Sequence[float]) -> float:
    return ordered[min(len(ordered) - 1, math.ceil(0.95 * len(ordered)) - 1)]


def _commit(root: Path) -> str:
    if not (root / ".git").exists():
        return ""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""  # a checkout without git installed
    return done.stdout.strip()
