# SPDX-License-Identifier: Apache-2.0
"""Objects of any shape: what folders may hold and how they are refused, superquadrics, and the sides things rest on."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common.errors import Code, OpenArmError
from openarm_common.objects import decompose
from openarm_common.objects.model import load_object, object_names
from openarm_common.objects.obj_file import obj_text, read_obj
from openarm_common.objects.posed import posed_object
from openarm_common.objects.resting import resting_sides
from openarm_common.objects.solid import Part, crossings, hull_part, mass_centre
from openarm_common.objects.superquadric import Superquadric, draw_superquadric
from openarm_common.scene.scene import parse_scene


def box(*edges: float, p: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Part:
    corners = np.array(list(itertools.product(*[(-0.5 * edge, 0.5 * edge) for edge in edges])))
    part = hull_part(corners + np.array(p))
    assert part is not None
    return part


def write(folder: Path, parts: list[Part], yaml: str = "mass: 0.2\n", collision: bool = True) -> Path:
    folder.mkdir(exist_ok=True)
    vertices = np.concatenate([part.vertices for part in parts])
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    groups = [(f"part_{k}", part.triangles + start) for k, (part, start) in enumerate(zip(parts, starts, strict=False))]
    (folder / "object.yaml").write_text(yaml)
    (folder / "visual.obj").write_text(obj_text(vertices, groups))
    if collision:
        (folder / "collision.obj").write_text(obj_text(vertices, groups))
    return folder


def refused(folder: Path, words: str) -> OpenArmError:
    with pytest.raises(OpenArmError, match=words) as caught:
        load_object(f"{folder}/")
    return caught.value


L_SHAPE = [box(0.08, 0.03, 0.02), box(0.02, 0.03, 0.06, p=(-0.03, 0.0, 0.04))]


def test_a_folder_says_mass_label_friction_and_colour(tmp_path) -> None:
    write(tmp_path / "bracket", L_SHAPE, "mass: 0.25\nlabel: steel bracket\nfriction: 0.4\ncolour: silver\n")
    model = load_object(str(tmp_path / "bracket"))
    assert (model.label, model.mass, model.rgb) == ("steel bracket", 0.25, (0.68, 0.69, 0.71))
    assert model.friction is not None
    assert model.friction[0] == 0.4
    assert [part.volume for part in model.parts] == pytest.approx([0.08 * 0.03 * 0.02, 0.02 * 0.03 * 0.06])
    assert load_object(str(tmp_path / "bracket")) is model  # read once
    write(tmp_path / "bracket", L_SHAPE[:1], "{}\n")
    again = load_object(str(tmp_path / "bracket"))
    assert (again.label, len(again.parts)) == ("bracket", 1)  # changed files are read again
    assert again.mass == pytest.approx(0.08 * 0.03 * 0.02 * 700.0)


@pytest.mark.parametrize(
    ("yaml", "words"),
    [
        ("mass: -1\n", "object.yaml:mass: .*greater than or equal to 0.001, got -1"),
        ("mass: .nan\n", "object.yaml:mass: .*finite"),
        ("mass: 1\nweight: 2\n", "weight: unknown key; valid keys: label, mass, friction, color"),
        ("color: pinkish\n", "color: unknown colour; expected .*red, orange"),
        ("friction: [1, 2]\n", "friction"),
        ("texture: a.png\n", "texture 'a.png', but visual.obj has no texture coordinates"),
    ],
)
def test_what_object_yaml_says_wrong_is_refused(tmp_path, yaml, words) -> None:
    assert refused(write(tmp_path / "x", L_SHAPE, yaml), words).code is Code.CONFIG_INVALID


def test_files_that_are_missing_or_no_meshes_are_refused(tmp_path) -> None:
    assert "objects: " in refused(tmp_path / "none", "there is no object.yaml in .*none'").message
    folder = write(tmp_path / "x", L_SHAPE)
    for text, words in (
        ("v 0 0 0\nv 1 0 0\nf 1 2 3\n", "visual.obj, line 3: index '3' of 2"),
        ("v 0 0 nan\n", "line 1: .*expected 3 finite numbers"),
        ("v 0 0 0\n", "visual.obj has no face"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n", "a face of 2 corners"),
        ("v 0 0 0\nv 100 0 0\nv 0 100 0\nf 1 2 3\n", "is it in millimetres"),
    ):
        (folder / "visual.obj").write_text(text)
        refused(folder, words)
    (folder / "visual.obj").unlink()
    refused(folder, "visual.obj does not exist")


def test_parts_that_are_flat_hollow_or_too_many_are_refused(tmp_path) -> None:
    folder = write(tmp_path / "x", L_SHAPE)
    flat = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n"
    (folder / "collision.obj").write_text(flat)
    refused(folder, "collision.obj has no part with a volume")
    text = (folder / "visual.obj").read_text()
    hollow = [line for line in text.splitlines() if not line.startswith("o ")]
    (folder / "collision.obj").write_text("o both\n" + "\n".join(hollow) + "\n")
    refused(folder, "part 'both' is not convex: it fills .* % of its hull")
    many = [box(0.004, 0.004, 0.004, p=(0.002 * k, 0.0, 0.0)) for k in range(140)]
    refused(write(tmp_path / "y", many), "140 convex parts, expected 1 to 128")


def test_without_collision_the_mesh_must_be_closed_and_coacd_there(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = write(tmp_path / "x", [box(0.05, 0.04, 0.03)], collision=False)
    monkeypatch.setitem(__import__("sys").modules, "coacd", None)
    assert refused(folder, "install the extra `objects`").code is Code.ENVIRONMENT
    lines = (folder / "visual.obj").read_text().splitlines()
    (folder / "visual.obj").write_text("\n".join(lines[:-2]) + "\n")
    refused(folder, "visual.obj is open: .* of its edges have one triangle")


def test_convex_parts_come_from_the_cache_when_they_are_there(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = write(tmp_path / "x", [box(0.05, 0.04, 0.03)], collision=False)
    calls: list[int] = []

    class Made:
        Mesh = staticmethod(lambda vertices, triangles: (vertices, triangles))
        set_log_level = staticmethod(lambda level: None)

        @staticmethod
        def run_coacd(mesh, **_):
            calls.append(1)
            return [mesh]

    monkeypatch.setitem(__import__("sys").modules, "coacd", Made)
    mesh = read_obj(folder / "visual.obj")
    for _ in range(2):
        parts = decompose.decomposed(mesh.vertices, mesh.triangles, "x")
        np.testing.assert_allclose(parts[0], mesh.vertices)
    assert len(calls) == 1
    kept = next((tmp_path / "openarm").rglob("*.npz"))
    kept.write_bytes(kept.read_bytes()[:20])  # a damaged one is made again
    decompose.decomposed(mesh.vertices, mesh.triangles, "x")
    assert len(calls) == 2


def test_a_texture_outside_of_the_folder_is_refused(tmp_path) -> None:
    folder = write(tmp_path / "x", L_SHAPE, "texture: ../secret.png\n")
    (tmp_path / "secret.png").write_bytes(b"")
    text = (folder / "visual.obj").read_text()
    (folder / "visual.obj").write_text("vt 0 0\n" + text)
    refused(folder, "outside the folder")


@settings(max_examples=8)
@given(
    half=st.tuples(*[st.floats(0.01, 0.06)] * 3),
    e1=st.floats(0.15, 1.0),
    e2=st.floats(0.15, 1.8),
    taper=st.floats(-0.4, 0.4),
)
def test_the_hull_of_a_superquadric_has_its_volume(half, e1, e2, taper) -> None:
    shape = Superquadric(half, e1, e2, taper)
    part = hull_part(shape.points(48, 96))
    assert part is not None
    assert part.volume == pytest.approx(shape.volume, rel=0.01)


@pytest.mark.parametrize("seed", [0, 24])
def test_a_superquadric_is_the_same_each_time_and_one_of_many(seed) -> None:
    assert draw_superquadric(seed) == draw_superquadric(seed)
    assert draw_superquadric(seed) != draw_superquadric(seed + 1)
    size = sorted(posed_object(f"superquadric:{seed}").size)
    assert 0.025 < size[0] <= 0.066
    assert size[2] <= 0.112
    for wrong in ("superquadric:", "superquadric:-1", "superquadric:x"):
        with pytest.raises(OpenArmError, match="SEED, a number"):
            load_object(wrong)


def test_a_box_rests_on_each_of_its_faces_and_mostly_on_the_largest() -> None:
    sides = resting_sides([box(0.04, 0.06, 0.10)])
    assert [side.height for side in sides] == pytest.approx([0.02, 0.02, 0.03, 0.03, 0.05, 0.05])
    assert sum(side.share for side in sides) == pytest.approx(1.0)
    assert sides[0].share == pytest.approx(sides[1].share)
    assert sides[1].share > sides[2].share > sides[4].share
    for side in sides:
        np.testing.assert_allclose(side.R @ side.R.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(side.R) == pytest.approx(1.0)


def test_facets_of_what_is_round_are_one_side() -> None:
    turn = np.arange(32) * (math.tau / 32)
    rings = [np.c_[0.03 * np.cos(turn), 0.03 * np.sin(turn), np.full(32, z)] for z in (0.0, 0.1)]
    cylinder = hull_part(np.concatenate(rings))
    assert cylinder is not None
    sides = resting_sides([cylinder])
    assert [round(side.height, 3) for side in sides] == [0.03, 0.05, 0.05]
    ball = hull_part(Superquadric((0.03, 0.03, 0.03), 1.0, 1.0).points(16, 32))
    assert ball is not None
    assert len(resting_sides([ball])) == 1


def test_a_slanted_box_falls_over_its_edge() -> None:
    low, high = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.02, np.array([0.07, 0.0])
    leaning = hull_part(np.concatenate([np.c_[low, np.zeros(4)], np.c_[low + high, np.full(4, 0.08)]]))
    assert leaning is not None
    assert mass_centre([leaning])[0] > 0.02  # beyond its foot: it can't stand on it
    assert 0.04 not in [round(side.height, 4) for side in resting_sides([leaning])]


def test_the_upright_box_of_an_object_follows_from_its_side() -> None:
    for side in range(2):
        posed = posed_object("hammer", side)
        points = np.concatenate([part.vertices for part in posed.parts])
        np.testing.assert_allclose(points.max(axis=0) * 2.0, posed.size, atol=1e-5)
        np.testing.assert_allclose(points.min(axis=0) * -2.0, posed.size, atol=1e-5)
        assert posed.size[2] == pytest.approx(0.029, abs=2e-3)
        assert posed.size[0] <= posed.size[1]
    with pytest.raises(OpenArmError, match="no side 9; sides: 0 to 1"):
        posed_object("hammer", 9)


def test_lines_through_a_part_end_at_its_faces() -> None:
    found = crossings(box(0.04, 0.06, 0.02), np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0]]), np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(found.ends[0], [-0.03, 0.03])
    assert found.ends[1, 0] > found.ends[1, 1]  # beside it
    np.testing.assert_allclose(found.normals[0], [[0, -1, 0], [0, 1, 0]], atol=1e-12)


@pytest.mark.long
def test_the_suite_has_objects_of_real_size_and_all_can_be_read() -> None:
    names = object_names()
    assert len(names) >= 24
    assert {"mug", "bowl", "banana", "hammer", "scissors", "torus", "tube", "star", "egg"} <= set(names)
    for name in names:
        model = load_object(name)
        assert model.texture is not None
        assert 0.02 <= model.mass <= 1.0
        assert np.ptp(model.points, axis=0).max() <= 0.35
        assert np.abs(np.ptp(model.points, axis=0) - np.ptp(model.visual.vertices, axis=0)).max() < 0.002


def test_a_scene_names_objects_and_says_what_is_wrong_with_them() -> None:
    mesh = {"name": "it", "shape": "mesh", "object": "mug", "side": 1, "position": [0.3, -0.2], "yaw": 0.3}
    scene = parse_scene({"objects": [mesh], "appearance": 4}, "here")
    item = scene.objects[0]
    assert (item.label, item.mass, item.color) == ("mug", 0.32, "")
    assert item.size == posed_object("mug", 1).size
    assert item.centre(scene.table)[2] == pytest.approx(scene.table.top_z + 0.5 * item.size[2])
    assert parse_scene(scene.model_dump(mode="json"), "again") == scene
    for change, words in (
        ({"object": "nothing"}, "no object 'nothing'.*objects: apple"),
        ({"object": ""}, "a mesh needs `object`"),
        ({"side": 40}, "has no side 40; sides: 0 to"),
        ({"attitude": [0, 0, 0, 2]}, "quaternion x, y, z, w of length 1"),
        ({"color": "pink"}, "unknown colour"),
        ({"shape": "box", "size": [0.1] * 3, "color": "red"}, "object, side, attitude are of the shape mesh"),
    ):
        with pytest.raises(OpenArmError, match=words):
            parse_scene({"objects": [mesh | change]}, "here")
