# SPDX-License-Identifier: Apache-2.0
"""Random jogging of all arms among bodies of the planning scene, through nodes: contacts, period, how soon arms stop.

    python -m benchmarks.servo [--robot NAME] [--seeds A-B] [--seconds S] [--profile NAME] [--no-peer] [--json PATH]

Starts the graph `motion`. For each seed the arms go to a posture, bodies are put around their tools, and each arm gets
commands at 100 Hz at up to full speed that change every 0.3 to 1.5 s: twists in the base frame, twists in the tool
frame, joint velocities; and straight at the table, at the other arm, into stretched postures. Every few seconds
commands cease, after half a second of a steady joint velocity. Printed are:

    contacts    joint states in which the arms overlap the table, a body, the other arm or themselves, by exact
                geometry of the collision shapes (states 10 ms apart)
    period      of set points while an arm is commanded, 99 % of the last 10 s at the end, as /diagnostics says, ms
    begins      from the last command to where the speed of the set point begins to fall (by 1 %), ms
    rests       from the last command to where the set point rests, within the limits of acceleration and jerk, ms

The peer is a plain resolved-rate jog: the same commands, a damped pseudo-inverse, joint limits, no look-ahead.
"""

from __future__ import annotations

import argparse
import asyncio
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from control_msgs.msg import JointJog, JointTrajectoryControllerState
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from moveit_msgs.msg import ServoStatus
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from benchmarks.report import Row, write_report
from openarm_bringup.supervision import environment, runs
from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.session import running_graph, work_until_stopped
from openarm_common.domain import reserve_domain
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import choose_robot
from openarm_common.ros.node import QOS_COMMAND
from openarm_common.scene.scene import load_scene
from openarm_common.types import Array
from openarm_evaluation.judging.ros.observer import Observer
from openarm_motion.collision.exact import Clearance
from openarm_motion.collision.solids import Box, box_from
from openarm_motion.config import MotionConfig, ServoingConfig
from openarm_motion.planning.arm import Arm
from openarm_motion.ros.client import MotionClient
from openarm_motion.service.motion_service import make_arms, table_box
from openarm_motion.servo.twist import joint_velocities

_SCENE, _PERIOD, _PAUSE, _STEADY = "demo", 0.01, 0.6, 0.5
_POSTURES = ("hands_up", "ready")
_TOUCH = Clearance(own=0.0, world=0.0, arms=0.0, hand=0.0, touch=0.0, rest=0.0)


@dataclass
class Jog:
    """A command of one arm: a twist (6,) in a frame, or joint velocities (n,); shares of full speed."""

    twist: Array | None = None
    frame: str = ""
    joints: Array | None = None


@dataclass
class Seen:
    """What was recorded: joint states, arrivals of trajectories, pauses and set points by arm."""

    states: list[dict[str, float]] = field(default_factory=list[dict[str, float]])
    trajectories: int = 0
    speeds: dict[str, list[tuple[float, float]]] = field(default_factory=dict[str, list[tuple[float, float]]])
    pauses: list[float] = field(default_factory=list[float])
    periods: list[float] = field(default_factory=list[float])
    status: dict[str, int] = field(default_factory=dict[str, int])


class Jogger(Observer):
    """Sends commands and records what follows."""

    def __init__(self, domain: int, arms: Mapping[str, Arm], base: str) -> None:
        super().__init__(domain)
        self._arms, self._base, self._recording = arms, base, False
        self.seen, self.latest = Seen(), dict[str, float]()
        prefixes = {name: f"/{name}" if len(arms) > 1 else "" for name in arms}
        make = self._node.create_publisher
        self._twists = {n: make(TwistStamped, f"{p}/servo_node/delta_twist_cmds", 10) for n, p in prefixes.items()}
        self._jogs = {n: make(JointJog, f"{p}/servo_node/delta_joint_cmds", 10) for n, p in prefixes.items()}
        self._plain = make(JointState, "/joint_commands", 10)
        listen = self._node.create_subscription
        listen(JointState, "/joint_states", self._on_state, QOS_COMMAND)
        listen(DiagnosticArray, "/diagnostics", self._on_report, QOS_COMMAND)
        listen(ServoStatus, "/servo_node/status", self._on_servo, QOS_COMMAND)
        for name in arms:
            controller = f"/{name}_joint_trajectory_controller"
            listen(JointTrajectory, f"{controller}/joint_trajectory", self._on_trajectory, QOS_COMMAND)
            listen(JointTrajectoryControllerState, f"{controller}/controller_state", self._moved(name), QOS_COMMAND)

    def jog(self, name: str, command: Jog) -> None:
        """Send a command of an arm."""
        if command.joints is not None:
            names = list(self._arms[name].names)
            self._jogs[name].publish(JointJog(joint_names=names, velocities=command.joints.tolist()))
        elif command.twist is not None:
            message = TwistStamped()
            message.header.frame_id = command.frame
            v, w = message.twist.linear, message.twist.angular
            v.x, v.y, v.z, w.x, w.y, w.z = command.twist.tolist()
            self._twists[name].publish(message)

    def plain(self, q: Mapping[str, Array]) -> None:
        """Send positions of all arms."""
        names = [joint for name in q for joint in self._arms[name].names]
        self._plain.publish(JointState(name=names, position=np.concatenate(list(q.values())).tolist()))

    def record(self, *, on: bool) -> None:
        """Start a new recording, or stop it."""
        if on:
            self.seen = Seen()
        self._recording = on

    def _on_state(self, message: JointState) -> None:
        self.latest = dict(zip(message.name, message.position, strict=True))
        if self._recording:
            self.seen.states.append(self.latest)

    def _on_report(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if self._recording and status.name.startswith("servo_node"):
                values = {value.key: value.value for value in status.values}
                self.seen.periods.append(float(values["period_p99_ms"]))

    def _on_servo(self, message: ServoStatus) -> None:
        if self._recording:
            key = f"{message.code}" if message.code >= 0 else message.message
            self.seen.status[key] = self.seen.status.get(key, 0) + 1

    def _on_trajectory(self, _: JointTrajectory) -> None:
        self.seen.trajectories += self._recording

    def _moved(self, name: str) -> Callable[[JointTrajectoryControllerState], None]:
        def note(message: JointTrajectoryControllerState) -> None:
            if self._recording:
                speed = float(np.linalg.norm(message.reference.velocities))
                self.seen.speeds.setdefault(name, []).append((time.monotonic(), speed))

        return note


class Script:
    """Random commands of an arm, the same for the same seed."""

    def __init__(self, seed: Sequence[int], arm: Arm, other: Array | None) -> None:
        self._rng, self._arm, self._other = np.random.default_rng(seed), arm, other
        self._until, self._now = -1.0, Jog()

    def at(self, t: float, q: Array) -> Jog:
        """The command at a time, s, with the arm at a configuration (n,)."""
        if t >= self._until:
            self._until, self._now = t + self._rng.uniform(0.3, 1.5), self._next(q)
        return self._now

    def _next(self, q: Array) -> Jog:
        rng, full = self._rng, self._rng.uniform(0.5, 1.0)
        tool = self._arm.kinematics.fk(q)[:3, 3]
        kind = rng.integers(6)
        direction = rng.normal(size=6)
        twist = direction / np.abs(direction).max() * full
        if kind == 0:
            joints = rng.uniform(-1.0, 1.0, self._arm.kinematics.n)
            return Jog(joints=joints / np.abs(joints).max() * full)
        if kind == 1:
            return Jog(twist=twist, frame=self._arm.kinematics.tool_link)
        if kind == 2:  # at the table
            return Jog(twist=np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0]))
        if kind == 3 and self._other is not None:  # at the other arm
            way = self._other - tool
            return Jog(twist=np.concatenate([way / np.abs(way).max(), np.zeros(3)]))
        if kind == 4:  # to a stretch
            way = tool / np.linalg.norm(tool)
            return Jog(twist=np.concatenate([way / np.abs(way).max() * full, np.zeros(3)]))
        return Jog(twist=twist)


def contacts(states: Sequence[Mapping[str, float]], arms: Mapping[str, Arm], bodies: Sequence[Box]) -> tuple[int, str]:
    """How many states overlap, and what the first one does."""
    count, first = 0, ""
    for state in states:
        for arm in arms.values():
            scene = arm.scene(state, bodies, clearance=_TOUCH)
            found = scene.contacts(np.array([state[name] for name in arm.names]))
            if found and found[0].distance < 0.0:
                count += 1
                first = first or str(found[0])
                break
    return count, first


def bodies_around(arms: Mapping[str, Arm], state: Mapping[str, float], rng: np.random.Generator) -> list[Box]:
    """Boxes near to the tools that touch nothing."""
    found: list[Box] = []
    for name, arm in arms.items():
        q = np.array([state[joint] for joint in arm.names])
        tool = arm.kinematics.fk(q)[:3, 3]
        mine = 0
        while mine < 5:
            way = rng.normal(size=3)
            centre = tool + way / np.linalg.norm(way) * rng.uniform(0.14, 0.35)
            box = box_from(f"{name}{mine}", centre, rng.uniform(0.03, 0.12, 3))
            wide = Clearance(own=0.0, world=0.03, hand=0.03, arms=0.0, rest=0.0)
            apart = not any(
                c.second == box.id
                for one in arms.values()
                for c in one.scene(state, [box], clearance=wide).contacts(np.array([state[j] for j in one.names]))
            )
            if apart:
                found.append(box)
                mine += 1
    return found


class Bench:
    """A graph that runs."""

    def __init__(self, jogger: Jogger, client: MotionClient, arms: Mapping[str, Arm], seconds: float) -> None:
        self._jogger, self._client, self._arms, self._seconds = jogger, client, arms, seconds

    def prepare(self, seed: int) -> list[Box]:
        """Put robot and bodies where they begin."""
        self._client.apply_scene(clear=True)
        self._jogger.reset_world(_SCENE, seed)
        for name, arm in self._arms.items():
            group, known = arm.config.group.format(arm=name), arm.description.semantics.states
            self._client.move_to_named(name, next(p for p in _POSTURES if (group, p) in known))
        self._jogger.wait(lambda: self._jogger.latest or None, 5.0, "joint states")
        bodies = bodies_around(self._arms, self._jogger.latest, np.random.default_rng([seed, 1]))
        self._client.apply_scene(add=bodies)
        return bodies

    def run(self, seed: int, *, plain: bool) -> Seen:
        """Jog for a while; plain: by the peer."""
        jogger, arms = self._jogger, self._arms
        ends = {n: a.kinematics.fk(self._q(a))[:3, 3] for n, a in arms.items()}
        others = {n: next((ends[m] for m in arms if m != n), None) for n in arms}
        scripts = {n: Script([seed, k], a, others[n]) for k, (n, a) in enumerate(arms.items())}
        q = {n: self._q(a) for n, a in arms.items()}
        jogger.record(on=True)
        begin = due = time.monotonic()
        pause_at, rng = 3.0, np.random.default_rng([seed, 2])
        while (t := due - begin) < self._seconds:
            if t >= pause_at and not plain:
                jogger.seen.pauses.append(time.monotonic())
                pause_at = t + _PAUSE + rng.uniform(2.0, 4.0)
                due += _PAUSE
            else:
                for name, arm in arms.items():
                    before_pause = t >= pause_at - _STEADY and not plain
                    command = _steady(arm, self._q(arm)) if before_pause else scripts[name].at(t, self._q(arm))
                    if plain:
                        q[name] = _plain_step(arm, q[name], command)
                    else:
                        jogger.jog(name, command)
                if plain:
                    jogger.plain(q)
                due += _PERIOD
            time.sleep(max(0.0, due - time.monotonic()))
        time.sleep(0.5)
        jogger.record(on=False)
        return jogger.seen

    def _q(self, arm: Arm) -> Array:
        return np.array([self._jogger.latest[name] for name in arm.names])


def _steady(arm: Arm, q: Array) -> Jog:
    """The last joint towards its middle, so that stops are measured from a steady speed."""
    joints = np.zeros(arm.kinematics.n)
    joints[-1] = np.sign(0.5 * (arm.lower + arm.upper)[-1] - q[-1]) * 0.6
    return Jog(joints=joints)


def _plain_step(arm: Arm, q: Array, command: Jog) -> Array:
    scale = ServoingConfig().scale
    if command.joints is not None:
        velocity = scale.joint * command.joints
    else:
        assert command.twist is not None
        twist = command.twist * np.repeat([scale.linear, scale.rotational], 3)
        if command.frame:
            turn = arm.kinematics.fk(q)[:3, :3]
            twist = np.concatenate([turn @ twist[:3], turn @ twist[3:]])
        velocity, _ = joint_velocities(arm.kinematics, q, twist)
        velocity /= max(1.0, float(np.max(np.abs(velocity) / arm.limits(1.0).velocity)))
    return np.clip(q + _PERIOD * velocity, arm.lower, arm.upper)


def stops(seen: Seen) -> tuple[list[float], list[float]]:
    """From each last command to where the speed of a steady set point begins to fall, and to where it rests, ms."""
    slows: list[float] = []
    rests: list[float] = []
    for speeds in seen.speeds.values():
        t, v = np.array(speeds).T
        for pause in seen.pauses:
            before, after = (t > pause - 0.05) & (t <= pause), (t > pause) & (t < pause + _PAUSE)
            if not before.any() or v[before].min() < 0.1 or np.ptp(v[before]) > 0.1 * v[before].max():
                continue  # it rests already, or speeds up or slows for another reason
            slower, still = after & (v < 0.99 * v[before].min()), after & (v < 1e-3)
            slows.append(1e3 * (t[slower][0] - pause) if slower.any() else np.inf)
            rests.append(1e3 * (t[still][0] - pause) if still.any() else np.inf)
    return slows, rests


async def measure(options: argparse.Namespace) -> list[Row]:
    """Run all seeds in one graph."""
    choose_robot(options.robot)
    description = RobotDescription.load()
    table = table_box(load_scene(_SCENE).table)
    arms = make_arms(MotionConfig(), description, [table])
    first, _, last = options.seeds.partition("-")
    seeds = range(int(first), int(last or first) + 1)
    folder = runs.new_run_dir()
    for name in ("logs", "params"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    sets = (f"mujoco_bridge.profile={options.profile}", "motion.servo.enabled=true")
    overrides: dict[str, Any] = {"domain": reserve_domain(), "scene": _SCENE}
    graph = load_graph("motion", overrides=overrides, sets=sets)
    found: list[dict[str, Any]] = []
    async with running_graph(graph, folder) as supervisor:
        await supervisor.wait_ready()
        with Jogger(environment.domain_id(graph), arms, description.base) as jogger, MotionClient() as client:
            bench = Bench(jogger, client, arms, options.seconds)

            def work() -> None:
                for seed in seeds:
                    bodies = bench.prepare(seed)
                    started = client.call(Trigger, "/servo_node/start_servo", Trigger.Request())
                    if not started.success:
                        raise RuntimeError(started.message)
                    seen = bench.run(seed, plain=False)
                    client.call(Trigger, "/servo_node/stop_servo", Trigger.Request())
                    row = _row(seed, seen, arms, bodies)
                    if not options.no_peer:
                        bodies = bench.prepare(seed)
                        row["peer"], row["peer_first"] = contacts(bench.run(seed, plain=True).states, arms, bodies)
                    print(row, flush=True)
                    found.append(row)

            await work_until_stopped(supervisor, work, threading.Event().set)
    return _rows(options.robot, found, peer=not options.no_peer)


def _row(seed: int, seen: Seen, arms: Mapping[str, Arm], bodies: Sequence[Box]) -> dict[str, Any]:
    count, first = contacts(seen.states, arms, bodies)
    slows, rests = stops(seen)
    moved = sum(
        float(np.abs(np.diff([[s[n] for n in a.names] for s in seen.states], axis=0)).sum()) for a in arms.values()
    )
    return {
        "seed": seed,
        "states": len(seen.states),
        "contacts": count,
        "first": first,
        "moved_rad": round(moved, 1),
        "trajectories": seen.trajectories,
        "period_p99_ms": seen.periods[-1] if seen.periods else np.inf,
        "begins_ms": [round(x) for x in slows],
        "rests_ms": [round(x) for x in rests],
        "status": seen.status,
    }


def _rows(robot: str, found: Sequence[Mapping[str, Any]], *, peer: bool) -> list[Row]:
    states = sum(row["states"] for row in found)
    slows, rests = ([x for row in found for x in row[key]] for key in ("begins_ms", "rests_ms"))
    theirs = float(sum(row["peer"] for row in found)) if peer else None
    plain = "resolved rate without look-ahead" if peer else ""
    out = [
        Row(
            f"servo contacts, {robot}", sum(r["contacts"] for r in found), "states", "lower", 0.0, plain, theirs, states
        ),
        Row(f"servo period p99, {robot}", max(r["period_p99_ms"] for r in found), "ms", "lower", 15.0, n=states),
    ]
    for name, values, target in (("begins to stop", slows, 50.0), ("rests", rests, None)):
        if values:
            out.append(
                Row(
                    f"servo {name} after the last command, worst, {robot}",
                    max(values),
                    "ms",
                    "lower",
                    target,
                    n=len(values),
                )
            )
            out.append(
                Row(
                    f"servo {name} after the last command, median, {robot}",
                    float(np.median(values)),
                    "ms",
                    "lower",
                    target,
                    n=len(values),
                )
            )
    return out


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default="openarm_v1")
    parser.add_argument("--seeds", default="1-1", help="A-B")
    parser.add_argument("--seconds", type=float, default=60.0, help="of jogging for each seed")
    parser.add_argument("--profile", default="openarm", help="motors of the simulation: openarm or ideal")
    parser.add_argument("--no-peer", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    write_report(asyncio.run(measure(options)), options.json)


if __name__ == "__main__":
    main()
