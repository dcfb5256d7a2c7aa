# SPDX-License-Identifier: Apache-2.0
"""The parameters with which the nodes of the graph run, for the same code in this process."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from openarm_bringup.supervision.graph import load_graph
from openarm_common.camera.cameras import detector_nodes
from openarm_common.robot.folder import per_robot
from openarm_grasp.config import GraspConfig
from openarm_motion.config import MotionConfig
from openarm_octomap.config import OctomapNodeConfig
from openarm_perception.config import DetectNodeConfig
from openarm_sim_bridge.config import BridgeConfig


@dataclass(frozen=True, eq=False)
class SuiteConfig:
    """Configuration of each node; `detectors` by camera."""

    bridge: BridgeConfig
    detectors: Mapping[str, DetectNodeConfig]
    octomap: OctomapNodeConfig
    motion: MotionConfig
    grasp: GraspConfig


@per_robot
def suite_config(sets: tuple[str, ...] = ()) -> SuiteConfig:
    """Read the parameters of the graph `sim`.

    Args:
        sets: `node.param=value`, as for `openarm up --set`.

    Raises:
        OpenArmError: INVALID_ARGUMENT or CONFIG_INVALID, for a fault in `sets`.
    """
    graph = load_graph("sim", sets=sets)
    detectors = [graph.config(node, DetectNodeConfig) for node in detector_nodes().values()]
    return SuiteConfig(
        bridge=graph.config("mujoco_bridge", BridgeConfig),
        detectors={config.camera: config for config in detectors},
        octomap=graph.config("octomap", OctomapNodeConfig),
        motion=graph.config("motion", MotionConfig),
        grasp=graph.config("grasp", GraspConfig),
    )
