# SPDX-License-Identifier: Apache-2.0
"""`openarm up --viz`: the node that shows a graph to Foxglove, added to the graph."""

from __future__ import annotations

import importlib.util
import secrets
import socket

from openarm_bringup.supervision.graph import Graph, NodeSpec
from openarm_bringup.view.guard import LOOPBACK
from openarm_common.errors import Code, OpenArmError

NODE = "foxglove"
#: Variable of the environment that carries the token: parameters and command lines can be read by others.
TOKEN_VARIABLE = "OPENARM_VIZ_TOKEN"


def with_viz(graph: Graph, port: int) -> tuple[Graph, str]:
    """Add the node to a graph.

    Args:
        graph: Any graph.
        port: TCP port on the loopback address.

    Returns:
        The graph, and the address to open in Foxglove, with its token.

    Raises:
        OpenArmError: ENVIRONMENT, when foxglove-sdk is not installed or the port is taken.
    """
    require_sdk()
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            text = f"can't listen on {LOOPBACK}:{port} for --viz: {error.strerror}; choose another with --viz-port"
            raise OpenArmError(Code.ENVIRONMENT, text) from error
    token = secrets.token_urlsafe(24)
    node = NodeSpec(
        module="openarm_bringup.view.ros.foxglove_node",
        params={"port": port},
        env={TOKEN_VARIABLE: token},
        uses=("every topic and service",),
    )
    address = f"ws://{LOOPBACK}:{port}/?token={token}"
    return graph.model_copy(update={"nodes": {**graph.nodes, NODE: node}}), address


def require_sdk() -> None:
    """Refuse to go on without foxglove-sdk.

    Raises:
        OpenArmError: ENVIRONMENT, saying how it is installed.
    """
    if importlib.util.find_spec("foxglove") is None:
        raise OpenArmError(
            Code.ENVIRONMENT,
            "--viz needs foxglove-sdk, which is not installed: `.venv/bin/uv pip install --require-hashes "
            "-r requirements-viz.lock` in a checkout, "
            "`pip install 'openarm-vision[viz]'` elsewhere; `openarm view` needs nothing",
        )
