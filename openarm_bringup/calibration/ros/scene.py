# SPDX-License-Identifier: Apache-2.0
"""Changes the simulated world of a running graph."""

from __future__ import annotations

from openarm_interfaces.srv import ResetWorld

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.client import BackgroundNode


class SceneClient(BackgroundNode):
    """A context manager that asks the simulation."""

    def __init__(self) -> None:
        super().__init__("scene_client")

    def reset_world(self, scene: str, seed: int = 0) -> None:
        """Load a scene, the robot in its home posture.

        Raises:
            OpenArmError: SCENE_INVALID, when the bridge refused it; NOT_READY, TIMEOUT.
        """
        answer = self.call(ResetWorld, "/sim/reset_world", ResetWorld.Request(scene=scene, seed=seed))
        if not answer.success:
            raise OpenArmError(Code.SCENE_INVALID, f"/sim/reset_world refused: {answer.message}")
