# SPDX-License-Identifier: Apache-2.0
"""What the tests of the strategies share: a scripted robot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from openarm_common.detection import Detection
from tests.openarm_grasp.scripted import World, standing


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

    def make(x: float, y: float, *others: tuple[str, float, float], **config: Any) -> World:
        world = World(standing("red", x, y), *(standing(*other) for other in others), **config)
        world.two_sided = True
        return world

    return make
