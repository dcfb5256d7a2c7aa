# SPDX-License-Identifier: Apache-2.0
"""Film an order that both arms carry out, and draw what each arm did when.

    python tools/order_pictures.py [SEED] [FOLDER]

Writes FOLDER/order.webp, FOLDER/order.mp4 and FOLDER/order.svg; the scene is that of `openarm campaign --suite orders`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from openarm_common.camera.cameras import spectator_camera
from openarm_evaluation.campaign.campaign import CampaignOptions
from openarm_evaluation.campaign.parameters import suite_config
from openarm_evaluation.campaign.report import time_lines
from openarm_evaluation.campaign.robot import SimRobot, SimulatedSenses
from openarm_evaluation.campaign.tasks.suites import make_task
from openarm_evaluation.campaign.trial import Trials
from openarm_evaluation.judging.film import ANIMATION_FPS, Film


def film(robot: SimRobot, into: Film) -> None:
    """Film a robot in this process from now on, at the rate of an animation."""
    tick: Callable[[], None] = robot.tick
    frames = 0

    def watched() -> None:
        nonlocal frames
        tick()
        if robot.t_ns * 1e-9 * ANIMATION_FPS >= frames:
            into.add(robot.t_ns, robot.draw(spectator_camera())[0].copy())
            frames += 1

    robot.tick = watched  # type: ignore[method-assign]


def main(seed: int, folder: Path) -> None:
    """Carry out an order, and write film and picture."""
    sets = CampaignOptions(set_name="orders").graph_parameters()
    trials = Trials(make_task("orders", seed, ""), SimulatedSenses(sets=sets), suite_config(sets).grasp)
    movie = Film(folder / "order.mp4", ANIMATION_FPS)
    film(trials.robot, movie)
    row = trials.run()
    print(f"{movie.close()} frames; {row['outcome']}: {row['message']}, {row['sim_s']} s")
    movie.save_animation(folder / "order.webp")
    (folder / "order.svg").write_bytes(time_lines([row]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seed", nargs="?", type=int, default=4000)
    parser.add_argument("folder", nargs="?", type=Path, default=Path())
    main(**vars(parser.parse_args()))
