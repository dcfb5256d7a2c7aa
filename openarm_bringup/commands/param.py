# SPDX-License-Identifier: Apache-2.0
"""`openarm param`: parameters of the nodes that run."""

from __future__ import annotations

from typing import Any

import yaml
from cyclopts import App

from openarm_bringup.commands.pick import meet_graph
from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code

app = App(name="param", help="List, read, set and dump parameters of the nodes that run.")


@app.command(name="list")
def list_(node: str, *, domain: int | None = None) -> Outcome:
    """Name the parameters of a node.

    Args:
        node: Its name.
        domain: ROS_DOMAIN_ID of the graph; found by itself when one graph runs on this machine.
    """
    values = _read(node, None, domain)
    return Outcome(True, data={"parameters": sorted(values)}, text="\n".join(sorted(values)))


@app.command
def get(node: str, name: str, *, domain: int | None = None) -> Outcome:
    """Print a parameter.

    Args:
        node: Name of the node.
        name: Of the parameter, such as approach.lift_height.
        domain: ROS_DOMAIN_ID of the graph.
    """
    values = _read(node, name, domain)
    return Outcome(True, data={"name": name, "value": values[name]}, text=str(values[name]))


@app.command
def dump(node: str, *, domain: int | None = None) -> Outcome:
    """Print all parameters of a node as a ROS parameter file.

    Args:
        node: Name of the node.
        domain: ROS_DOMAIN_ID of the graph.
    """
    values = _read(node, None, domain)
    file = {node.rpartition("/")[2]: {"ros__parameters": values}}
    return Outcome(True, data={"parameters": values}, text=yaml.safe_dump(file, sort_keys=True))


@app.command(name="set")
def set_(node: str, name: str, value: str, *, domain: int | None = None) -> Outcome:
    """Set a parameter; most of the suite's are fixed at the start (`openarm up --set`) and say so.

    Args:
        node: Name of the node.
        name: Of the parameter.
        value: As YAML.
        domain: ROS_DOMAIN_ID of the graph.
    """
    meet_graph(domain)
    from openarm_bringup.ros.peer import Peer

    with Peer() as peer:
        parameters = peer.parameters(node)
        parameters.check(name)
        taken, reason = parameters.set(name, yaml.safe_load(value))
    found = parameters.node
    data = {"node": found, "name": name, "value": value}
    if not taken:
        hint = f"{reason or 'refused'}; give it at the start: openarm up --set {found.strip('/')}.{name}={value}"
        return Outcome(False, f"{found} {name}: {hint}", Code.INVALID_ARGUMENT, data)
    return Outcome(True, f"{found} {name} = {value}", data=data)


def _read(node: str, name: str | None, domain: int | None) -> dict[str, Any]:
    meet_graph(domain)
    from openarm_bringup.ros.peer import Peer

    with Peer() as peer:
        parameters = peer.parameters(node)
        if name is not None:
            parameters.check(name)
        return parameters.get([name] if name is not None else parameters.names)
