# SPDX-License-Identifier: Apache-2.0
"""A container has 64 MB of /dev/shm unless configured otherwise: no image may be lost there, and it may be full."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.graph, pytest.mark.long, pytest.mark.alone]

ROOT = Path(__file__).parents[2]


def in_small_shm(*command: str) -> list[str]:
    mount = 'mount -t tmpfs -o size=64m tmpfs /dev/shm && exec "$@"'
    return ["unshare", "--mount", "--map-root-user", "sh", "-c", mount, "sh", *command]


def can_mount() -> bool:
    try:
        return subprocess.run(in_small_shm("true"), capture_output=True, timeout=20, check=False).returncode == 0
    except FileNotFoundError:
        return False


def in_namespace(script: str, *arguments: str) -> dict[str, Any]:
    """Run a script of this folder there, and return the JSON of its last line."""
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = in_small_shm(sys.executable, str(Path(__file__).parent / script), *arguments)
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


@pytest.mark.skipif(not can_mount(), reason="this machine does not permit mount namespaces")
def test_octomap_comes_back_when_there_is_room_again() -> None:
    """It dies while the memory is full, is given up, and is tried again until there is room; all others go on."""
    result = in_namespace("full_shm.py")
    assert "failed" in result["states"]
    assert result["states"][-1] == "ready"
    assert result["others"] == []
    assert result["health"] == "ready"


@pytest.mark.skipif(not can_mount(), reason="this machine does not permit mount namespaces")
def test_no_image_is_lost_on_64_mb_of_shared_memory() -> None:
    result = in_namespace("small_shm.py", "6")
    assert result["total_mib"] == 64
    assert result["used_mib"] < 62
    assert result["images"] > 150
    assert result["others"] > 10
    # A reader that the machine keeps waiting loses one now and then; segments that are too small lose every other.
    assert result["lost"] <= 0.03 * result["images"], result
