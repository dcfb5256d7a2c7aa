# SPDX-License-Identifier: Apache-2.0
"""The node graph as data: a YAML file becomes a validated, frozen model.

A graph names its nodes, what each needs before it starts, when it counts as ready, and its parameters. A file can
extend another one and keep only some of its nodes; what it says in `emulate` puts a simulated robot in place of a real
one. `${scene}`, `${seed}` and `${mount_seed}` in parameters are
replaced by the graph's own top-level values, `${arm}`, `${camera}` and `${hand_camera}` as in `supervision.parts`.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import Field, model_validator

from openarm_bringup.supervision.discovery import LAST_DOMAIN, Discovery
from openarm_bringup.supervision.params import flatten, read_params, substitute
from openarm_bringup.supervision.parts import for_each_part
from openarm_common.config import Config, ConfigT, load_yaml, parse_yaml, validate
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.resources import config_dir, is_file
from openarm_common.robot.folder import robot_folder

ConditionKind = Literal["topic", "message", "service", "action"]

#: Values of the graph that parameters may refer to.
VARIABLES = ("scene", "seed", "mount_seed")
#: Modules of the suite begin with this.
_SUITE = "openarm_"
#: Parameters that every node has, of rclpy or of `BaseNode`.
_OF_ROS = ("use_sim_time", "qos_overrides.", "executor")


class Ready(Config):
    """One condition of readiness, written as `{kind: name}`.

    A topic has a publisher, of a message topic one was received, a service or an action has a server.
    """

    kind: ConditionKind
    name: str = Field(description="absolute ROS name")

    @model_validator(mode="before")
    @classmethod
    def _of_one_key(cls, data: Any) -> Any:
        if not isinstance(data, dict) or len(data) != 1 or not set(data) <= set(get_args(ConditionKind)):  # pyright: ignore
            raise ValueError(f"give exactly one of {', '.join(get_args(ConditionKind))}")
        ((kind, name),) = data.items()  # pyright: ignore
        if not str(name).startswith("/"):  # pyright: ignore
            raise ValueError(f"{name!r} must be an absolute name, such as /{name}")
        return {"kind": kind, "name": name}

    def __str__(self) -> str:
        return f"{self.kind} {self.name}"


class Restart(Config):
    """What happens when a node ends by itself."""

    policy: Literal["never", "on_failure", "always"] = "on_failure"
    backoff: float = Field(default=0.1, gt=0, description="s before a restart; doubles while the node fails soon")
    backoff_max: float = Field(default=8.0, gt=0, description="s, the longest wait")
    max: int = Field(default=5, ge=0, description="restarts before the node is given up")
    retry: float = Field(
        default=30.0, gt=0, description="s until a node that was given up is tried again, if the graph goes on"
    )
    forget_after: float = Field(default=10.0, gt=0, description="s of being ready that make up for earlier restarts")


class NodeSpec(Config):
    """One process of the graph."""

    module: str | None = Field(default=None, description="started as `python -m module`")
    command: tuple[str, ...] = Field(default=(), description="started instead of a module")
    params: dict[str, Any] = Field(default_factory=dict, description="ROS parameters, nested or joined by dots")
    params_file: str | None = Field(default=None, description="ROS parameter file, in config/ or next to the graph")
    remaps: dict[str, str] = Field(default_factory=dict)
    ready: tuple[Ready, ...] = Field(default=(), description="all must hold; none = ready when started")
    ready_timeout: float = Field(default=60.0, gt=0, description="s")
    needs: tuple[str, ...] = Field(default=(), description="nodes that must be ready before this one is started")
    restart: Restart = Restart()
    essential: bool = Field(default=True, description="false: once it was ready, the graph goes on when it is given up")
    large_messages: bool = Field(default=False, description="publishes images or clouds: a large Fast DDS segment")
    segment_mib: int = Field(default=32, ge=1, le=1024, description="MiB of /dev/shm for large messages")
    shared_mib: float = Field(default=0.0, ge=0.0, le=1024.0, description="MiB of /dev/shm that it takes by itself")
    env: dict[str, str] = Field(default_factory=dict)
    offers: tuple[str, ...] = Field(default=(), description="topics, services, actions, for `graph draw`")
    uses: tuple[str, ...] = Field(default=(), description="names that other nodes offer, for `graph draw`")

    @property
    def program(self) -> str:
        """What is started, as in a shell."""
        start = shlex.join(self.command) if self.command else f"python -m {self.module}"
        return " ".join([*(f"{name}={shlex.quote(value)}" for name, value in self.env.items()), start])

    @property
    def foreign(self) -> bool:
        """Whether it is more than a module of the suite: a command, another module, or variables of its own."""
        return bool(self.command or self.env) or not str(self.module).startswith(_SUITE)

    @model_validator(mode="after")
    def _start(self) -> NodeSpec:
        if (self.module is None) == (not self.command):
            raise ValueError("give either module or command")
        return self


class Graph(Config):
    """All nodes that run together."""

    name: str
    description: str = ""
    scene: str = Field(default="demo", description="name or path of a scene, or `random`")
    seed: int = Field(default=0, ge=0, description="of a random scene")
    mount_seed: int | Literal["none"] = Field(default="none", description="of the true camera mounts; none = nominal")
    domain: int | None = Field(
        default=None, ge=0, le=LAST_DOMAIN, description="ROS_DOMAIN_ID; null = environment, or 0"
    )
    discovery: Discovery = Field(default="localhost", description="ROS_AUTOMATIC_DISCOVERY_RANGE")
    nodes: dict[str, NodeSpec] = Field(min_length=1)

    def levels(self) -> tuple[tuple[str, ...], ...]:
        """Return the node names by depth of dependency: the first needs nothing, each needs only earlier ones."""
        sorter = TopologicalSorter({name: spec.needs for name, spec in self.nodes.items()})
        sorter.prepare()
        levels: list[tuple[str, ...]] = []
        while ready := sorter.get_ready():
            levels.append(tuple(name for name in self.nodes if name in ready))
            sorter.done(*ready)
        return tuple(levels)

    def node(self, name: str) -> NodeSpec:
        """Return one node.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing the nodes of the graph.
        """
        if name not in self.nodes:
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"graph {self.name} has no node {name!r}; its nodes are {', '.join(self.nodes)}"
            )
        return self.nodes[name]

    def parameters(self, name: str) -> dict[str, Any]:
        """Return the ROS parameters of a node by dotted name: parameter file, inline parameters, then `--set`.

        This is the one source of a node's parameters: the supervisor writes them to the file that the node is started
        with. Those that are null are left out and take the node's default.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for an unknown node.
        """
        return {key: value for key, value in self.node(name).params.items() if value is not None}

    def config(self, name: str, model: type[ConfigT]) -> ConfigT:
        """Return the configuration that a node of this graph runs with, for code that runs its core in process.

        Args:
            name: The node.
            model: Its configuration model, such as `openarm_motion.config.MotionConfig` for `motion`.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for an unknown node; CONFIG_INVALID, naming each wrong parameter.

        Example:
            >>> load_graph("sim", sets=["motion.planning.seed=7"]).config("motion", MotionConfig)  # doctest: +SKIP
        """
        nested: dict[str, Any] = {}
        for key, value in self.parameters(name).items():
            if key.startswith(_OF_ROS):
                continue
            *groups, last = key.split(".")
            place = nested
            for group in groups:
                place = place.setdefault(group, {})
            place[last] = value
        return validate(model, nested, f"parameters of {name} in graph {self.name}")


def graph_names() -> list[str]:
    """Return the names of the graphs that come with the suite: of all robots, and of this process's robot alone."""
    return sorted({path.stem for folder in _folders() for path in folder.glob("*.yaml")})


def _folders() -> tuple[Path, Path]:
    return robot_folder() / "graphs", config_dir() / "graphs"


def find_graph(name: str) -> Path:
    """Return the file of a graph, given its name or its path.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the graphs that exist.
    """
    for path in (*(folder / f"{name}.yaml" for folder in _folders()), Path(name)):
        if is_file(path):
            return path
    raise OpenArmError(
        Code.INVALID_ARGUMENT, f"there is no graph {brief(name)}; give a file, or one of {', '.join(graph_names())}"
    )


def load_graph(
    name: str, *, overrides: Mapping[str, Any] | None = None, sets: Sequence[str] = (), emulate: bool = False
) -> Graph:
    """Read a graph, apply overrides, substitute variables, and check it as a whole.

    Args:
        name: Name of a graph of the suite, or path of a file.
        overrides: Top-level values (scene, seed, mount_seed, domain, discovery); None leaves the file's value.
        sets: `node.param=value`, the value as YAML.
        emulate: True for the graph with what the file says in `emulate`.

    Raises:
        OpenArmError: CONFIG_INVALID for a fault in a file (named as file:key); INVALID_ARGUMENT for one in `sets`,
            `overrides` or `name`.
    """
    path = find_graph(name)
    data = _read(path, ())
    stand_in = data.pop("emulate", None)
    if emulate:
        data = _emulated(data, stand_in, path)
    given = {key: value for key, value in (overrides or {}).items() if value is not None}
    data.update(given)
    where = f"{path} with {given}" if given else str(path)
    graph = validate(Graph, data, where)
    _check_needs(graph, str(path))
    variables = {key: getattr(graph, key) for key in VARIABLES}
    nodes = {
        node: spec.model_copy(update={"params": _node_params(node, spec, path, variables)})
        for node, spec in graph.nodes.items()
    }
    graph = graph.model_copy(update={"nodes": nodes})
    for item in sets:
        set_parameter(graph, item)
    return graph


def _read(path: Path, trail: tuple[Path, ...]) -> dict[str, Any]:
    """Read one file and what it extends, as plain data."""
    if path in trail:
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{path}:extends: {' → '.join(p.name for p in (*trail, path))} is a circle"
        )
    graph: dict[str, Any] = {"name": path.stem, **for_each_part(load_yaml(path))}
    base_name, only = graph.pop("extends", None), graph.pop("only", None)
    _require_mappings(graph.get("nodes"), path)
    if base_name is not None:
        if not isinstance(base_name, str) or not isinstance(only or [], list):
            raise OpenArmError(
                Code.CONFIG_INVALID, f"{path}: expected the name of a graph in `extends`, a list in `only`"
            )
        sibling = path.parent / f"{base_name}.yaml"
        base = {"nodes": {}, **_read(sibling if is_file(sibling) else find_graph(base_name), (*trail, path))}
        if only is not None:
            unknown = [node for node in only if node not in list(base["nodes"])]
            if unknown:
                known = ", ".join(base["nodes"])
                raise OpenArmError(
                    Code.CONFIG_INVALID, f"{path}:only: unknown node {brief(unknown[0])}; nodes are {known}"
                )
            base["nodes"] = {node: spec for node, spec in base["nodes"].items() if node in only}
        own = graph.pop("nodes", None) or {}
        for node, spec in own.items():
            base["nodes"][node] = {**base["nodes"].get(node, {}), **spec}
        graph = {**base, **graph}
    elif only is not None:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path}:only: needs `extends`")
    return graph


def _emulated(graph: Mapping[str, Any], stand_in: Any, path: Path) -> dict[str, Any]:
    """Return a graph with its emulation: nodes taken out, parameters set, nodes and top-level values added."""
    if not isinstance(stand_in, dict):
        text = f"{path} has no `emulate`, which says what stands for the robot; a graph that has is real"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    values: dict[str, Any] = dict(stand_in)  # pyright: ignore[reportUnknownArgumentType]
    own, without = values.pop("nodes", None) or {}, values.pop("without", [])
    _require_mappings(own, path)
    nodes = {node: spec for node, spec in graph["nodes"].items() if node not in without}
    for node, spec in own.items():
        known = nodes.get(node, {})
        params = {**(known.get("params") or {}), **(spec.get("params") or {})}
        nodes[node] = {**known, **spec, "params": params}
    return {**graph, **values, "nodes": nodes}


def _require_mappings(nodes: Any, path: Path) -> None:
    """Refuse nodes that are no mappings, before they are merged with those of another file."""
    found: Any = {} if nodes is None else nodes
    if not isinstance(found, dict) or not all(isinstance(spec, dict) for spec in found.values()):  # pyright: ignore
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{path}:nodes: expected a mapping of names, each with a mapping of keys"
        )


def _check_needs(graph: Graph, where: str) -> None:
    for node, spec in graph.nodes.items():
        for need in spec.needs:
            if need not in graph.nodes:
                raise OpenArmError(
                    Code.CONFIG_INVALID,
                    f"{where}:nodes.{node}.needs: unknown node {need!r}; nodes are {', '.join(graph.nodes)}",
                )
    try:
        graph.levels()
    except CycleError as error:
        circle: list[str] = error.args[1][::-1]
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{where}:nodes.{circle[0]}.needs: {' → '.join(circle)} is a circle; remove one need"
        ) from error


def _node_params(node: str, spec: NodeSpec, graph_file: Path, variables: Mapping[str, Any]) -> dict[str, Any]:
    """Merge the parameter file and the inline parameters (which win), flat, with variables filled in."""
    params: dict[str, Any] = {}
    if spec.params_file is not None:
        places = [config_dir() / spec.params_file, graph_file.parent / spec.params_file, Path(spec.params_file)]
        found = [place for place in places if place.is_file()]
        if not found:
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"{graph_file}:nodes.{node}.params_file: {spec.params_file} is neither in {places[0].parent} "
                f"nor in {places[1].parent}",
            )
        params.update(read_params(found[0], node))
    params.update(flatten(spec.params))
    return {
        key: substitute(value, variables, f"{graph_file}:nodes.{node}.params.{key}") for key, value in params.items()
    }


def set_parameter(graph: Graph, item: str) -> None:
    """Apply one `node.param=value` to a graph that load_graph made: its dictionaries of parameters are its own.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for another form, an unknown node or a value that is not YAML.
    """
    target, equals, text = item.partition("=")
    node, dot, param = target.partition(".")
    if not (equals and dot and param):
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"--set {item}: expected node.param=value, such as grasp.velocity_scale=0.5"
        )
    graph.node(node).params[param] = parse_yaml(text, f"--set {brief(item)}: the value", Code.INVALID_ARGUMENT)
