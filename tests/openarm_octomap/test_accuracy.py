# SPDX-License-Identifier: Apache-2.0
"""The map against the geometry of the simulator: surfaces, ghosts, the sweeping arm and what it holds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from benchmarks.map_accuracy import compare
from benchmarks.map_scene import MapScene, Visible
from openarm_common import se3
from openarm_common.camera.flying_pixels import FlyingConfig
from openarm_common.robot.held import HeldBox
from openarm_common.robot.self_filter import SelfFilter
from openarm_common.scene.scene import load_scene
from openarm_octomap.config import FieldConfig, FilterConfig, GridConfig
from openarm_octomap.kernels import OCCUPIED
from openarm_octomap.mapper import Mapper
from openarm_sim_bridge.cameras.noise import DepthNoiseConfig

PERIOD_NS = 500_000_000
DEMO = load_scene("demo")


@pytest.fixture(scope="module")
def scene() -> Iterator[MapScene]:
    out = MapScene(DEMO)
    yield out
    out.close()


@pytest.fixture(scope="module")
def truth(scene: MapScene) -> Visible:
    return scene.truth(mapper(scene).lattice)


def mapper(scene: MapScene, **robot: Any) -> Mapper:
    return Mapper(scene.body, GridConfig(), FilterConfig(**robot), FieldConfig())


def states_after(target: Mapper, scene: MapScene, t_ns: int, rng=None, held=(), **noise) -> np.ndarray:
    states = target.update(scene.frames(t_ns, rng, **noise), held, wanted={"states"}).snapshot.states
    assert states is not None
    return states


def test_compare_counts_what_it_says() -> None:
    """A surface seen one cell off is neither a ghost nor missed."""
    states, surface = np.zeros((9, 9, 9), np.uint8), np.zeros((9, 9, 9), bool)
    surface[2:5, 4, 4] = True
    states[2:5, 4, 5] = OCCUPIED
    shifted = compare(states, surface, surface)
    assert (shifted.iou, shifted.iou_strict, shifted.ghosts, shifted.missed) == (1.0, 0.0, 0, 0)
    states[8, 8, 8] = OCCUPIED
    surface[0, 0, 0] = True
    worse = compare(states, surface, surface)
    assert (worse.ghosts, worse.missed, worse.occupied, worse.surface) == (1, 1, 4, 4)
    assert worse.iou == pytest.approx(3 / 5)


@pytest.mark.requirement("N-10", "A-46")
def test_the_map_is_the_visible_geometry(scene: MapScene, truth: Visible) -> None:
    """Both cameras, as noisy as a D435: no ghost, hardly anything missed, the robot itself not in it."""
    target, rng = mapper(scene), np.random.default_rng(1)
    for i in range(4):
        states = states_after(target, scene, i * PERIOD_NS, rng)
    result = compare(states, truth.surface, truth.solid)
    assert result.surface > 2500
    assert result.ghosts == 0
    assert result.missed <= 0.005 * result.surface
    assert result.iou >= 0.98


@pytest.mark.requirement("A-51", "A-52")
def test_without_the_filter_flying_pixels_fill_the_map_and_nothing_else_does(scene: MapScene, truth: Visible) -> None:
    """Hundreds of ghosts; so the tests with noise can fail. Noise along the rays alone makes none."""
    ghosts = []
    for config in (DepthNoiseConfig(), DepthNoiseConfig(flying=0.0)):
        target, rng = mapper(scene, flying=FlyingConfig(enabled=False)), np.random.default_rng(1)
        states = states_after(target, scene, 0, rng, noise=config)
        ghosts.append(compare(states, truth.surface, truth.solid).ghosts)
    assert ghosts[0] > 300
    assert ghosts[1] == 0


def test_flying_pixels_are_counted_by_camera(scene: MapScene) -> None:
    """A clean picture has a few at the edges of the arms, a noisy one thousands; frames stay as given."""
    rng = np.random.default_rng(1)
    counts = []
    for frames in (scene.frames(0), scene.frames(0, rng)):
        counts.append(mapper(scene).update(frames).flying)
        assert all(frame.scan.label is None for frame in frames)
    assert counts[0].keys() == counts[1].keys() == {"overhead", "wrist"}
    assert sum(counts[0].values()) < 300 < 1000 < sum(counts[1].values())


@pytest.mark.requirement("A-46")
def test_the_clouds_of_both_cameras_meet_in_the_base_frame(scene: MapScene) -> None:
    """Where both see a surface, they say the same of its depth: 5 mm at the 95th percentile."""
    home, looking = dict(scene.joints), scene.description.group_state("right_arm", "wrist_look")
    scene.joints |= {name: q for name, q in looking.items() if name in home}
    frames = scene.frames(0)
    wrist = frames[1].scan.points()
    body = SelfFilter(scene.body, FilterConfig())
    label, _ = body.label_points(wrist, body.shapes(scene.joints))
    scene.joints = home
    view = frames[0].scan
    local = se3.apply(se3.inverse(view.T_base_camera), wrist[label == 0])
    u, v = np.round(view.intrinsics.project(local)).T
    inside = (u >= 0) & (u < 640) & (v >= 0) & (v < 480)
    there = view.depth[v[inside].astype(int), u[inside].astype(int)] * 1e-3
    error = np.abs(there - local[inside, 2])
    shared = error < 0.02  # the rest is hidden from the overhead camera
    assert np.count_nonzero(shared) > 100_000
    assert np.percentile(error[shared], 95) <= 0.005


def test_the_robot_is_taken_out_where_it_was_last(scene: MapScene) -> None:
    """Of frames of different times: what an old one shows of the robot is not in the map where the robot is now."""
    first, *others = scene.frames(PERIOD_NS)
    away = scene.joints | scene.description.group_state("right_arm", "wrist_look")
    old = replace(first, t_ns=0, joints={name: away[name] for name in first.joints})  # shows the arm where it is now
    for frames in ([old, *others], [*others, old]):
        target = mapper(scene)
        assert target.update(frames).reset > 0
        assert target.update([first]).reset == 0


@pytest.mark.parametrize("every", [6, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.requirement("P-05")
def test_no_cell_of_the_arm_or_of_what_it_holds_in_thirty_seconds_of_sweeping(
    scene: MapScene, truth: Visible, every: int
) -> None:
    """At 2 Hz, or every so many frames of that; the second half with an object in the hand."""
    solid = binary_dilation(truth.solid, np.ones((3, 3, 3)))
    home, item = dict(scene.joints), DEMO.objects[0]
    rng, target = np.random.default_rng(3), mapper(scene)
    tool = scene.description.tcp_link("left")
    ghosts, seen = 0, 0
    try:
        for i in range(0, 60, every):
            swing = np.sin(i / 4.0)
            for side in ("left", "right"):
                for joint, reach in ((1, 0.35), (2, 0.15), (4, 0.4), (7, 0.8)):
                    name = f"openarm_{side}_joint{joint}"
                    lower, upper = (float(v[0]) for v in scene.description.limits([name]))
                    scene.joints[name] = float(np.clip(home[name] + reach * swing, lower, upper))
            held = []
            if i >= 30:
                box = HeldBox("left/it", tool, se3.make(None, (0.0, 0.0, 0.02)), item.size)
                T = scene.description.link_pose(tool, scene.joints) @ box.T_link_box
                scene.put(item.name, tuple(T[:3, 3]))
                # the object keeps upright in this scene, the box turns with the hand: the padding has to bear it
                turned = se3.make(scene.description.link_pose(tool, scene.joints)[:3, :3].T, box.T_link_box[:3, 3])
                held = [HeldBox(box.name, tool, turned, item.size)]
            report = target.update(scene.frames(i * PERIOD_NS, rng), held, wanted={"states"})
            seen += sum(sum(links.values()) for links in report.removed.values())
            assert report.snapshot.states is not None
            ghosts = max(ghosts, int(((report.snapshot.states == OCCUPIED) & ~solid).sum()))
    finally:
        scene.joints = home
        scene.put(item.name, item.centre(DEMO.table))
    assert seen > 60 // every * 5000  # the arms were in the pictures
    assert ghosts == 0


def test_without_the_self_filter_the_arm_is_in_the_map(scene: MapScene, truth: Visible) -> None:
    """So the tests above can fail."""
    states = states_after(mapper(scene, enabled=False), scene, 0)
    assert compare(states, truth.surface, truth.solid).ghosts > 100
