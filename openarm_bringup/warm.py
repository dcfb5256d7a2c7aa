# SPDX-License-Identifier: Apache-2.0
"""`python -m openarm_bringup.warm [first]`: compile the numba kernels once, so that no node waits for them.

`first`: those that the first pick of an object of known shape needs. The others are compiled when they are first used,
which the log of the node says.
"""

from __future__ import annotations

import gc
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from openarm_calibration import warm as calibration
from openarm_common.collision.self_collision import SelfCollision
from openarm_common.robot.description import RobotDescription
from openarm_grasp import warm as grasp
from openarm_motion import warm as motion
from openarm_octomap import warm as octomap
from openarm_perception import warm as perception


def warm_hardware() -> None:
    """Check a robot against itself once, as the node of the motors does."""
    description = RobotDescription.load()
    SelfCollision(description, [name for arm in description.arms.values() for name in arm.controlled])


#: What the first pick needs, and the rest; the dearest first.
FIRST = (motion.warm_collision, octomap.warm, motion.warm_kinematics)
REST = (calibration.warm, octomap.warm_rest, grasp.warm, perception.warm, warm_hardware)


def main() -> None:
    """Warm packages that have kernels, in as many processes as there are processors."""
    parts = FIRST if sys.argv[1:] == ["first"] else (*FIRST, *REST)
    # The collector would look at the many objects of numba again and again.
    with ProcessPoolExecutor(
        len(os.sched_getaffinity(0)), mp_context=get_context("spawn"), initializer=gc.disable
    ) as pool:
        for part in [pool.submit(part) for part in parts]:
            part.result()


if __name__ == "__main__":
    main()
