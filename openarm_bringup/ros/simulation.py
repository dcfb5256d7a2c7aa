# SPDX-License-Identifier: Apache-2.0
"""Requests to the simulation of a running graph."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from openarm_interfaces.srv import ResetWorld

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.client import BackgroundNode


def reset_world(
    client: BackgroundNode,
    scene: str,
    seed: int = 0,
    timeout: float = 60.0,
    joints: Mapping[str, float] = MappingProxyType({}),
) -> None:
    """Load a scene, with the robot in its home posture.

    Args:
        client: Node that asks.
        scene: Name or path of the scene, or "random"; empty keeps the present one.
        seed: Seed of a random scene.
        timeout: Longest wait for the answer, s of wall clock.
        joints: Positions that are not those of the home posture, rad or m.

    Raises:
        OpenArmError: SCENE_INVALID, when the simulation refused it; NOT_READY, when there is none; TIMEOUT.
    """
    request = ResetWorld.Request(
        scene=scene, seed=seed, joint_names=list(joints), joint_positions=list(joints.values())
    )
    answer = client.call(ResetWorld, "/sim/reset_world", request, timeout)
    if not answer.success:
        raise OpenArmError(Code.SCENE_INVALID, f"/sim/reset_world refused: {answer.message}")
