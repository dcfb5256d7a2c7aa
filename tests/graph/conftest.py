# SPDX-License-Identifier: Apache-2.0
"""A running graph, started as a user starts it, in a domain and folders of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest

from openarm_bringup.supervision.runs import NodeRecord, RunRecord
from openarm_bringup.supervision.state import state_dir
from openarm_common.domain import reserve_domain
from openarm_evaluation.judging.ros.observer import Observer
from openarm_grasp.ros.client import GraspClient
from tests.conftest import DEADLINE_S

ROOT = Path(__file__).parents[2]


@dataclass
class Up:
    """An `openarm up` and what is known of it."""

    process: subprocess.Popen[str]
    env: dict[str, str]
    domain: int
    output: Path

    def openarm(self, *args: str, timeout: float = 120.0) -> subprocess.CompletedProcess[str]:
        """Run another command of the command line next to it."""
        command = [sys.executable, "-m", "openarm_bringup.cli", *args]
        return subprocess.run(
            command, env=self.env, cwd=ROOT, capture_output=True, text=True, timeout=timeout, check=False
        )

    def record(self) -> dict[str, Any] | None:
        """Return what `openarm ps` says of the graph, or None when it is not listed."""
        done = self.openarm("ps", "--json", "--seconds", "0.01")
        graphs = [graph for graph in json.loads(done.stdout)["graphs"] if graph["pid"] == self.process.pid]
        return graphs[0] if graphs else None

    def wait_ready(self, seconds: float = DEADLINE_S) -> RunRecord:
        """Wait until all nodes are ready; return what the supervisor has recorded."""
        written = state_dir(self.env) / f"{self.process.pid}.json"
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            assert self.process.poll() is None, self.output.read_text()
            if written.exists() and (record := RunRecord.model_validate_json(written.read_text())).ready:
                return record
            time.sleep(0.05)
        pytest.fail(f"not ready within {seconds:g} s: {self.output.read_text()}")

    def node(self, name: str) -> NodeRecord:
        """Return what the supervisor has recorded of a node."""
        written = state_dir(self.env) / f"{self.process.pid}.json"
        return RunRecord.model_validate_json(written.read_text()).nodes[name]

    def wait_back(self, name: str, killed: int, seconds: float = DEADLINE_S) -> None:
        """Wait until a node that was killed runs in another process, and is ready."""
        deadline = time.monotonic() + seconds
        while (node := self.node(name)).pid == killed or node.state != "ready":
            assert time.monotonic() < deadline, f"{name} is not back within {seconds:g} s: {self.output.read_text()}"
            time.sleep(0.05)

    def pids(self) -> list[int]:
        """Return every process below the supervisor, and itself."""
        me = psutil.Process(self.process.pid)
        return [self.process.pid, *(child.pid for child in me.children(recursive=True))]

    def stop(self, number: int = signal.SIGINT, seconds: float = 30.0) -> int:
        """Stop as Ctrl-C does; return the exit code."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(timeout=seconds)


Starter = Callable[..., Up]


@pytest.fixture(scope="module")
def start_graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Starter]:
    """A function that starts a graph, in the domain of another when asked; all are stopped at the end of the module."""
    started: list[Up] = []

    def start(*args: str, joining: Up | None = None) -> Up:
        folder = tmp_path_factory.mktemp("graph")
        domain = joining.domain if joining else reserve_domain()
        # without a display, also where the machine has one.
        env = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
        env |= {
            "OPENARM_RUNS": str(folder / "runs"),
            "XDG_RUNTIME_DIR": joining.env["XDG_RUNTIME_DIR"] if joining else str(folder),
            "ROS_DOMAIN_ID": str(domain),
            "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH", "")))),
        }
        output = folder / "up.log"
        with output.open("w") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "openarm_bringup.cli", "up", *args, "--domain", str(domain)],
                env=env,
                cwd=ROOT,
                stdout=log,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
            )
        started.append(Up(process, env, domain, output))
        return started[-1]

    yield start
    for up in started:
        up.stop()


@pytest.fixture
def domain(up: Any, monkeypatch: pytest.MonkeyPatch) -> int:
    """Clients of this process meet the graph."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(up.domain))
    return up.domain


@pytest.fixture
def observer(domain: int) -> Iterator[Observer]:
    with Observer(domain) as watching:
        yield watching


@pytest.fixture
def client(domain: int) -> Iterator[GraspClient]:
    with GraspClient() as asking:
        yield asking
