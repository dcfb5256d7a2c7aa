# SPDX-License-Identifier: Apache-2.0
"""Picks one after another on a graph of its own while faults happen, and judges each round."""

from __future__ import annotations

import asyncio
import itertools
import math
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import psutil
import yaml

from openarm_bringup.supervision import environment, shm
from openarm_bringup.supervision.graph import Graph, load_graph
from openarm_bringup.supervision.keeper import NodeState
from openarm_bringup.supervision.session import running_graph, work_until_stopped
from openarm_bringup.supervision.state import socket_path, state_dir
from openarm_bringup.supervision.supervisor import Supervisor
from openarm_common.domain import release_domain, reserve_domain
from openarm_common.errors import Code, OpenArmError
from openarm_common.ports import in_domain
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import Scene, SceneObject, random_scene
from openarm_evaluation.chaos import judge
from openarm_evaluation.chaos.judge import Violation
from openarm_evaluation.chaos.schedule import HOLDING, Fault, Round, rounds
from openarm_evaluation.chaos.usage import Usage
from openarm_evaluation.judging.trial import Step, wait_scene

#: After an answer the arms may come to rest, then they are watched, s of simulated time; a busy machine takes longer.
_SETTLE_S, _WATCH_S, _WALL_S = 1.0, 2.0, 30.0
#: Longest wait for a graph that does not come back, s.
_NEVER_RETURNS_S = 90.0
#: So long the supervisor has for noticing that a node was killed, s.
_NOTICED_S = 5.0


@dataclass
class Hit:
    """When a fault really happened.

    Attributes:
        state: State of the grasp at that time; None: not yet.
        began: s, monotonic.
        ended: The same of its end.
        back: s from its end until the graph was ready.
        over: The request was answered before it began.
    """

    state: str | None = None
    began: float = math.inf
    ended: float = 0.0
    back: float = 0.0
    over: bool = False

    def where(self, fault: Fault) -> str:
        """Return the state of the grasp that was hit, and whether it is the one that was wanted."""
        if not fault.when:
            return "before the request"
        if self.over:
            return f"after the answer; {fault.when} was never reached"
        return self.state or "before the first state"


@dataclass
class Report:
    """What was done and seen.

    Attributes:
        seed: Seed of the schedule.
        seconds: s of wall clock.
        rounds: One row each: request, answer, fault, times.
        violations: Each with its round, fault and time.
        usage: Memory, descriptors and threads of the nodes.
        cut: Why it ended early; "" when it did not.
        code: Code of that.
    """

    seed: int
    seconds: float = 0.0
    rounds: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    violations: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    usage: Usage | None = None
    cut: str = ""
    code: Code = Code.OK

    def faults(self) -> dict[str, int]:
        """Return how many faults of each kind there were."""
        kinds = [row["kind"] for row in self.rounds if row["kind"]]
        return {kind: kinds.count(kind) for kind in sorted(set(kinds))}


def run(
    seed: int,
    seconds: float,
    kinds: tuple[str, ...],
    folder: Path,
    show: Callable[[dict[str, Any]], None],
    most: int | None = None,
) -> Report:
    """Run picks and faults on a graph of its own until the time is over, or something ends it; return what was seen.

    Args:
        seed: Seed of scenes, requests and faults.
        seconds: s of wall clock; a round that has begun is finished.
        kinds: Kinds of faults.
        folder: Gets logs, scenes and memory; `run` below it is the run folder.
        show: Called with the row of each round.
        most: Rounds at most.
    """
    report, domain = Report(seed), reserve_domain()
    release_domain(domain)  # to be reserved again once it is clear what the graph has left
    sets = [f"mujoco_bridge.ground_truth_rate={judge.TRUTH_HZ}"]
    graph = load_graph("sim", overrides={"domain": domain, "scene": "random", "seed": seed}, sets=sets)
    seen: set[int] = set()
    try:
        asyncio.run(_run(graph, report, seconds, kinds, folder, show, seen, most))
    except OpenArmError as error:
        report.cut, report.code = error.message, error.code
    except (Exception, KeyboardInterrupt) as error:
        report.cut, report.code = f"{type(error).__name__}: {error}", Code.INTERNAL
    for text in left_over(domain, seen):
        report.violations.append({"rule": "nothing is left", "text": text, "seed": seed})
    return report


def left_over(domain: int, pids: set[int]) -> list[str]:
    """Return what a graph has left behind: processes, shared memory, records and ports."""
    found = [f"process {pid}" for pid in pids if psutil.pid_exists(pid)]
    found += [f"/dev/shm/{name}" for name in sorted(shm.names_of(domain))]
    found += [str(path) for path in (socket_path(_me()), state_dir() / f"{_me()}.json") if path.exists()]
    held = {c.laddr.port for c in psutil.net_connections("udp") if c.laddr and in_domain(c.laddr.port, domain)}
    return [*found, *(f"port {port}" for port in sorted(held))]


def _me() -> int:
    return psutil.Process().pid


async def _run(
    graph: Graph,
    report: Report,
    seconds: float,
    kinds: tuple[str, ...],
    folder: Path,
    show: Callable[[dict[str, Any]], None],
    seen: set[int],
    most: int | None,
) -> None:
    run_dir = folder / "run"
    for name in ("logs", "params"):
        (run_dir / name).mkdir(parents=True, exist_ok=True)
    (folder / "scenes").mkdir(parents=True, exist_ok=True)
    try:
        async with running_graph(graph, run_dir) as supervisor:
            await supervisor.wait_ready()
            with _Work(graph, supervisor, report, folder, seen) as work:

                def all_rounds() -> None:
                    began = time.monotonic()
                    schedule = itertools.islice(
                        rounds(report.seed, kinds, list(graph.nodes), RobotDescription.load().arm_names), most
                    )
                    for one in schedule:
                        if work.ended.is_set() or time.monotonic() - began > seconds:
                            break
                        work.round(one)
                        show(report.rounds[-1])
                        report.seconds = round(time.monotonic() - began, 1)

                await work_until_stopped(supervisor, all_rounds, work.cancel)
    finally:
        shutil.copytree(run_dir / "logs", folder / "logs", dirs_exist_ok=True)


class _Work:
    """The clients of one graph and its rounds; a context manager."""

    def __init__(self, graph: Graph, supervisor: Supervisor, report: Report, folder: Path, seen: set[int]) -> None:
        from openarm_evaluation.chaos.ros.actors import Actors
        from openarm_evaluation.judging.ros.observer import Observer
        from openarm_grasp.ros.client import GraspClient

        domain = environment.domain_id(graph)
        self._graph, self._supervisor, self._report, self._folder = graph, supervisor, report, folder
        self._seen = seen
        self._steps: threading.Condition = threading.Condition()
        self._state = ""
        self.ended = threading.Event()
        self._observer = Observer(domain, self._on_step)
        self._client = GraspClient()
        self._actors = Actors(domain, supervisor.pid, folder / "run")
        self._usage = report.usage = Usage(self._pids, folder / "usage.csv")
        self._scene: Scene | None = None
        self._left: list[SceneObject] = []
        self._scenes = itertools.count()

    def __enter__(self) -> _Work:
        self._usage.__enter__()
        return self

    def __exit__(self, *about: object) -> None:
        self._usage.__exit__(None, None, None)
        for node in (self._actors, self._client, self._observer):
            node.close()

    def cancel(self) -> None:
        """End the present request and begin no other."""
        self.ended.set()
        self._client.cancel()

    def round(self, one: Round) -> None:
        """Ask for an object while the fault happens, and judge what was seen."""
        from openarm_grasp.requests.request import GraspOutcome

        found: list[Violation] = []
        if not self._left:
            self._new_scene()
        item = self._left[one.pick % len(self._left)]
        label = f"the {item.color} {item.shape}" if one.worded else item.label
        self._state = ""
        self._observer.joints()
        self._observer.forget()
        self._observer.wait(lambda: self._observer.track(item.name) or None, _WALL_S, f"ground truth of {item.name}")
        over, hit = threading.Event(), Hit()
        actor = threading.Thread(target=self._act, args=(one.fault, over, hit, found), daemon=True)
        actor.start()
        if one.fault is not None and not one.fault.when:
            actor.join()
        began = time.monotonic()
        outcome = ""
        try:
            answer: Any = self._client.pick(label, arm=one.arm, timeout=judge.REQUEST_S)
            outcome = answer.outcome
        except OpenArmError as error:
            answer = GraspOutcome(error.code, error.message, label)
            if error.code is Code.TIMEOUT:
                found.append(Violation("every request is answered", f"pick: {error}"))
        answered = time.monotonic()
        over.set()
        actor.join()
        killed = one.fault is not None and one.fault.kind == "kill" and one.fault.node == "grasp"
        if killed and began < hit.began < answered and answered - hit.began > judge.DEATH_S:
            late = f"the client learnt of the death of grasp after {answered - hit.began:.1f} s"
            found.append(Violation("every request is answered", late))
        if hit.back <= judge.BACK_S:  # else it is said already
            self._wait_back(answered, found)  # also without a fault, or when it is felt late
        found += self._watch_rest(answered)
        tracks = {thing.name: self._observer.track(thing.name) for thing in (self._scene or random_scene(0)).objects}
        found += judge.falls(tracks)
        place = answer.place_position if any(answer.place_position) else (float("nan"),) * 2
        if not self.ended.is_set():
            felt = None if hit.began > answered or (killed and hit.began < began) else one.fault
            found += judge.fits(answer.code, felt)
        found += judge.claims(tracks[item.name], answer.success, outcome, place)
        row = {
            "round": one.number,
            "label": label,
            "arm": one.arm,
            "fault": str(one.fault or ""),
            "kind": one.fault.kind if one.fault else "",
            "target": one.fault.target if one.fault else "",
            "wanted_state": (one.fault.when or "before the request") if one.fault else "",
            "state": hit.where(one.fault) if one.fault else "",
            "reached": one.fault is not None and (not one.fault.when or hit.state == one.fault.when) and not hit.over,
            "code": str(answer.code),
            "message": answer.message,
            "seconds": round(answered - began, 1),
            "known_s": round(answered - hit.began, 1) if began < hit.began < answered else None,
            "back_s": round(hit.back, 1),
            "violations": [asdict(violation) for violation in found],
        }
        self._report.rounds.append(row)
        about = {"seed": self._report.seed, "round": one.number, "fault": row["fault"], "time": time.strftime("%X")}
        for violation in found:
            log = {node: self._log_end(node) for node in ("supervisor", "grasp", "motion")}
            self._report.violations.append({**about, **asdict(violation), "answer": answer.message, "logs": log})
        if answer.success:
            self._left.remove(item)
        else:
            self._left = []

    def _on_step(self, step: Step) -> None:
        with self._steps:
            self._state = step.state
            self._steps.notify_all()

    def _act(self, fault: Fault | None, over: threading.Event, hit: Hit, found: list[Violation]) -> None:
        """Wait for the state in which a fault begins, or for the end of the request, and carry it out."""
        if fault is None:
            return
        with self._steps:
            while fault.when and self._state != fault.when and not over.is_set():
                self._steps.wait(timeout=0.05)
        over.wait(fault.after if fault.when else 0.0)
        hit.over, hit.state, hit.began = over.is_set(), self._state, time.monotonic()
        try:
            found += self._actors.carry_out(fault, lambda: not over.is_set() and self._state in HOLDING)
        except OpenArmError as error:  # the simulation did not answer: its own fault is judged by the rest
            found.append(Violation("every request is answered", f"{fault}: {error}"))
        hit.ended = time.monotonic()
        ready = lambda: self._supervisor.states().get(fault.node) is NodeState.READY  # noqa: E731
        while fault.kind == "kill" and ready() and time.monotonic() - hit.ended < _NOTICED_S:
            time.sleep(0.02)
        hit.back = self._wait_back(hit.ended, found)

    def _wait_back(self, since: float, found: list[Violation]) -> float:
        """Wait until the graph is ready again; return how long that took since then, s."""
        while True:
            states = self._supervisor.states()
            lacking = [f"{name} is {state}" for name, state in states.items() if state is not NodeState.READY]
            took = time.monotonic() - since
            if not lacking or took > _NEVER_RETURNS_S or self.ended.is_set():
                break
            time.sleep(0.1)
        if took > judge.BACK_S:
            text = f"{', '.join(lacking) or 'ready'} {took:.1f} s after the fault"
            found.append(Violation("the graph comes back within 15 s", text))
        return took

    def _watch_rest(self, answered: float) -> list[Violation]:
        """Watch the arms for a while in which nobody asks for anything."""
        truth, seen = self._observer.truth(), len(self._observer.joints())
        begin = (truth.t_ns if truth else 0) + int(_SETTLE_S * 1e9)

        def watched() -> bool:
            now = self._observer.truth()
            return now is not None and not begin - 60e9 < now.t_ns < begin + _WATCH_S * 1e9

        with suppress(OpenArmError):
            self._observer.wait(watched, _WALL_S, "simulated time")
        speed, joint = judge.unasked_speed(self._observer.joints(), seen, begin)
        if speed > judge.REST_SPEED:
            return [Violation("no arm moves without a request", f"{joint} at {speed:.2f} rad/s after the answer")]
        return []

    def _new_scene(self) -> None:
        """Load the next scene of the seed; hands that may hold something open where nothing can fall."""
        number = 1_000 * self._report.seed + next(self._scenes)
        scene = random_scene(number)
        path = self._folder / "scenes" / f"{number}.yaml"
        path.write_text(yaml.safe_dump(scene.model_dump(mode="json"), sort_keys=False), encoding="utf-8")
        after_ns = self._observer.reset_world(str(path), number)
        for arm in RobotDescription.load().arm_names:
            self._client.release(arm)
        wait_scene(self._observer, scene, after_ns)
        self._scene, self._left = scene, list(scene.objects)

    def _pids(self) -> dict[str, int]:
        pids: dict[str, int] = {}
        for node in self._graph.nodes:
            with suppress(OpenArmError, psutil.NoSuchProcess):
                pids[node] = self._supervisor.pid(node)
                self._seen.update([pids[node], *(c.pid for c in psutil.Process(pids[node]).children(recursive=True))])
        return pids

    def _log_end(self, node: str) -> list[str]:
        path = self._folder / "run" / "logs" / f"{node}.log"
        return path.read_text(encoding="utf-8", errors="replace").splitlines()[-15:] if path.exists() else []
