# SPDX-License-Identifier: Apache-2.0
"""One task of a campaign in this process: the strategies of the grasp on a `SimRobot`, judged by its truth."""

from __future__ import annotations

import math
import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Awaitable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.servos import ServoModel
from openarm_common.types import Array
from openarm_evaluation.campaign import record
from openarm_evaluation.campaign.dynamics import with_servos
from openarm_evaluation.campaign.hands import with_hands
from openarm_evaluation.campaign.in_process_robot import InProcessRobot
from openarm_evaluation.campaign.mounts import with_mounts
from openarm_evaluation.campaign.options import CampaignOptions, Row
from openarm_evaluation.campaign.parameters import suite_config
from openarm_evaluation.campaign.robot import UNKNOWN, Known, SimRobot, SimulatedSenses, together, turn
from openarm_evaluation.campaign.tasks.suites import make_task
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.judging.arm_clearance import LEAST_CLEARANCE, watch_clearance
from openarm_evaluation.judging.judge import RULES, Sample, judge, rests, rise_of
from openarm_evaluation.judging.provenance import scene_hash
from openarm_evaluation.judging.trial import Step, Trial, choose_targets, higher_by
from openarm_grasp.config import GraspConfig
from openarm_grasp.context import GraspContext
from openarm_grasp.requests.orders import Order
from openarm_grasp.requests.request import GraspOutcome, GraspRequest
from openarm_grasp.requests.task import GraspSession, Status
from openarm_grasp.requests.task import Task as GraspTask
from openarm_grasp.robot.coordination import ArmCoordination, coordinated
from openarm_grasp.robot.skills import Skills
from openarm_grasp.strategies.pair import pick_two
from openarm_grasp.strategies.registry import carry_out
from openarm_sim_bridge.faults.faults import checked_fault

_SETTLE_S = 0.5
_REST_LIMIT_S = 5.0
#: Directions that a push tries before it counts as blocked on every side.
_DIRECTIONS = 12


class Trials:
    """Runs the requests of one task.

    Args:
        task: Task to carry out.
        senses: Noise and settings of the cameras and detectors.
        config: Parameters of the grasp.
        known: Calibration of the robot by the suite.
        folder: Gets what is kept of a failure.
        again: The command that runs this task again, for the report.
    """

    def __init__(
        self,
        task: Task,
        senses: SimulatedSenses,
        config: GraspConfig,
        known: Known = UNKNOWN,
        folder: Path | None = None,
        again: str = "",
    ) -> None:
        self._task = task
        self._again = again
        self._config = config
        senses = senses.model_copy(update={"sets": (*senses.sets, *task.sets)})
        self.robot = SimRobot(
            task.scene,
            senses,
            mount_seed=task.mount_seed,
            dynamics_seed=task.dynamics_seed,
            hand_seed=task.hand_seed,
            known=known,
            seed=task.seed,
            posture=task.posture,
        )
        self.link = InProcessRobot(self.robot, config)
        self.skills = Skills(self.link, config)
        self._coordination = ArmCoordination()
        self.session = GraspSession(
            GraspContext.of(config, self.robot.table, self.robot.description, self.robot.mounted)
        )
        self.steps: list[Step] = []
        self._keep = record.Keeper(self.robot, folder) if folder is not None else None
        self._faulty = False
        #: Whether the fault of the task has begun.
        self.injected = False
        #: Robot time of the requests of an order, s, and what it left, a sentence each.
        self._seconds = 0.0
        self._left: tuple[str, ...] = ()

    def run(self) -> dict[str, Any]:
        """Carry out the task and return its row."""
        began = time.monotonic()
        self.robot.pass_time(_SETTLE_S)
        self._begin_fault("")
        two = self._task.together or self._task.set_name == "pairs_in_turn"
        clearance = watch_clearance(self.robot) if two else None
        began_ns = self.robot.t_ns
        pair = self._task.together and not self._task.clear
        trials = self.link.run(self._both(*map(GraspRequest, self._task.labels))) if pair else self._ordered()
        row = row_of(self._task, trials, time.monotonic() - began)
        row["again"], row["left"] = self._again, list(self._left)
        row["sim_s"] = round(self._seconds, 2) or row["sim_s"]
        if clearance is not None:
            add_clearance(row, clearance.least, (self.robot.t_ns - began_ns) * 1e-9)
        row["planning_ms_median"] = round(1e3 * float(np.median(self.robot.planning_s or [math.nan])), 1)
        if self._keep is not None and not row["as_expected"]:
            self._keep.write(row, [step.__dict__ for step in self.steps])
        return row

    def _ordered(self) -> list[Trial]:
        """Grasp what is asked for; what others hide or block is asked for again when they have been placed."""
        task, labels, clear = self._task, self._task.labels, self._task.clear
        if not clear and len(set(labels)) < len(labels):  # the same object more than once
            return [self.link.run(self._grasp(GraspRequest(label))) for label in labels]
        arms = self.robot.description.arm_names if task.together else ()
        order, placed, open_ = (
            Order(labels, each=0 if clear else Counter(labels), arms=arms),
            list[Trial](),
            dict[object, Trial](),
        )

        async def work() -> None:
            while (ask := order.next()) is not None or order.running:
                if ask is None:
                    await turn()
                    continue
                trial = await self._grasp(ask)
                self._seconds += trial.sim_s
                answer, touched = trial.answer, trial.answer.attempts > 0
                held = isinstance(answer, GraspOutcome) and answer.held
                ends = answer.place_position, answer.object_position
                how = {"touched": touched, "held": held}
                left = order.done(ask, Code(answer.code), answer.message, *ends, **how, by=answer.arm)
                if ask.phase == "aside":
                    continue
                if answer.success:
                    placed.append(trial)
                    continue
                label = order.label_of(ask)
                if left is not None:
                    open_[left] = trial
                elif all(one.label != label for one in order.left):  # else it says of nothing new that it isn't in view
                    open_[label] = trial
                if touched and not clear:  # three attempts are what a scene may take
                    order.failed[label] = answer.message

        self.link.run(together([work] * max(1, len(arms))))
        # what was taken twice does not count for two
        done = len({trial.target for trial in placed}) if clear else len(placed)
        self._left, missing = order.faults(), len(labels) - done
        last = [open_[key] for key in (*order.left, *order.failed) if key in open_] or list(open_.values())
        # what nothing was asked about was not seen: the last answer says so
        return [*placed, *(last + last[-1:] * missing)[:missing]]

    async def _grasp(self, ask: GraspRequest) -> Trial:
        """Carry out one request and judge it: at once where the other arm may be at work, else when all is at rest."""
        task, robot, began, steps = self._task, self.robot, time.monotonic(), list[Step]()
        if not task.together:
            await self._begin(lifted=ask.phase == "place")
        since_ns = robot.t_ns
        request = replace(ask, arm=task.arm if ask.arm == "auto" else ask.arm, place=task.place, place_on=task.place_on)
        outcome = await self._carry_out(request, steps, alone=ask.arm == "auto")
        wall_s = time.monotonic() - began
        return await self._trial(
            ask.label, outcome, steps, wall_s, since_ns if task.together and ask.phase != "place" else 0
        )

    async def _begin(self, *, lifted: bool = False) -> None:
        """Forget how objects have moved; what is held has been lifted before."""
        for track in () if lifted else self.robot.tracks.values():
            track.clear()
        await self.robot.wait(0.1)

    async def _carry_out(self, request: GraspRequest, steps: list[Step], *, alone: bool) -> GraspOutcome:
        """Carry out one request with all arms, or with the one that it names."""
        arms = self.robot.description.arm_names if alone else (request.arm,)
        try:
            with self._coordination.taking(arms, request.label):
                return await carry_out(self.grasp_task(request, steps, alone=alone))
        except OpenArmError as error:
            return GraspOutcome(error.code, error.message, request.label)

    async def _both(self, first: GraspRequest, second: GraspRequest) -> list[Trial]:
        """Ask for two objects at once, of both arms."""
        began = time.monotonic()
        steps: tuple[list[Step], list[Step]] = ([], [])

        def carry_out_one(i: int, request: GraspRequest) -> Awaitable[GraspOutcome]:
            return self._carry_out(request, steps[i], alone=request.arm == "auto")

        await self._begin()
        outcomes: Sequence[GraspOutcome]
        try:
            both = await pick_two(
                self.session, self.skills, (first, second), lambda work: work(), carry_out_one, lambda _: None
            )
            outcomes = both.answers
        except OpenArmError as error:
            outcomes = [GraspOutcome(error.code, error.message, ask.label) for ask in (first, second)]
        wall_s, labels = 0.5 * (time.monotonic() - began), (first.label, second.label)
        return [await self._trial(*each, wall_s) for each in zip(labels, outcomes, steps, strict=True)]

    def grasp_task(self, request: GraspRequest, steps: list[Step] | None = None, *, alone: bool = True) -> GraspTask:
        """A request, to be carried out by a strategy.

        Args:
            request: Request.
            steps: Gets the states that it enters.
            alone: No other is carried out meanwhile.
        """

        def report(status: Status) -> None:
            self._report(status)
            if steps is not None:
                steps.append(self.steps[-1])

        skills = self.skills
        if not alone:
            skills = coordinated(request.arm, self.link.next_to_other(), self._coordination, self._config)
        return GraspTask(self.session, skills, request, report)

    # --- while it runs
    def _report(self, status: Status) -> None:
        entered = (status.state.value, status.previous.value, status.reason, status.attempt)
        step = Step(self.robot.t_ns, *entered, status.label, status.arm)
        self.steps.append(step)
        if self._keep is not None:
            self._keep.step(step.state, failed=status.failed)
        fault = self._task.fault
        if fault is None:
            return
        if self._faulty and fault.until_attempt and status.attempt >= fault.until_attempt:
            self._faulty = False
            self.robot.world_faults.clear()
            self.robot.camera_faults.set(())
        elif status.attempt == 1:
            self._begin_fault(step.state)

    def _begin_fault(self, state: str) -> None:
        fault = self._task.fault
        if fault is None or self._faulty or fault.when != state:
            return
        self._faulty = True
        for seed in range(self._task.seed, self._task.seed + _DIRECTIONS):
            try:
                self.robot.inject(checked_fault(fault.name, fault.parameters, seed))
                self.injected = True
                return
            except OpenArmError as error:
                if error.code is not Code.SCENE_INVALID:
                    raise
        # Blocked on every side: it is not pushed, and the task is a nominal one.

    # --- after it
    async def _trial(
        self, asked: str, outcome: GraspOutcome, steps: Sequence[Step], wall_s: float, since_ns: int = 0
    ) -> Trial:
        """Judge the object that was asked for; where there are several, that which was taken.

        Of those that were lifted it is the one that is nearest to where it was put, else the one that went highest.

        Args:
            asked: Words for it.
            outcome: The answer.
            steps: States that were entered.
            wall_s: Duration, s of wall clock.
            since_ns: When it was asked for, where the other arm may be at work; 0: when all was at rest last.
        """
        robot, task, end_ns = self.robot, self._task, self.robot.t_ns
        names: list[str] = []
        with suppress(OpenArmError):  # what the scene has not is asked for, too
            names = [item.name for item in choose_targets(task.scene, asked)]
        if not names:
            return Trial(task.scene, task.seed, "", outcome, None, steps, wall_s, end_ns)
        if not since_ns:
            await self._rest(names)
        tracks = {name: _since(robot.tracks[name], since_ns) for name in names}
        where, seen = outcome.place_position, outcome.object_position
        xy = (where[0], where[1]) if any(where) else (math.nan, math.nan)
        name = max(names, key=lambda n: rise_of(tracks[n]))
        lifted = [n for n in names if rise_of(tracks[n]) >= RULES.lift]
        if lifted and any(where):
            name = min(lifted, key=lambda n: math.dist(tracks[n][-1].p_world[:2], xy))
        if seen is not None and not outcome.attempts:  # nothing rose: that which was looked at
            name = min(names, key=lambda n: float(np.linalg.norm(tracks[n][0].p_world - np.array(seen))))
        item = task.scene.object(name)
        higher = higher_by(task.scene, item, task.place_on)
        verdict = judge(tracks[name], xy, claimed=outcome.success, corners=item.corners, higher=higher)
        return Trial(task.scene, task.seed, name, outcome, verdict, steps, wall_s, end_ns)

    async def _rest(self, names: list[str]) -> None:
        end_ns = self.robot.t_ns + round(_REST_LIMIT_S * 1e9)
        least_ns = self.robot.t_ns + round(1.2 * RULES.rest * 1e9)
        while self.robot.t_ns < end_ns:
            await turn()
            if self.robot.t_ns > least_ns and all(rests(self.robot.tracks[name]) for name in names):
                return


def _since(track: Sequence[Sample], t_ns: int) -> Sequence[Sample]:
    """Return the part of a track from the last sample before a moment on."""
    return track[max(0, bisect_left(track, t_ns, key=lambda sample: sample.t_ns) - 1) :]


def with_robot(task: Task, options: CampaignOptions, folder: Path) -> tuple[Task, Known]:
    """The task with the robot of its seed, and what the suite has found of that.

    Args:
        task: The task.
        options: Options of the campaign.
        folder: Folder of the campaign; what it lacks of calibrations, identifications and learned hands is made.
    """
    mounts: Mapping[str, Array] = {}
    servos: Mapping[str, ServoModel] | None = None
    if options.profile != "ideal":
        task, servos = with_servos(task, options, folder / "servos")
    if options.mount_seeds:
        hardware = suite_config(options.graph_parameters()).bridge.hardware.of_seed(task.dynamics_seed)
        task, mounts = with_mounts(task, options.mount_seeds, folder / "mounts", hardware)
    task, hands = with_hands(task, options, folder)
    return task, Known(mounts, servos, hands)


def run_one(options: CampaignOptions, seed: int, folder: Path) -> Row:
    """Run one task in this process and return its row, whatever happens."""
    task, sets = make_task(options.set_name, seed, options.objects), options.graph_parameters()
    try:
        task, known = with_robot(task, options, folder)
        trials = Trials(
            task,
            SimulatedSenses(sets=sets),
            suite_config(sets).grasp,
            known,
            folder=folder / "failures" / str(seed),
            again=options.command(seed),
        )
        return trials.run()
    except Exception as error:  # one task must not end a campaign of a thousand; its row says what happened
        return {**crashed_row(task, error), "again": options.command(seed)}


def row_of(task: Task, trials: list[Trial], wall_s: float) -> dict[str, Any]:
    """One row of the report."""
    grasps = [trial.as_row() for trial in trials]
    bad = next((g for g in grasps if not g["placed"]), None)
    errors = [g["place_error_mm"] for g in grasps if g["placed"]]
    placed = bad is None
    false = any(g["false_success"] for g in grasps)
    allowed = {code.value for code in task.codes}
    strayed = bool(task.route) and any(g["placed"] and g["route"] != task.route for g in grasps)
    expected = not (false or strayed) and all(
        g["code"] in allowed and (g["placed"] or g["code"] != Code.OK) for g in grasps
    )
    refused = expected and not placed
    shown = bad or grasps[-1]
    return _head(task, len(trials)) | {
        "outcome": "false success" if false else "placed" if placed else "refused" if refused else "failed",
        "as_expected": expected,
        "placed": placed,
        "false_success": false,
        **{key: shown[key] for key in ("code", "message", "reasons", "arm")},
        "attempts": max(g["attempts"] for g in grasps),
        "place_error_mm": max(errors, default=None),
        "sim_s": round(sum(g["sim_s"] for g in grasps), 2),
        "wall_s": round(wall_s, 2),
        "grasps": grasps,
    }


def add_clearance(row: dict[str, Any], least: float, sim_s: float) -> None:
    """Say how near the arms came to each other, m, and how long both objects took together, s."""
    row["arm_clearance_mm"] = round(1e3 * least, 1)
    row["as_expected"] = bool(row["as_expected"] and least >= LEAST_CLEARANCE)
    row["sim_s"] = round(sim_s, 2)


def crashed_row(task: Task, error: Exception) -> dict[str, Any]:
    """The row of a task that an error ended outside the grasp."""
    return _head(task, len(task.labels)) | {
        "outcome": "failed",
        "as_expected": False,
        "placed": False,
        "false_success": False,
        "code": (error.code if isinstance(error, OpenArmError) else Code.INTERNAL).value,
        "message": f"{type(error).__name__}: {error}",
        "reasons": [],
        "arm": "",
        "attempts": 0,
        "place_error_mm": None,
        "sim_s": 0.0,
        "wall_s": 0.0,
        "grasps": [],
    }


def _head(task: Task, targets: int) -> dict[str, Any]:
    """What a row says of the task, whatever came of it."""
    return {
        "set": task.set_name,
        "seed": task.seed,
        "kind": task.kind,
        "scene_hash": scene_hash(task.scene),
        "objects": len(task.scene.objects),
        "targets": targets,
        "expected": ["placed" if code is Code.OK else code.value for code in task.codes],
        **({"things": _things(task)} if task.graspable else {}),
    }


def _things(task: Task) -> dict[str, Any]:
    """What a row says of objects of any shape: which, on which side, and why a hand can't take it ("": it can)."""
    return {
        item.name: {"object": item.object, "side": item.side, "why_not": task.graspable[item.name]}
        for item in task.scene.objects
    }
