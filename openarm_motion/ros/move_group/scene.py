# SPDX-License-Identifier: Apache-2.0
"""The planning scene of the motion service as MoveIt's: services and topics."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from moveit_msgs.msg import (
    AllowedCollisionEntry,
    AllowedCollisionMatrix,
    AttachedCollisionObject,
    CollisionObject,
    MoveItErrorCodes,
    ObjectColor,
    PlanningScene,
)
from moveit_msgs.msg import PlanningSceneComponents as Components
from moveit_msgs.srv import ApplyPlanningScene, GetPlanningScene

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.node import QOS_COMMAND, BaseNode
from openarm_common.types import Array
from openarm_motion.collision.occupancy import MAP
from openarm_motion.ros.move_group.codes import MoveItError
from openarm_motion.ros.move_group.convert import Converter, as_moveit, object_msg, state_msg
from openarm_motion.ros.move_group.fields import ATTACHED, OBJECT, SCENE, check_fields
from openarm_motion.ros.move_group.octomap import SceneOctomap
from openarm_motion.scene.bodies import SceneBodies, SceneBody, SceneDraft

if TYPE_CHECKING:
    from openarm_motion.constraints.names import RobotNames
    from openarm_motion.ros.move_group.planning import Requests
    from openarm_motion.service.motion_service import MotionService

#: A state in a scene that is further than this from where the robot is asks for another one, rad.
_PRESENT = 0.05
_ALL = 2 * Components.OBJECT_COLORS - 1
#: MoveIt's name of the map in allowed collisions.
_OCTOMAP = "<octomap>"


class SceneServer:
    """/get_planning_scene, /apply_planning_scene, /planning_scene, /collision_object, /attached_collision_object.

    Args:
        node: Owner.
        service: Has the scene.
        description: The robot.
        names: Names of its links.
        convert: Messages to core data.
        requests: Checks what hands may touch.
        octomap: Octomap of the scene.
        on_change: Called when the scene has changed.
        refuse: Reports a refusal of what has a name.
    """

    def __init__(
        self,
        node: BaseNode[Any],
        service: MotionService,
        description: RobotDescription,
        names: RobotNames,
        convert: Converter,
        requests: Requests,
        octomap: SceneOctomap,
        on_change: Callable[[], None],
        refuse: Callable[[str, OpenArmError], None],
    ) -> None:
        self._node, self._service, self._description, self._names = node, service, description, names
        self._convert, self._requests, self._octomap = convert, requests, octomap
        self._on_change, self._refuse = on_change, refuse
        self._bodies = SceneBodies(service)
        self._colors: dict[str, ObjectColor] = {}
        self._monitored = node.create_publisher(PlanningScene, "/monitored_planning_scene", QOS_COMMAND)
        node.create_service(GetPlanningScene, "/get_planning_scene", self._on_get)
        node.create_service(ApplyPlanningScene, "/apply_planning_scene", self._on_apply)
        node.create_subscription(PlanningScene, "/planning_scene", self._change, QOS_COMMAND)
        node.create_subscription(CollisionObject, "/collision_object", self._on_object, QOS_COMMAND)
        node.create_subscription(AttachedCollisionObject, "/attached_collision_object", self._on_attached, QOS_COMMAND)
        node.create_timer(node.REPORT_PERIOD_S, self._show, clock=node.steady_clock)

    # --- questions
    async def _on_get(self, request: GetPlanningScene.Request, response: GetPlanningScene.Response) -> object:
        response.scene = await self.message(request.components.components or _ALL)
        return response

    async def message(self, components: int = _ALL) -> PlanningScene:
        """The scene, as far as it is asked for, without what can't be removed: the table."""
        scene = PlanningScene(name="openarm", robot_model_name=self._description.name)
        scene.robot_state.is_diff = True
        base = self._description.base
        if components & Components.ROBOT_STATE and self._service.robot.state_age() < float("inf"):
            t_ns, state = self._service.robot.states.latest()
            known = {name: x for name, x in state.items() if name in self._description.joints}
            scene.robot_state = state_msg(known, t_ns)
        if components & (Components.ROBOT_STATE | Components.ROBOT_STATE_ATTACHED_OBJECTS):
            for id, held in self._bodies.held.items():
                kinematics = self._service.arms[held.arm].kinematics
                body = object_msg(id, held.body.T, held.body.shapes, kinematics.tool_link)
                touch = sorted(self._service.arms[held.arm].robot.arm.hand)
                scene.robot_state.attached_collision_objects.append(
                    AttachedCollisionObject(link_name=kinematics.tool_link, object=body, touch_links=touch)
                )
        geometry = bool(components & Components.WORLD_OBJECT_GEOMETRY)
        if geometry or components & Components.WORLD_OBJECT_NAMES:
            for body in self._bodies.world.values():
                scene.world.collision_objects.append(object_msg(body.id, body.T, body.shapes, base, geometry=geometry))
        if components & Components.ALLOWED_COLLISION_MATRIX:
            scene.allowed_collision_matrix = self._matrix()
        if components & Components.OBJECT_COLORS:
            scene.object_colors = [color for id, color in self._colors.items() if id in self._bodies.world]
        if components & Components.OCTOMAP:
            scene.world.octomap = await self._octomap.message()
        return scene

    def _entry_names(self) -> list[str]:
        links = [link.name for link in self._description.links.values() if link.collision]
        fixed = [solid.id for solid in self._service.scene.fixed]
        return [*links, *fixed, *self._bodies.world, *self._bodies.held, MAP]

    def _matrix(self) -> AllowedCollisionMatrix:
        known = self._entry_names()
        more = sorted({name for pair in self._service.scene.allowed for name in pair} - set(known))
        names = [*known, *more]
        allowed = self._service.scene.allowed | self._description.allowed_collisions
        grid = np.zeros((len(names), len(names)), np.bool_)
        index = {name: k for k, name in enumerate(names)}
        for a, b in (tuple(pair) for pair in allowed if len(pair) == 2):
            if a in index and b in index:
                grid[index[a], index[b]] = grid[index[b], index[a]] = True
        return AllowedCollisionMatrix(
            entry_names=[_OCTOMAP if name == MAP else name for name in names],
            entry_values=[AllowedCollisionEntry(enabled=row) for row in grid.tolist()],
        )

    # --- changes
    async def _on_apply(self, request: ApplyPlanningScene.Request, response: ApplyPlanningScene.Response) -> object:
        try:
            await self._change(request.scene)
            response.success = True
        except OpenArmError as error:
            self._refuse("/apply_planning_scene", error)
        return response

    async def clear_octomap(self) -> None:
        """Take a client's octomap out of the scene."""
        self._service.scene.see(None)
        await self._show()

    async def _change(self, scene: PlanningScene) -> None:
        check_fields(scene, SCENE, "planning scene")
        if scene.robot_model_name not in ("", self._description.name):
            text = f"robot_model_name is {scene.robot_model_name!r}, expected {self._description.name!r}"
            raise MoveItError(MoveItErrorCodes.INVALID_ROBOT_STATE, text)
        self._check_state(scene)
        octree = await self._octomap.read(scene.world.octomap, is_diff=scene.is_diff)
        draft = self._bodies.draft()
        if not scene.is_diff:
            draft.remove("")
        for message in scene.world.collision_objects:
            self._put(draft, message)
        for attached in scene.robot_state.attached_collision_objects:
            self._attach(draft, attached)
        if scene.allowed_collision_matrix.entry_names or scene.allowed_collision_matrix.default_entry_names:
            draft.allowed = self._allowed(scene.allowed_collision_matrix, draft)
        with as_moveit(MoveItErrorCodes.INVALID_OBJECT_NAME):
            self._bodies.apply(draft)
        self._octomap.put(octree, scene.world.octomap)
        self._colors.update({color.id: color for color in scene.object_colors})
        await self._changed()

    async def _on_object(self, message: CollisionObject) -> None:
        check_fields(message, OBJECT, "collision object")
        draft = self._bodies.draft()
        self._put(draft, message)
        await self._apply(draft)

    async def _on_attached(self, message: AttachedCollisionObject) -> None:
        check_fields(message, ATTACHED, "attached object")
        draft = self._bodies.draft()
        self._attach(draft, message)
        await self._apply(draft)

    async def _apply(self, draft: SceneDraft) -> None:
        with as_moveit(MoveItErrorCodes.INVALID_OBJECT_NAME):
            self._bodies.apply(draft)
        await self._changed()

    async def _changed(self) -> None:
        self._on_change()
        await self._show()

    def _check_state(self, scene: PlanningScene) -> None:
        state = self._convert.state(scene.robot_state)
        present = self._service.robot.states.latest()[1] if self._service.robot.state_age() < float("inf") else {}
        for name, value in state.items():
            if abs(value - present.get(name, np.inf)) > _PRESENT:
                text = f"robot_state.joint_state has {name} at {value:.3f}, it is at {present.get(name, np.nan):.3f}"
                raise MoveItError(
                    MoveItErrorCodes.INVALID_ROBOT_STATE, f"{text}: the scene is that of the robot as it is"
                )

    def _put(self, draft: SceneDraft, message: CollisionObject) -> None:
        with as_moveit(MoveItErrorCodes.INVALID_OBJECT_NAME):
            if message.operation == CollisionObject.REMOVE:
                draft.remove(message.id)
                return
            if message.id in ("", _OCTOMAP):
                text = f"an object with the id {message.id!r}, expected one of its own"
                raise OpenArmError(Code.INVALID_ARGUMENT, text)
            T, shapes = self._convert.shapes(message)
            if message.operation == CollisionObject.MOVE:
                if shapes:
                    text = f"object {message.id!r} is to be moved and has shapes, expected none"
                    raise OpenArmError(Code.INVALID_ARGUMENT, text)
                draft.move(message.id, T)
                return
            if message.operation not in (CollisionObject.ADD, CollisionObject.APPEND):
                text = f"operation of {message.id!r} is {message.operation!r}; valid: ADD 0, REMOVE 1, APPEND 2, MOVE 3"
                raise OpenArmError(Code.INVALID_ARGUMENT, text)
            if not shapes:
                raise OpenArmError(Code.INVALID_ARGUMENT, f"object {message.id!r} has no primitives and no meshes")
            draft.put(SceneBody(message.id, T, shapes), append=message.operation == CollisionObject.APPEND)

    def _attach(self, draft: SceneDraft, message: AttachedCollisionObject) -> None:
        body = message.object
        if body.operation == CollisionObject.REMOVE:
            with as_moveit(MoveItErrorCodes.INVALID_OBJECT_NAME):
                ids = (
                    [body.id]
                    if body.id
                    else [id for id, held in draft.held.items() if self._carries(held.arm, message)]
                )
                for id in ids:
                    arm = draft.held[id].arm if id in draft.held else ""
                    draft.detach(id, self._tool(arm) if arm else np.eye(4))
            return
        with as_moveit(MoveItErrorCodes.INVALID_LINK_NAME):
            arm = self._names.arm_of_link(message.link_name)
        self._requests.check_touch(message.touch_links, arm)
        with as_moveit(MoveItErrorCodes.INVALID_OBJECT_NAME):
            if body.operation not in (CollisionObject.ADD, CollisionObject.APPEND) or not body.id:
                text = (
                    f"attached object {body.id!r} with operation {body.operation!r}; valid: ADD 0, REMOVE 1, and an id"
                )
                raise OpenArmError(Code.INVALID_ARGUMENT, text)
            T, shapes = self._convert.shapes(body)
            draft.attach(body.id, arm, self._tool(arm), SceneBody(body.id, T, shapes) if shapes else None)

    def _carries(self, arm: str, message: AttachedCollisionObject) -> bool:
        return not message.link_name or message.link_name in self._names.links_on_tool(arm)

    def _tool(self, arm: str) -> Array:
        if self._service.robot.state_age() == float("inf"):
            raise OpenArmError(Code.NOT_READY, "no /joint_states yet, so it is not known where the hand is")
        state = self._service.robot.states.latest()[1]
        kinematics = self._service.arms[arm].kinematics
        return kinematics.fk(np.array([state[name] for name in kinematics.names]))

    def _allowed(self, matrix: AllowedCollisionMatrix, draft: SceneDraft) -> frozenset[frozenset[str]]:
        """Pairs of a matrix that may touch, but for those of the SRDF, which can't be taken back."""
        names = [MAP if name == _OCTOMAP else name for name in matrix.entry_names]
        rows = [list(entry.enabled) for entry in matrix.entry_values]
        if len(rows) != len(names) or any(len(row) != len(names) for row in rows):
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"allowed_collision_matrix has {len(names)} names and is not square like them"
            )
        if len(matrix.default_entry_names) != len(matrix.default_entry_values):
            raise OpenArmError(Code.INVALID_ARGUMENT, "default_entry_names and default_entry_values differ in length")
        out: set[frozenset[str]] = set()
        for i, j in combinations(range(len(names)), 2):
            pair = frozenset((names[i], names[j]))
            if rows[i][j] != rows[j][i]:
                text = f"allowed_collision_matrix says both of {names[i]!r} and {names[j]!r}, expected a symmetric one"
                raise OpenArmError(Code.INVALID_ARGUMENT, text)
            if rows[i][j]:
                out.add(pair)
            elif pair in self._description.allowed_collisions:
                text = f"{names[i]!r} and {names[j]!r} are left out by the SRDF and can't be checked again"
                raise OpenArmError(Code.INVALID_ARGUMENT, f"allowed_collision_matrix: {text}")
        everyone = {*self._entry_names(), *draft.world, *names}
        for given, enabled in zip(matrix.default_entry_names, matrix.default_entry_values, strict=True):
            name = MAP if given == _OCTOMAP else given
            if enabled:
                out |= {frozenset((name, other)) for other in everyone if other != name and other not in names}
        return frozenset(out - self._description.allowed_collisions)

    # --- what is published
    async def _show(self) -> None:
        """Publish the scene while someone listens."""
        if self._monitored.get_subscription_count():
            self._monitored.publish(await self.message())
