# SPDX-License-Identifier: Apache-2.0
"""Identification of the servos of an arm in the running graph: planned motions to postures, and waves around them."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cached_property

import numpy as np
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTolerance, JointTrajectoryControllerState
from rcl_interfaces.srv import GetParameters

from openarm_calibration.dynamics.excite import postures, waves
from openarm_calibration.dynamics.identify import Identified, ServoLog, identify
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.servos import ArmLoad
from openarm_common.ros.convert import stamp_to_ns, trajectory_to_msg
from openarm_common.ros.node import QOS_COMMAND
from openarm_common.scene.scene import load_scene
from openarm_common.types import Array
from openarm_motion.config import MotionConfig
from openarm_motion.ros.client import MotionClient
from openarm_motion.service.motion_service import make_arms, table_box

#: A wave has this long beyond its duration, and joint states to be there, s of wall clock.
_OVERTIME_S = 20.0
_ANSWER_S = 5.0
_BRIDGE = "mujoco_bridge"


def named_arms(arm: str) -> tuple[str, ...]:
    """Return the arms that an option names: one, or `both` for all.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the choices.
    """
    names = RobotDescription.load().arm_names
    if arm not in (*names, "both"):
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--arm {arm}: expected {', '.join(names)} or both")
    return names if arm == "both" else (arm,)


class DynamicsClient(MotionClient):
    """Moves arms of the running graph so that their servos show; a context manager."""

    def __init__(self) -> None:
        super().__init__()
        self._description = RobotDescription.load()
        self._arms = make_arms(MotionConfig(), self._description, (table_box(load_scene("demo").table),))

    def dynamics_seed(self) -> int | None:
        """Return the seed of the simulated robot; None for a real one.

        Raises:
            OpenArmError: NOT_READY, without joint states; INVALID_ARGUMENT, when its servos carry the arms by
                themselves.
        """
        deadline = time.monotonic() + _ANSWER_S
        while not (sources := self._sources()):
            if time.monotonic() > deadline:
                raise OpenArmError(Code.NOT_READY, "there is no publisher of /joint_states; is a graph running?")
            time.sleep(0.05)
        if _BRIDGE not in sources:
            return None
        asked = GetParameters.Request(names=["profile", "openarm.dynamics_seed"])
        profile, seed = self.call(GetParameters, f"/{_BRIDGE}/get_parameters", asked).values
        if profile.string_value == "ideal":
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                "the servos of the profile `ideal` are known: start the graph with the default one, `openarm`, to"
                " identify those of a robot as owners have it",
            )
        return int(seed.integer_value)

    @cached_property
    def _controller(self) -> str:
        """The action of an arm's controller, as the motion node has it."""
        (value,) = self.call(
            GetParameters, "/motion/get_parameters", GetParameters.Request(names=["controller"])
        ).values
        return str(value.string_value)

    def _sources(self) -> set[str]:
        """Return the names of the nodes that publish joint states, those of which discovery knows them."""
        names = {info.node_name for info in self._node.get_publishers_info_by_topic("/joint_states")}
        return {name for name in names if not name.startswith("_")}

    def identify(self, side: str, count: int, on_posture: Callable[[int, int], None]) -> Identified:
        """Identify the servos of an arm, and bring it back to its posture `home`.

        Args:
            side: left or right.
            count: Postures; six are usual.
            on_posture: Called before each with its number, from 1, and how many there are.

        Raises:
            OpenArmError: Error of the motion node; EXECUTION_FAILED, when the controller gives up; NO_PLAN, when no
                posture is free; INVALID_ARGUMENT, when motions show too little.
        """
        description, arm = self._description, self._arms[side]
        load, logs = ArmLoad(description, arm.names, description.tcp_link(side)), list[ServoLog]()
        home = {n: q for s in description.arm_names for n, q in description.group_state(f"{s}_arm", "home").items()}
        home |= {hand.joint: hand.closed for hand in description.hands.values()}
        collides = arm.scene(home, ()).collides
        lower, upper = description.limits(arm.names, np.pi)
        chosen = postures(lower, upper, load, lambda q: not collides(q), count, np.random.default_rng(0))
        for k, posture in enumerate(chosen, 1):
            on_posture(k, count)
            there = self.move_to_joints(side, posture)
            if there.success:
                logs += self._wave(side, arm.names, *waves(posture))
            elif there.code not in (Code.IN_COLLISION, Code.NO_PLAN):  # what the map has may be in the way of one
                there.raise_for_code()
        self.move_to_named(side, "home").raise_for_code()
        return identify(logs, load)

    def _wave(self, side: str, names: tuple[str, ...], t: Array, q: Array) -> list[ServoLog]:
        """Play a wave and return what the controller says of it."""
        action, states = self._controller.format(arm=side), list[JointTrajectoryControllerState]()
        topic = f"{action.rpartition('/')[0]}/controller_state"
        subscription = self._node.create_subscription(JointTrajectoryControllerState, topic, states.append, QOS_COMMAND)
        goal = FollowJointTrajectory.Goal(trajectory=trajectory_to_msg(names, t, q))
        goal.path_tolerance = [JointTolerance(name=name, position=-1.0) for name in names]
        goal.goal_tolerance = [JointTolerance(name=name, position=-1.0) for name in names]
        try:
            result = self.do(
                FollowJointTrajectory,
                action,
                goal,
                timeout=float(t[-1]) + _OVERTIME_S,
            )
        finally:
            self._node.destroy_subscription(subscription)
        if result.error_code != FollowJointTrajectory.Result.SUCCESSFUL:
            raise OpenArmError(Code.EXECUTION_FAILED, f"controller of the {side} arm: {result.error_string}")
        return pieces(names, states)


def pieces(names: tuple[str, ...], states: list[JointTrajectoryControllerState]) -> list[ServoLog]:
    """Return the states of a controller as logs of equal steps: what lies between gaps.

    Raises:
        OpenArmError: STALE_DATA, when the controller publishes no targets of its servos.
    """
    usable = [state for state in states if len(state.output.positions) == len(names)]
    if len(usable) < 2:
        raise OpenArmError(
            Code.STALE_DATA,
            f"{len(usable)} of {len(states)} messages on controller_state have the output of all joints; the controller"
            " has to publish what it commands",
        )
    order = [list(usable[0].joint_names).index(name) for name in names]
    t_ns = np.array([stamp_to_ns(state.header.stamp) for state in usable])
    target, position = (
        np.array([getattr(state, part).positions for state in usable])[:, order] for part in ("output", "feedback")
    )
    steps = np.diff(t_ns)
    period = int(np.median(steps))
    cuts = np.flatnonzero(np.abs(steps - period) > 0.1 * period) + 1
    return [
        ServoLog(period * 1e-9, target[piece], position[piece])
        for piece in np.split(np.arange(len(usable)), cuts)
        if len(piece) > 1
    ]
