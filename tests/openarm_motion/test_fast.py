# SPDX-License-Identifier: Apache-2.0
"""The fast collision layer: it never says free where the exact layer says collision."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
import pytest
from scipy import ndimage

from benchmarks.robot_models import ROBOTS, load_arm
from openarm_common import se3
from openarm_common.collision import shape_kernels as kernels
from openarm_common.errors import OpenArmError
from openarm_motion.collision.fast import DistanceMap, FastScene, cover
from openarm_motion.collision.solids import Box, box_from
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.dual_arm import DualArm
from tests.openarm_motion.conftest import both_layers

robot_arm = functools.cache(load_arm)


def turned_boxes(rng: np.random.Generator, count: int) -> list[Box]:
    """Boxes of any size in any orientation around the arms."""
    boxes = []
    for i in range(count):
        R = se3.exp_so3(rng.uniform(-2.0, 2.0, 3))
        boxes.append(box_from(f"b{i}", rng.uniform((0.1, -0.5, 0.4), (0.7, 0.5, 1.0)), rng.uniform(0.01, 0.3, 3), R))
    return boxes


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("scenes", [4, pytest.param(50, marks=pytest.mark.long)])
@pytest.mark.requirement("A-68")
def test_never_free_where_the_exact_layer_says_collision(
    arms: dict[str, Arm], home: dict[str, float], side: str, scenes: int
) -> None:
    """With boxes and something held, 1000 states a scene."""
    arm, rng = arms[side], np.random.default_rng(68)
    found = []
    for _ in range(scenes):
        held = [box_from("thing", (0.0, 0.0, 0.03), rng.uniform(0.02, 0.12, 3))]
        exact = arm.scene(home, turned_boxes(rng, 6), held)
        states = rng.uniform(arm.kinematics.lower, arm.kinematics.upper, (1000, arm.kinematics.n))
        found.append(both_layers(FastScene([exact]), exact, states))
    fast, free = np.sum(found, axis=0)
    assert free > 300
    assert free - fast < 0.05 * free  # it is of use, too


@pytest.mark.requirement("A-74")
def test_both_arms_never_free_where_they_meet(arms: dict[str, Arm], home: dict[str, float]) -> None:
    both = DualArm(arms["left"], arms["right"])
    rng = np.random.default_rng(74)
    exact = both.scene(home, turned_boxes(rng, 3))
    fast = FastScene([exact.first, exact.second])
    states = rng.uniform(both.lower, both.upper, (1500, 14))
    free, truth = both_layers(fast, exact, states)
    assert free > 0.9 * truth > 30


def test_a_thin_wall_is_not_jumped_over(right: Arm, home: dict[str, float]) -> None:
    """The hand on one side of a sheet of 1 mm, and on the other: steps are short enough to meet it."""
    poses = [se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.32, y, 0.62)) for y in (-0.32, -0.10)]
    scene = right.scene(home)
    a, b = (next(s.q for s in right.inverse.solutions(p, 0.05) if not scene.collides(s.q)) for p in poses)
    walled = right.scene(home, [box_from("sheet", (0.32, -0.21, 0.6), (0.5, 0.001, 0.4))])
    assert not FastScene([walled]).edge_free(a, b, 0.05, 0.02)


def map_of(cells: np.ndarray, reach: float) -> DistanceMap:
    """Distances to occupied cells (x, y, z) of 2 cm, the corner at (-0.2, -0.8, 0.2)."""
    distances = np.minimum(ndimage.distance_transform_edt(~cells) * 0.02, reach).astype(np.float32)
    return DistanceMap(distances, np.array([-0.2, -0.8, 0.2]), 0.02, reach)


def map_boxes(cells: np.ndarray) -> Sequence[Box]:
    corner = np.array([-0.2, -0.8, 0.2])
    return [box_from(f"c{k}", corner + (i + 0.5) * 0.02, (0.02,) * 3) for k, i in enumerate(np.argwhere(cells))]


@pytest.mark.requirement("A-59")
def test_cells_of_a_map_are_never_overlooked(right: Arm, home: dict[str, float]) -> None:
    rng = np.random.default_rng(9)
    cells = np.zeros((50, 80, 50), np.bool_)
    cells[tuple(rng.integers(0, cells.shape, (60, 3)).T)] = True
    exact = right.scene(home, map_boxes(cells))
    fast = FastScene([right.scene(home)], map_of(cells, 0.15))
    states = rng.uniform(right.kinematics.lower, right.kinematics.upper, (1000, 7))
    free, truth = both_layers(fast, exact, states)
    assert 10 < free < int(np.sum(FastScene([right.scene(home)]).free_many(states)))
    assert free > 0.9 * truth  # the balls about the shapes don't have the last word


def test_a_map_that_does_not_reach_far_enough_is_refused(right: Arm, home: dict[str, float]) -> None:
    cells = np.zeros((5, 5, 5), np.bool_)
    with pytest.raises(OpenArmError, match="distances of the map are cut at"):
        FastScene([right.scene(home)], map_of(cells, 0.05))


@pytest.mark.parametrize("kind", [kernels.BOX, kernels.CYLINDER, kernels.SPHERE])
def test_spheres_cover_their_shape(kind: int) -> None:
    rng = np.random.default_rng(kind)
    for _ in range(20):
        size = rng.uniform(0.005, 0.12, 3)
        p = rng.uniform(-1.0, 1.0, (2000, 3))
        if kind == kernels.BOX:
            p = p * size
        elif kind == kernels.CYLINDER:
            p = p[np.hypot(p[:, 0], p[:, 1]) <= 1.0] * [size[0], size[0], size[1]]
        else:
            p = p[np.linalg.norm(p, axis=1) <= 1.0] * size[0]
        spheres = cover(kind, tuple(size.tolist()))
        gaps = np.min([np.linalg.norm(p - centre, axis=1) - radius for *centre, radius in spheres], axis=0)
        assert np.all(gaps <= 0.0)


@pytest.mark.requirement("B-13")
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("name", list(ROBOTS))
def test_hands_of_other_robots_are_never_too_free(name: str, share: float) -> None:
    """Wherever the fingers are, and with something in them."""
    arm = robot_arm(name)
    (hand,) = arm.description.hands.values()
    state = {hand.joint: hand.closed + share * (hand.opened - hand.closed)}
    held = [box_from("thing", (0.0, 0.0, 0.03), (0.03, 0.02, 0.08))]
    exact = arm.scene(state, [box_from("post", (0.45, 0.1, 0.4), (0.1, 0.1, 0.8))], held)
    states = np.random.default_rng(14).uniform(arm.kinematics.lower, arm.kinematics.upper, (1000, arm.kinematics.n))
    free, truth = both_layers(FastScene([exact]), exact, states)
    assert free > 0.9 * truth > 250


def test_what_a_line_leaves_out_is_free_in_all_its_states(arms: dict[str, Arm], home: dict[str, float]) -> None:
    """Both arms among turned boxes: the look at a line agrees with one look after the other, by the exact layer."""
    both = DualArm(arms["left"], arms["right"])
    rng = np.random.default_rng(21)
    exact = both.scene(home, turned_boxes(rng, 2))
    fast = FastScene([exact.first, exact.second])
    starts = rng.uniform(both.lower, both.upper, (600, 14))
    starts = starts[fast.free_many(starts)]
    agreed = [0, 0]
    for a in starts:
        b = np.clip(a + rng.normal(0.0, 0.25, 14), both.lower, both.upper)
        n = int(np.ceil(max(np.abs(b - a).max() / 0.05, np.abs(b - a) @ fast.levers / 0.02, 1.0)))
        states = a + np.arange(n + 1)[:, None] / n * (b - a)
        line, each = fast.edge_free(a, b, 0.05, 0.02), fast.free_many(states)
        assert line or not each.all()
        if line:
            assert not any(exact.collides(q) for q in states[~each])
        agreed[line] += 1
    assert min(agreed) > 15


def test_a_line_past_cells_of_a_map_agrees_with_its_states(right: Arm, home: dict[str, float]) -> None:
    rng = np.random.default_rng(22)
    cells = np.zeros((50, 80, 50), np.bool_)
    cells[tuple(rng.integers(0, cells.shape, (80, 3)).T)] = True
    exact, fast = right.scene(home, map_boxes(cells)), FastScene([right.scene(home)], map_of(cells, 0.15))
    starts = rng.uniform(right.kinematics.lower, right.kinematics.upper, (400, 7))
    agreed = [0, 0]
    for a in starts[fast.free_many(starts)]:
        b = np.clip(a + rng.normal(0.0, 0.15, 7), right.kinematics.lower, right.kinematics.upper)
        line = fast.edge_free(a, b, 0.05, 0.02)
        if line:
            assert exact.edge_free(a, b, 0.05, 0.02)
        agreed[line] += 1
    assert min(agreed) > 5
