# SPDX-License-Identifier: Apache-2.0
"""Servoing of all arms of a motion service: who may command them, their set points, and why they slow or stop."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.config import ServoingConfig
from openarm_motion.servo.arm_servo import ArmServo, ServoCommand, ServoReport, ServoState
from openarm_motion.servo.surroundings import Surroundings
from openarm_motion.timing.trajectory import Motion

if TYPE_CHECKING:
    from openarm_motion.service.motion_service import MotionService

#: Joint states may be so old, s.
_STALE = 0.1
#: A joint state stands for the present for so long, s.
_FORESEEN = 0.08
#: What others read that want the arm meanwhile, after its name.
_OWNED = "is moved by servoing; wait until the commands cease, or call stop_servo"
#: Positions of an arm under way that are kept clear of, and how far ahead, s.
_SAMPLES, _AHEAD = 8, 1.0


class Servoing:
    """Servoing. `start`, `stop` and `refresh` come from the event loop, all else from one thread that keeps the pace.

    Args:
        service: Service whose arms, planning scene and map these are.
        config: Parameters.
        send: Hands a trajectory of an arm, and the stamp of its beginning, to its controller.
    """

    def __init__(
        self, service: MotionService, config: ServoingConfig, send: Callable[[str, Motion, int], None]
    ) -> None:
        self._service, self._config, self._send = service, config, send
        self._lock = threading.Lock()
        self._around: Surroundings | None = None
        self._seen: object = None
        #: Positions of the joints; stamp and time of arrival, s, of the newest that are of an arm.
        self._state: dict[str, float] = {}
        self._heard: dict[str, tuple[int, float]] = {}
        self._missing = "the surroundings were not looked at yet"
        self._started: set[str] = set()
        #: Arms that are claimed, and whether there is one.
        self._claimed: set[str] = set()
        tolerance = service.config.execution.start_tolerance
        self._make: Callable[[str], ArmServo] = lambda name: ArmServo(service.arms[name], config, tolerance)
        self._arms = {name: self._make(name) for name in service.arms}

    @property
    def names(self) -> tuple[str, ...]:
        """The arms."""
        return tuple(self._arms)

    @property
    def started(self) -> frozenset[str]:
        """The arms that take commands."""
        return frozenset(self._started)

    def reports(self) -> Mapping[str, ServoReport]:
        """What each arm does."""
        return {name: arm.report for name, arm in self._arms.items()}

    def busy(self, name: str) -> bool:
        """Whether an arm is commanded or under way."""
        return self._arms[name].busy

    @property
    def active(self) -> bool:
        """Whether any arm is."""
        return bool(self._claimed)

    def hear(self, stamp_ns: int, state: Mapping[str, float], at: float) -> None:
        """Take a joint state.

        Args:
            stamp_ns: Robot time.
            state: Positions by joint, rad or m; of all joints of an arm, or of none.
            at: When it arrived, s.
        """
        self._state.update(state)
        for name, servo in self._arms.items():
            if state.keys() >= set(servo.arm.names):
                self._heard[name] = stamp_ns, at

    # --- who may command
    async def start(self, names: Sequence[str]) -> None:
        """Take commands of arms from now on.

        Raises:
            OpenArmError: as `refresh`.
        """
        await self.refresh()
        self._started.update(names)

    def stop(self, names: Sequence[str]) -> None:
        """Take no commands of arms any more; they come to rest."""
        self._started.difference_update(names)
        with self._lock:
            for name in names:
                self._arms[name].halt()

    def twist(self, name: str, twist: Array, frame: str, at: float) -> None:
        """Move a tool by a twist.

        Args:
            name: Arm.
            twist: (6,) linear and angular velocity of the tool's origin, in axes of the frame.
            frame: Any frame of the robot; "": the base frame.
            at: When the command came, s.

        Raises:
            OpenArmError: NOT_READY, when servoing is not started; INVALID_ARGUMENT, for numbers that are none or too
                large; NO_TRANSFORM; BUSY, while the arm follows a goal.
        """
        scale = self._config.scale
        velocity = self._checked(twist, "xyz", "twist") * np.repeat(self._units(scale.linear, scale.rotational), 3)
        if name not in self._heard:
            raise OpenArmError(Code.NOT_READY, f"no /joint_states of the {name} arm yet; is its driver running?")
        turn = self._service.in_base(np.eye(4), frame, self._state)[:3, :3]
        base = np.concatenate([turn @ velocity[:3], turn @ velocity[3:]])
        self._take(name, ServoCommand(base, at, is_twist=True))

    def jog(self, names: Sequence[str], velocities: Sequence[float], at: float) -> None:
        """Move joints of one arm with velocities.

        Args:
            names: Joints; the others of the arm rest.
            velocities: One for each.
            at: When the command came, s.

        Raises:
            OpenArmError: as `twist`.
        """
        if not names or len(names) != len(velocities):
            text = f"{len(names)} joint_names and {len(velocities)} velocities, expected as many, and one at least"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        name = self.arm_of(names)
        joints = self._arms[name].arm.names
        given = self._checked(np.array(velocities, dtype=np.float64), names, "velocity of")
        velocity = np.zeros(len(joints))
        velocity[[joints.index(joint) for joint in names]] = given * self._units(self._config.scale.joint)
        self._take(name, ServoCommand(velocity, at, is_twist=False))

    def arm_of(self, joints: Sequence[str]) -> str:
        """The arm that joints belong to.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when there is none, or one is named twice.
        """
        arms = {name: servo.arm.names for name, servo in self._arms.items()}
        found = next((name for name, known in arms.items() if set(joints) <= set(known)), None)
        if found is None or len(set(joints)) != len(joints):
            known = "; ".join(f"{name}: {', '.join(of)}" for name, of in arms.items())
            text = f"joint_names {', '.join(joints)[:200]}: expected different joints of one arm; joints of {known}"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        return found

    def arm_moving(self, frame: str) -> str | None:
        """The arm whose joints move a frame of the robot; None: no arm does."""
        for name, servo in self._arms.items():
            robot = servo.arm.description
            if frame in robot.links and any(joint.name in servo.arm.names for joint in robot.chain(frame)):
                return name
        return None

    def _units(self, *scales: float) -> Array:
        return np.array(scales if self._config.command_in_type == "unitless" else [1.0] * len(scales))

    def _checked(self, values: Array, names: Sequence[str], what: str) -> Array:
        limit = 1.0 if self._config.command_in_type == "unitless" else np.inf
        wrong = np.flatnonzero(~(np.isfinite(values) & (np.abs(values) <= limit + 1e-9)))
        if wrong.size:
            i = int(wrong[0])
            where = f"{what} {('linear.', 'angular.')[i // 3] if len(values) == 6 and len(names) == 3 else ''}"
            expected = "-1 to 1 (command_in_type is unitless)" if np.isfinite(limit) else "a finite number"
            text = f"{where}{names[i % len(names)]} is {values[i]}, expected {expected}"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        return values

    def _take(self, name: str, command: ServoCommand) -> None:
        if name not in self._started:
            raise OpenArmError(Code.NOT_READY, f"servoing of the {name} arm is not started; call start_servo")
        if self._around is None:
            raise OpenArmError(Code.NOT_READY, f"servoing can't begin: {self._missing}")
        with self._lock:
            arm = self._arms[name]
            if not arm.busy:
                if arm.arm is not self._service.arms[name]:  # a camera is mounted elsewhere, or the lift is
                    arm = self._arms[name] = self._make(name)
                self._service.claims.take(name, why=_OWNED)
                self._claimed.add(name)
            arm.take(command)

    # --- what is around
    async def refresh(self) -> None:
        """Look at what is around the arms, where it has changed.

        Raises:
            OpenArmError: when the arms or the map can't be seen.
        """
        try:
            found = await self._service.around_all(self._seen)
            if found is not None:
                arms, config = list(self._service.arms.values()), self._config
                around = await self._service.robot.compute(
                    lambda: Surroundings.of(arms, found.prepared.complete(), found.held, config.clearance, config.lag)
                )
                with self._lock:
                    self._around, self._seen = around, found.seen
        except OpenArmError as error:
            self._missing, self._seen = error.message, None
            with self._lock:
                self._around = None
            raise

    # --- set points
    def fail(self, why: str) -> None:
        """Send no more set points, because something is wrong here; the last trajectories end at rest."""
        with self._lock:
            self._started.clear()
            for name in sorted(self._claimed):
                self._arms[name].drop()
                self._arms[name].report = ServoReport(ServoState.INVALID, f"the {name} arm stops: {why}")
                self._service.claims.give(name)
            self._claimed.clear()

    def tick(self, wall: float) -> None:
        """Send every arm that is commanded its next set point; at the pace of `publish_period`.

        Args:
            wall: Present time, s.
        """
        with self._lock:
            for name in sorted(self._claimed):
                self._tick(name, wall)

    def _tick(self, name: str, wall: float) -> None:
        stamp_ns, at = self._heard.get(name, (0, -np.inf))
        age = wall - at
        now_ns = stamp_ns + round(min(max(age, 0.0), _FORESEEN) * 1e9)
        arm = self._arms[name]
        why = ""
        if age > _STALE:
            why = f"no /joint_states for {age:.2f} s"
        elif self._around is None:
            why = self._missing
        elif self._service.closing:
            why = "the node ends"
        if why:
            arm.halt()
        around = self._around
        if around is not None and age <= _STALE:
            others = {other: self._others(other, now_ns) for other in around.names if other != name}
            measured = self._positions(name)
            found = arm.tick(now_ns, wall, (stamp_ns, measured), around, others)
            if found is not None:
                self._send(name, *found)
        else:
            arm.drop()  # the last trajectory ends at rest
        if why:
            arm.report = ServoReport(ServoState.INVALID, f"the {name} arm stops: {why}")
        if not arm.busy:
            self._service.claims.give(name)
            self._claimed.discard(name)

    def _positions(self, name: str) -> Array:
        return np.array([self._state[joint] for joint in self._arms[name].arm.names])

    def _others(self, name: str, now_ns: int) -> Array:
        """Positions (m, n) of another arm from now on."""
        arm = self._arms[name]
        here = self._positions(name)[None]
        if arm.busy:
            return np.concatenate([here, arm.ahead(now_ns)])
        motion = self._service.coordination.followers[name].active
        if motion is None:
            return here
        begin = (now_ns - motion.since_ns) * 1e-9
        times = np.clip(begin + np.linspace(0.0, _AHEAD, _SAMPLES), 0.0, motion.motion.duration)
        return np.concatenate([here, motion.motion.states(times)])
