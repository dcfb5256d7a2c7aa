# SPDX-License-Identifier: Apache-2.0
"""Provenance of results: versions, machine and scene."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import subprocess
from pathlib import Path
from typing import Any

import psutil

from openarm_bringup import versions as installed
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
    found = {**installed.versions(PACKAGES), "python": platform.python_version()}
    commit = _commit(Path(__file__).resolve().parents[2])
    return {**found, "commit": commit} if commit else found


def machine() -> dict[str, Any]:
    """Return the class of the machine: enough to compare figures, nothing that names it."""
    model = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(errors="replace"), re.MULTILINE)
    return {
        "cpu": model[1] if model else platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "system": f"{platform.system()} {platform.release()}",
        "renderer": os.environ.get("MUJOCO_GL", "egl"),
    }


def scene_hash(scene: Config) -> str:
    """Return a hash of a scene, 12 hexadecimal digits."""
    return hashlib.sha256(scene.model_dump_json().encode()).hexdigest()[:12]


def _commit(root: Path) -> str:
    if not (root / ".git").exists():
        return ""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""  # a checkout without git installed
    return done.stdout.strip()
