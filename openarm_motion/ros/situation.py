# SPDX-License-Identifier: Apache-2.0
"""What a request to the motion node starts from: joints, planning scene, map, what the hands hold."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from geometry_msgs.msg import PoseStamped

from openarm_common.octree.distance_field import field_path
from openarm_common.ros.convert import pose_to_matrix
from openarm_common.ros.node import BASE_FRAME
from openarm_common.types import Array
from openarm_motion.collision.seen import Known, carried
from openarm_motion.collision.solids import Box, Solid
from openarm_motion.planning.arm import Arm, Situation
from openarm_motion.ros.follower import Robot, Watch, stale
from openarm_motion.scene.map_eye import Look, MapEye, unexplained
from openarm_motion.scene.planning_scene import PlanningScene

#: Beside an arm under way plans keep this distance from where it will end, m: more than what is then proven.
_BESIDE = 0.035


@dataclass(frozen=True, eq=False)
class Prepared:
    """A situation without the map yet, the scene's version, and what the answer says of the map."""

    now: Situation
    version: int
    note: str
    complete: Callable[[], Situation]


class Situations:
    """Makes situations from what the node knows.

    Args:
        robot: The robot and its node.
        scene: Bodies.
    """

    def __init__(self, robot: Robot, scene: PlanningScene) -> None:
        self._node, self._states, self._arms = robot.node, robot.states, robot.arms
        self._followers, self._held, self._scene = robot.followers, robot.held, scene
        node = robot.node
        name = node.config.map.name or str(node.context.get_domain_id())
        self._eye = MapEye(node.config.map, field_path(name), (BASE_FRAME, node.description.root))

    def look(self) -> Look:
        """The map as it is now; what is required and missing is an error, see `MapEye.look`."""
        return self._eye.look(time.monotonic_ns())

    def prepare(
        self,
        arm: Arm,
        start: Sequence[float],
        scale: float,
        stopped: Callable[[], bool],
        estimates: Sequence[Box] = (),
        attached: Sequence[Box] = (),
        expected: int = 0,
    ) -> Prepared:
        """The robot as it is now; a given start is enough where the joint states are missing.

        Another arm under way is taken to be where it will end.

        Args:
            arm: The arm that is asked.
            start: Its joints, or empty for the present ones.
            scale: Velocity scale.
            stopped: Whether the request was cancelled.
            estimates: Boxes of the request: what the map shows of them is theirs.
            attached: What the arm holds, tool frame.
            expected: Version that the scene must have; 0 is any.

        Returns:
            `complete` takes some ms and is for a worker thread.

        Raises:
            OpenArmError: from `Arm.situation`, `PlanningScene.require` and `MapEye.look`; NOT_READY without joints.
        """
        self._scene.require(expected)
        now = self.situation(arm, start, scale, stopped)
        ends = self._ends(arm)
        later = {**now.state, **ends}
        solids = (*self._scene.solids, *self._others_hold(arm, later))
        held = carried(attached, arm.kinematics.fk(now.start))
        return self._prepared(now, solids, estimates, held, later, _BESIDE if ends else 0.0)

    def prepare_both(
        self,
        arms: Sequence[Arm],
        scale: float,
        stopped: Callable[[], bool],
        estimates: Sequence[Box],
        attached: Sequence[Sequence[Box]],
        expected: int,
    ) -> Prepared:
        """As `prepare`, for two arms: `start` is the joints of both."""
        self._scene.require(expected)
        parts = [self.situation(arm, (), scale, stopped) for arm in arms]
        held = [
            box
            for arm, part, boxes in zip(arms, parts, attached, strict=True)
            for box in carried(boxes, arm.kinematics.fk(part.start))
        ]
        now = replace(parts[0], start=np.concatenate([part.start for part in parts]))
        return self._prepared(now, self._scene.solids, estimates, held, now.state)

    def situation(self, arm: Arm, start: Sequence[float], scale: float, stopped: Callable[[], bool]) -> Situation:
        """Joints alone, without scene and map."""
        state: dict[str, float] = {}
        age = self._states.age_s()
        if age <= self._node.config.execution.stale_after:
            state = self._states.buffer.latest()[1]
        elif len(start) == 0:
            raise stale(age)
        return arm.situation(state, start, scale, stopped)

    async def fresh(self) -> None:
        """Wait a moment for a fresh joint state; see `Watch.fresh`."""
        if self._states.age_s() <= self._node.config.execution.stale_after:
            return
        watch = Watch(self._node, self._states)
        try:
            await watch.fresh()
        finally:
            watch.close()

    def pose(self, message: PoseStamped) -> Array:
        """`T_base_pose` (4, 4) of a pose in any known frame.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for a pose that is none; NO_TRANSFORM, listing the frames there are.
        """
        T_frame_pose = pose_to_matrix(message.pose)
        frame = message.header.frame_id
        if frame in ("", BASE_FRAME):
            return T_frame_pose
        buffer = self._states.buffer
        stamp_ns = buffer.latest()[0] if self._states.age_s() < float("inf") else 0
        return buffer.lookup(self._node.description.root, frame, stamp_ns) @ T_frame_pose

    def unchanged(self, version: int) -> None:
        """Refuse to carry out what was planned in another scene.

        Raises:
            OpenArmError: STALE_DATA, with both versions.
        """
        self._scene.require(version)

    def _prepared(
        self,
        now: Situation,
        solids: tuple[Solid, ...],
        estimates: Sequence[Box],
        held: Sequence[Box],
        later: Mapping[str, float],
        apart: float = 0.0,
    ) -> Prepared:
        look, config = self.look(), self._node.config.map
        certain = (*self._scene.fixed, *solids)
        robot = next(iter(self._arms.values())).description  # with what is mounted on it

        def complete() -> Situation:
            seen = look.seen
            if seen is not None:
                seen = unexplained(seen, config, robot, now.state, certain, [*estimates, *held])
            return replace(now, state=later, known=Known(solids, seen, apart))

        # a graph without a map is as it should be; one with an old map is not
        note = f" without the map: {look.why}" if look.why and look.version else ""
        return Prepared(now, self._scene.version, note, complete)

    def _ends(self, arm: Arm) -> dict[str, float]:
        """Where the joints of the other arms under way will end."""
        under_way = [f.running for name, f in self._followers.items() if name != arm.name and f.running is not None]
        return {joint: x for running in under_way for joint, x in running.motion.at(running.motion.duration).items()}

    def _others_hold(self, arm: Arm, state: Mapping[str, float]) -> list[Box]:
        """What the other arms hold, where they hold it in a state."""
        boxes: list[Box] = []
        for name, held in self._held.held.items():
            other = self._arms[name]
            if other is arm or any(joint not in state for joint in other.names):
                continue
            T = other.kinematics.fk(np.array([state[joint] for joint in other.names]))
            boxes += [replace(box, id=f"{box.id} in the {name} hand") for box in carried(held, T)]
        return boxes
