# SPDX-License-Identifier: Apache-2.0
"""Fixtures that all tests share.

Nodes are tested in process: the node and its probes run in one executor, in a ROS domain of their own, and wait for
conditions with a deadline, never for a time to pass.
"""

from __future__ import annotations

import fcntl
import gc
import os
import shutil
import signal
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import hypothesis
import pytest
import yaml

from openarm_common.domain import release_domain, reserve_domain
from openarm_common.resources import models_dir
from openarm_common.robot import folder, zeros
from openarm_common.robot.description import RobotDescription

# Before any rclpy is imported: a domain of this process, no traffic beyond this machine, software rendering.
os.environ["ROS_DOMAIN_ID"] = str(reserve_domain())
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.pop(folder.ROBOT, None)  # a test that is about another robot than the default one says so
os.environ.pop(zeros.ZEROS, None)
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # begun in the background of a script; commands would inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A run of the suite draws the same examples every time and times none; `--hypothesis-profile=explore` draws new ones.
hypothesis.settings.register_profile("suite", deadline=None, derandomize=True)
hypothesis.settings.register_profile("explore", deadline=None)
hypothesis.settings.load_profile("suite")


#: What a wait for nodes and processes takes at most, s; far above what it takes on a slow and busy machine.
DEADLINE_S = 120.0


class MachineLock:
    """Keeps a test that is marked `alone` from running at the same time as tests of other worker processes.

    Tests share the lock; one that is marked takes it exclusively. Whoever waits for it holds the queue, so that a test
    that comes later cannot overtake.

    Args:
        folder: Of the lock files, the same for all workers.
    """

    def __init__(self, folder: Path) -> None:
        self._queue, self._lock = ((folder / name).open("a") for name in ("queue", "lock"))
        self._alone = False

    def acquire(self, *, alone: bool) -> None:
        if not self._alone:
            with _locked(self._queue):
                fcntl.flock(self._lock, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
            self._alone = alone

    def release(self) -> None:
        fcntl.flock(self._lock, fcntl.LOCK_UN)
        self._alone = False


@contextmanager
def _locked(file: IO[str]) -> Iterator[None]:
    fcntl.flock(file, fcntl.LOCK_EX)
    try:
        yield
    finally:
        fcntl.flock(file, fcntl.LOCK_UN)


_LOCK = pytest.StashKey[MachineLock]()


def _alone(item: pytest.Item) -> bool:
    return item.get_closest_marker("alone") is not None


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config, "workerinput"):
        config.stash[_LOCK] = MachineLock(config.cache.mkdir("lock"))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--all", action="store_true", help="run the tests that are marked `long`, too")
    parser.addoption(
        "--record", action="store_true", help="simulate what tests replay, and write new recordings; no other test"
    )


def _wanted(item: pytest.Item) -> bool:
    if item.config.getoption("record"):
        return "recorded" in getattr(item, "fixturenames", ()) and "simulated" in item.name
    named = any("::" in argument for argument in item.config.args)  # a test that is asked for by its name is run
    return named or item.config.getoption("all") or item.get_closest_marker("long") is None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    wanted = [_wanted(item) for item in items]
    config.hook.pytest_deselected(items=[item for item, keep in zip(items, wanted, strict=True) if not keep])
    items[:] = [item for item, keep in zip(items, wanted, strict=True) if keep]
    items.sort(key=_alone)  # last: until then no worker waits


def pytest_collection_finish(session: pytest.Session) -> None:
    gc.collect()
    gc.freeze()  # what was imported stays: the collector need not look at it again and again


def pytest_sessionfinish() -> None:
    gc.unfreeze()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> Generator[None, object, object]:
    lock = item.config.stash.get(_LOCK, None)
    if lock is None:
        return (yield)
    lock.acquire(alone=_alone(item))
    try:
        return (yield)
    finally:
        # fixtures of the module stay in place between its tests
        if nextitem is None or nextitem.path != item.path or not (_alone(item) and _alone(nextitem)):
            lock.release()


class RosProbe:
    """An executor with nodes in it, driven by conditions; deadlines are in seconds of the wall clock."""

    def __init__(self) -> None:
        from rclpy.node import Node

        from openarm_common.ros.executor import WaitSetExecutor

        self.executor = WaitSetExecutor()
        self.nodes: list[Node] = []
        #: A node to make publishers, subscriptions and clients of the test with.
        self.node = self.add(Node("probe"))

    def add(self, node):
        """Add a node; it is closed and destroyed at the end of the test."""
        for one in (node, *getattr(node, "companions", ())):
            self.executor.add_node(one)
        self.nodes.append(node)
        return node

    def start(self, kind, /, **parameters: object):
        """Add a node of a class with parameters; a dot in a name may be written __."""
        from rclpy.parameter import Parameter

        overrides = [Parameter(name.replace("__", "."), value=value) for name, value in parameters.items()]
        return self.add(kind(parameter_overrides=overrides))

    def hear(self, kind: type, topic: str, qos: object = 10) -> list:
        """The messages of a topic from now on."""
        got: list = []
        self.node.create_subscription(kind, topic, got.append, qos)
        return got

    def spin_until(self, condition: Callable[[], object], timeout: float = DEADLINE_S, what: str = "") -> None:
        """Spin until `condition` holds; fail with `what` after `timeout` seconds."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                pytest.fail(f"not within {timeout:g} s: {what or 'the condition'}")
            self.executor.spin_once(timeout_sec=0.05)

    def send_until(self, send: Callable[[], None], every: float, condition: Callable[[], object], what: str) -> None:
        """Send, and again after `every` seconds (best effort may lose one), until `condition` holds."""
        due = 0.0

        def step() -> object:
            nonlocal due
            if time.monotonic() >= due:
                due = time.monotonic() + every
                send()
            return condition()

        self.spin_until(step, what=what)

    def result(self, future, timeout: float = DEADLINE_S, what: str = "the answer"):
        """Spin until a future is done and return its result."""
        self.spin_until(future.done, timeout, what)
        return future.result()

    def call(self, client, request, timeout: float = DEADLINE_S):
        """Call a service and return its answer."""
        self.spin_until(client.service_is_ready, timeout, f"service {client.srv_name} is there")
        return self.result(client.call_async(request), timeout, f"an answer of {client.srv_name}")

    def send_goal(self, client, goal, timeout: float = DEADLINE_S, **kwargs):
        """Send an action goal and return (goal handle, result future or, when it was rejected, None)."""
        self.spin_until(client.server_is_ready, timeout, "the action server is there")
        handle = self.result(client.send_goal_async(goal, **kwargs), timeout, "goal answer")
        return handle, handle.get_result_async() if handle.accepted else None

    def hear_all(self, client, goal, heard: list, last: Callable[[], object], timeout: float = DEADLINE_S):
        """Send a goal, put its feedback into `heard`, and return its result.

        That is asked for only when the `last` feedback has come: rclpy takes no more of it once it has the result.
        """
        self.spin_until(client.server_is_ready, timeout, "the action server is there")
        sent = client.send_goal_async(goal, lambda message: heard.append(message.feedback))
        self.spin_until(last, timeout, "the last feedback")
        return self.result(self.result(sent).get_result_async(), timeout).result

    def close(self) -> None:
        """Take the nodes down, the newest first."""
        self.executor.shutdown(timeout_sec=2.0)
        for node in reversed(self.nodes):
            if hasattr(node, "close"):
                node.close()
            node.destroy_node()


@pytest.fixture(scope="module")
def description() -> RobotDescription:
    """The default robot."""
    return RobotDescription.load()


@contextmanager
def own_domain() -> Iterator[int]:
    """A context in a ROS domain of its own: what others left in this process is not met."""
    import rclpy

    domain, before = reserve_domain(), os.environ["ROS_DOMAIN_ID"]
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    rclpy.init()
    try:
        yield domain
    finally:
        rclpy.try_shutdown()
        release_domain(domain)
        os.environ["ROS_DOMAIN_ID"] = before  # another process may reserve the released one


@pytest.fixture(scope="module")
def ros_domain() -> Iterator[int]:
    """The domain that the tests of a module share."""
    with own_domain() as domain:
        yield domain


@pytest.fixture
def ros(ros_domain: int) -> Iterator[RosProbe]:
    """An executor and a probe node for one test, in the domain of its module."""
    probe = RosProbe()
    try:
        yield probe
    finally:
        probe.close()


@pytest.fixture(autouse=True)
def _robot_as_before() -> Iterator[None]:
    """Undo what a command of a test has chosen for the process."""
    before = os.environ.get("OPENARM_ROBOT")
    yield
    os.environ.pop("OPENARM_ROBOT", None)
    if before is not None:
        os.environ["OPENARM_ROBOT"] = before


@pytest.fixture
def own_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Calibrations of one test alone."""
    monkeypatch.setenv("OPENARM_CALIBRATIONS", str(tmp_path / "store"))


@pytest.fixture
def own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Records of running graphs of one test alone."""
    (tmp_path / "xdg").mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "xdg"))


@pytest.fixture
def nearer(tmp_path, monkeypatch) -> str:
    """Let the process's robot be one like OpenArm v1 with a higher table and a nearer region; its name."""
    robots = tmp_path / "models" / "robots"
    for name in ("openarm_v1", "nearer"):
        shutil.copytree(models_dir() / "robots" / "openarm_v1", robots / name)
    path = robots / "nearer" / "robot.yaml"
    data = yaml.safe_load(path.read_text())
    data["work"]["table"]["top_z"] = 0.45
    data["work"]["region"] = {"x": [0.15, 0.35], "abs_y": [0.05, 0.45]}
    path.write_text(yaml.safe_dump(data))
    monkeypatch.setattr(folder, "models_dir", lambda: robots.parent)
    monkeypatch.setenv(folder.ROBOT, "nearer")
    return "nearer"
