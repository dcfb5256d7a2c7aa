# SPDX-License-Identifier: Apache-2.0
"""`python -m openarm_bringup.warm [nodes]`: compile the numba kernels once, so that no node waits for them.

`nodes`: those that nodes run in their executor, which must not halt for seconds. The others are compiled when they are
first used, which the log of the node says: those of calibration, which run in a worker thread, of depth images in
metres, and of maps with many different log-odds, which the suite does not make itself.
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
from openarm_world import warm as world


def warm_hardware() -> None:
    """Check a robot against itself once, as the node of the motors does."""
    description = RobotDescription.load()
    SelfCollision(description, [name for arm in description.arms.values() for name in arm.controlled])


#: What nodes run in their executor, and the rest; the dearest first.
OF_NODES = (
    octomap.warm, motion.warm_collision, grasp.warm, motion.warm_kinematics, perception.warm, warm_hardware, world.warm,
)  # fmt: skip
REST = (calibration.warm, octomap.warm_rest)


def main() -> None:
    """Warm packages that have kernels, in as many processes as there are processors."""
    parts = OF_NODES if sys.argv[1:] == ["nodes"] else (*OF_NODES, *REST)
    # The collector would look at the many objects of numba again and again.
    with ProcessPoolExecutor(
        len(os.sched_getaffinity(0)), mp_context=get_context("spawn"), initializer=gc.disable
    ) as pool:
        for part in [pool.submit(part) for part in parts]:
            part.result()


if __name__ == "__main__":
    main()
