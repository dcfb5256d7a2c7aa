# SPDX-License-Identifier: Apache-2.0
"""Request a grasp, observe it and judge it by ground truth."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from openarm_common.detection import Detection, kind_of
from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.scene import Scene, SceneObject
from openarm_common.wanted import describe, select
from openarm_evaluation.judging.judge import Sample, Verdict, at_rest, judge, rests
from openarm_evaluation.judging.provenance import scene_hash
from openarm_grasp.requests.request import GraspOutcome, GraspRequest

if TYPE_CHECKING:
    from openarm_evaluation.judging.ros.observer import Observer
    from openarm_grasp.ros.client import GraspClient, GraspResult

#: How near an object must be to its place in the scene file to be that scene's, m.
_SAME_PLACE = 0.02
SETTLE_TIMEOUT_S = 20.0


@dataclass(frozen=True)
class Step:
    """A state that a grasp has entered, at simulated time `t_ns`."""

    t_ns: int
    state: str
    previous: str
    reason: str
    attempt: int
    label: str
    arm: str


@dataclass(frozen=True)
class Trial:
    """A grasp that was observed, and its verdict.

    Args:
        scene: Scene with the objects on the table.
        seed: Seed of the scene.
        target: Name of the object; "" when the scene has none of the label.
        answer: `GraspResult` of a client, or `GraspOutcome` in process.
        verdict: Verdict of ground truth; None when the object could not be observed.
        steps: States that the grasp entered, in order.
        wall_s: Duration, s of wall clock.
        end_ns: When the last state ended; None when it still lasts.
    """

    scene: Scene
    seed: int | None
    target: str
    answer: GraspResult | GraspOutcome
    verdict: Verdict | None
    steps: Sequence[Step]
    wall_s: float
    end_ns: int | None = None

    @property
    def placed(self) -> bool:
        """Judged as placed."""
        return self.verdict is not None and self.verdict.placed

    @property
    def outcome(self) -> str:
        """Placed, failed (and reported so), or false success."""
        if self.placed:
            return "placed"
        return "false success" if self.answer.success else "failed"

    @property
    def sim_s(self) -> float:
        """Simulated s from the request's first state to the last one's beginning."""
        return (self.steps[-1].t_ns - self.steps[0].t_ns) * 1e-9 if self.steps else 0.0

    def as_row(self) -> dict[str, Any]:
        """Return what reports write; without an end, the last state is left out of `states`, and so is IDLE."""
        verdict, answer = self.verdict, self.answer
        error = verdict.place_error * 1e3 if verdict else math.nan
        ends = [step.t_ns for step in self.steps[1:]] + ([] if self.end_ns is None else [self.end_ns])
        return {
            "seed": self.seed,
            "scene": self.scene.name,
            "scene_hash": scene_hash(self.scene),
            "target": self.target,
            "label": answer.label,
            "arm": answer.arm,
            "route": answer.route,
            "outcome": self.outcome,
            "placed": self.placed,
            "claimed_success": answer.success,
            "false_success": self.outcome == "false success",
            "code": str(answer.code),
            "message": answer.message,
            "reasons": list(verdict.reasons) if verdict else ["the object could not be observed"],
            "attempts": answer.attempts,
            "place_error_mm": round(error, 2) if math.isfinite(error) else None,
            "rise_mm": round(verdict.rise * 1e3, 1) if verdict else None,
            "tilt_deg": round(math.degrees(verdict.tilt), 2) if verdict else None,
            "sim_s": round(self.sim_s, 2),
            "began_s": round(self.steps[0].t_ns * 1e-9, 3) if self.steps else 0.0,
            "wall_s": round(self.wall_s, 2),
            "states": [
                {
                    "state": step.state,
                    "seconds": round((end - step.t_ns) * 1e-9, 3),
                    "attempt": step.attempt,
                    "reason": step.reason,
                }
                for step, end in zip(self.steps, ends, strict=False)
                if step.state != "IDLE"
            ],
        }


def choose_targets(scene: Scene, words: str) -> tuple[SceneObject, ...]:
    """Return the objects of a scene that words ask for, the best first; all without words.

    Raises:
        OpenArmError: UNKNOWN_OBJECT or NOTHING_DETECTED, listing the objects of the scene.
    """
    things: dict[Detection, SceneObject] = {}
    for item in scene.objects:
        name, size = "" if item.label == item.color else item.label, np.array(item.size)
        kind, T = "" if item.shape == "mesh" else kind_of(item.shape, size), item.T_world_object(scene.table)
        things[Detection(name, 1.0, T, size, kind=kind, color=item.color)] = item
    try:
        return tuple(things[one] for one in select(words, tuple(things)))
    except OpenArmError as error:
        text = f"scene {scene.name} has no object {words!r}; it has {describe(tuple(things))}"
        raise OpenArmError(error.code, text) from error


def shows(scene: Scene, positions: Mapping[str, Sample]) -> bool:
    """Return whether ground truth is of this scene, untouched and at rest."""
    if set(positions) != {item.name for item in scene.objects}:
        return False
    return all(
        at_rest(positions[item.name])
        and float(np.hypot(*(positions[item.name].p_world[:2] - np.array(item.position[:2])))) < _SAME_PLACE
        for item in scene.objects
    )


def wait_scene(observer: Observer, scene: Scene, after_ns: int) -> None:
    """Wait until ground truth shows the scene at rest, later than `after_ns`.

    Raises:
        OpenArmError: TIMEOUT.
    """

    def there() -> bool | None:
        truth = observer.truth()
        return truth is not None and truth.t_ns > after_ns and shows(scene, truth.objects)

    observer.wait(there, SETTLE_TIMEOUT_S, f"ground truth of scene {scene.name} at rest")


def higher_by(scene: Scene, item: SceneObject, place_on: str) -> float:
    """Return how much higher, m, an object is to stand than in the scene: on the table, or on what words ask for.

    Raises:
        OpenArmError: UNKNOWN_OBJECT, listing the objects of the scene.
    """
    floor, table = scene.table.top_z, scene.table
    if place_on:
        support = choose_targets(scene, place_on)[0]
        floor = support.centre(table)[2] + 0.5 * support.size[2]
    return floor - item.centre(table)[2] + 0.5 * item.size[2]


def run_trial(
    observer: Observer,
    client: GraspClient,
    scene: Scene,
    wanted: GraspRequest,
    *,
    seed: int | None = None,
    after_ns: int = 0,
    before: Callable[[], None] | None = None,
    moved: bool = False,
) -> Trial:
    """Wait for the scene, request a grasp, wait until all is at rest, and judge.

    Args:
        observer: Observes the graph.
        client: Requests the grasp.
        scene: Scene with the objects that are on the table now.
        wanted: Object to grasp and place to put it; without a label, the first object of the scene.
        seed: Seed of the scene, for the report.
        after_ns: Ground truth up to this time is of an earlier scene.
        before: Called when the scene is at rest, before the grasp is requested.
        moved: Earlier grasps have moved its objects, so it is not waited for.

    Raises:
        OpenArmError: TIMEOUT, when the scene does not show; UNKNOWN_OBJECT.
    """
    item = choose_targets(scene, wanted.label)[0]
    if not moved:
        wait_scene(observer, scene, after_ns)
    if before is not None:
        before()
    observer.forget()

    def request() -> Sequence[GraspResult]:
        return [client.carry_out(replace(wanted, label=wanted.label or item.label))]

    (trial,) = _observed(observer, scene, seed, [item], request, wanted.place, wanted.place_on)
    return trial


def run_pair(
    observer: Observer,
    client: GraspClient,
    scene: Scene,
    labels: Sequence[str],
    *,
    seed: int | None = None,
    after_ns: int = 0,
) -> list[Trial]:
    """As `run_trial`, for two objects that are requested simultaneously; the observer keeps joint states meanwhile."""
    items = [choose_targets(scene, label)[0] for label in labels]
    wait_scene(observer, scene, after_ns)
    observer.forget()
    observer.wait(lambda: observer.joints() or None, SETTLE_TIMEOUT_S, "/joint_states")

    def request() -> Sequence[GraspResult | GraspOutcome]:
        both = client.pick_two(*labels)
        return both.results or [GraspOutcome(both.code, both.message, item.label) for item in items]

    return _observed(observer, scene, seed, items, request)


def _observed(
    observer: Observer,
    scene: Scene,
    seed: int | None,
    items: Sequence[SceneObject],
    request: Callable[[], Sequence[GraspResult | GraspOutcome]],
    place: tuple[float, ...] | None = None,
    place_on: str = "",
) -> list[Trial]:
    """Request grasps of objects and judge each by where it was to be placed: as requested, else as the grasp chose."""
    for item in items:
        observer.wait(lambda n=item.name: observer.track(n) or None, SETTLE_TIMEOUT_S, f"ground truth of {item.name}")
    began = time.monotonic()
    try:
        results = request()
    except OpenArmError as error:
        results = [GraspOutcome(error.code, error.message, item.label) for item in items]
    wall_s = (time.monotonic() - began) / len(items)
    for item in items:
        _wait_rest(observer, item.name)
    # also after a request whose answer never came: the next trial resets
    observer.wait(lambda: not observer.steps() or observer.steps()[-1].state == "IDLE", 90.0, "the end of the grasp")
    trials: list[Trial] = []
    for item, result in zip(items, results, strict=True):
        chosen = result.place_position if any(result.place_position) else (math.nan, math.nan)
        x, y = (place or chosen)[:2]
        track = observer.track(item.name)
        higher = higher_by(scene, item, place_on)
        verdict = judge(track, (x, y), claimed=result.success, corners=item.corners, higher=higher)
        steps = [step for step in observer.steps() if len(items) == 1 or step.label in (item.label, result.label)]
        trials.append(Trial(scene, seed, item.name, result, verdict, _stamped(steps), wall_s))
    return trials


def _stamped(steps: Sequence[Step]) -> list[Step]:
    """Give steps from before the first joint state, whose stamp is 0, that of the first one after it."""
    first_ns = next((step.t_ns for step in steps if step.t_ns), 0)
    return [step if step.t_ns else replace(step, t_ns=first_ns) for step in steps]


def _wait_rest(observer: Observer, name: str) -> None:
    """Wait until the object has been at rest for as long as the judge requires; one that never rests is judged so."""

    def resting() -> bool:
        track = observer.track(name)
        return bool(track) and rests(track)

    try:
        observer.wait(resting, 5.0, f"{name} at rest")
    except OpenArmError as error:
        if error.code != Code.TIMEOUT:
            raise
