# SPDX-License-Identifier: Apache-2.0
"""The robot and what it holds are no objects, and no part of them."""

from __future__ import annotations

import time

import cv2
import numpy as np
import pytest

from benchmarks.localization import Studio, errors
from openarm_common import se3
from openarm_common.camera.depth_view import DepthView
from openarm_common.robot.held import HeldBox
from openarm_common.scene.scene import load_scene, random_scene
from openarm_perception.detection.clouds import labelled_cloud, smooth_depth
from openarm_perception.detection.robot import CloudRobotConfig, RobotConfig, RobotFinder
from openarm_perception.geometry.depth import DepthLimits, View
from openarm_perception.ros.convert import mask_image

TCP = "openarm_right_hand_tcp"
RED = (205, 25, 25)


class Look:
    """What a camera sees of a scene, and where the robot is in it."""

    def __init__(self, studio: Studio, scene, joints, camera: str = "overhead", held=()) -> None:
        studio.load(scene, joints)
        self.scene, self.joints, self.held = scene, joints, held
        config = studio.cameras[camera]
        self.K, self.T = config.intrinsics, studio.T_base_camera(camera, joints)
        self.rgb, self.depth = studio.draw(camera)
        self.view = DepthView(self.depth, self.K, self.T, config.near, config.far)
        self.finder = RobotFinder(studio.description, RobotConfig())
        self.pipeline = studio.pipeline(camera, scene.table)
        self.robot, self.removed = self.finder.find(self.view, joints, held)

    def perceive(self, robot=None):
        return self.pipeline.run(self.rgb, self.depth, self.K, self.T, robot)


def in_the_hand(studio: Studio, joints):
    """A scene with a red cube in the tips of the right hand's fingers, and the box that motion would call held."""
    scene = load_scene("empty")
    cube = next(item for item in load_scene("demo").objects if item.label == "red")
    T_base_tcp = studio.description.link_pose(TCP, joints)
    x, y, z = se3.apply(T_base_tcp, (0.0, 0.0, 0.04)).tolist()  # far enough out to be seen from above
    cube = cube.model_copy(update={"position": (x, y, z), "yaw": 0.0})
    held = HeldBox("right/red", TCP, se3.inverse(T_base_tcp) @ se3.make(None, (x, y, z)), cube.size)
    return scene.model_copy(update={"objects": (cube,)}), held


@pytest.mark.requirement("P-04", "P-05")
def test_what_a_hand_holds_is_not_reported_as_standing_on_the_table(studio) -> None:
    """Without the self-filter it is: as a tower below the hand. In the image it is found in either case."""
    scene, held = in_the_hand(studio, studio.looking())
    look = Look(studio, scene, studio.looking(), held=[held])
    assert [place.label for place in look.perceive().located] == ["red"]
    seen = look.perceive(look.robot)
    assert [found.label for found in seen.found] == ["red"]
    assert seen.located == ()
    assert "the robot or what it holds" in seen.refused[0]
    assert look.removed["held/right/red"] > 100
    # the same cube, no longer held: 18 cm from where motion says that the hand has something
    x, y, z = scene.objects[0].position
    away = scene.objects[0].model_copy(update={"position": (x + 0.1, y + 0.15, z)})
    dropped = Look(studio, scene.model_copy(update={"objects": (away,)}), studio.looking(), held=[held])
    assert [place.label for place in dropped.perceive(dropped.robot).located] == ["red"]


def test_a_hand_over_the_table_gives_no_object_whatever_its_colour(studio) -> None:
    """The hand painted red, with its outline: taken for an object, unless the robot is known."""
    look = Look(studio, load_scene("empty"), studio.looking())
    v, u = np.nonzero(look.robot)
    points = se3.apply(look.T, look.K.deproject(np.stack([u, v], axis=-1), look.depth[v, u] * 1e-3))
    near = np.linalg.norm(points - studio.description.link_pose(TCP, look.joints)[:3, 3], axis=1) < 0.11
    hand = np.zeros(look.robot.shape, np.uint8)
    hand[v[near], u[near]] = 1
    look.rgb[cv2.dilate(hand, np.ones((3, 3), np.uint8)) > 0] = RED
    assert [place.label for place in look.perceive().located] == ["red"]
    seen = look.perceive(look.robot)
    assert seen.found
    assert seen.located == ()
    links = {name for name, n in look.removed.items() if n > 50}
    assert any("right_hand" in name or "right_left_finger" in name for name in links), look.removed


def test_a_finger_of_its_colour_over_an_object_does_not_pull_its_box(studio) -> None:
    """From the side onto the cube, 7 mm above it, of the same colour: taken for a part of it, unless known."""
    scene = load_scene("demo")
    scene = scene.model_copy(update={"objects": tuple(item for item in scene.objects if item.label == "red")})
    look = Look(studio, scene, studio.home())
    (before,) = look.perceive(look.robot).located
    (u, v), (w, h) = before.source.origin, before.source.size
    finger = np.zeros(look.robot.shape, np.bool_)
    finger[v + 3 * h // 10 : v + 6 * h // 10, u + 6 * w // 10 : u + 13 * w // 10] = True
    look.rgb[finger] = RED
    look.depth[finger] = np.median(look.depth[v : v + h, u : u + w][before.source.mask]) - 7
    (pulled,) = look.perceive().located
    assert errors(pulled, scene.objects[0], scene.table)[0] > 10.0
    (place,) = look.perceive(look.robot | finger).located
    position, size, _ = errors(place, scene.objects[0], scene.table)
    assert position < 1.0
    assert size < 1.0
    assert place.visible < before.visible


def test_nothing_is_taken_from_objects_away_from_the_robot(studio) -> None:
    """Random scenes, the robot at home: not a pixel of an object, the same detections."""
    for seed in range(100, 102):
        look = Look(studio, random_scene(seed), studio.home())
        robot, _ = look.finder.find(look.view, look.joints)
        with_filter = look.perceive(robot)
        plain = look.perceive()
        assert robot.any()
        assert len(with_filter.located) == len(look.scene.objects)
        for a, b in zip(plain.located, with_filter.located, strict=True):
            np.testing.assert_array_equal(a.T_base_object, b.T_base_object)
            np.testing.assert_array_equal(a.size, b.size)
        np.testing.assert_array_equal(mask_image(plain, robot.shape) > 0, (mask_image(with_filter, robot.shape) > 0))


@pytest.mark.long
def test_the_robot_is_found_in_little_of_the_processors_time(studio) -> None:
    took = []
    for seed in range(100, 104):
        look = Look(studio, random_scene(seed), studio.home())
        started = time.process_time()
        look.finder.find(look.view, look.joints)
        took.append(time.process_time() - started)
    assert np.median(took) < 0.025


def test_the_mask_counts_detections_from_one_and_leaves_the_robot_out(studio) -> None:
    look = Look(studio, load_scene("demo"), studio.home())
    seen = look.perceive(look.robot)
    image = mask_image(seen, look.robot.shape)
    assert image.dtype == np.uint8
    assert set(np.unique(image)) == set(range(len(seen.found) + 1))
    for i, found in enumerate(seen.found, 1):
        assert np.count_nonzero(image == i) == found.area
        assert image[round(found.centre[1]), round(found.centre[0])] == i
    everything = look.perceive(np.ones(look.robot.shape, np.bool_))
    assert not mask_image(everything, look.robot.shape).any()


def test_clouds_keep_the_robot_unless_asked() -> None:
    assert RobotConfig().enabled
    assert not CloudRobotConfig().enabled
    assert RobotConfig().padding == CloudRobotConfig().padding == 0.005


def test_the_points_of_objects_are_on_them_and_what_is_around_is_none_of_theirs(studio) -> None:
    """From the demo scene: points of an object lie in its box, those with no label on the table or on another one."""
    scene = load_scene("demo")
    look = Look(studio, scene, studio.home())
    perceived = look.perceive(look.robot)
    view = View(look.rgb, look.depth, look.K, look.T, look.robot)
    cloud = labelled_cloud(view, smooth_depth(view, DepthLimits()), perceived.boxes, DepthLimits()).moved(look.T)
    assert np.allclose(cloud.camera, look.T[:3, 3])
    assert set(cloud.labels.tolist()) == set(range(len(perceived.boxes) + 1))
    for number, place in enumerate(perceived.boxes, start=1):
        points = cloud.points[cloud.labels == number]
        inside = np.abs(se3.apply(se3.inverse(place.T_base_object), points)) <= place.size / 2.0 + 0.004
        assert len(points) > 100
        assert inside.all(axis=1).mean() > 0.99
    rest = cloud.points[cloud.labels == 0]
    assert (rest[:, 2] < scene.table.top_z + 0.004).mean() > 0.95  # the table, and the floor beyond its edge
    table = rest[np.abs(rest[:, 2] - scene.table.top_z) < 0.004]
    assert len(table) > 1000
