# SPDX-License-Identifier: Apache-2.0
"""Action /calibration/auto: moves the arm from pose to pose by /motion/move, takes a sample at each, and solves."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from openarm_interfaces.action import AutoCalibrate, MoveArm
from openarm_interfaces.msg import CollisionBox
from openarm_interfaces.srv import ComputeCalibration
from rclpy.action import CancelResponse
from rclpy.action.server import ServerGoalHandle

from openarm_calibration.handeye.offline import Result
from openarm_calibration.handeye.verdict import estimate_delay
from openarm_calibration.ros.image_capture import wait_until
from openarm_calibration.sampling.next_pose import PoseSearch
from openarm_calibration.sampling.samples import SESSION_SUFFIXES, Sample
from openarm_common import se3
from openarm_common.asked_files import file_to_write
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.actions import ActionClient, ActionServer, run_goal
from openarm_common.ros.convert import matrix_to_pose, vector
from openarm_common.scene.boards import board_of
from openarm_common.types import Array

if TYPE_CHECKING:
    from openarm_calibration.ros.node import CalibrationNode


def fill(message: AutoCalibrate.Result | ComputeCalibration.Response, solved: Result, child: str) -> None:
    """Write a solved calibration into an answer.

    Args:
        message: Message of the action, or of compute_calibration.
        solved: The result.
        child: Frame whose mount it is.
    """
    calibration, verdict = solved.calibration, solved.verdict
    message.grade, message.reasons = verdict.grade, list(verdict.reasons)
    message.message = f"{verdict.grade}: {'; '.join(verdict.reasons) or 'within all limits'}"
    message.parent, message.child = calibration.parent, child
    message.mount = matrix_to_pose(calibration.T_parent_link)
    message.sigma_translation, message.sigma_rotation = calibration.sigma_translation, calibration.sigma_rotation
    message.outliers = [outlier.name for outlier in solved.solution.outliers]
    message.report = json.dumps(solved.as_json())


#: Codes of a pose that can't be reached, while another one may.
_ELSEWHERE = frozenset({Code.IN_COLLISION, Code.NO_PLAN, Code.UNREACHABLE, Code.LIMITS})
#: Codes of a pose that gave no sample, while another one may.
_NO_SAMPLE = frozenset({Code.NOTHING_DETECTED, Code.STALE_DATA, Code.MOVING})
#: Proposals of one search, and poses without a sample in a row before it is given up.
_AT_ONCE, _MISSES = 15, 6
#: Images of the moving arm that the delay needs, and are enough.
_FEWEST_MOVING, _ENOUGH_MOVING = 4, 16


class AutoCalibrateServer:
    """Serves the action.

    Args:
        node: Node that has the samples, the solver and the store.
    """

    def __init__(self, node: CalibrationNode) -> None:
        self._node = node
        self._mover = ActionClient(node, MoveArm, "/motion/move")
        self._server = ActionServer(
            node, AutoCalibrate, "/calibration/auto", self._execute, cancel_callback=lambda _: CancelResponse.ACCEPT
        )

    async def _execute(self, handle: ServerGoalHandle) -> AutoCalibrate.Result:
        begin = time.monotonic()
        result = AutoCalibrate.Result()
        try:
            with self._node.work("calibrating automatically"):
                run = _Run(self._node, self._mover, handle, result)
                await run.sample()
                await run.solve()
            result.success, result.code = True, Code.OK.value
            handle.succeed()
        except OpenArmError as error:
            result.code, result.message = error.code.value, error.message
            if error.code == Code.CANCELLED and handle.is_cancel_requested:
                handle.canceled()
            else:
                handle.abort()
        result.samples = len(self._node.samples)
        result.duration = time.monotonic() - begin
        return result


class _Run:
    """One goal."""

    def __init__(
        self, node: CalibrationNode, mover: ActionClient, handle: ServerGoalHandle, result: AutoCalibrate.Result
    ) -> None:
        self._node, self._mover, self._handle, self._result = node, mover, handle, result
        self._goal: AutoCalibrate.Goal = handle.request
        self._config = config = node.config.auto
        node.use(self._goal.camera or node.camera.name, self._goal.carrier)
        head = node.samples.head
        self._arm = node.description.arm_of(head.parent if head.setup == "in_hand" else head.carrier)
        self._poses = int(self._goal.poses) or config.poses
        self._enough_t = self._goal.sigma_translation or config.sigma_translation
        self._enough_r = self._goal.sigma_rotation or config.sigma_rotation
        fixed = head.setup == "to_hand"
        place = (config.on_hand if fixed else config.on_table).pose
        if place is None and config.as_in_scene:
            place = board_of(node.camera, node.description, self._arm)[1]
        self._fixed = fixed
        self._search = PoseSearch(node.description, node.camera.T_parent_optical, place, config.search)

    # --- taking samples
    async def sample(self) -> None:
        """Take samples until the result is certain enough, or the budget is spent.

        Raises:
            OpenArmError: CANCELLED; what keeps the arm or the camera from working.
        """
        if self._search.belief.Z is None:
            await self._first()
        missed = 0
        while len(self._node.samples) < self._poses:
            q = await self._next()
            self._report("sampling", "")
            try:
                await self._take()
            except OpenArmError as error:
                if error.code not in _NO_SAMPLE:
                    raise
                missed += 1
                self._miss(q, error)
                if missed >= _MISSES:
                    raise OpenArmError(
                        error.code, f"{missed} poses in a row gave no sample; of the last: {error.message}"
                    ) from error
                continue
            missed = 0
            belief = await self._node.in_thread(self._search.learn, self._node.samples)
            certain = belief.sigma_translation < self._enough_t and belief.sigma_rotation < self._enough_r
            if certain and len(self._node.samples) >= min(self._config.fewest, self._poses):
                break

    async def _first(self) -> None:
        """Take a sample at the present posture, to locate the board."""
        self._report("sampling", "at the present posture, to locate the board")
        try:
            await self._take()
        except OpenArmError as error:
            if error.code != Code.NOTHING_DETECTED:
                raise
            key = "on_hand" if self._fixed else "on_table"
            raise OpenArmError(
                Code.NOTHING_DETECTED,
                f"the position of the board is not configured (parameter auto.{key}.position), and it is not in view:"
                f" {error.message}",
            ) from error
        await self._node.in_thread(self._search.learn, self._node.samples)

    async def _next(self) -> Array:
        """Move to the most informative pose that the arm reaches, and return the posture.

        Raises:
            OpenArmError: The planner's error for the last one, when none is reached; CANCELLED and the like at once.
        """
        fault: OpenArmError | None = None
        tried = 0
        while tried < self._config.tries:
            self._report("looking", "for the most informative pose")
            state = await self._node.capture.state()
            for q in await self._node.in_thread(self._search.propose, self._node.samples, state, _AT_ONCE):
                self._report("moving", f"try {tried + 1}: the arm did not reach the one before" if tried else "")
                tried += 1
                try:
                    await self._move(q, self._config.velocity_scale, self._stopped)
                except OpenArmError as error:
                    if error.code not in _ELSEWHERE:
                        raise
                    fault = error
                    self._search.refuse(q)
                    continue
                return q
        last = fault.message if fault is not None else "none was proposed"
        raise OpenArmError(Code.NO_PLAN, f"the arm reaches none of {tried} poses; of the last: {last}")

    async def _take(self) -> Sample:
        """Take a sample as soon as the arm is at rest and images come."""
        began = time.monotonic()
        longest = {Code.MOVING: self._config.settle_timeout, Code.NOT_READY: self._config.camera_timeout}
        while True:
            self._check()
            try:
                return await self._node.take()
            except OpenArmError as error:
                if time.monotonic() > began + longest.get(error.code, 0.0):
                    raise

    def _miss(self, q: Array, error: OpenArmError) -> None:
        self._search.refuse(q, reached=True)
        posture = ", ".join(f"{position:.2f}" for position in q)
        self._result.missed.append(f"({posture}): {error.message}")
        self._node.get_logger().info(f"no sample at ({posture}): {error.message}")

    # --- the arm
    async def _move(self, q: Array, scale: float, stopped: Callable[[], bool]) -> None:
        """Move to a posture.

        Raises:
            OpenArmError: Same as /motion/move, or NOT_READY without it; CANCELLED, with the arm stopped.
        """
        moved, names = self._node.description.arm_joints(self._arm), self._node.samples.joint_names
        positions = [position for name, position in zip(names, q.tolist(), strict=True) if name in moved]
        goal = MoveArm.Goal(arm=self._arm, kind=MoveArm.Goal.JOINTS, joint_positions=positions)
        goal.velocity_scale = scale
        self._surround(goal)
        until, limit = partial(wait_until, self._node), self._config.move_timeout
        answer: MoveArm.Result | None = await run_goal(self._mover, goal, until, stopped=stopped, limit=limit)
        if answer is None or stopped():
            self._check()
            return  # stopped for another reason than a cancel
        if not answer.success:
            self._check()
            if answer.code not in Code.__members__:
                raise OpenArmError(
                    Code.INTERNAL, "/motion/move ended without an answer; see the log of the motion node"
                )
            raise OpenArmError(Code(answer.code), answer.message)

    def _surround(self, goal: MoveArm.Goal) -> None:
        """Let the planner know of the board."""
        Z = self._search.belief.Z
        if Z is None:
            return
        thick = self._config.plate
        box = CollisionBox(id="calibration board", size=vector((*self._node.samples.board.size, thick)))
        T_carrier_box = Z @ se3.make(None, (0.0, 0.0, thick / 2.0))  # the board's z points into it
        if not self._fixed:
            box.pose = matrix_to_pose(T_carrier_box)
            goal.obstacles, goal.hand_empty = [box], True  # of the camera before, the board was in the hand
            return
        description = self._node.description
        tool, carrier = description.tcp_link(self._arm), self._node.samples.head.carrier
        anyhow = dict.fromkeys(description.joints, 0.0)  # the two are fixed to each other
        T_tool_carrier = se3.inverse(description.link_pose(tool, anyhow)) @ description.link_pose(carrier, anyhow)
        box.pose = matrix_to_pose(T_tool_carrier @ T_carrier_box)
        goal.attached = [box]

    # --- solving
    async def solve(self) -> None:
        """Solve, judge, and store the result if the goal says so."""
        goal, result, node = self._goal, self._result, self._node
        self._report("solving", f"{len(node.samples)} samples")
        if goal.session:
            node.samples.save(file_to_write(goal.session, SESSION_SUFFIXES))
        solved: Result = await node.solve()
        fill(result, solved, node.camera.link_frame)
        if goal.measure_delay:
            result.delay, result.delay_sigma = await self._delay()
        if goal.save:
            result.path = str(node.save())
            result.message += f"; stored in {result.path}"

    async def _delay(self) -> tuple[float, float]:
        """Return the age of the images at their stamps, s, and its predicted error: from a slow motion to a far pose.

        Raises:
            OpenArmError: NOTHING_DETECTED, when the moving arm was seen too rarely.
        """
        node = self._node
        here = node.samples.samples[-1].joints
        names = node.samples.joint_names

        def away(sample: Sample) -> float:
            return max(abs(sample.joints[name] - here[name]) for name in names)

        far = max(node.samples.samples, key=away)
        both = node.samples.copy()
        begun, seen = len(both), 0
        q = np.array([far.joints[name] for name in names])
        executor = node.executor
        assert executor is not None  # it runs this coroutine
        motion = executor.create_task(
            self._move, q, self._config.delay_velocity_scale, lambda: self._stopped() or seen >= _ENOUGH_MOVING
        )
        with node.capture.listening():
            while not motion.done() and seen < _ENOUGH_MOVING:
                self._report("delay", f"{seen} images of the moving arm")
                try:
                    t_ns, matched, detection, _ = await node.observe(moving=True)
                except OpenArmError as error:
                    if error.code not in _NO_SAMPLE:
                        raise
                    continue
                if matched.speed > node.config.gate.max_speed:
                    both.take(t_ns, matched, detection)
                    seen = len(both) - begun
        await motion
        self._check()
        if seen < _FEWEST_MOVING:
            raise OpenArmError(
                Code.NOTHING_DETECTED,
                f"{seen} images of the moving arm showed the board, at least {_FEWEST_MOVING} are needed for the delay;"
                " lower auto.delay_velocity_scale",
            )
        return await node.in_thread(estimate_delay, both)

    # --- feedback
    def _stopped(self) -> bool:
        return bool(self._handle.is_cancel_requested)

    def _check(self) -> None:
        if self._stopped():
            raise OpenArmError(Code.CANCELLED, f"cancelled after {len(self._node.samples)} samples; the arm is stopped")

    def _report(self, stage: str, message: str) -> None:
        self._check()
        belief = self._search.belief
        feedback = AutoCalibrate.Feedback(stage=stage, message=message, poses=self._poses)
        feedback.pose = min(len(self._node.samples) + 1, self._poses)
        if belief.solved:
            feedback.sigma_translation, feedback.sigma_rotation = belief.sigma_translation, belief.sigma_rotation
        self._handle.publish_feedback(feedback)
