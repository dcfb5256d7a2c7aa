# SPDX-License-Identifier: Apache-2.0
"""Where things stand without depth: rays and planes for any attitude of the camera."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code
from openarm_perception.detection.localize import Localizer, LocalizerConfig, LocatedObject
from openarm_perception.geometry import plane
from openarm_perception.geometry.depth import DepthLimits, View
from tests.refusals import refused

K = Intrinsics.from_fovy(640, 480, 60.0)
FLAT = (0.0, 0.0, 1.0)


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
@pytest.mark.requirement("B-31")
def test_a_point_of_any_plane_comes_back_for_any_attitude_of_the_camera(seed: int) -> None:
    """Tilted, rolled, upside down; the plane need not be level."""
    rng = np.random.default_rng(seed)
    T = se3.make(se3.exp_so3(rng.normal(size=3) * 2.0), rng.normal(size=3))
    pixels = rng.uniform((0, 0), (639, 479), (20, 2))
    points = se3.apply(T, K.deproject(pixels, rng.uniform(0.3, 2.0, 20)))
    for pixel, point in zip(pixels, points, strict=True):
        ray = (point - T[:3, 3]) / np.linalg.norm(point - T[:3, 3])
        normal = rng.normal(size=3)
        if abs(ray @ normal) < 0.1 * np.linalg.norm(normal):
            continue
        found = plane.intersect(pixel, K, T, normal, float(normal @ point))
        np.testing.assert_allclose(found, point, atol=1e-9)


@pytest.mark.parametrize(("tilt", "v"), [(np.pi / 2, 100), (np.pi / 2, 239.5), (2.5, 240)])
@pytest.mark.requirement("B-31")
def test_pixels_above_the_horizon_are_refused(tilt: float, v: float) -> None:
    """A camera that looks level or up at 1 m over the plane."""
    forward = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    T = se3.make(se3.rotation_from_z_y(forward, np.cross(forward, (0.0, -1.0, 0.0))), (0.0, 0.0, 1.0))
    assert refused("horizon", plane.intersect, (320.0, v), K, T, FLAT, 0.0).code is Code.NOTHING_DETECTED


def blind(tabletop, height: float) -> Localizer:
    """Knows how tall red things are."""
    return Localizer(LocalizerConfig(heights=(f"red={height}",)), DepthLimits(near=0.07), tabletop.table_height)


def without_depth(localizer: Localizer, found, seen) -> LocatedObject:
    """The object of a detection in a view whose depth image is empty."""
    view = View(seen.rgb, np.zeros_like(seen.depth), seen.intrinsics, seen.T_base_camera)
    return localizer.locate(localizer.cut(found, view))


VIEWS = {  # position, target, right: from straight above to 30 degrees over the table, and rolled
    "above": ((0.30, 0.0, 1.0), (0.3001, 0.0, 0.4), (0.0, 1.0, 0.0)),
    "tilted": ((0.80, 0.1, 1.0), (0.3, 0.0, 0.42), (0.0, 1.0, 0.0)),
    "low": ((0.95, 0.2, 0.78), (0.3, 0.0, 0.42), (0.0, 1.0, 0.0)),
    "rolled": ((0.6, -0.4, 0.95), (0.3, 0.0, 0.42), (0.5, 0.6, 0.4)),
}


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.requirement("B-21", "B-31", "B-63")
def test_objects_of_known_height_are_within_five_millimetres_without_depth(tabletop, detector, view: str) -> None:
    """Boxes and cylinders by their silhouette, from any tilt: position, yaw and size."""
    T = tabletop.look_at(*VIEWS[view])
    rng = np.random.default_rng(11)
    for kind, size in (("box", (0.05, 0.05, 0.05)), ("box", (0.04, 0.06, 0.08)), ("cylinder", (0.066, 0.066, 0.115))):
        for _ in range(3):
            x, y, yaw = rng.uniform(0.22, 0.38), rng.uniform(-0.12, 0.12), rng.uniform(-1.5, 1.5)
            thing = tabletop.Thing("red", kind, size, x, y, yaw)
            seen = tabletop.render([thing], T)
            (found,) = detector.detect(seen.rgb)
            place = without_depth(blind(tabletop, size[2]), found, seen)
            assert not place.from_depth
            assert np.linalg.norm(place.p_base - thing.position) <= 0.005, (thing, place.p_base)
            assert np.abs(np.array(place.size) - (min(size[:2]), max(size[:2]), size[2])).max() <= 0.006
            if kind == "box":
                period = np.pi / 2 if size[0] == size[1] else np.pi
                turn = (place.yaw - yaw + period / 2) % period - period / 2
                assert abs(np.degrees(turn)) <= 5.0


@pytest.mark.requirement("B-63")
def test_a_wrong_height_stays_within_the_stated_uncertainty(tabletop, detector) -> None:
    """5 mm too tall, with a standard deviation of 5 mm: the error along the view is about half of what that leans."""
    thing = tabletop.Thing("red", "box", (0.05, 0.05, 0.05), 0.3, 0.1, 0.3)
    seen = tabletop.render([thing], tabletop.look_at(*VIEWS["tilted"]))
    (found,) = detector.detect(seen.rgb)
    config = LocalizerConfig(heights=("red=0.055",), height_std=0.005)
    localizer = Localizer(config, DepthLimits(near=0.07), tabletop.table_height)
    place = without_depth(localizer, found, seen)
    error = np.linalg.norm((place.p_base - thing.position)[:2])
    assert 0.0005 < error < 3.0 * np.sqrt(place.covariance[0, 0] + place.covariance[1, 1])


def test_without_depth_what_has_no_known_height_is_refused_as_before(tabletop, detector) -> None:
    thing = tabletop.Thing("blue", "box", (0.05, 0.05, 0.05), 0.3, 0.0, 0.3)
    seen = tabletop.render([thing])
    (found,) = detector.detect(seen.rgb)
    refused("pixels with a depth of", without_depth, blind(tabletop, 0.05), found, seen)


@pytest.mark.parametrize("wrong", ["red", "red=tall", "red=3"])
def test_heights_are_pairs_of_label_and_metres(wrong: str) -> None:
    with pytest.raises(ValueError, match="heights"):
        LocalizerConfig(heights=(wrong,))
