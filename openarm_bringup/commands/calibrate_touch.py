# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate touch`, and what touches say of a calibration."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from openarm_bringup.commands.connect import Domain, Robot, join_graph
from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import choose_robot

if TYPE_CHECKING:
    from openarm_bringup.calibration.source import Solved
    from openarm_calibration.handeye.touch import Touch

Point = tuple[float, float, float]


def touch(file: Path, *, mark: int, arm: str = "", domain: Domain = None, robot: Robot = None) -> Outcome:
    """Note that the tip of a hand is on a mark of the board; `openarm calibrate check --touches` compares.

    Lead the closed hand to the mark by hand or by jogging, and let it rest. Marks are numbered as on the board: circles
    and corners row by row.

    Args:
        file: CSV file that the touch is added to.
        mark: Number of the mark.
        arm: Arm; needed when there are several.
    """
    choose_robot(robot)
    from openarm_calibration.handeye.touch import Touch, add_touch
    from openarm_common.robot.description import RobotDescription

    arms = RobotDescription.load().arms
    name = arm or (next(iter(arms)) if len(arms) == 1 else "")
    if name not in arms:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--arm {arm or '(none)'}: expected one of {', '.join(arms)}")
    join_graph(domain)
    from openarm_bringup.ros.joint_listener import JointListener

    with JointListener() as listener:
        joints = listener.at_rest(arms[name].joints)
    count = add_touch(file, Touch(mark, joints))
    return Outcome(True, f"mark {mark} by the {name} arm; {count} touches in {file}", data={"joints": joints})


def comparison(file: Path, tip: Point, steady: float) -> Callable[[Solved, Outcome], Outcome]:
    """Return what adds touches to the outcome of a check.

    Args:
        file: CSV file of touches.
        tip: Tip that touched, in the frame of the tool centre point, m.
        steady: Standard deviation of a touch by axis, m.

    Raises:
        OpenArmError: INVALID_ARGUMENT.
    """
    from openarm_calibration.handeye.touch import read_touches

    if not (math.isfinite(steady) and steady > 0.0 and all(map(math.isfinite, tip))):
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--tip {tip}, --steady {steady:g}: expected finite numbers, > 0")
    touches = read_touches(file)
    return lambda done, outcome: _compared(done, outcome, touches, tip, steady)


def _compared(done: Solved, outcome: Outcome, touches: Sequence[Touch], tip: Point, steady: float) -> Outcome:
    from openarm_calibration.handeye.touch import check_touches

    checked = check_touches(done.samples, done.result.solution, touches, tip=tip, steady=steady)
    rows = [
        f"mark {touch.mark}: " + ", ".join(f"{value * 1e3:+.2f}" for value in offset) + " mm"
        for touch, offset in zip(touches, checked.offsets, strict=True)
    ]
    mean = float((checked.mean**2).sum() ** 0.5)
    text = (
        f"the tip meets {len(touches)} marks {mean * 1e3:.2f} mm from where the camera sees them on average (predicted:"
        f" {checked.predicted * 1e3:.2f} mm), {checked.rms * 1e3:.2f} mm rms"
    )
    figures = {"predicted": checked.predicted, "rms": checked.rms, "agrees": checked.agrees}
    figures |= {"offsets": checked.offsets.tolist(), "mean": checked.mean.tolist()}
    data = {**outcome.data, "touches": figures}
    lines = "\n".join((outcome.text, "", "tip minus mark in the base frame:", *rows))
    if not checked.agrees:
        return Outcome(False, f"{text}: mount, zeros of the joints, or --tip are wrong", Code.DEGENERATE, data, lines)
    return Outcome(outcome.success, f"{outcome.message}; {text}", outcome.code, data, lines)
