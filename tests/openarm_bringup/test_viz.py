# SPDX-License-Identifier: Apache-2.0
"""`up --viz`: the node it adds, what it refuses, and the layout that is shipped."""

from __future__ import annotations

import importlib.util
import json
import re
import socket
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

from openarm_bringup.bags.definitions import full_definition
from openarm_bringup.commands import up
from openarm_bringup.outcome import Outcome
from openarm_bringup.supervision.graph import Graph, load_graph
from openarm_bringup.view.proxy import hidden_address
from openarm_bringup.view.viz import NODE, TOKEN_VARIABLE, with_viz
from openarm_common.errors import Code, OpenArmError

ROOT = Path(__file__).parents[2]
LAYOUT = ROOT / "config" / "foxglove" / "openarm.json"


@pytest.fixture
def sdk(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if it were installed."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: object())


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@pytest.mark.usefixtures("sdk")
def test_the_node_is_added_and_its_token_is_in_no_parameter() -> None:
    graph, address = with_viz(load_graph("sim_only"), port := free_port())
    node = graph.nodes[NODE]
    token = parse_qs(urlsplit(address).query)["token"][0]
    assert address.startswith(f"ws://127.0.0.1:{port}/?token=")
    assert node.env[TOKEN_VARIABLE] == token
    assert token not in str(node.params)
    assert len(graph.nodes) == len(load_graph("sim_only").nodes) + 1
    assert with_viz(load_graph("sim_only"), free_port())[1] != address


@pytest.mark.usefixtures("sdk")
def test_up_sets_parameters_of_the_added_node_too(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("OPENARM_RUNS", str(tmp_path))
    started: list[Any] = []

    async def note(graph: Graph, run_dir: Path, address: str) -> Outcome:
        started.append(graph)
        return Outcome(True)

    monkeypatch.setattr(up, "_up", note)
    sets = ("foxglove.origins=[http://localhost:8080]", "mujoco_bridge.images=false")
    assert up.up("sim_only", set_=sets, viz=True, viz_port=free_port()).success
    assert started[0].nodes[NODE].params["origins"] == ["http://localhost:8080"]
    assert started[0].nodes["mujoco_bridge"].params["images"] is False
    with pytest.raises(OpenArmError, match="no node 'foxglove'"):
        up.up("sim_only", set_=sets)


def test_a_missing_sdk_is_said_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(OpenArmError, match=r"--require-hashes -r requirements-viz\.lock") as refused:
        with_viz(load_graph("sim_only"), free_port())
    assert refused.value.code is Code.ENVIRONMENT


@pytest.mark.usefixtures("sdk")
def test_a_port_that_is_taken_is_refused_before_anything_starts() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(OpenArmError, match=f"127.0.0.1:{port}.*--viz-port"):
            with_viz(load_graph("sim_only"), port)


def test_the_server_behind_the_door_listens_elsewhere_each_time() -> None:
    addresses = {hidden_address() for _ in range(50)}
    assert len(addresses) == 50
    assert all(address.startswith("127.") for address in addresses)


def test_a_definition_holds_every_type_once() -> None:
    from vision_msgs.msg import Detection3DArray

    text = full_definition(Detection3DArray)
    assert text.startswith("std_msgs/Header header\n")
    names = re.findall(r"^MSG: (\S+)$", text, re.MULTILINE)
    assert len(names) == len(set(names))
    assert {"vision_msgs/Detection3D", "std_msgs/Header", "builtin_interfaces/Time", "geometry_msgs/Point"} <= set(
        names
    )


def test_the_layout_shows_topics_and_services_that_there_are() -> None:
    layout = json.loads(LAYOUT.read_text(encoding="utf-8"))
    interfaces = (ROOT / "docs" / "interfaces.md").read_text(encoding="utf-8")
    known = set(re.findall(r"^\| `(/[\w/]+)`", interfaces, re.MULTILINE))

    def names(value: Any) -> set[str]:
        if isinstance(value, dict):
            keys = {key for key in value if key.startswith("/")}
            return keys.union(*map(names, value.values()))
        if isinstance(value, list):
            return set().union(*map(names, value))
        return {re.split(r"[.\[]", value)[0]} if isinstance(value, str) and value.startswith("/") else set()

    used = names(layout["configById"])
    assert {"/grasp", "/robot_description", "/detection_image"} <= used
    assert used <= known

    def panels(tree: Any) -> list[str]:
        return [tree] if isinstance(tree, str) else panels(tree["first"]) + panels(tree["second"])

    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
