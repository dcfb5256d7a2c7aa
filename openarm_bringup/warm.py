# SPDX-License-Identifier: Apache-2.0
"""`python -m openarm_bringup.warm`: compile the numba kernels once, so that no node waits for them."""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from openarm_calibration.warm import warm as warm_calibration
from openarm_common.collision.self_collision import SelfCollision
from openarm_common.robot.description import RobotDescription
from openarm_grasp.warm import warm as warm_grasp
from openarm_motion.warm import warm as warm_motion
from openarm_octomap.warm import warm as warm_octomap
from openarm_perception.warm import warm as warm_perception


def warm_hardware() -> None:
    """Check a robot against itself once, as the node of the motors does."""
    description = RobotDescription.load()
    SelfCollision(description, [name for arm in description.arms.values() for name in arm.controlled])


#: The dearest first.
PARTS = (warm_motion, warm_octomap, warm_grasp, warm_perception, warm_calibration, warm_hardware)


def main() -> None:
    """Warm all packages that have kernels, in as many processes as there are processors."""
    with ProcessPoolExecutor(len(os.sched_getaffinity(0)), mp_context=get_context("spawn")) as pool:
        for part in [pool.submit(part) for part in PARTS]:
            part.result()


if __name__ == "__main__":
    main()
