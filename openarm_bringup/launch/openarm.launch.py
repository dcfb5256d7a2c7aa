# SPDX-License-Identifier: Apache-2.0
"""A graph of the suite under `ros2 launch`.

`ros2 launch openarm_bringup openarm.launch.py graph:=map rviz:=true`. Nodes, parameters and environment are those of
`openarm up`; what launch has no word for is left out: nodes are started at once instead of in the order of their needs
(each waits for what it uses by itself), and parameters that a node does not have are not refused.
"""

from __future__ import annotations

import shlex

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration

from openarm_bringup.supervision.discovery import PROFILE
from openarm_bringup.supervision.environment import node_arguments, node_environment
from openarm_bringup.supervision.graph import graph_names, load_graph
from openarm_bringup.supervision.runs import new_run_dir
from openarm_common.resources import config_dir
from openarm_common.robot.folder import choose_robot

#: Name, default and meaning; an empty value leaves what the graph says.
ARGUMENTS = (
    ("robot", "", "name of a folder of models/robots"),
    ("graph", "sim", f"one of {', '.join(graph_names())}, or a file"),
    ("scene", "", "name or path of a scene, or random"),
    ("seed", "", "of a random scene"),
    ("mount_seed", "", "of the true camera mounts"),
    ("domain", "", "ROS_DOMAIN_ID"),
    ("set", "", "parameters as 'node.param=value node.param=value'"),
    ("rviz", "false", "true starts RViz with the view of the graph"),
)


def generate_launch_description() -> LaunchDescription:
    """Return the arguments, and a function that makes the processes once these are known."""
    declared = [DeclareLaunchArgument(name, default_value=value, description=about) for name, value, about in ARGUMENTS]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])


def start(context: LaunchContext) -> list[ExecuteProcess]:
    """Make one process a node."""
    given = {name: LaunchConfiguration(name).perform(context) for name, _, _ in ARGUMENTS}
    choose_robot(given["robot"] or None)
    overrides = {name: given[name] or None for name in ("scene", "seed", "mount_seed", "domain")}
    graph = load_graph(given["graph"], overrides=overrides, sets=shlex.split(given["set"]))
    run_dir = new_run_dir()
    processes = [
        ExecuteProcess(
            cmd=node_arguments(graph, name, run_dir),
            env=node_environment(graph, name, run_dir),
            name=name,
            output="screen",
            respawn=spec.restart.policy != "never",
            respawn_delay=spec.restart.backoff,
            respawn_max_retries=spec.restart.max,
        )
        for name, spec in graph.nodes.items()
    ]
    if given["rviz"].lower() == "true":
        view = config_dir() / "rviz" / f"{graph.name}.rviz"
        whole = config_dir() / "rviz" / "sim.rviz"
        environment = node_environment(graph, next(iter(graph.nodes)), run_dir)
        environment.pop(PROFILE, None)  # RViz publishes nothing large
        command = ["rviz2", "-d", str(view if view.is_file() else whole)]
        processes.append(ExecuteProcess(cmd=command, env=environment, name="rviz", output="screen"))
    return processes
