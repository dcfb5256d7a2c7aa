# SPDX-License-Identifier: Apache-2.0
"""Second half of tools/colcon_check.sh: is everything taken from the colcon install, and does it run?

Called in its environment with the install folder. Every package that was built is imported from there; a node is
started by its own executable, then a graph by `openarm up`; both are asked for a joint state and ended by Ctrl-C.
With `--give FOLDER`, it copies the message packages that are not to be built into another environment.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

SUITE = ("common", "sim_bridge", "perception", "calibration", "octomap", "motion", "grasp", "bringup")
MESSAGES = ("openarm_interfaces", "tf2_msgs", "octomap_msgs", "object_recognition_msgs")
#: Of the installation.
GIVEN = ("control_msgs", "vision_msgs", "moveit_msgs")
PACKAGES = (*(f"openarm_{name}" for name in SUITE), *MESSAGES)
OPENARM = Path("openarm_bringup", "lib", "openarm_bringup", "openarm")
BRIDGE = Path("openarm_sim_bridge", "lib", "openarm_sim_bridge", "sim_bridge")


def main() -> int:
    """Check the install folder given as argument."""
    if sys.argv[1] == "--give":
        give(Path(sys.argv[2]))
        return 0
    install = Path(sys.argv[1]).resolve()
    for name in PACKAGES:
        package = importlib.import_module(name)
        place = Path(package.__file__ or next(iter(package.__path__))).resolve()
        if install not in place.parents:
            raise SystemExit(f"{name} is imported from {place}, not from {install}")
    for name in GIVEN:
        if (install / name / "lib").exists():
            raise SystemExit(f"{name} was built in {install / name}, though it is installed")
        importlib.import_module(name)
    resources = importlib.import_module("openarm_common.resources").resource_root()
    if install not in resources.parents:
        raise SystemExit(f"models and config are taken from {resources}, not from {install}")
    say(f"{len(PACKAGES)} packages, models and config come from {install}")
    for command in ([install / BRIDGE, "--ros-args", "-p", "images:=false"], [install / OPENARM, "up", "sim_only"]):
        serve(install, [str(part) for part in command])
    return 0


def give(env: Path) -> None:
    """Copy the installed packages that are not built into another environment of the same Python."""
    site = env / Path(sysconfig.get_path("purelib")).relative_to(sys.prefix)
    for name in GIVEN:
        for file in importlib.metadata.files(name) or ():
            place = site / file
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file.locate(), place)


def say(text: str) -> None:
    """Write a line."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def serve(install: Path, command: list[str]) -> None:
    """Start a command, hear a joint state of it, and end it by Ctrl-C."""
    began = time.monotonic()
    process = subprocess.Popen(command, start_new_session=True)
    try:
        echo = [str(install / OPENARM), "topic", "echo", "/joint_states", "-n", "1", "--timeout", "60", "--json"]
        answer = subprocess.run(echo, capture_output=True, text=True, timeout=120, check=False)
        while answer.returncode != 0 and time.monotonic() - began < 120 and process.poll() is None:
            answer = subprocess.run(echo, capture_output=True, text=True, timeout=120, check=False)
        if answer.returncode != 0:
            raise SystemExit(f"{command[0]}: no joint state: {answer.stdout}\n{answer.stderr}")
        names = json.loads(answer.stdout)["messages"][0]["name"]
        say(f"{Path(command[0]).name}: a joint state of {len(names)} joints after {time.monotonic() - began:.1f} s")
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
        code = process.wait(timeout=60)
    if code != 0:
        raise SystemExit(f"{command[0]} ended with {code} at Ctrl-C")


if __name__ == "__main__":
    sys.exit(main())
