# SPDX-License-Identifier: Apache-2.0
"""`openarm up`: start a graph and keep it until Ctrl-C."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from openarm_bringup.commands.connect import Robot, Sets
from openarm_bringup.outcome import AT_END, Outcome, console, failure
from openarm_bringup.supervision.discovery import Discovery, exposure
from openarm_common.errors import OpenArmError
from openarm_common.robot.folder import choose_robot, robot_name

if TYPE_CHECKING:
    from openarm_bringup.supervision.graph import Graph
    from openarm_bringup.supervision.supervisor import Event

STYLES = {"ready": "green", "failed": "bold red", "backoff": "yellow", "exited": "yellow", "stopped": "dim"}


def up(
    graph: str = "sim",
    *,
    set_: Sets = (),
    scene: str | None = None,
    seed: int | None = None,
    mount_seed: str | None = None,
    domain: int | None = None,
    discovery: Discovery | None = None,
    viz: bool = False,
    viz_port: int = 8765,
    emulate: bool = False,
    moveit: bool = False,
    robot: Robot = None,
) -> Outcome:
    """Start the nodes of a graph, and stop them at Ctrl-C (a second Ctrl-C: emergency stop, and hurry).

    Args:
        graph: Name of a graph (sim, sim_only, perception, motion, real) or a file.
        scene: Name or path of a scene, or "random".
        seed: Seed of a random scene.
        mount_seed: Seed of the true camera mounts, or "none" for the nominal ones.
        domain: ROS_DOMAIN_ID; the environment's, or 0, when not given.
        discovery: Reach of discovery; localhost when the graph says nothing else.
        viz: Offer every topic and service to Foxglove, at an address that is printed.
        viz_port: TCP port for that.
        emulate: Run the graph real on the simulated robot in place of motors and cameras, frame by frame.
        moveit: Answer clients of MoveIt, too (nodes move_group and servo_node). The first time builds moveit_msgs.
    """
    choose_robot(robot)
    import asyncio

    from openarm_bringup.supervision.graph import load_graph, set_parameter
    from openarm_bringup.supervision.runs import new_run_dir
    from openarm_bringup.view.viz import NODE, with_viz
    from openarm_common.scene.scene import load_scene

    overrides = {"scene": scene, "seed": seed, "mount_seed": mount_seed, "domain": domain, "discovery": discovery}
    of_viz = tuple(item for item in set_ if viz and item.startswith(f"{NODE}."))
    sets = [item for item in set_ if item not in of_viz]
    if moveit:
        sets = [*(f"motion.{node}.enabled=true" for node in ("move_group", "servo")), *sets]
    loaded = load_graph(graph, overrides=overrides, sets=sets, emulate=emulate)
    load_scene(loaded.scene, loaded.seed)  # a scene that does not fit is refused before anything starts
    address = ""
    if viz:
        loaded, address = with_viz(loaded, viz_port)
    for item in of_viz:
        set_parameter(loaded, item)
    return asyncio.run(_up(loaded, new_run_dir(), address))


async def _up(graph: Graph, run_dir: Path, viz_address: str) -> Outcome:
    from openarm_bringup.supervision import shm
    from openarm_bringup.supervision.environment import domain_id
    from openarm_bringup.supervision.session import running_graph

    shown = console()

    def show(event: Event) -> None:
        style = STYLES.get(event.state, "")
        line = event.detail.partition("\n")[0]
        shown.print(f"[dim]{event.seconds:6.1f} s[/dim]  {event.node:<22} ", end="")
        shown.print(f"{event.state:<9}", style=style, end=" ")
        shown.print(line, markup=False, soft_wrap=True)

    data: dict[str, Any] = {"graph": graph.name, "robot": robot_name(), "run_dir": str(run_dir)}
    data["domain"] = domain_id(graph)
    if warning := exposure(graph.discovery):
        shown.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)
    try:
        async with running_graph(graph, run_dir, show, ends=True) as supervisor:
            AT_END.append(lambda code: shm.leave(supervisor.left, code))
            data["ready_s"] = round(await supervisor.wait_ready(), 2)
            supervisor.daemon.start()  # it has nothing to compete with any more
            shown.print(
                f"[bold green]{graph.name} is ready[/bold green] after {data['ready_s']:.1f} s: "
                f"{data['robot']}, domain {data['domain']}, logs in {run_dir / 'logs'}; Ctrl-C stops it",
                soft_wrap=True,
            )
            if viz_address:
                text = f"Foxglove: open the connection {viz_address}"
                shown.print(text, markup=False, soft_wrap=True)
            await supervisor.wait_stop_asked()
            data["states"] = supervisor.states()
        data["lost_log_lines"] = supervisor.lost_lines
    except OpenArmError as error:
        return failure(error, **data)
    lost = f", without {lines} lines that the disk did not take" if (lines := data["lost_log_lines"]) else ""
    message = f"{graph.name} stopped; no process is left, the logs are in {run_dir / 'logs'}{lost}"
    return Outcome(True, message, data=data)
