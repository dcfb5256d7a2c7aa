# SPDX-License-Identifier: Apache-2.0
"""Look at a scene in MuJoCo's own viewer: ``.venv/bin/python examples/view_world.py demo``.

``--headless`` runs a thousand steps without a window and prints how fast they went.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings

import glfw
import mujoco

from openarm_common.camera.cameras import load_cameras
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import load_scene
from openarm_sim_bridge.world.model import compile_model

STEPS = 1000
NO_DISPLAY = (
    "view_world: there is no display for a window: set DISPLAY or WAYLAND_DISPLAY to one, leave the window out "
    "(--headless), or look at a running graph in a browser (./openarm up, then ./openarm view)"
)


def has_display() -> bool:
    """Return whether a window can be opened; without one the viewer ends with an error of GLFW."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return bool(glfw.init())


def main() -> None:
    """Load, step a thousand times, keep the window in step with the wall clock until it is closed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", default="demo", help="name or path of a scene")
    parser.add_argument("--headless", action="store_true", help="no window: step and print the rate")
    arguments = parser.parse_args()
    if not arguments.headless and not has_display():
        sys.exit(NO_DISPLAY)
    try:
        scene = load_scene(arguments.scene)
    except OpenArmError as error:
        sys.exit(f"view_world: {error}")
    model = compile_model(RobotDescription.load(), scene, load_cameras())
    data = mujoco.MjData(model)
    if arguments.headless:
        began = time.perf_counter()
        mujoco.mj_step(model, data, STEPS)
        seconds = time.perf_counter() - began
        print(
            f"{STEPS} steps, {data.time:.2f} s simulated in {seconds:.2f} s ({data.time / seconds:.0f} times real time)"
        )
        return
    from mujoco import viewer as window  # needs a display

    with window.launch_passive(model, data) as viewer:
        while viewer.is_running():
            ahead = time.perf_counter() + model.opt.timestep
            mujoco.mj_step(model, data)
            viewer.sync()
            while time.perf_counter() < ahead:
                pass


if __name__ == "__main__":
    main()
