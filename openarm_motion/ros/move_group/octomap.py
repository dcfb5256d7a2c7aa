# SPDX-License-Identifier: Apache-2.0
"""The octomap of a planning scene: the map node's octree, or one that a client has put into the scene.

As in MoveIt an octomap replaces the one before it, and one without data removes it. Plans keep clear of the map all the
same: a client's octomap comes in addition. A scene that a client changes and sends back has the octomap that it was
given; that of the map, which is older by then, is left to the map.
"""

from __future__ import annotations

import hashlib
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np
from octomap_msgs.msg import OctomapWithPose
from octomap_msgs.srv import GetOctomap
from std_msgs.msg import Header

from openarm_common.errors import Code, OpenArmError
from openarm_common.octree.codec import TREE_ID, decode
from openarm_common.printable import brief
from openarm_common.ros.convert import matrix_to_pose
from openarm_common.ros.node import BaseNode
from openarm_motion.scene.octree import SceneOctree
from openarm_motion.service.robot import RobotWatch

if TYPE_CHECKING:
    from openarm_motion.ros.move_group.convert import Converter
    from openarm_motion.service.motion_service import MotionService

#: The map has this long to answer, s.
_ANSWER = 1.0
#: Maps that were given are known again, so many of them.
_GIVEN = 64


class SceneOctomap:
    """Gives and takes the octomap.

    Args:
        node: Owner.
        service: Has the scene.
        convert: Messages to core data.
        source: Name of the service that has the map.
    """

    def __init__(self, node: BaseNode[Any], service: MotionService, convert: Converter, source: str) -> None:
        self._node, self._service, self._convert = node, service, convert
        self._map = node.create_client(GetOctomap, source)
        self._taken = OctomapWithPose()
        self._given: deque[bytes] = deque(maxlen=_GIVEN)

    async def message(self) -> OctomapWithPose:
        """Return the octomap of a client, else that of the map; without data where there is neither."""
        if self._service.scene.octree is not None:
            return self._taken
        out = OctomapWithPose(header=Header(frame_id=self._node.description.base))
        if self._service.config.map.use == "off" or not self._map.service_is_ready():
            return out
        asked = self._map.call_async(GetOctomap.Request())
        if not await RobotWatch(self._service.robot).until(asked.done, limit=_ANSWER):
            self._map.remove_pending_request(asked)
            self._node.get_logger().warning(f"{self._map.srv_name} did not answer within {_ANSWER:g} s")
            return out
        answer: Any = asked.result()
        out.octomap, out.header = answer.map, answer.map.header
        out.octomap.header = Header()  # as MoveIt has it
        if out.octomap.data:
            self._given.append(_digest(out))
        return out

    async def read(self, message: OctomapWithPose, *, is_diff: bool) -> SceneOctree | None:
        """Return the octree that is in the scene after a message; that of now where it says nothing.

        Raises:
            OpenArmError: INVALID_ARGUMENT, saying what is wrong with it; NO_TRANSFORM.
        """
        octomap, frame = message.octomap, message.header.frame_id
        if not octomap.data:
            return self._service.scene.octree if is_diff and not octomap.id else None
        T = self._convert.pose(message.origin, frame)
        self._check(message)
        if np.allclose(T, np.eye(4), atol=1e-9) and _digest(message) in self._given:
            return None
        data = np.frombuffer(octomap.data, np.uint8)
        leaves = await self._node.in_thread(decode, data, octomap.resolution, binary=octomap.binary, tree=octomap.id)
        return SceneOctree(leaves, T)

    def put(self, octree: SceneOctree | None, message: OctomapWithPose) -> None:
        """Put an octree, which `read` has made of a message, in force."""
        if octree is not None and octree is not self._service.scene.octree:
            origin = matrix_to_pose(octree.T_base_tree)
            self._taken = OctomapWithPose(header=Header(frame_id=self._node.description.base), origin=origin)
            self._taken.octomap = message.octomap
        self._service.scene.see(octree)

    def _check(self, message: OctomapWithPose) -> None:
        octomap, frame = message.octomap, message.header.frame_id
        if not octomap.id:
            text = f"octomap.id is empty and there are data, expected the class of the tree, such as {TREE_ID!r}"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"world.octomap.{text}")
        if octomap.header.frame_id not in ("", frame):
            text = f"octomap.header.frame_id is {brief(octomap.header.frame_id)}, header.frame_id {brief(frame)}"
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"world.octomap.{text}; expected the same twice, or the former empty"
            )


def _digest(message: OctomapWithPose) -> bytes:
    return hashlib.blake2b(memoryview(message.octomap.data).cast("B")).digest()
