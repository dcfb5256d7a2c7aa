# SPDX-License-Identifier: Apache-2.0
"""Robots by their meshes: convex parts, the distance of hulls, and links that always touch."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import coal
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.collision.hull_kernels import hull_separation
from openarm_common.collision.shape_kernels import BOX, CYLINDER, HULL, SPHERE
from openarm_common.robot.convex import convex_parts, hull_of
from openarm_common.robot.description import RobotDescription
from openarm_motion.collision.exact import Clearance, CollisionContext, CollisionScene
from openarm_motion.collision.fast import FastScene
from openarm_motion.collision.robot import CollisionRobot
from openarm_motion.collision.solids import Mesh, box_from
from openarm_motion.kinematics.chain import ArmKinematics
from tests.openarm_motion.conftest import both_layers

#: Corners (lower, upper) of the boxes that a mesh is the union of, m.
Boxes = Sequence[tuple[tuple[float, float, float], tuple[float, float, float]]]
#: An L: the post along z, and a foot along x.
L_SHAPE: Boxes = [((-0.03, -0.03, 0.0), (0.03, 0.03, 0.3)), ((0.03, -0.03, 0.0), (0.2, 0.03, 0.06))]
_TOUCHING = Clearance(own=0.0, world=0.0, arms=0.0, hand=0.0, touch=0.0, rest=0.0)
_FACES = np.array([(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 5, 1), (0, 4, 5), (2, 3, 7), (2, 7, 6), (0, 2, 6),
                   (0, 6, 4), (1, 5, 7), (1, 7, 3)])  # fmt: skip


def triangles_of(boxes: Boxes) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles (m, 3) of closed boxes."""
    corners = [[np.where(bits, high, low) for bits in itertools.product((0, 1), repeat=3)] for low, high in boxes]
    faces = [_FACES + 8 * k for k in range(len(boxes))]
    return np.array(corners, np.float64).reshape(-1, 3), np.concatenate(faces)


def write_stl(path: Path, boxes: Boxes) -> None:
    vertices, faces = triangles_of(boxes)
    facets = [
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in vertices[face])
        + "endloop\nendfacet\n"
        for face in faces
    ]
    path.write_text("solid a\n" + "".join(facets) + "endsolid a\n", encoding="utf-8")


def mesh_robot(folder: Path, links: Mapping[str, Boxes], joints: Sequence[str]) -> RobotDescription:
    """A robot whose links are meshes; a joint is given as `parent child type axis xyz`, with limits of 2 rad."""
    parts: list[str] = []
    for name, boxes in links.items():
        if boxes:
            write_stl(folder / f"{name}.stl", boxes)
        mesh = f'<collision><geometry><mesh filename="{name}.stl"/></geometry></collision>' if boxes else ""
        parts.append(f'<link name="{name}">{mesh}</link>')
    for k, joint in enumerate(joints):
        parent, child, kind, axis, xyz = joint.split()
        limit = '<limit lower="-2" upper="2" effort="1" velocity="1"/>' if kind != "fixed" else ""
        parts.append(
            f'<joint name="j{k}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{limit}'
            f'<axis xyz="{axis.replace(",", " ")}"/><origin xyz="{xyz.replace(",", " ")}"/></joint>'
        )
    path = folder / "robot.urdf"
    path.write_text(f'<robot name="r">{"".join(parts)}</robot>', encoding="utf-8")
    return RobotDescription.from_files(path)


def arm_of(description: RobotDescription) -> CollisionRobot:
    return CollisionRobot(description, ArmKinematics(description, "tool"))


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> CollisionRobot:
    """Three links of an L each, one above the other, with a tool."""
    return arm_of(
        mesh_robot(
            tmp_path_factory.mktemp("three"),
            {"base": [((-0.1, -0.1, -0.1), (0.1, 0.1, -0.01))], "a": L_SHAPE, "b": L_SHAPE, "c": L_SHAPE, "tool": []},
            [
                "base a revolute 0,0,1 0,0,0",
                "a b revolute 0,1,0 0,0,0.3",
                "b c revolute 1,0,0 0,0,0.3",
                "c tool fixed 0,0,0 0,0,0.3",
            ],
        )
    )


def test_an_l_is_two_hulls_and_its_corner_stays_free(three: CollisionRobot) -> None:
    """Points decide, one small box each: inside the L hits, outside does not, the hollow included."""
    assert three.links.count("a") == 2
    rng = np.random.default_rng(5)
    points = rng.uniform((-0.06, -0.06, -0.02), (0.24, 0.06, 0.34), (400, 3))
    low, high = (np.array(corner) for corner in zip(*L_SHAPE, strict=True))
    gaps = np.linalg.norm(np.maximum(np.maximum(low - points[:, None], points[:, None] - high), 0.0), axis=2).min(
        axis=1
    )
    shapes = [solid for link, solid in zip(three.links, three.solids, strict=True) if link == "a"]
    ball = coal.Sphere(1e-4)
    for point, gap in zip(points, gaps, strict=True):
        hits = any(
            coal.collide(
                shape.geometry, coal.Transform3s(shape.T[:3, :3], shape.T[:3, 3]), ball,
                coal.Transform3s(np.eye(3), point), coal.CollisionRequest(), coal.CollisionResult(),
            )
            for shape in shapes
        )  # fmt: skip
        if not 1e-5 < gap < 3e-4:
            assert hits == (gap == 0.0), (point, gap)


def test_a_box_in_the_corner_of_an_l_does_not_collide(three: CollisionRobot) -> None:
    """It is inside the hull about the whole link."""
    q, free, inside = np.zeros(3), box_from("free", (0.12, 0.0, 0.12), (0.04,) * 3), (0.12, 0.0, 0.05)
    corners = hull_of(triangles_of(L_SHAPE)[0])[0]
    near = coal.distance(
        Mesh("m", np.eye(4), corners).geometry, coal.Transform3s.Identity(), coal.Sphere(0.001),
        coal.Transform3s(np.eye(3), free.T[:3, 3]), coal.DistanceRequest(), coal.DistanceResult(),
    )  # fmt: skip
    assert near < 0.0
    scenes = [
        CollisionScene(three, CollisionContext({}, [box], clearance=_TOUCHING))
        for box in (free, box_from("hit", inside, (0.04,) * 3))
    ]
    assert [scene.collides(q) for scene in scenes] == [False, True]
    assert [FastScene([scene]).free(q) for scene in scenes] == [True, False]


def test_the_fast_layer_of_hulls_decides_as_the_exact_one(three: CollisionRobot) -> None:
    boxes = [box_from("post", (0.35, 0.1, 0.4), (0.05, 0.3, 0.5)), box_from("lid", (0.0, -0.3, 0.8), (0.4, 0.2, 0.02))]
    exact = CollisionScene(three, CollisionContext({}, boxes))
    states = np.random.default_rng(6).uniform(-2.0, 2.0, (1500, 3))
    free, truth = both_layers(FastScene([exact]), exact, states)
    assert 0.99 * truth < free
    assert 200 < truth < 1300


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_point_of_a_mesh_is_outside_its_parts(seed: int) -> None:
    """Random boxes that overlap each other or not: points on their faces and inside are in some part."""
    rng = np.random.default_rng(seed)
    low = rng.uniform(-0.2, 0.2, (3, 3))
    boxes = [(tuple(a), tuple(a + size)) for a, size in zip(low, rng.uniform(0.01, 0.3, (3, 3)), strict=True)]
    vertices, faces = triangles_of(boxes)  # pyright: ignore[reportArgumentType]
    parts = convex_parts(vertices, faces)
    on = np.einsum("nkc,ncd->nkd", rng.dirichlet((1.0, 1.0, 1.0), (len(faces), 20)), vertices[faces]).reshape(-1, 3)
    inside = np.concatenate([rng.uniform(a, b, (40, 3)) for a, b in boxes])
    points = np.concatenate([on, inside, vertices])
    covered = np.zeros(len(points), np.bool_)
    for corners in parts:
        seen = _halfspaces(corners)
        covered |= (points @ seen[:, :3].T + seen[:, 3] <= 1e-9).all(axis=1)
    assert covered.all()


@settings(max_examples=50, deadline=None)
@given(st.integers(4, 60), st.integers(0, 2**32 - 1), st.floats(0.02, 1.0))
def test_what_is_beyond_a_hull_is_outside(count: int, seed: int, flatness: float) -> None:
    """No mixture of its points is; all is that is far away; every corner is reached along edges."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * (0.1, 0.1 * flatness, 0.3) @ se3.exp_so3(rng.normal(size=3)).T + 0.2
    hull = Mesh("m", np.eye(4), points).hull
    inside = rng.dirichlet(np.ones(count), 200) @ points - hull.centre
    assert not hull.beyond(inside, 1e-9).any()
    away = rng.normal(size=(50, 3))
    assert hull.beyond(
        away / np.linalg.norm(away, axis=1, keepdims=True) * 20.0 * np.abs(hull.corners).max(), 1e-3
    ).all()
    assert np.all(np.abs(hull.corners) <= hull.half + 1e-12)
    seen = {0}
    for _ in hull.corners:
        seen |= {int(c) for k in seen for c in hull.rings[k]}
    assert len(seen) == len(hull.corners)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([BOX, CYLINDER, SPHERE, HULL]), st.floats(-0.02, 0.05))
def test_what_is_proven_of_two_shapes_is_their_distance(seed: int, kind: int, keep: float) -> None:
    """Never more than coal finds; nearly as much where they are apart."""
    rng = np.random.default_rng(seed)
    meshes = [Mesh(f"{n}", np.eye(4), rng.normal(size=(n, 3)) * size) for n, size in ((30, 0.1), (12, 0.08))]
    sizes = np.array([(0.0, 0.0, 0.0), rng.uniform(0.02, 0.2, 3)])
    hulls = [mesh.hull for mesh in meshes]
    start = len(hulls[0].corners)
    rings = [*hulls[0].rings, *(ring + start for ring in hulls[1].rings)]
    corners, firsts = np.concatenate([hull.corners for hull in hulls]), np.cumsum([0, *(len(ring) for ring in rings)])
    axes, tips, proven = np.zeros((1, 3)), np.array([(0, start if kind == HULL else 0)]), -np.inf
    places = [_random_pose(rng, 0.0), _random_pose(rng, 0.3)]
    # what is remembered of another pose is no more than where to begin
    for T in (*(_random_pose(rng, 0.3) for _ in range(int(rng.integers(3)))), places[1]):
        world = np.array(
            [
                (places[0] @ se3.make(None, hulls[0].centre))[:3],
                (T @ se3.make(None, hulls[1].centre) if kind == HULL else T)[:3],
            ]
        )
        proven = hull_separation(
            0, 0, 1, keep, 1.0, np.array([HULL, kind]), sizes, corners, firsts, np.concatenate(rings), world, axes,
            tips, np.empty((14, 3)),
        )  # fmt: skip
    a, b, c = sizes[1]
    shapes = {BOX: coal.Box(2 * a, 2 * b, 2 * c), CYLINDER: coal.Cylinder(a, 2 * b), SPHERE: coal.Sphere(a)}
    second = meshes[1].geometry if kind == HULL else shapes[kind]
    truth = coal.distance(
        meshes[0].geometry, coal.Transform3s(places[0][:3, :3], places[0][:3, 3]),
        second, coal.Transform3s(places[1][:3, :3], places[1][:3, 3]),
        coal.DistanceRequest(), coal.DistanceResult(),
    )  # fmt: skip
    assert proven <= truth + 1e-6
    if truth > max(keep, 1e-3):
        assert proven >= 0.99 * truth - 1e-6


def test_links_that_always_touch_are_named_and_others_stay_checked(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """`c` turns inside `a`, which is not its neighbour; `d` meets `a` only when it is bent back."""
    small: Boxes = [((-0.02, -0.02, -0.02), (0.02, 0.02, 0.02))]
    rod: Boxes = [((-0.01, -0.01, 0.03), (0.01, 0.01, 0.4))]
    description = mesh_robot(
        tmp_path,
        {"a": [((-0.1, -0.1, -0.2), (0.1, 0.1, 0.1))], "b": small, "c": small, "d": rod, "tool": []},
        [
            "a b revolute 0,0,1 0,0,0",
            "b c revolute 0,0,1 0,0,0",
            "c d revolute 0,1,0 0,0,0.13",
            "d tool fixed 0,0,0 0,0,0.4",
        ],
    )
    with caplog.at_level("WARNING"):
        robot = arm_of(description)
    assert robot.touching == {frozenset(("a", "c"))}
    assert "a and c" in caplog.text
    checked = {frozenset((robot.links[i], robot.links[j])) for i, j in robot.pairs}
    assert checked == {frozenset(("a", "d")), frozenset(("b", "d"))}
    scene = CollisionScene(robot, CollisionContext({}, clearance=_TOUCHING))
    assert [scene.collides(np.array([0.0, 0.0, angle])) for angle in (0.0, 1.0, 2.0)] == [False, False, True]
    assert {"a", "d"} == {scene.contacts(np.array([0.0, 0.0, 2.0]))[0].first, scene.contacts([0.0, 0.0, 2.0])[0].second}


def test_a_description_keeps_the_meshes_and_offers_boxes_about_them(three: CollisionRobot, tmp_path: Path) -> None:
    description = mesh_robot(tmp_path, {"base": L_SHAPE, "tool": L_SHAPE}, ["base tool revolute 0,0,1 0,0,0.5"])
    assert str(tmp_path / "base.stl") in description.urdf
    for shape in description.links["base"].collision:
        assert shape.kind == "box"
        assert shape.corners is not None
        assert np.all(np.abs(shape.corners) <= 0.5 * np.array(shape.size) + 1e-12)
        np.testing.assert_allclose(np.ptp(shape.corners, axis=0), shape.size)


def _halfspaces(corners: np.ndarray) -> np.ndarray:
    from scipy.spatial import ConvexHull

    return ConvexHull(corners).equations


def _random_pose(rng: np.random.Generator, spread: float) -> np.ndarray:
    return se3.make(se3.exp_so3(rng.normal(size=3)), rng.uniform(-spread, spread, 3))
