# SPDX-License-Identifier: Apache-2.0
"""What a node process is started with: environment, arguments, Fast DDS profile."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import yaml

from openarm_bringup.supervision.discovery import ACROSS_MACHINES, LAST_DOMAIN, PROFILE, network_profile, variables
from openarm_bringup.supervision.graph import Graph, NodeSpec
from openarm_common.errors import Code, OpenArmError
from openarm_common.records import default_folder
from openarm_common.resources import config_dir, write_whole
from openarm_common.robot.learned import LearnedStore, StoredHands, StoredZeros
from openarm_common.robot.zeros import REAL, ZEROS, Zeros, keep_zeros

#: Of one message through shared memory, MiB; a cloud of 640x480 points takes 3.7 MB.
_LARGEST_MIB = 4
#: The node that simulates a robot.
_BRIDGE = "mujoco_bridge"
#: Its parameters that draw what is learned of a robot.
_DRAWS = ("zero_seed", "zero_rms", "hand_seed")


def domain_id(graph: Graph, environ: Mapping[str, str] = os.environ) -> int:
    """Return the ROS domain of a graph: its own, else the environment's, else 0.

    Raises:
        OpenArmError: ENVIRONMENT, when ROS_DOMAIN_ID is not a number of a domain.
    """
    if graph.domain is not None:
        return graph.domain
    text = environ.get("ROS_DOMAIN_ID", "") or "0"
    if not text.isdecimal() or int(text) > LAST_DOMAIN:
        raise OpenArmError(Code.ENVIRONMENT, f"ROS_DOMAIN_ID is {text!r}; expected a number from 0 to {LAST_DOMAIN}")
    return int(text)


def ros_environment(graph: Graph, environ: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return the variables that decide which processes a node or a client of the graph meets."""
    return variables(domain_id(graph, environ), graph.discovery)


def profile_of(graph: Graph, environ: Mapping[str, str] = os.environ) -> str:
    """Return the Fast DDS profile of a process that publishes nothing large; a user's own comes first."""
    if graph.discovery in ACROSS_MACHINES:
        return str(network_profile())
    return environ.get(PROFILE) or str(config_dir() / "fastdds_small.xml")


def client_environment(graph: Graph, run_dir: Path, environ: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return the whole environment of a process that meets the graph; keeps the zeros of its robot in the run folder.

    Raises:
        OpenArmError: CONFIG_INVALID, when the stored zeros of the joints, or the learned hands, are damaged.
    """
    env = {
        **environ,
        **ros_environment(graph, environ),
        "PYTHONUNBUFFERED": "1",
        ZEROS: str(zeros_file(graph, run_dir)),
    }
    env.pop("ROS_LOCALHOST_ONLY", None)  # deprecated, and would override the discovery range
    env.setdefault("RCUTILS_CONSOLE_OUTPUT_FORMAT", "[{severity}] {message}")
    env[PROFILE] = profile_of(graph, environ)
    # The nodes share few cores; a pool of BLAS threads in each would only fight over them.
    for key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        env.setdefault(key, "1")
    return env


def node_environment(graph: Graph, name: str, run_dir: Path, environ: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return the whole environment of one node; writes its Fast DDS profile when it has one."""
    spec, env = graph.node(name), client_environment(graph, run_dir, environ)
    if spec.large_messages:
        env[PROFILE] = str(write_profile(spec, run_dir / "params" / f"{name}.fastdds.xml"))
    return {**env, **spec.env}


def zeros_file(graph: Graph, run_dir: Path) -> Path:
    """Return the file of the zeros of the joints in a run folder, copied from what is stored when a run begins.

    With the hands as they were learned.
    """
    folder = run_dir / "zeros"
    if kept := sorted(folder.glob("*.yaml")):
        return kept[0]
    record = LearnedStore(_folder(graph, "calibration_publisher", "store"), StoredZeros).in_use(zeros_name(graph))
    hands = LearnedStore(_folder(graph, "grasp", "calibrations"), StoredHands).in_use(record.of).hands
    return keep_zeros(Zeros(robot=record.robot, of=record.of, offsets=record.offsets, hands=hands), folder)


def _folder(graph: Graph, node: str, parameter: str) -> Path:
    """Return the folder of calibrations that a parameter of a node names; the default one without it."""
    given = str(graph.parameters(node).get(parameter, "")) if node in graph.nodes else ""
    return Path(given).expanduser() if given else default_folder()


def zeros_name(graph: Graph) -> str:
    """Return what the zeros of the robot of a graph are stored as; a simulated one goes by what draws its zeros."""
    return name_of_zeros(graph.parameters(_BRIDGE) if _BRIDGE in graph.nodes else None)


def name_of_zeros(bridge: Mapping[str, object] | None) -> str:
    """Return what zeros are stored as by the parameters of the bridge that simulates the robot; None: a real one."""
    if bridge is None:
        return REAL
    profile = str(bridge.get("profile", "openarm"))
    drawn = [f"{key}_{bridge[f'{profile}.{key}']}" for key in _DRAWS if f"{profile}.{key}" in bridge]
    return re.sub("[^a-z0-9_]", "_", "_".join(["simulated", profile, *drawn]).lower())[:64]


def write_profile(spec: NodeSpec, path: Path) -> Path:
    """Write config/fastdds.xml with the segment size of one node, and return where.

    No message may be larger than the segment: otherwise Fast DDS uses no shared memory for any of them.
    """
    file = config_dir() / "fastdds.xml"
    sized, largest = file.read_text(encoding="utf-8"), min(spec.segment_mib, _LARGEST_MIB)
    for tag, mib in (("segment_size", spec.segment_mib), ("maxMessageSize", largest)):
        sized, count = re.subn(rf"(?<=<{tag}>)\d+(?=</{tag}>)", str(mib * 2**20), sized)
        if count != 1:
            raise OpenArmError(Code.CONFIG_INVALID, f"{file}: expected one <{tag}>, found {count}")
    _keep(path, sized)
    return path


def _keep(path: Path, text: str) -> None:
    """Write a file that does not have this content yet: a restart needs no room on the disk."""
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        write_whole(path, text.encode())


@contextmanager
def profiled(profile: Path) -> Iterator[None]:
    """Let the participants that are made inside have a Fast DDS profile; those that come later get what was there."""
    before = os.environ.get(PROFILE)
    os.environ[PROFILE] = str(profile)
    try:
        yield
    finally:
        if before is None:
            del os.environ[PROFILE]
        else:
            os.environ[PROFILE] = before


def of_one_type(value: object) -> object:
    """Return a value of a parameter; whole numbers in a list with others become such: rcl takes lists of one type."""
    if not isinstance(value, list):
        return value
    items = cast("list[object]", value)
    numbers = all(isinstance(item, int | float) and not isinstance(item, bool) for item in items)
    if not numbers or not any(isinstance(item, float) for item in items):
        return items
    return [float(cast("float", item)) for item in items]


def node_arguments(graph: Graph, name: str, run_dir: Path) -> list[str]:
    """Return the command line of one node; writes its parameters to a file in the run folder."""
    spec = graph.node(name)
    argv = list(spec.command) if spec.command else [sys.executable, "-m", str(spec.module)]
    if argv[0] == "python":
        argv[0] = sys.executable
    # Everything a node says goes to its log through the supervisor; rcl's own log files would only repeat it.
    ros = ["--disable-external-lib-logs", "-r", f"__node:={name}"]
    ros += [part for old, new in spec.remaps.items() for part in ("-r", f"{old}:={new}")]
    if params := graph.parameters(name):
        path = run_dir / "params" / f"{name}.yaml"
        params = {key: of_one_type(value) for key, value in params.items()}
        _keep(path, yaml.safe_dump({name: {"ros__parameters": params}}, sort_keys=False))
        ros += ["--params-file", str(path)]
    return [*argv, "--ros-args", *ros]
