# SPDX-License-Identifier: Apache-2.0
"""Servoing on arms that follow their set points exactly: trajectories keep clear, within limits, and end at rest."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_motion.collision.exact import Clearance
from openarm_motion.collision.occupancy import Environment
from openarm_motion.collision.solids import box_from
from openarm_motion.config import ServoingConfig
from openarm_motion.planning.moves import named_posture
from openarm_motion.servo.arm_servo import ArmServo, ServoCommand, ServoState
from openarm_motion.servo.course import Course, JointState
from openarm_motion.servo.surroundings import Surroundings
from openarm_motion.servo.twist import joint_velocities

pytestmark = pytest.mark.requirement("R-29")

TICK_NS = 10_000_000
TOUCH = Clearance(own=0.0, world=0.0, arms=0.0, hand=0.0, touch=0.0, rest=0.0)
CONFIG = ServoingConfig()


class Bench:
    """All arms of a robot; each follows exactly."""

    def __init__(self, arms, home, bodies=(), held=None):
        self.arms, self.held = arms, held or {name: () for name in arms}
        state = dict(home)
        for arm in arms.values():
            state.update(zip(arm.names, named_posture(arm, "hands_up", np.zeros(arm.kinematics.n)), strict=True))
        self.state, self.environment = state, Environment(tuple(bodies))
        now = next(iter(arms.values())).start_state(state, environment=self.environment)
        held_by = [self.held[name] for name in arms]
        self.around = Surroundings.of(list(arms.values()), now, held_by, CONFIG.clearance, CONFIG.lag)
        self.servos = {name: ArmServo(arm, CONFIG, 0.05) for name, arm in arms.items()}
        self.q = {name: np.array([state[joint] for joint in arm.names]) for name, arm in arms.items()}
        self.sent = {name: [] for name in arms}
        self.tracks = {name: [q] for name, q in self.q.items()}
        self.said = {name: set() for name in arms}
        self.stuck: set[str] = set()
        self.t_ns = 1_000_000_000

    def tick(self, commands):
        """10 ms; commands: twist or joint velocities by arm."""
        self.t_ns += TICK_NS
        for name, servo in self.servos.items():
            if name in commands:
                velocity = np.asarray(commands[name], dtype=float)
                servo.take(ServoCommand(velocity, self.t_ns * 1e-9, is_twist=len(velocity) == 6))
            others = {
                other: np.vstack([self.q[other], self.servos[other].ahead(self.t_ns)])
                for other in self.servos
                if other != name
            }
            found = servo.tick(self.t_ns, self.t_ns * 1e-9, (self.t_ns, self.q[name]), self.around, others)
            self.said[name].add(servo.report.status)
            if found is not None:
                self.sent[name].append(found)
        for name in self.arms:
            if name in self.stuck:
                continue
            for motion, stamp_ns in reversed(self.sent[name][-20:]):
                t = (self.t_ns - stamp_ns) * 1e-9
                if t >= motion.t[0]:
                    self.q[name] = motion.states(np.array([t]))[0]
                    break
            self.tracks[name].append(self.q[name])

    def ticks(self, n, commands):
        for _ in range(n):
            self.tick(commands)

    def overlaps(self):
        """Sentences about states in which something overlaps."""
        found = []
        for rows in list(zip(*(self.tracks[name] for name in self.arms), strict=True))[::-10]:
            state = dict(self.state)
            for arm, q in zip(self.arms.values(), rows, strict=True):
                state.update(zip(arm.names, q, strict=True))
            for arm, q in zip(self.arms.values(), rows, strict=True):
                scene = arm.scene(state, (), self.held[arm.name], environment=self.environment, clearance=TOUCH)
                found += [str(c) for c in scene.contacts(q) if c.distance < 0.0]
        return found

    def tool(self, name):
        return self.arms[name].kinematics.fk(self.q[name])[:3, 3]


def turning(speed):
    """Joint 5 alone, at a speed."""
    return speed * np.eye(7)[4]


def towards(direction, speed=0.4):
    return np.concatenate([speed * np.asarray(direction, dtype=float) / np.abs(direction).max(), np.zeros(3)])


@pytest.fixture
def bench(arms, home) -> Bench:
    return Bench(arms, home)


def test_a_twist_moves_the_tool_as_it_says(bench):
    before = bench.tool("right")

    bench.ticks(40, {"right": towards([0.0, 0.0, -1.0], 0.1)})

    moved = bench.tool("right") - before
    assert moved[2] < -0.015
    assert np.linalg.norm(moved[:2]) < 0.1 * abs(moved[2])
    assert bench.said["right"] == {ServoState.NO_WARNING}


@pytest.mark.long
@pytest.mark.parametrize(("seed", "ticks"), [(1, 240), (0, 900), (1, 900)])
def test_both_arms_jogged_at_random_among_bodies_touch_nothing(arms, home, seed, ticks):
    rng = np.random.default_rng(seed)
    free = Bench(arms, home)
    bodies = [
        box_from(f"{name}{k}", free.tool(name) + way / np.linalg.norm(way) * 0.25, (0.05, 0.05, 0.05))
        for name in arms
        for k, way in enumerate(rng.normal(size=(4, 3)))
    ]
    bench = Bench(arms, home, bodies)
    bodies = [b for b in bodies if not any(b.id in text for text in bench.overlaps())]
    bench = Bench(arms, home, bodies)

    for k in range(ticks):
        if k % 60 == 0:
            commands = {
                name: rng.uniform(-0.5, 0.5, 7) if rng.random() < 0.4 else rng.uniform(-0.5, 0.5, 6) for name in arms
            }
        bench.tick(commands if k % 300 < 270 else {})

    assert bench.overlaps() == []
    assert all(np.ptp(track, axis=0).max() > 0.3 for track in bench.tracks.values())  # they did move


@pytest.mark.long
def test_at_full_speed_towards_the_table_an_arm_slows_and_what_it_holds_stops_over_it(arms, home, table):
    bench = Bench(arms, home, held={"left": (), "right": (box_from("cube", (0.0, 0.0, 0.05), (0.05, 0.05, 0.15)),)})
    top = table.T[2, 3] + 0.5 * table.size[2]

    bench.ticks(300, {"right": towards([0.0, 0.0, -1.0])})

    assert bench.overlaps() == []
    assert bench.said["right"] & {
        ServoState.HALT_FOR_COLLISION,
        ServoState.JOINT_BOUND,
        ServoState.HALT_FOR_SINGULARITY,
    }
    assert bench.tool("right")[2] > top


def test_arms_sent_towards_each_other_stop_apart(bench):
    for _ in range(150):
        way = bench.tool("left") - bench.tool("right")
        bench.tick({"right": towards(way), "left": towards(-way)})

    assert bench.overlaps() == []
    assert ServoState.HALT_FOR_COLLISION in bench.said["right"] | bench.said["left"]


def test_a_joint_stops_before_its_limit(bench, arms):
    bench.ticks(450, {"left": turning(0.5)})

    arm = arms["left"]
    assert bench.q["left"][4] <= arm.upper[4] - CONFIG.joint_limit_margin + 1e-6
    assert bench.servos["left"].report.status in (ServoState.JOINT_BOUND, ServoState.HALT_FOR_COLLISION)
    assert np.max(bench.tracks["left"], axis=0)[4] > bench.tracks["left"][0][4] + 0.3


def test_set_points_keep_velocity_acceleration_and_jerk(arms, home):
    bench, rng = Bench(arms, home), np.random.default_rng(5)
    limits = arms["right"].limits(1.0)

    for k in range(200):
        if k % 40 == 0:
            twist = rng.uniform(-0.4, 0.4, 6)
        bench.tick({"right": twist})

    speed = np.abs(np.diff(bench.tracks["right"], axis=0)) / 0.01
    assert np.all(speed <= limits.velocity * 1.01)
    course = Course.of(JointState.rest(bench.q["right"]), 0.9 * limits.velocity, 0.5, limits)
    a = np.array([course.at(t).a for t in np.arange(0.0, course.duration, 1e-3)])
    assert np.all(np.abs(a) <= limits.acceleration * 1.001)
    assert np.all(np.abs(np.diff(a, axis=0)) <= 1e-3 * limits.jerk * 1.01)


def test_when_commands_cease_the_set_point_begins_to_slow_within_50_ms_and_every_trajectory_ends_at_rest(bench):
    bench.ticks(60, {"right": turning(0.3)})
    last = len(bench.tracks["right"])

    bench.ticks(60, {})

    speed = np.abs(np.diff(np.array(bench.tracks["right"])[:, 4])) / 0.01
    slowed = np.flatnonzero(speed[last:] < 0.999 * speed[last - 2])[0]
    assert (slowed + 1) * 0.01 <= 0.05
    assert speed[last + 18 :].max() < 1e-6
    assert not bench.servos["right"].busy
    assert all(np.all(motion.v[-1] == 0.0) for motion, _ in bench.sent["right"])


def test_a_stretched_arm_stops_at_the_singular_posture_and_comes_back(bench):
    bench.ticks(250, {"right": towards([1.0, -0.2, 0.3])})
    assert bench.said["right"] & {ServoState.HALT_FOR_SINGULARITY, ServoState.JOINT_BOUND}
    out = bench.tool("right")

    bench.ticks(150, {"right": towards([-1.0, 0.2, -0.3])})

    assert np.linalg.norm(bench.tool("right") - out) > 0.03


def test_an_arm_that_does_not_follow_gets_no_set_points_until_commands_pause(bench, arms):
    bench.stuck.add("right")
    bench.ticks(60, {"right": turning(0.5)})
    assert bench.servos["right"].report.status is ServoState.INVALID
    assert arms["right"].names[4] in bench.servos["right"].report.text
    bench.stuck.clear()
    bench.ticks(60, {})

    bench.ticks(60, {"right": turning(0.5)})

    assert bench.servos["right"].report.status is ServoState.NO_WARNING


def test_joint_velocities_are_those_of_the_twist(right):
    q = np.full(right.kinematics.n, 0.3)
    twist = np.array([0.1, -0.2, 0.05, 0.3, 0.1, -0.2])
    velocity, _ = joint_velocities(right.kinematics, q, twist)

    assert np.allclose(right.kinematics.jacobian(q) @ velocity, twist)
    step = 1e-6
    moved = right.kinematics.fk(q + step * velocity)[:3, 3] - right.kinematics.fk(q)[:3, 3]
    assert np.allclose(moved / step, twist[:3], atol=1e-4)
