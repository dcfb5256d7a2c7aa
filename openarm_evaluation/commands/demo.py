# SPDX-License-Identifier: Apache-2.0
"""`openarm demo`: see it work, and get a report of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from openarm_bringup.commands.connect import check_arms
from openarm_bringup.outcome import GraphReport, Outcome
from openarm_common.errors import Code
from openarm_common.robot.folder import choose_robot
from openarm_evaluation.demo.options import DemoOptions

if TYPE_CHECKING:
    from openarm_evaluation.demo.demo import DemoResult
    from openarm_evaluation.judging.trial import Step, Trial

DEFAULTS = DemoOptions()


def demo(*, options: DemoOptions = DEFAULTS, accept: float = 0.9) -> Outcome:
    """Start a graph of its own without a display, grasp and place an object, judge it by ground truth, and stop.

    Leaves a folder below runs/ with report.json, the logs of all nodes, pictures and a video.

    Args:
        accept: Share of objects placed that counts as success, with seeds.
    """
    choose_robot(options.robot)
    check_arms(options.arm)
    from openarm_evaluation.demo.demo import Listeners, run_demo

    show = _Show(quiet_steps=bool(options.seeds))
    listeners = Listeners(show.event, show.ready, show.step, show.trial, show.note)
    return _outcome(run_demo(options, listeners), options.seeds, accept)


class _Show(GraphReport):
    """Prints what happens, on stderr."""

    def __init__(self, *, quiet_steps: bool) -> None:
        super().__init__()
        self._quiet = quiet_steps
        self._first_ns: int | None = None

    def note(self, note: str) -> None:
        self._console.print(note, style="yellow", markup=False)

    def ready(self, seconds: float) -> None:
        super().ready(seconds)
        if self._quiet:
            head = f"{'seed':>4} {'target':<17}{'arm':<6}{'att.':>4}  {'outcome':<18}{'mm':>6}{'sim s':>7}{'wall s':>7}"
        else:
            head = f"{'sim s':>7}  {'state':<18}{'attempt':>7}  reason"
        self._console.print(head, style="bold")

    def step(self, step: Step) -> None:
        if self._quiet:
            return
        if self._first_ns is None:
            self._first_ns = step.t_ns
        seconds = (step.t_ns - self._first_ns) * 1e-9
        self._console.print(f"{seconds:7.2f}  [cyan]{step.state:<18}[/cyan]{step.attempt or '':>7}  ", end="")
        self._console.print(step.reason, markup=False)

    def trial(self, trial: Trial) -> None:
        if not self._quiet:
            return
        row = trial.as_row()
        error = "-" if row["place_error_mm"] is None else f"{row['place_error_mm']:.1f}"
        outcome = "placed" if trial.placed else f"FALSE {row['code']}" if row["claimed_success"] else row["code"]
        self._console.print(
            f"{row['seed']:>4} {row['target']:<17}{row['arm']:<6}{row['attempts']:>4}  {outcome:<18}{error:>6}"
            f"{row['sim_s']:>7.1f}{row['wall_s']:>7.1f}",
            style="" if trial.placed else "red",
            markup=False,
        )


def _outcome(result: DemoResult, seeds: tuple[int, ...], accept: float) -> Outcome:
    from openarm_evaluation.judging.statistics import summarise

    rows: list[dict[str, Any]] = [trial.as_row() for trial in result.trials]
    summary = summarise(rows)
    here, folder = Path.cwd(), result.run_dir
    where = str(folder.relative_to(here) if folder.is_relative_to(here) else folder)
    data: dict[str, Any] = {
        "run_dir": str(result.run_dir),
        "summary": summary,
        "rows": rows,
        "warnings": result.warnings,
        "mounts": result.mounts,
    }
    notes = "".join(f"note: {warning}\n" for warning in result.warnings)
    for camera, off in result.mounts.items():
        notes += (
            f"{camera}: the mount in use is {off['used_mm']:.2f} mm and {off['used_deg']:.3f}° off,"
            f" that of the configuration {off['nominal_mm']:.1f} mm and {off['nominal_deg']:.2f}°\n"
        )
    if result.error is not None:
        return Outcome(False, f"{result.error.message}; the logs are in {where}/logs", result.error.code, data, notes)
    if seeds:
        return _campaign_outcome(result.trials, summary, accept, where, data, notes)
    trial = result.trials[0]
    if trial.verdict is None or not trial.placed:
        why = "; ".join(rows[0]["reasons"])
        claimed = trial.answer.success
        claim = "it reported success, but " if claimed else f"{trial.answer.message} — "
        code = Code.PLACE_FAILED if claimed else trial.answer.code
        return Outcome(False, f"{trial.target} was not placed: {claim}{why}. See {where}", code, data, notes)
    verdict = trial.verdict
    arm, attempts = trial.answer.arm, trial.answer.attempts
    message = (
        f"{trial.target} was placed {verdict.place_error * 1e3:.1f} mm from its target by the {arm} arm "
        f"({attempts} attempt{'s' if attempts != 1 else ''}, lifted {verdict.rise * 1e3:.0f} mm, "
        f"{trial.sim_s:.1f} s), judged by ground truth. Report, pictures and video: {where}"
    )
    return Outcome(True, message, data=data, text=notes)


def _campaign_outcome(
    trials: list[Trial], summary: dict[str, Any], accept: float, where: str, data: dict[str, Any], notes: str
) -> Outcome:
    lines = [notes] if notes else []
    failed = [trial for trial in trials if not trial.placed]
    for trial in failed:
        answer = trial.answer
        lines.append(f"seed {trial.seed}, {trial.target}: {trial.outcome}: {answer.code}: {answer.message}")
        lines += [f"    ground truth: {reason}" for reason in trial.as_row()["reasons"]]
    error = summary["place_error_mm"]
    figures = f", place error median {error['median']:.1f} mm, max {error['max']:.1f} mm" if error else ""
    message = (
        f"{summary['success']} of {summary['n']} placed ({summary['first_attempt']} at the first attempt), "
        f"{summary['false_success']} false successes{figures}. Report: {where}/report.json"
    )
    success = summary["n"] > 0 and summary["success"] >= accept * summary["n"] and summary["false_success"] == 0
    return Outcome(success, message, Code.OK if success else Code.PLACE_FAILED, data, "\n".join(lines))
