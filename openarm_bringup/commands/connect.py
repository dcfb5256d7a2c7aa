# SPDX-License-Identifier: Apache-2.0
"""Connection of commands to the running graph, and the options that they share."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import ROBOT, known_arm
from openarm_common.robot.zeros import ZEROS

if TYPE_CHECKING:
    from openarm_bringup.ros.peer import Peer


Robot = Annotated[
    str | None,
    Parameter(help="Folder of models/robots, or the path of one; OPENARM_ROBOT, or openarm_v1, when not given."),
]

Domain = Annotated[
    int | None,
    Parameter(help="ROS_DOMAIN_ID of the graph; found automatically when one graph runs on this machine."),
]
Sets = Annotated[
    tuple[str, ...], Parameter(name="--set", help="A parameter, as node.param=value; may be given several times.")
]
Count = Annotated[int, Parameter(name=["--count", "-n"])]


#: Makes the node of a command in the daemon of a graph, which has joined it.
PEER: ContextVar[Callable[[], Peer] | None] = ContextVar("PEER", default=None)


def join_graph(domain: int | None) -> None:
    """Set the environment of this process so that it meets the graph: that of a domain, or the only one running here.

    The robot of this process is that of the graph then.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for no number of a domain, or when several graphs run.
    """
    from openarm_bringup.supervision import discovery, runs

    if domain is not None and not 0 <= domain <= discovery.LAST_DOMAIN:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"--domain {domain}: expected 0 to {discovery.LAST_DOMAIN}, as for ROS_DOMAIN_ID"
        )
    try:
        record = runs.the_running(domain)
    except OpenArmError as error:
        if error.code != Code.NOT_READY:
            raise
        # It may run elsewhere, or have been started by other means: the environment says where.
        if domain is not None:
            os.environ["ROS_DOMAIN_ID"] = str(domain)
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        return
    os.environ.update({**discovery.variables(record.domain, record.discovery), ROBOT: record.robot})
    for kept in sorted((Path(record.run_dir) / "zeros").glob("*.yaml")):
        os.environ[ZEROS] = str(kept)
    if record.discovery in discovery.ACROSS_MACHINES:
        os.environ.setdefault(discovery.PROFILE, str(discovery.network_profile()))


def check_arms(*arms: str) -> None:
    """Refuse arms that the robot of this process does not have; "auto" and "" are left to the suite.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the arms.
    """
    for arm in arms:
        try:
            known_arm(arm)
        except ValueError as error:
            raise OpenArmError(Code.INVALID_ARGUMENT, str(error)) from error


def graph_peer(domain: int | None) -> Peer:
    """Join the graph; return a node of this command, a context manager.

    Raises:
        OpenArmError: NOT_READY, on entering, when no node runs.
    """
    if make := PEER.get():
        return make()
    join_graph(domain)
    from openarm_bringup.ros.peer import Peer

    return Peer()


@contextmanager
def requires_node(node: str, graph: str) -> Iterator[None]:
    """Explain a NOT_READY inside the block when the running graph has no such node.

    Args:
        node: Its name.
        graph: Graph that has it.

    Raises:
        OpenArmError: NOT_READY.
    """
    from openarm_bringup.supervision import runs

    try:
        yield
    except OpenArmError as error:
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        here = [run for run in runs.running() if str(run.domain) == domain]
        if error.code != Code.NOT_READY or not here or any(node in run.nodes for run in here):
            raise
        names = " and ".join(run.graph for run in here)
        raise OpenArmError(
            Code.NOT_READY,
            f"what runs here in domain {domain} ({names}) has no node `{node}`, and no other answers: stop it, and "
            f"start one that has it, `openarm up {graph}`",
        ) from error


@contextmanager
def stop_event() -> Iterator[threading.Event]:
    """Give an event that SIGINT and SIGTERM set, in place of what they do otherwise."""
    stop = threading.Event()
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
