# SPDX-License-Identifier: Apache-2.0
"""The real robot on stage: joints, home, tracking of a motion, frames, adding objects."""

from __future__ import annotations

import itertools
import time

import numpy as np
import pytest
from pydantic import ValidationError

from openarm_common.camera.cameras import load_cameras
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.edges import MovingEdges
from openarm_common.scene.scene import Scene, SceneObject, load_scene
from openarm_control.arm import TrajectoryConfig, TrajectoryOutcome
from openarm_control.carrier import CarrierConfig
from openarm_control.trajectory import Trajectory, TrajectoryResult
from openarm_sim_bridge.config import BridgeConfig
from openarm_sim_bridge.robot import SimulatedRobot
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.stage import Stage, with_object
from openarm_sim_bridge.world.world import World
from tests.refusals import refuses


@pytest.fixture(scope="module")
def stage() -> Stage:
    return Stage(RobotDescription.load(), load_cameras(), None, PhysicsConfig())


@pytest.fixture(scope="module")
def demo() -> Scene:
    return load_scene("demo")


def test_sixteen_joints_start_at_home_and_stay_there(stage: Stage, demo: Scene) -> None:
    world = stage.world(demo)
    assert len(stage.joint_names) == 16
    home = np.array([stage.home[name] for name in stage.joint_names])
    np.testing.assert_allclose(world.read_joints().position, home)
    for _ in range(100):
        world.step(world.steps_per_tick)
    np.testing.assert_allclose(world.read_joints().position, home, atol=0.002)
    assert [o.object.name for o in world.objects()] == [o.name for o in demo.objects]


@pytest.mark.parametrize("lag", [True, False])
def test_an_arm_tracks_a_brisk_motion_within_its_tolerance(stage: Stage, demo: Scene, lag: bool) -> None:
    world = stage.world(demo)
    config = TrajectoryConfig(carrier=CarrierConfig(lag=lag), path_tolerance=0.2)
    controller = SimulatedRobot.controllers(stage, world, config)
    arm, columns = controller.arms["right"], slice(8, 15)
    start = world.read_joints().position[columns]
    # A quintic of 0.9 s from rest to rest that peaks near 2 rad/s.
    end = start + np.array([0.9, -0.9, 0.7, 0.6, 0.7, 0.5, -0.7])
    goal = Trajectory(arm.group.names, np.array([0.9]), end[None], np.zeros((1, 7)), np.zeros((1, 7)))
    outcomes: list[TrajectoryOutcome] = []
    arm.start(arm.check(goal), world.t_ns, start, outcomes.append)
    worst = 0.0
    for _ in range(200):
        world.set_targets(controller.update(world.read_joints(), world.period_ns))
        world.step(world.steps_per_tick)
        if arm.busy and arm.state is not None:
            worst = max(worst, float(np.abs(arm.state.desired - arm.state.actual).max()))
    assert outcomes[0].result is TrajectoryResult.SUCCESSFUL, outcomes[0].text
    assert worst < (0.03 if lag else 0.08)
    np.testing.assert_allclose(world.read_joints().position[columns], end, atol=0.005)


def test_an_object_in_the_robot_or_with_a_taken_name_is_refused(stage: Stage, demo: Scene) -> None:
    box = {"name": "extra", "shape": "box", "size": (0.04,) * 3, "color": "purple"}
    with pytest.raises(OpenArmError, match="'red_cube' already; names in use: red_cube"):
        with_object(demo, box | {"name": "red_cube", "position": (0.4, 0.0)})
    world = stage.world(demo)
    hand = RobotDescription.load().link_pose("openarm_right_hand", stage.home)[:3, 3]
    with refuses(Code.SCENE_INVALID, "'extra' would overlap 'openarm_right_"):
        world.extend(stage.compile(world, with_object(demo, box | {"position": tuple(hand)})))


@pytest.mark.requirement("A-73")
def test_moving_edges_equal_the_forward_kinematics(stage: Stage) -> None:
    description = RobotDescription.load()
    edges = MovingEdges(description, stage.joint_names)
    assert len(edges.frames) == 18  # the mimicking fingers move too
    lower, upper = description.limits(stage.joint_names)
    rng = np.random.default_rng(0)
    for _ in range(50):
        q = rng.uniform(lower, upper)
        poses = description.link_poses(dict(zip(stage.joint_names, q, strict=True)))
        for (parent, child), p, (x, y, z, w) in zip(edges.frames, *edges.poses(q), strict=True):
            T = np.linalg.inv(poses[parent]) @ poses[child]
            np.testing.assert_allclose(p, T[:3, 3], atol=1e-12)
            R = np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
                ]
            )
            np.testing.assert_allclose(R, T[:3, :3], atol=1e-12)


def test_mount_seed_none_is_the_nominal_mounts() -> None:
    for value in (None, "none", -1):
        assert BridgeConfig(mount_seed=value).mount_seed == -1
    assert BridgeConfig(mount_seed=3).mount_seed == 3
    with pytest.raises(ValidationError, match="mount_seed"):
        BridgeConfig(mount_seed=-2)


def thirty_objects(stage: Stage) -> World:
    """Let them come to rest."""
    kinds = [("box", (0.05, 0.05, 0.05)), ("cylinder", (0.05, 0.05, 0.08)), ("box", (0.04, 0.06, 0.08))]
    spots = itertools.product(np.linspace(0.16, 0.76, 6), np.linspace(-0.5, 0.5, 5))
    items = [
        SceneObject(name=f"o{i}", label=f"l{i}", shape=shape, size=size, color="red", position=(x, y), yaw=0.1 * i)
        for i, ((x, y), (shape, size)) in enumerate(zip(spots, itertools.cycle(kinds), strict=False))
    ]
    world = stage.world(Scene(objects=tuple(items)))
    assert len(world.objects()) == 30
    for _ in range(30):
        world.step(world.steps_per_tick)
    return world


@pytest.mark.long
def test_thirty_objects_leave_half_of_a_tick_for_everything_else(stage: Stage) -> None:
    """By the time of this thread, so that a busy machine does not count."""
    world, spent = thirty_objects(stage), list[float]()
    for _ in range(100):
        began = time.thread_time()
        world.step(world.steps_per_tick)
        spent.append(time.thread_time() - began)
    assert np.percentile(spent, 95) < 0.005


@pytest.mark.requirement("P-25")
def test_a_keyframe_is_a_posture_of_both_arms(stage: Stage) -> None:
    look, home = stage.posture("wrist_look"), stage.posture("home")
    assert home == stage.home
    assert look.keys() == home.keys()
    assert look["openarm_right_joint2"] == pytest.approx(2.46)
    assert {name: look[name] for name in look if "left" in name} == {n: home[n] for n in home if "left" in n}
    with refuses(Code.INVALID_ARGUMENT, r"no keyframe 'bow'; keyframes: .*hands_up, home.*zero"):
        stage.posture("bow")
