# SPDX-License-Identifier: Apache-2.0
"""World: addresses, ticks, targets, reset, exchange. A free body comes first in every model, to shift the addresses."""

from __future__ import annotations

import ast
from pathlib import Path

import mujoco
import numpy as np
import pytest

import openarm_sim_bridge
from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.scene import SceneObject
from openarm_sim_bridge.world.world import World
from tests.refusals import refused, refuses

BALL = """<body name="ball" pos="0.5 0 {z}"><freejoint name="ball"/>
<geom name="ball" type="sphere" size="0.05" mass="0.1"/></body>"""
CUBE = (
    """<body name="cube" pos="{pos}"><freejoint name="cube"/><geom type="box" size=".03 .03 .03" mass=".1"/></body>"""
)
MODEL = """
<mujoco><compiler angle="radian"/><option timestep="{timestep}" integrator="implicitfast"/><worldbody>
<geom name="floor" type="plane" size="2 2 .1"/>{extra}
<body name="upper" pos="0 0 1"><joint name="shoulder" axis="0 1 0" damping="1" range="-2 2" limited="true"/>
<geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".5"/>
<body name="lower" pos=".2 0 0"><joint name="elbow" axis="0 1 0" damping=".5" range="-2 2" limited="true"/>
<geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".3"/>
<body name="left" pos=".2 0 0"><joint name="finger" type="slide" axis="0 1 0" range="0 .04" limited="true"/>
<geom type="box" size=".01 .01 .01" mass=".02"/></body>
<body name="right" pos=".2 0 0"><joint name="mimic" type="slide" axis="0 -1 0"/>
<geom type="box" size=".01 .01 .01" mass=".02"/></body></body></body></worldbody>
<contact><exclude body1="left" body2="right"/><exclude body1="lower" body2="left"/>
<exclude body1="lower" body2="right"/></contact>
<equality><joint joint1="mimic" joint2="finger" polycoef="0 1 0 0 0"/></equality>
<actuator><position name="c" joint="finger" kp="2000" kv="40" forcerange="-30 30" ctrlrange="0 .04"/>
<position name="b" joint="elbow" kp="100" kv="2" forcerange="-7 7"/>
<position name="a" joint="shoulder" kp="200" kv="3" forcerange="-40 40"/></actuator></mujoco>"""
JOINTS = ("shoulder", "elbow", "finger")
HOME = {"shoulder": -0.3, "elbow": 0.8, "finger": 0.02}
BALL_OBJECT, CUBE_OBJECT, UPPER_OBJECT = (
    SceneObject(name=name, shape="box", size=(0.1, 0.1, 0.1), color="red", position=(0.0, 0.0))
    for name in ("ball", "cube", "upper")
)


def spec(extra: str = BALL.format(z=0.05), timestep: float = 0.002) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(MODEL.format(extra=extra, timestep=timestep))


def make(extra: str = BALL.format(z=0.05), objects: tuple[SceneObject, ...] = (BALL_OBJECT,), **kwargs) -> World:
    return World(spec(extra), joint_names=JOINTS, home=HOME, objects=objects, **kwargs)


@pytest.fixture
def world() -> World:
    return make()


@pytest.mark.requirement("A-22")
def test_joint_index_uses_qposadr_with_free_body_first(world: World) -> None:
    assert world.model.joint("shoulder").qposadr[0] == 7
    state = world.read_joints()
    np.testing.assert_allclose(state.position, [-0.3, 0.8, 0.02])
    world.set_targets(np.array([0.1, 0.2, 0.03]))
    assert world.data.ctrl.tolist() == [0.03, 0.2, 0.1]  # actuators stand in another order than joints


@pytest.mark.parametrize(("timestep", "steps"), [(0.002, 5), (0.001, 10), (0.005, 2), (0.01, 1)])
@pytest.mark.requirement("A-19")
def test_a_tick_is_ten_milliseconds_whatever_the_time_step(timestep: float, steps: int) -> None:
    world = World(spec(timestep=timestep), joint_names=JOINTS, home=HOME)
    assert world.steps_per_tick == steps
    for _ in range(7):
        world.step(world.steps_per_tick)
    assert world.t_ns == 70_000_000
    assert world.data.time == pytest.approx(0.07)


@pytest.mark.requirement("A-19")
def test_a_time_step_that_does_not_divide_the_tick_is_refused() -> None:
    with refuses(Code.CONFIG_INVALID, "10 ms is not a whole number of physics steps of 3 ms"):
        World(spec(timestep=0.003), joint_names=JOINTS, home=HOME)


@pytest.mark.requirement("A-21")
def test_targets_move_joints_by_force_and_never_write_qpos(world: World) -> None:
    before = world.data.qpos.copy()
    world.set_targets(np.array([0.5, 0.2, 0.0]))
    np.testing.assert_array_equal(world.data.qpos, before)
    for _ in range(300):
        last = world.data.qpos[7:].copy()
        world.step(1)  # what is not integrated from the velocity would be a teleport
        np.testing.assert_allclose(world.data.qpos[7:] - last, world.data.qvel[6:] * 0.002, atol=1e-12)
    gravity_sag = 0.05
    np.testing.assert_allclose(world.read_joints().position, [0.5, 0.2, 0.0], atol=gravity_sag)


@pytest.mark.requirement("A-21", "P-16")
def test_qpos_is_written_in_one_place_of_the_package_and_nothing_is_welded() -> None:
    writers: list[str] = []
    for path in sorted(Path(openarm_sim_bridge.__file__).parent.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        assert "mjEQ_WELD" not in source, path
        assert "mjEQ_CONNECT" not in source, path
        for function in (n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)):
            for node in ast.walk(function):
                targets = (
                    node.targets
                    if isinstance(node, ast.Assign)
                    else [node.target]
                    if isinstance(node, ast.AugAssign)
                    else []
                )
                for target in targets:
                    base = target.value if isinstance(target, ast.Subscript) else target
                    if isinstance(base, ast.Attribute) and base.attr in (
                        "qpos",
                        "qvel",
                        "xfrc_applied",
                        "qfrc_applied",
                    ):
                        writers.append(f"{path.name}:{function.name}:{ast.unparse(base)}")
    # Renderers draw copies of their own.
    assert [w for w in writers if not w.startswith(("renderer.py", "export.py"))] == [
        "world.py:_place:self.data.qpos",
        "world.py:_place:self.data.qvel",
    ]


def test_effort_is_what_the_actuator_pushes(world: World) -> None:
    world.set_targets(np.array([-0.3, 0.8, 0.04]))
    world.step(1)
    assert world.read_joints().effort[2] == pytest.approx(30.0)  # 2000 N/m x 0.02 m, limited
    world.set_effort_limits(np.array([np.inf, np.inf, 5.0]))
    world.step(1)
    assert abs(world.read_joints().effort[2]) == pytest.approx(5.0)
    world.set_effort_limits(np.array([np.inf, np.inf, 500.0]))
    world.step(1)
    assert abs(world.read_joints().effort[2]) <= 30.0 + 1e-9  # never more than the model allows


def test_objects_report_pose_and_twist_in_the_world_frame() -> None:
    world = make(BALL.format(z=1.0))
    world.data.qvel[:6] = [0.1, 0.2, 0.0, 0.0, 0.0, 3.0]
    world.data.qpos[3:7] = [np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0, 0.0]  # turned by 90 degrees about x
    (ball,) = world.objects()
    assert ball.object == BALL_OBJECT
    np.testing.assert_allclose(ball.T_world_object[:3, 3], [0.5, 0.0, 1.0])
    np.testing.assert_allclose(ball.linear, [0.1, 0.2, 0.0])
    np.testing.assert_allclose(ball.angular, [0.0, -3.0, 0.0], atol=1e-12)


def test_reset_puts_everything_back_and_time_goes_on() -> None:
    world = make(BALL.format(z=0.3))
    world.set_targets(np.array([1.0, 0.0, 0.0]))
    for _ in range(20):
        world.step(world.steps_per_tick)
    t_ns = world.t_ns
    world.reset()
    assert world.t_ns == t_ns
    np.testing.assert_allclose(world.read_joints().position, [-0.3, 0.8, 0.02])
    np.testing.assert_allclose(world.read_joints().velocity, 0.0)
    assert world.objects()[0].T_world_object[2, 3] == pytest.approx(0.3)
    world.step(world.steps_per_tick)
    assert world.t_ns == t_ns + 10_000_000
    np.testing.assert_allclose(world.read_joints().position, [-0.3, 0.8, 0.02], atol=0.05)


@pytest.mark.requirement("P-25")
def test_a_reset_may_start_elsewhere_and_the_next_one_is_at_home_again(world: World) -> None:
    elsewhere = se3.make(None, (-0.4, 0.3, 0.05))
    world.reset({"finger": 0.03, "elbow": -0.2}, {"ball": elsewhere})
    np.testing.assert_allclose(world.read_joints().position, [-0.3, -0.2, 0.03])
    np.testing.assert_allclose(world.data.ctrl, [0.03, -0.2, -0.3])  # it is held there
    assert world.data.joint("mimic").qpos[0] == pytest.approx(0.03)  # what is coupled follows
    np.testing.assert_allclose(world.objects()[0].T_world_object, elsewhere)
    world.reset()
    np.testing.assert_allclose(world.read_joints().position, [-0.3, 0.8, 0.02])
    np.testing.assert_allclose(world.objects()[0].T_world_object[:3, 3], [0.5, 0.0, 0.05])


@pytest.mark.requirement("P-25")
def test_a_start_that_overlaps_leaves_the_world_as_it_was(world: World) -> None:
    for _ in range(3):
        world.step(world.steps_per_tick)
    model, qpos, qvel = world.model, world.data.qpos.copy(), world.data.qvel.copy()
    cube = CUBE.format(pos="0 1 .05") + BALL.format(z=0.05)
    other = world.compile(spec(extra=cube), (CUBE_OBJECT, BALL_OBJECT))
    into_the_floor, into_the_ball = se3.make(None, (0.5, 0.0, 0.01)), se3.make(None, (0.5, 0.02, 0.05))
    refused("'ball' would overlap 'world' by 40 mm", world.reset, objects={"ball": into_the_floor})
    with pytest.raises(OpenArmError, match=r"'cube' would overlap 'ball'|'ball' would overlap 'cube'"):
        world.exchange(other, objects={"cube": into_the_ball})
    refused("no object 'cube'; objects: ball", world.reset, objects={"cube": into_the_ball})
    assert world.model is model
    np.testing.assert_array_equal(world.data.qpos, qpos)
    np.testing.assert_array_equal(world.data.qvel, qvel)


def test_exchange_loads_another_world_and_time_goes_on(world: World) -> None:
    world.step(world.steps_per_tick)
    world.exchange(world.compile(spec(extra=""), ()))
    assert world.t_ns == 10_000_000
    assert world.objects() == ()
    np.testing.assert_allclose(world.read_joints().position, [-0.3, 0.8, 0.02])


def test_extend_keeps_the_state_of_everything_that_was_there(world: World) -> None:
    target = np.array([0.4, 0.1, 0.03])
    world.set_targets(target)
    for _ in range(30):
        world.step(world.steps_per_tick)
    before, pose, t_ns = world.read_joints(), world.objects()[0].T_world_object, world.t_ns
    cube = CUBE.format(pos="0 1 .05")
    world.extend(world.compile(spec(extra=cube + BALL.format(z=0.05)), (CUBE_OBJECT, BALL_OBJECT)))
    after = world.read_joints()
    np.testing.assert_array_equal(after.position, before.position)
    np.testing.assert_array_equal(after.velocity, before.velocity)
    assert after.t_ns == t_ns
    np.testing.assert_allclose(world.objects()[1].T_world_object, pose)
    np.testing.assert_allclose(world.objects()[0].T_world_object[:3, 3], [0.0, 1.0, 0.05])
    assert world.data.ctrl[2] == target[0]


def test_extend_refuses_what_overlaps_and_leaves_the_world_as_it_was(world: World) -> None:
    world.step(world.steps_per_tick)
    model, position = world.model, world.read_joints().position
    cube = CUBE.format(pos="0.5 0.06 .05")
    with refuses(Code.SCENE_INVALID, r"'cube' would overlap 'ball' by \d+ mm at \(0\.5"):
        world.extend(world.compile(spec(extra=cube + BALL.format(z=0.05)), ()))
    assert world.model is model
    np.testing.assert_array_equal(world.read_joints().position, position)


def test_a_diverged_simulation_is_reported_and_a_reset_mends_it(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning to a file there
    world.data.qvel[8] = np.nan
    assert refused(r"diverged at 0\.010 s", world.step, world.steps_per_tick).code is Code.INTERNAL
    world.reset()
    world.step(world.steps_per_tick)
    assert np.all(np.isfinite(world.read_joints().position))
    world.set_targets(np.array([np.nan, 0.0, 0.0]))
    refused("diverged", world.step, world.steps_per_tick)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"joint_names": ("shoulder", "wrist")}, "lacks a joint: Invalid name 'wrist'. Valid names: .*ball"),
        ({"joint_names": ("mimic",)}, "no actuator for the joints mimic"),
        ({"objects": (UPPER_OBJECT,)}, "lacks a joint: Invalid name 'upper'"),
        ({"home": {"knee": 0.0}}, "lacks a joint: Invalid name 'knee'"),
    ],
)
def test_what_the_model_lacks_is_named(kwargs: dict, message: str) -> None:
    refused(message, World, spec(), **({"joint_names": JOINTS, "home": HOME} | kwargs))


@pytest.mark.parametrize("sleep", [True, False])
def test_an_object_at_rest_is_left_out_of_the_physics_until_another_touches_it(sleep: bool) -> None:
    world = make(BALL.format(z=0.6) + CUBE.format(pos="0.5 0 0.03"), (BALL_OBJECT, CUBE_OBJECT), sleep=sleep)
    cube, resting = world.model.body("cube").id, []
    for _ in range(150):
        world.step(world.steps_per_tick)
        resting.append(world.data.body_awake[cube] == mujoco.mjtSleepState.mjS_ASLEEP)
    assert resting[25] is sleep  # while the ball falls
    assert not all(resting[30:])  # it lands on the cube
    assert world.model.opt.enableflags == 0  # cameras and judges find every body where it is
    assert sum(one.T_world_object[2, 3] > 0.02 for one in world.objects()) == 2
