# SPDX-License-Identifier: Apache-2.0
"""The map as an obstacle: which cells count, and that neither layer overlooks one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code
from openarm_common.octree.distance_field import CameraMoment, DistanceFieldReader, DistanceFieldWriter
from openarm_common.octree.lattice import Lattice
from openarm_motion.collision.fast import FastScene
from openarm_motion.collision.occupancy import Environment, OccupancyMap, robot_bodies
from openarm_motion.collision.solids import Cylinder, Mesh, Sphere, box_from
from openarm_motion.kinematics.line import line_contact, solve_line
from openarm_motion.planning import moves
from openarm_motion.planning.arm import Arm
from tests.refusals import refused, refuses

LATTICE = Lattice.from_bounds(0.02, (-0.48, -1.0, -0.08), (1.28, 1.0, 1.36))
DOWN = se3.rotation_from_z_y((0, 0, -1), (0, 1, 0))


def seen(*points: tuple[float, float, float]) -> OccupancyMap:
    """The cells that contain points."""
    indices = LATTICE.indices(np.array(points, np.float64).reshape(-1, 3))
    return OccupancyMap(np.unique(indices, axis=0), LATTICE, 1)


def wall(y: float) -> OccupancyMap:
    """A wall one cell thick, across the right arm's way."""
    x, z = np.meshgrid(np.arange(0.24, 0.44, 0.02), np.arange(0.50, 0.76, 0.02))
    return seen(*np.stack([x.ravel(), np.full(x.size, y), z.ravel()], axis=1))


def test_cells_are_those_at_no_distance(tmp_path: Path) -> None:
    writer = DistanceFieldWriter(tmp_path / "field", LATTICE, 0.4, "base", ["eye"])
    distances = np.full(LATTICE.shape, 0.4, np.float32)
    distances[3, 4, 5] = distances[10, 20, 30] = 0.0
    writer.begin()[:] = distances
    writer.commit(1, 2, {"eye": CameraMoment(1, 2)})
    found = OccupancyMap.of(DistanceFieldReader(tmp_path / "field").latest())
    assert found.indices.tolist() == [[3, 4, 5], [10, 20, 30]]
    np.testing.assert_allclose(found.centres[0], LATTICE.lower + np.array([3.5, 4.5, 5.5]) * 0.02)


@pytest.mark.requirement("A-59")
def test_map_is_met_by_both_layers_alike(right: Arm, home: dict[str, float]) -> None:
    rng = np.random.default_rng(4)
    cells = seen(*rng.uniform([0.2, -0.8, 0.4], [0.7, 0.3, 1.0], (40, 3)))
    exact = right.scene(home, environment=Environment(map=cells))
    boxes = [box_from(f"cell{k}", c, (0.02,) * 3) for k, c in enumerate(cells.centres)]
    as_boxes = right.scene(home, boxes)
    states = rng.uniform(right.kinematics.lower, right.kinematics.upper, (600, 7))
    truth = np.array([as_boxes.collides(q) for q in states])
    assert [exact.collides(q) for q in states] == truth.tolist()
    free = FastScene([exact], exact.distances).free_many(states)
    assert not np.any(free & truth)
    assert int(free.sum()) > 30
    assert int(truth.sum()) > 100


@pytest.mark.requirement("A-59")
def test_plans_go_around_the_map_at_its_own_resolution(right: Arm, home: dict[str, float]) -> None:
    wall_map = wall(-0.21)
    known = Environment(map=wall_map)
    walled = right.scene(home, environment=known)
    poses = [se3.make(DOWN, (0.32, y, 0.62)) for y in (-0.34, -0.08)]
    start, goal = (next(s.q for s in right.inverse.solutions(p, 0.05) if not walled.collides(s.q)) for p in poses)
    free = moves.to_joints(right, right.start_state(home, start.tolist(), 1.0), goal.tolist(), moves.RequestBoxes())
    now = right.start_state(home, start.tolist(), 1.0, environment=known)
    blocked = moves.to_joints(right, now, goal.tolist(), moves.RequestBoxes())
    scene = right.scene(home, [box_from(f"c{k}", c, (0.02,) * 3) for k, c in enumerate(wall_map.centres)])
    with scene.lenient(0.0):
        assert any(scene.collides(q) for q in free.at(np.arange(0.0, free.duration, 0.005))[0])
        # looks 5 mm apart at most, as the row asks
        assert not any(scene.collides(q) for q in blocked.at(np.arange(0.0, blocked.duration, 0.003))[0])


def test_a_refusal_says_where_the_map_is_in_the_way(right: Arm, home: dict[str, float]) -> None:
    goal = next(s.q for s in right.inverse.solutions(se3.make(DOWN, (0.32, -0.20, 0.62)), 0.05))
    now = right.start_state(home, environment=Environment(map=seen((0.325, -0.205, 0.605))))
    with refuses(Code.IN_COLLISION, r"the map at \(0\.33, -0\.21, 0\.61\)"):
        moves.to_joints(right, now, goal.tolist(), moves.RequestBoxes())


def test_octree_cell_at_the_gripper_does_not_hold_the_arm(right: Arm, home: dict[str, float]) -> None:
    """A cell half in the hand is an error of the map: the arm may leave, but not go deeper."""
    q = np.array([home[name] for name in right.names])
    pad = right.scene(home)
    tip = right.kinematics.fk(q)
    near = next(
        point
        for d in np.arange(0.0, 0.2, 0.002)
        for point in [tip[:3, 3] + tip[:3, 0] * d]
        if right.scene(home, environment=Environment(map=seen(point))).collides(q)
        and right.scene(home, environment=Environment(map=seen(point))).contacts(q)[0].distance > -0.02
    )
    assert not pad.collides(q)
    now = right.start_state(home, scale=1.0, environment=Environment(map=seen(near)))
    goal = right.description.group_state("right_arm", "official_home")
    plan = moves.to_joints(right, now, [goal[name] for name in right.names], moves.RequestBoxes())
    assert plan.duration > 0.5


def test_a_hand_may_back_off_along_cells_next_to_it_but_not_into_them(right: Arm, home: dict[str, float]) -> None:
    """The steps of an object's cells come a little nearer to fingers that leave it than they were at the start."""
    T = se3.make(se3.rotation_from_z_y((0.25, 0, -1), (1, 0, 0)), (0.349, -0.191, 0.468))
    opened = right.with_gripper(home, right.opened)
    known = Environment(map=seen((0.37, -0.19, 0.51)))
    q = next(s.q for s in right.inverse.solutions(T, 0.05) if not right.scene(opened, straight=True).collides(s.q))
    scene = right.scene(opened, straight=True, environment=known)
    assert not scene.collides(q)
    back, into = T.copy(), T.copy()
    back[:3, 3] -= 0.1 * T[:3, 2]
    line = solve_line(right.inverse, right.inverse.classify(q), T, back, 0.05)
    contact = line_contact(scene, line)
    assert contact is not None, "it comes nearer than straight lines may"
    assert 0.001 < contact.distance < 0.003
    now = right.start_state(opened, q, environment=known)
    assert moves.to_pose_on_line(right, now, back, moves.RequestBoxes()).duration > 0.1
    nearest = max(line.q, key=lambda at: -min((c.distance for c in scene.contacts(at)), default=1.0))
    refused("of the map", moves.to_pose_on_line, right, now, right.kinematics.fk(nearest), moves.RequestBoxes())
    into[0, 3] -= 0.02
    refused("finger would hit the map", moves.to_pose_on_line, right, now, into, moves.RequestBoxes())


def test_cells_in_the_robot_and_in_known_bodies_are_explained(right: Arm, home: dict[str, float]) -> None:
    inside = robot_bodies(right.description, home)
    hand = right.kinematics.fk(np.array([home[name] for name in right.names]))[:3, 3]
    middle = next(box for box in inside if box.id == "openarm_right_hand").T[:3, 3]
    can = Cylinder("can", se3.make(None, (0.4, 0.3, 0.46)), 0.033, 0.115)
    ball = Sphere("ball", se3.make(None, (0.4, -0.3, 0.46)), 0.05)
    rock = Mesh("rock", se3.make(se3.rot_z(0.7), (0.5, 0.0, 0.45)), np.random.default_rng(1).uniform(0, 0.1, (20, 3)))
    cells = seen(
        middle, (0.4, 0.3, 0.47), (0.4, -0.3, 0.47), rock.T[:3, 3] + rock.T[:3, :3] @ np.full(3, 0.05), (0.4, 0.3, 0.6)
    )
    left = cells.without([*inside, can, ball, rock], 0.005)
    np.testing.assert_allclose(left.centres, [[0.41, 0.31, 0.61]], atol=0.0101)
    assert len(left.indices) == 1
    assert np.linalg.norm(hand - middle) < 0.3


@pytest.mark.parametrize("kind", ["cylinder", "sphere", "mesh"])
def test_bodies_of_every_shape_are_met_by_both_layers(kind: str, right: Arm, home: dict[str, float]) -> None:
    rng = np.random.default_rng(5)
    T = se3.make(se3.rot_x(0.4) @ se3.rot_z(1.0), (0.35, -0.2, 0.7))
    solid = {
        "cylinder": Cylinder("post", T, 0.08, 0.5),
        "sphere": Sphere("ball", T, 0.15),
        "mesh": Mesh("rock", T, rng.uniform(-0.15, 0.2, (30, 3))),
    }[kind]
    exact, empty = right.scene(home, environment=Environment((solid,))), right.scene(home)
    states = rng.uniform(right.kinematics.lower, right.kinematics.upper, (400, 7))
    truth, alone = (np.array([scene.collides(q) for q in states]) for scene in (exact, empty))
    assert int((truth & ~alone).sum()) > 10
    assert not np.any(FastScene([exact]).free_many(states) & truth)


def test_bodies_that_are_none_are_refused() -> None:
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float64)
    for make, text in (
        (lambda: Cylinder("can", np.eye(4), 0.0, 0.1), "cylinder 'can' has diameter 0 m and height 0.1 m"),
        (lambda: Sphere("ball", np.eye(4), float("nan")), "sphere 'ball' has diameter nan m"),
        (lambda: Mesh("sheet", np.eye(4), flat), "mesh 'sheet' has vertices in one plane"),
        (lambda: Mesh("line", np.eye(4), flat[:2]), "mesh 'line' has 2 vertices, expected at least 4"),
    ):
        assert refused(text, make).code is Code.INVALID_ARGUMENT
