# SPDX-License-Identifier: Apache-2.0
"""Ask for motions from plain Python: no node, no executor and no spinning in the caller's code. Base frame, m, rad."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import ArrayLike
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, MoveArms
from openarm_interfaces.msg import ArmTarget, PlanFailure
from openarm_interfaces.srv import ApplyScene, ComputeIK, GetScene

from openarm_common.errors import Answer, Code, OpenArmError
from openarm_common.ros.client import BackgroundNode
from openarm_common.ros.convert import matrix_to_pose, trajectory_from_msg
from openarm_common.types import Array
from openarm_motion.collision.solids import Box, Solid
from openarm_motion.ros import convert
from openarm_motion.timing.trajectory import Trajectory

#: Longest wait for a motion, s of wall clock.
_LONG = 120.0


@dataclass(frozen=True, eq=False)
class MotionResult(Answer):
    """How a motion ended.

    Success: it arrived (plan only: there is a plan).

    Attributes:
        trajectories: The plan, of each arm that was asked for; empty without one.
        scene_version: Version of the planning scene that it was made in; 0 for `execute`.
        failure: Reason and place of the failure, and the nearest feasible goal, if any; None after a success.
    """

    trajectories: tuple[Trajectory, ...] = ()
    scene_version: int = 0
    failure: PlanFailure | None = None


class MotionClient(BackgroundNode):
    """Asks the motion node; a context manager.

    Args:
        timeout: Longest wait for the motion node to be there, s of wall clock.

    Example:
        ``with MotionClient() as motion: motion.move_to_pose("left", T).raise_for_code()``
    """

    def __init__(self, *, timeout: float = 10.0) -> None:
        super().__init__("motion_client", timeout=timeout)

    # --- one arm
    def move_to_joints(self, arm: str, q: ArrayLike, **options: Any) -> MotionResult:
        """Free path to joint positions (n,), rad.

        Args:
            arm: Arm, for example "left".
            q: The goal.
            options: `obstacles` and `attached` (boxes; without `attached` what the hand is known to hold, `hand_empty`
                drops it), `scale` of the velocity, `plan_only`, `max_start_delay` s for another arm under way,
                `scene_version` that the scene must have, `on_feedback(stage, progress)`.

        Raises:
            OpenArmError: NOT_READY, without a motion node; TIMEOUT. Everything else is in the result.
        """
        goal = MoveArm.Goal(arm=arm, kind=MoveArm.Goal.JOINTS)
        goal.joint_positions = np.asarray(q, np.float64).tolist()
        return self._move(goal, **options)

    def move_to_named(self, arm: str, posture: str, **options: Any) -> MotionResult:
        """Free path to a posture of the SRDF; options and errors as `move_to_joints`."""
        return self._move(MoveArm.Goal(arm=arm, kind=MoveArm.Goal.NAMED, named=posture), **options)

    def move_to_pose(
        self, arm: str, pose: Array, frame: str = "", *, position_only: bool = False, **options: Any
    ) -> MotionResult:
        """Free path of the tool to a pose (4, 4) in a frame; options and errors as `move_to_joints`."""
        goal = MoveArm.Goal(arm=arm, kind=MoveArm.Goal.POSE, pose=stamped(pose, frame))
        goal.position_only = position_only
        return self._move(goal, **options)

    def move_on_line(self, arm: str, pose: Array, frame: str = "", **options: Any) -> MotionResult:
        """Straight line of the tool to a pose (4, 4) in a frame; options and errors as `move_to_joints`."""
        return self._move(MoveArm.Goal(arm=arm, kind=MoveArm.Goal.LINEAR, pose=stamped(pose, frame)), **options)

    def execute(
        self,
        arm: str,
        plan: MotionResult,
        on_progress: Callable[[float], None] | None = None,
        *,
        max_start_delay: float = 0.0,
    ) -> MotionResult:
        """Carry out what was planned with `plan_only`; refused when the scene has changed since.

        With `max_start_delay` it rests first until another arm under way leaves room, for so many seconds at most.
        """
        goal = ExecuteTrajectory.Goal(arm=arm, scene_version=plan.scene_version, max_start_delay=max_start_delay)
        goal.trajectory = convert.trajectory_msg(plan.trajectories[0])
        deliver = None if on_progress is None else (lambda feedback: on_progress(feedback.progress))
        result = self.do(ExecuteTrajectory, "/motion/execute", goal, timeout=_LONG, on_feedback=deliver)
        return MotionResult(result.success, Code(result.code), result.message)

    # --- both arms
    def move_both(
        self,
        targets: Sequence[ArmTarget],
        *,
        strategy: int = MoveArms.Goal.ANY,
        obstacles: Sequence[Box] = (),
        scale: float = 0.0,
        plan_only: bool = False,
        scene_version: int = 0,
    ) -> MotionResult:
        """Both arms at once, kept apart; see openarm_interfaces/action/MoveArms. Errors as `move_to_joints`."""
        goal = MoveArms.Goal(targets=list(targets), strategy=strategy, velocity_scale=scale, plan_only=plan_only)
        goal.obstacles = [convert.box_msg(box) for box in obstacles]
        goal.expected_scene_version = scene_version
        result = self.do(MoveArms, "/motion/move_arms", goal, timeout=_LONG)
        return _result(result, result.trajectories)

    # --- kinematics and scene
    def compute_ik(self, arm: str, pose: Array, frame: str = "", *, position_only: bool = False) -> Array:
        """Joint positions (n,) with the tool at a pose (4, 4), nearest to the present ones.

        Raises:
            OpenArmError: UNREACHABLE, with the nearest reachable pose, and as the service says.
        """
        request = ComputeIK.Request(arm=arm, pose=stamped(pose, frame), position_only=position_only)
        answer = self.call(ComputeIK, "/motion/compute_ik", request)
        if not answer.success:
            raise OpenArmError(Code(answer.code), answer.message)
        return np.array(answer.joint_positions)

    def apply_scene(
        self, add: Sequence[Solid] = (), remove: Sequence[str] = (), *, clear: bool = False, expected: int = 0
    ) -> int:
        """Change the planning scene and return its version; every later plan sees the change.

        Raises:
            OpenArmError: STALE_DATA or INVALID_ARGUMENT; nothing was changed then.
        """
        request = ApplyScene.Request(clear=clear, remove=list(remove), expected_version=expected)
        request.add = [convert.solid_msg(solid, "") for solid in add]
        answer = self.call(ApplyScene, "/motion/apply_scene", request)
        if not answer.success:
            raise OpenArmError(Code(answer.code), answer.message)
        return int(answer.version)

    def scene(self) -> GetScene.Response:
        """The bodies of the planning scene, its version, and whether the map is used."""
        return self.call(GetScene, "/motion/get_scene", GetScene.Request())

    def _move(
        self,
        goal: MoveArm.Goal,
        *,
        obstacles: Sequence[Box] = (),
        attached: Sequence[Box] = (),
        hand_empty: bool = False,
        scale: float = 0.0,
        plan_only: bool = False,
        max_start_delay: float = 0.0,
        scene_version: int = 0,
        on_feedback: Callable[[str, float], None] | None = None,
    ) -> MotionResult:
        goal.obstacles = [convert.box_msg(box) for box in obstacles]
        goal.attached = [convert.box_msg(box) for box in attached]
        goal.hand_empty, goal.max_start_delay = hand_empty, max_start_delay
        goal.velocity_scale, goal.plan_only, goal.expected_scene_version = scale, plan_only, scene_version
        deliver = None if on_feedback is None else (lambda message: on_feedback(message.stage, message.progress))
        result = self.do(MoveArm, "/motion/move", goal, timeout=_LONG, on_feedback=deliver)
        return _result(result, [result.trajectory])


def stamped(T: Array, frame: str = "") -> PoseStamped:
    """Message of a pose (4, 4) in a frame; the base frame when that is empty."""
    message = PoseStamped(pose=matrix_to_pose(T))
    message.header.frame_id = frame
    return message


def _result(result: Any, messages: Sequence[Any]) -> MotionResult:
    trajectories: list[Trajectory] = []
    for message in messages:
        if message.points:
            names, t, q, v, a = trajectory_from_msg(message)
            rest = np.zeros_like(q)
            trajectories.append(Trajectory(tuple(names), t, q, rest if v is None else v, rest if a is None else a))
    failure = None if result.success else result.failure
    return MotionResult(
        result.success, Code(result.code), result.message, tuple(trajectories), int(result.scene_version), failure
    )
