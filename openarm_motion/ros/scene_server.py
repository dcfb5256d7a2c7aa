# SPDX-License-Identifier: Apache-2.0
"""Serves the planning scene: /motion/apply_scene, /motion/get_scene, and latched /motion/scene for people."""

from __future__ import annotations

from openarm_interfaces.srv import ApplyScene, GetScene
from visualization_msgs.msg import MarkerArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import BASE_FRAME, QOS_LATCHED, BaseNode
from openarm_common.scene.scene import load_scene
from openarm_motion.collision.solids import Box, box_from
from openarm_motion.config import MotionConfig
from openarm_motion.ros import convert
from openarm_motion.ros.situation import Situations
from openarm_motion.scene.planning_scene import PlanningScene


class SceneExecutor:
    """See the module's head. A change is in force when the answer is sent: plans are made in the same process.

    Args:
        node: Owns the services.
        scene: What is changed and told.
        situations: Knows frames and the map.
    """

    def __init__(self, node: BaseNode[MotionConfig], scene: PlanningScene, situations: Situations) -> None:
        self._node, self._scene, self._situations = node, scene, situations
        self._markers = node.create_publisher(MarkerArray, "/motion/scene", QOS_LATCHED)
        node.create_service(ApplyScene, "/motion/apply_scene", self._on_apply)
        node.create_service(GetScene, "/motion/get_scene", self._on_get)
        self._show()

    def _on_apply(self, request: ApplyScene.Request, response: ApplyScene.Response) -> ApplyScene.Response:
        before = self._scene.version
        try:
            solids = [convert.solid_from_msg(message, self._situations.pose) for message in request.add]
            self._scene.apply(clear=request.clear, remove=request.remove, add=solids, expected=request.expected_version)
            names = ", ".join(solid.id for solid in self._scene.solids) or "nothing beside what is fixed"
            response.success, response.code = True, Code.OK.value
            response.message = f"version {self._scene.version}: {names}"
        except OpenArmError as error:
            response.code, response.message = error.code.value, error.message
        response.version = self._scene.version
        if self._scene.version != before:
            self._show()
        return response

    def _on_get(self, _: GetScene.Request, response: GetScene.Response) -> GetScene.Response:
        scene = self._scene
        response.version = scene.version
        response.objects = [convert.solid_msg(solid, BASE_FRAME) for solid in (*scene.fixed, *scene.solids)]
        response.fixed = [box.id for box in scene.fixed]
        response.map = self._node.config.map.use
        try:
            look = self._situations.look()
            response.map_used = look.seen is not None
            response.map_version, response.map_age, response.map_message = look.version, look.age_s, look.why
        except OpenArmError as error:
            response.map_age, response.map_message = -1.0, error.message
        return response

    def _show(self) -> None:
        solids = (*self._scene.fixed, *self._scene.solids)
        self._markers.publish(convert.scene_markers(solids, BASE_FRAME))


def table_boxes(scene: str) -> tuple[Box, ...]:
    """The table top of a scene as an obstacle; none for an empty name.

    Raises:
        OpenArmError: SCENE_INVALID, from the scene.
    """
    if not scene:
        return ()
    table = load_scene(scene).table
    x, y = table.centre
    return (box_from("table", (x, y, table.top_z - 0.5 * table.thickness), table.extents),)
