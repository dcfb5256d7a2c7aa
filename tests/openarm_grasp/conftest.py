# SPDX-License-Identifier: Apache-2.0
"""What the tests of the strategies share: a scripted robot, and one that was recorded or is simulated."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from openarm_common.detection import Detection
from tests.openarm_grasp.recorded import Recordings
from tests.openarm_grasp.scripted import World, standing

#: A test with a robot of `recorded` runs on its recording, and in the long suite in simulation.
_ROBOTS = ("replayed", pytest.param("simulated", marks=pytest.mark.long))


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "recorded" in metafunc.fixturenames:
        metafunc.parametrize("recorded", _ROBOTS, indirect=True)


@pytest.fixture
def recorded(request: pytest.FixtureRequest) -> Iterator[Recordings]:
    """Makes the robot of a test; with --record, a test that passes in simulation writes its recording."""
    case = [request.node.originalname, *(part for part in request.node.callspec.id.split("-") if part != request.param)]
    name = re.sub(r"\W+", "_", "-".join(case).removeprefix("test_"))
    path = Path(__file__).parent / "recordings" / request.path.stem.removeprefix("test_") / name
    robots = Recordings(path, simulated=request.param == "simulated")
    failed = request.session.testsfailed
    yield robots
    if request.config.getoption("record") and request.session.testsfailed == failed:
        robots.write()


@pytest.fixture
def box() -> Callable[..., Detection]:
    """Makes a cube on the table: label, x, y, and edge, m."""
    return standing


@pytest.fixture
def worlds() -> Callable[..., World]:
    """Makes a world of its objects and parameters of the grasp."""
    return World


@pytest.fixture
def world() -> World:
    """A red cube on the right, a blue one on the left."""
    return World(standing("red", 0.26, -0.2), standing("blue", 0.26, 0.2))


@pytest.fixture
def robot() -> Callable[..., World]:
    """Makes a world in which each arm reaches its own side and a strip of the other's: x, y of the red cube, others."""

    def make(x: float, y: float, *others: tuple[str, float, float], far: float = 1.0, **config: Any) -> World:
        world = World(standing("red", x, y), *(standing(*other) for other in others), **config)
        world.two_sided, world.far = True, far
        return world

    return make
