# SPDX-License-Identifier: Apache-2.0
"""What stands on a box, a board or in a tray is measured from there; expected values are those that were drawn."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from openarm_perception.detection.localize import Localizer, LocalizerConfig
from openarm_perception.detection.network import NetworkConfig
from openarm_perception.detection.pipeline import SUPPORT, make_pipeline
from openarm_perception.geometry.depth import DepthLimits
from openarm_perception.geometry.levels import find_levels
from openarm_sim_bridge.cameras.noise import DepthNoiseConfig, add_depth_noise
from tests.openarm_perception.conftest import TABLE, Thing


@dataclass(frozen=True)
class Raised(Thing):
    """A thing with its bottom so high above the table, m."""

    over: float = 0.0

    @property
    def position(self):
        return super().position + np.array([0.0, 0.0, self.over])


@pytest.fixture(scope="module", params=["color", "anything"])
def finds(request, tabletop, detector):
    """Finds the objects among things, those called anything by their place."""
    pipeline = make_pipeline(
        request.param, detector, NetworkConfig(), Localizer(LocalizerConfig(), DepthLimits(near=0.07), TABLE)
    )

    def find(*things: Thing, noise: bool = False, colour: str = ""):
        if colour and request.param != colour:
            pytest.skip(f"of the detector {colour}")
        view = tabletop.render(things)
        depth = view.depth
        if noise:
            rng = np.random.default_rng(7)
            depth = add_depth_noise(depth.copy(), view.intrinsics.fy, DepthNoiseConfig(enabled=True), rng)
        return replace(view, depth=depth).perceived(pipeline)

    return find


def is_measured(places, thing: Raised, within: float = 0.003) -> None:
    """One of the places is where the thing is, as high, and ends where it ends."""
    place = min(places, key=lambda one: float(np.linalg.norm(one.p_base - thing.position)))
    assert place.p_base == pytest.approx(thing.position, abs=within)
    assert place.bottom == pytest.approx(TABLE + thing.over, abs=within)
    assert place.top == pytest.approx(TABLE + thing.over + thing.size[2], abs=within)


@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("height", [0.05, 0.10, 0.23])
@pytest.mark.parametrize("off", [0.0, 0.035])
def test_a_cube_on_a_box_is_measured_from_the_top_of_the_box(finds, height: float, off: float, noise: bool):
    cube = Raised("red", "box", (0.045, 0.045, 0.045), 0.28 + off, 0.12, 0.5, over=height)
    box, can = (
        Raised("blue", "box", (0.12, 0.15, height), 0.28, 0.12),
        Raised("green", "cylinder", (0.06, 0.06, 0.08), 0.3, -0.2),
    )
    seen = finds(box, cube, can, noise=noise)
    assert len(seen.boxes) == 3
    is_measured(seen.located, cube)
    is_measured(seen.located, can)
    carrier = min(
        seen.boxes, key=lambda one: float(np.linalg.norm(one.p_base[:2] - box.position[:2])) + abs(one.bottom - TABLE)
    )
    assert carrier.bottom == pytest.approx(TABLE, abs=0.003)
    assert carrier.top == pytest.approx(TABLE + height, abs=0.003)


def test_a_pile_of_three_is_measured_each_from_the_one_below(finds):
    lowest = Raised("blue", "box", (0.16, 0.16, 0.05), 0.28, 0.1)
    middle = Raised("green", "box", (0.10, 0.10, 0.06), 0.28, 0.1, 0.3, over=0.05)
    cube = Raised("red", "box", (0.045, 0.045, 0.045), 0.28, 0.1, 0.6, over=0.11)
    seen = finds(lowest, middle, cube)
    assert {round(one.bottom - TABLE, 2) for one in seen.boxes} == {0.0, 0.05, 0.11}
    is_measured(seen.located, cube)


def test_what_carries_and_is_of_no_colour_is_an_obstacle(finds):
    board, cube = (
        Raised("grey", "box", (0.2, 0.28, 0.15), 0.28, 0.15),
        Raised("red", "box", (0.05, 0.05, 0.05), 0.25, 0.2, over=0.15),
    )
    seen = finds(board, cube, colour="color")
    is_measured(seen.located, cube)
    (obstacle,) = seen.unmeasured
    assert (obstacle.name, obstacle.bottom) == (SUPPORT, pytest.approx(TABLE, abs=0.003))
    assert obstacle.top == pytest.approx(TABLE + 0.15, abs=0.003)
    assert obstacle.size[:2] == pytest.approx((0.2, 0.28), abs=0.02)


def test_things_in_a_tray_are_measured_from_its_bottom(finds):
    floor = Raised("grey", "box", (0.2, 0.26, 0.015), 0.28, 0.1)
    rims = [Raised("grey", "box", (0.2, 0.01, 0.04), 0.28, 0.1 + side) for side in (-0.135, 0.135)]
    cube = Raised("red", "box", (0.045, 0.045, 0.045), 0.28, 0.05, 0.4, over=0.015)
    can = Raised("green", "cylinder", (0.06, 0.06, 0.08), 0.27, 0.16, over=0.015)
    seen = finds(floor, *rims, cube, can, colour="color")
    is_measured(seen.located, cube)
    is_measured(seen.located, can)


def test_a_box_with_nothing_on_it_is_one_object(finds):
    box = Raised("blue", "box", (0.12, 0.14, 0.2), 0.28, 0.1, 0.4)
    seen = finds(box)
    assert len(seen.boxes) == 1
    is_measured(seen.located, box)


def test_a_cube_next_to_a_flat_box_stands_on_the_table(finds):
    flat, cube = (
        Raised("blue", "box", (0.16, 0.2, 0.03), 0.28, 0.0),
        Raised("red", "box", (0.05, 0.05, 0.05), 0.28, 0.13),
    )
    seen = finds(flat, cube)
    is_measured(seen.located, cube)
    is_measured(seen.located, flat)


def test_points_of_a_step_are_divided_by_it_and_a_cup_by_nothing():
    """A grid of 2 mm seen straight from above: a block on a plate; and a cup, whose wall stands around its bottom."""
    xy = np.stack(np.meshgrid(np.arange(100) * 0.002, np.arange(100) * 0.002), axis=-1)
    z = np.zeros((100, 100))
    z[20:80, 20:80], z[40:60, 40:60] = 0.05, 0.09
    points = np.dstack([xy, z])
    levels = find_levels(points, np.zeros((100, 100), bool), 0.008)
    assert levels.height == pytest.approx([0.0, 0.05], abs=1e-6)
    assert (levels.under[40:60, 40:60] == 1).all()
    assert np.count_nonzero(levels.under) == 400
    assert levels.face[30, 30] == 1
    hidden = find_levels(points, z > 0.06, 0.008)  # the block is the robot
    assert len(hidden.height) == 1
    away = np.linalg.norm(xy - 0.1, axis=-1)
    points[..., 2] = np.where(away < 0.035, 0.01, np.where(away < 0.042, 0.08, 0.0))
    assert len(find_levels(points, np.zeros((100, 100), bool), 0.008).height) == 1
