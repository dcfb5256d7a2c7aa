# SPDX-License-Identifier: Apache-2.0
"""Plans that a person confirms: show one, wait for the answer, and see that it may still be executed.

What is shown are the very trajectories that are executed after it. A plan that the world has overtaken is not replaced
silently: `agree` says so, and what is planned again is shown under another id. Base frame, m, rad.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from secrets import token_hex
from typing import TYPE_CHECKING

from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_grasp.perception.detections import Frame, Sighting, apart

if TYPE_CHECKING:
    from openarm_grasp.requests.task import Task
    from openarm_grasp.robot.interface import Planned, Trajectory
    from openarm_grasp.robot.skills import Skills

#: Names of the parts of a plan, as they are shown.
GRASP = ("transfer", "approach", "lift")
PLACE = ("carry", "put down", "leave")
PUSH = ("move behind", "move down", "push")


@dataclass(frozen=True)
class ShownPlan:
    """A plan that waits for a person.

    Attributes:
        id: Id to confirm or reject it by.
        arm: Arm that would move.
        parts: Name and trajectory of each part, in their order.
    """

    id: str
    arm: str
    parts: tuple[tuple[str, Trajectory], ...]


#: Reports a sentence, with the plan that waits.
Show = Callable[[str, ShownPlan | None], None]


class PlanGate:
    """Where a plan waits for its answer; one at a time."""

    def __init__(self) -> None:
        self._waiting = ""
        self._accepted: bool | None = None

    def answer(self, plan_id: str, *, accept: bool) -> str:
        """Confirm or reject the plan that waits; returns what comes of it.

        Raises:
            OpenArmError: NOT_READY, when none waits; INVALID_ARGUMENT, when it is another one.
        """
        if not self._waiting:
            raise OpenArmError(Code.NOT_READY, "no plan waits for an answer; ask for a grasp with `confirm` first")
        if plan_id != self._waiting:
            text = f"plan {plan_id!r} does not wait for an answer; plan {self._waiting!r} does"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        self._waiting, self._accepted = "", accept
        return f"plan {plan_id!r} is {'confirmed' if accept else 'rejected'}"

    async def accepted(self, robot: Skills, plan_id: str, show: Callable[[], None]) -> bool:
        """Show a plan, and wait until it is answered, or the request ends.

        Raises:
            OpenArmError: CANCELLED, also when the time of the request is over; ROBOT_LOST.
        """
        self._waiting, self._accepted = plan_id, None
        try:
            show()
            await robot.until(lambda: self._accepted is not None, inf, f"waiting for the answer to plan {plan_id!r}")
        finally:
            self._waiting = ""
        return bool(self._accepted)


async def agree(
    task: Task,
    arm: str,
    text: str,
    plans: Sequence[tuple[Sequence[str], Planned]],
    show: Show,
    standing: Sequence[Detection] = (),
) -> str:
    """Show plans that follow each other as one and wait until a person has confirmed it; nothing without `confirm`.

    Args:
        task: Task that it is a part of.
        arm: Arm that would move.
        text: Sentence on what it does.
        plans: Names of the parts of each, and the plan.
        show: Reports it.
        standing: Objects that must still be seen there when it is confirmed, and nothing new; empty: not looked at.

    Returns:
        Why it may not be executed any more; "" when it may.

    Raises:
        OpenArmError: CANCELLED, when it is rejected, or as the wait.
    """
    if not task.request.confirm or task.request.dry_run:
        return ""
    robot = task.robot
    every = (part for names, p in plans for part in zip(names, (p.transfer, p.approach, p.retreat), strict=True))
    parts = tuple((name, trajectory) for name, trajectory in every if trajectory is not None)
    shown = ShownPlan(f"p{token_hex(3)}", arm, parts)  # a letter first: YAML takes it for a string
    text = f"{text}; {sum(plan.duration for _, plan in plans):.1f} s of motion"
    before = {**robot.joints(), **plans[0][1].start}
    ask = f"{text}; plan {shown.id!r} waits for /grasp/confirm"
    if not await task.session.gate.accepted(robot, shown.id, lambda: show(ask, shown)):
        text = f"plan {shown.id!r} was rejected; the arms hold where they are, and a hand keeps what it holds"
        raise OpenArmError(Code.CANCELLED, text)
    show(f"plan {shown.id!r} is confirmed; seeing that nothing has changed", None)
    fault = await outdated(robot, [plan for _, plan in plans], before, task.context.config.confirm.joints)
    if not fault and standing:
        frames = await robot.look(task.context.config.detect.frames)
        fault = changed(standing, frames, task.context.config.held.moved, task.context.table.top_z)
    return f"plan {shown.id!r} is not executed: {fault}; planning again" if fault else ""


async def agree_once(task: Task, arm: str, text: str, names: Sequence[str], plan: Planned, found: Sighting) -> None:
    """As `agree`, of one plan for what was found, which is not planned again.

    Raises:
        OpenArmError: STALE_DATA, when the scene has changed meanwhile; CANCELLED, when it is rejected.
    """
    changed = await agree(task, arm, text, [(names, plan)], task.note, (found.target, *found.others))
    if changed:
        raise OpenArmError(Code.STALE_DATA, f"{changed.removesuffix('; planning again')}; ask again")


async def outdated(robot: Skills, plans: Sequence[Planned], start: Mapping[str, float], tolerance: float) -> str:
    """Why plans do not hold any more; "" when they do.

    Args:
        robot: Robot that would execute them.
        plans: Plans in their order.
        start: Joint positions at the start, rad by name.
        tolerance: Largest distance of a joint from there, rad.
    """
    version, joints = await robot.scene_version(), robot.joints()
    for plan in plans:
        if plan.scene_version != version:
            return f"the planning scene has changed from version {plan.scene_version} to {version}"
    off = {name: abs(joints[name] - value) for name, value in start.items()}
    worst = max(off, key=lambda name: off[name], default="")
    if worst and off[worst] > tolerance:
        return f"{worst} is {off[worst]:.3f} rad from where the plan begins, expected at most {tolerance:g}"
    return ""


def changed(standing: Sequence[Detection], frames: Sequence[Frame], limit: float, table_z: float) -> str:
    """How what stands on the table differs from what was planned for; "" when it does not.

    Args:
        standing: Objects that it was planned for.
        frames: Seen since; a detector may miss an object in one.
        limit: Largest distance of an object from its place, m.
        table_z: Height of the table, m.
    """
    for one in standing:
        seen = [d for frame in frames for d in frame.detections if d.label == one.label]
        nearest = min((apart(d, one) for d in seen), default=inf)
        if nearest > limit:
            where = f"the nearest is {nearest * 1e3:.0f} mm away" if seen else "none is in view"
            return f"{one.label!r} is not seen any more where it stood ({where})"
    for d in frames[-1].detections:
        if d.top > table_z + 0.005 and all(apart(d, one) > max(limit, 0.5 * max(one.size[:2])) for one in standing):
            x, y = d.p_base[:2]
            return f"{d.label!r} has come to ({x:.3f}, {y:.3f}) m"
    return ""
