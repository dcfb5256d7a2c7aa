# SPDX-License-Identifier: Apache-2.0
"""The controllers of a robot that is reached by its joint states and by position commands alone.

What it is told is a stream of positions, one for each control tick, which its driver passes on to position servos.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.pacing import Pacer, PeriodMeter
from openarm_common.robot.turns import nearest_turns
from openarm_common.types import Array
from openarm_control.controller import RobotController
from openarm_control.joints import JointReadout
from openarm_control.loop import ControlLoop

PERIOD_NS = 10_000_000
#: Joint states that are further apart than this, rad (fingers: m), and what these move meanwhile, rad/s (m/s), are of a
#: robot that was put elsewhere, or of an encoder that jumped.
_JUMP_ARM, _SPEED_ARM = 0.05, 6.0
_JUMP_FINGER, _SPEED_FINGER = 0.005, 0.5
#: Time over which a finger's velocity is taken from its positions, s.
_FINGER_S = 0.05
#: After a pause of the process commands go on where they were, faster by this share until they are in time; after a
#: longer one than `_LOST_NS` they do not come back to it.
_CATCH_UP_NS, _LOST_NS = PERIOD_NS // 5, 1_000_000_000
#: For so long the robot is waited for to say what targets its servos have, once there are joint states.
_TARGETS_NS = 100_000_000
#: Joints are taken to go on as they moved since the stamp of their state for so long at most, s.
_FORESEEN_S = 0.05


class Driver(Protocol):
    """What the loop needs of the robot; called in its thread."""

    def now_ns(self) -> int:
        """Return the present time of stamps."""
        ...

    def take(self) -> JointReadout | None:
        """Return the newest joint state that has come since the last call, at the time of its stamp."""
        ...

    def fault(self) -> str:
        """Return why the robot takes no targets now; nothing: it does."""
        ...

    def targets(self, since_ns: int) -> Array:
        """Return the targets (n,) that the servos have, by what the robot said since a stamp; NaN where it did not."""
        ...

    def send(self, targets: Array) -> None:
        """Command positions (n,) of all joints."""
        ...


class StreamedRobot(ControlLoop):
    """Runs controllers on a robot behind a `Driver`.

    Args:
        controller: Controller of its joints.
        driver: Reaches it.
        stale_after: Age of joint states from which on nothing is commanded, s.
        observe: Called at the end of each tick.
        crashed: Called when the thread ends by an unexpected error.
    """

    def __init__(
        self,
        controller: RobotController,
        driver: Driver,
        stale_after: float,
        observe: Callable[[JointReadout], None],
        crashed: Callable[[Exception], None] | None = None,
    ) -> None:
        super().__init__("control", controller, crashed)
        self._robot = controller
        self.periods = PeriodMeter()
        self.fault = "there is no joint state yet"
        self._driver = driver
        self._stale_ns = round(stale_after * 1e9)
        self._observe = observe
        self._pacer = Pacer(PERIOD_NS, max_debt_ns=PERIOD_NS // 2)
        self._state: JointReadout | None = None
        self._received_ns = 0
        self._ticked_ns = 0
        #: Stamp of the joint state and wall time from which on the targets of the servos are waited for.
        self._waits_since: tuple[int, int] | None = None
        self._fingers = np.array(
            [controller.joint_names.index(gripper.group.names[0]) for gripper in controller.grippers.values()]
        )
        self._jump, self._speed = (np.full(len(controller.joint_names), x) for x in (_JUMP_ARM, _SPEED_ARM))
        levers = np.abs([gripper.group.lever for gripper in controller.grippers.values()])
        self._jump[self._fingers], self._speed[self._fingers] = _JUMP_FINGER / levers, _SPEED_FINGER / levers
        self._finger_at: Array = np.zeros(len(self._fingers))
        self._finger_velocity: Array = np.zeros(len(self._fingers))
        self._finger_ns = 0

    def _read(self) -> JointReadout:
        if self._state is None:
            raise OpenArmError(Code.NOT_READY, self.fault)
        return self._state

    def _turn(self) -> float:
        wall_ns = time.monotonic_ns()
        wait_ns = self._pacer.wait_ns(wall_ns)
        if wait_ns > 0:
            return wait_ns * 1e-9
        self._pacer.ticked(wall_ns)
        self._tick(wall_ns)
        return 0.0

    def _tick(self, wall_ns: int) -> None:
        fresh = self._driver.take()
        if fresh is not None:
            self._received_ns = wall_ns
            self._note(fresh)
        if self._state is None:
            return
        if why := self._driver.fault():
            self._lose(why)
            return
        if wall_ns - self._received_ns > self._stale_ns:
            self._lose(f"no joint state for {(wall_ns - self._received_ns) * 1e-9:.2f} s; is the driver alive?")
            return
        if self.fault and not self._begins(self._state, wall_ns):
            return
        now_ns = self._driver.now_ns()
        self._ticked_ns = t_ns = self._next_stamp(now_ns)
        state = replace(self._state, t_ns=t_ns, position=self._position_at(now_ns))
        targets = self._robot.update(state, PERIOD_NS)
        self._driver.send(targets)
        self.periods.add(wall_ns)
        self._observe(state)

    def _next_stamp(self, now_ns: int) -> int:
        """Return the time of a tick: a period after the last one, or a little more where it is late."""
        next_ns = self._ticked_ns + PERIOD_NS
        late_ns = now_ns - next_ns
        if not -PERIOD_NS // 2 <= late_ns <= _LOST_NS:
            return now_ns
        return next_ns if late_ns <= PERIOD_NS // 2 else next_ns + _CATCH_UP_NS

    def _position_at(self, now_ns: int) -> Array:
        """Return where the joints are now, by the newest state."""
        assert self._state is not None
        age_s = min(max(0.0, (now_ns - self._state.t_ns) * 1e-9), _FORESEEN_S)
        return self._state.position + age_s * self._state.velocity

    def _note(self, fresh: JointReadout) -> None:
        """Take a joint state; give up when it says that the robot was put elsewhere.

        Joints that turn without end go on from the last state, whatever turn an encoder starts again with.
        """
        before = self._state
        if before is not None:
            fresh = replace(fresh, position=nearest_turns(fresh.position, before.position, self._robot.upper))
        self._state = self._with_finger_velocity(fresh)
        if before is not None and not self.fault:
            moved = np.abs(fresh.position - before.position)
            excess = moved - self._jump - self._speed * max(0.0, (fresh.t_ns - before.t_ns) * 1e-9)
            j = int(np.argmax(excess))
            if excess[j] > 0.0:
                self._lose(
                    f"{self.controller.joint_names[j]} jumped by {moved[j]:.3f} from one joint state to the next"
                )

    def _begins(self, state: JointReadout, wall_ns: int) -> bool:
        """Hold where the robot is, from the targets that its servos have; False while these are waited for.

        What they had before the joints were where they are now says nothing: taken for the present targets, it would
        be a blow.
        """
        if self._waits_since is None:
            self._waits_since = (state.t_ns, wall_ns)
        since_ns, began_ns = self._waits_since
        targets = nearest_turns(self._driver.targets(since_ns), state.position, self._robot.upper)
        if np.isnan(targets).any() and wall_ns - began_ns < _TARGETS_NS:
            return False
        self._waits_since, self.fault = None, ""
        self.controller.reset(state)
        self._robot.begin(targets)
        return True

    def _lose(self, why: str) -> None:
        """Command nothing more; goals are given up."""
        if not self.fault:
            self.controller.abort(why)
        self.fault, self._waits_since = why, None

    def _with_finger_velocity(self, fresh: JointReadout) -> JointReadout:
        """Fill in the velocity of the fingers, of which such drivers say nothing."""
        at = fresh.position[self._fingers]
        seconds = (fresh.t_ns - self._finger_ns) * 1e-9
        if seconds > _FINGER_S or seconds < 0.0:
            moved = (at - self._finger_at) / seconds
            self._finger_velocity = moved if 0.0 < seconds < 10.0 * _FINGER_S else np.zeros_like(at)
            self._finger_at, self._finger_ns = at, fresh.t_ns
        velocity = fresh.velocity.copy()
        velocity[self._fingers] = self._finger_velocity
        return replace(fresh, velocity=velocity)
