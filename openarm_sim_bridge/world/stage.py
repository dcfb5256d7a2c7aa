# SPDX-License-Identifier: Apache-2.0
"""Making worlds: the robot and its cameras in a scene that can be exchanged and extended."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import mujoco

from openarm_common.camera.cameras import CameraConfig
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.servos import ServoModel
from openarm_common.scene.scene import Scene, SceneObject, parse_object
from openarm_control.joints import arm_loads, joint_names
from openarm_sim_bridge.world.hardware import IDEAL, HardwareConfig, drawn
from openarm_sim_bridge.world.model import PhysicsConfig, build_spec, robot_spec
from openarm_sim_bridge.world.world import PERIOD_NS, CompiledWorld, World


class Stage:
    """Makes worlds from scenes.

    Args:
        description: The robot as the suite believes; what is simulated is as its folder describes it.
        cameras: Cameras by name.
        mount_seed: Seed of the camera mounts' errors; None is the nominal mounts.
        physics: Solver, contacts, fingers.
        hardware: Motors of the arms, and how they differ from the description; None is ideal ones.
    """

    def __init__(
        self,
        description: RobotDescription,
        cameras: Mapping[str, CameraConfig],
        mount_seed: int | None,
        physics: PhysicsConfig,
        hardware: HardwareConfig | None = None,
    ) -> None:
        self.description = description
        self._described = described = description.described
        self._cameras = cameras
        self._mount_seed = mount_seed
        self._physics = physics
        self._hardware = hardware or IDEAL
        made = drawn(self._hardware, described)
        self._robot = robot_spec(described, physics, made)
        lift = () if described.lift is None else (described.lift.joint,)
        self.joint_names = (*joint_names(described), *lift)
        self.encoders = made.encoders(described, self.joint_names)
        self.home: dict[str, float] = {}
        if described.lift is not None:
            self.home[described.lift.joint] = described.lift.home
        for side in described.arm_names:
            hand, stops = described.hand(side), made.fingers.get(side)
            closed = hand.closed if stops is None else hand.position(stops.closed)
            self.home |= described.group_state(f"{side}_arm", "home") | {hand.joint: closed}

    @cached_property
    def servos(self) -> dict[str, ServoModel]:
        """What the profile says of the servos by side, as a client knows it that has not identified them."""
        return {
            side: self._hardware.model(self.description, load) for side, load in arm_loads(self.description).items()
        }

    def world(
        self, scene: Scene, add: Callable[[mujoco.MjSpec], None] = lambda _: None, *, each_step: bool = False
    ) -> World:
        """Make a world with the robot in its home posture, grippers closed.

        Args:
            scene: Table and objects.
            add: Adds what is no part of a scene.
            each_step: A control tick is one physics step, else 10 ms.

        Raises:
            OpenArmError: CONFIG_INVALID, when the model can't be built.
        """
        spec = self._spec(scene)
        add(spec)
        period = round(spec.option.timestep * 1e9) if each_step else PERIOD_NS
        return World(
            spec,
            joint_names=self.joint_names,
            home=self.home,
            objects=scene.objects,
            period_ns=period,
            encoders=self.encoders,
            sleep=self._physics.sleep,
        )

    def compile(self, world: World, scene: Scene) -> CompiledWorld:
        """Compile another scene for `World.exchange` or `World.extend`; slow, changes nothing.

        Raises:
            OpenArmError: CONFIG_INVALID, when the model can't be built.
        """
        return world.compile(self._spec(scene), scene.objects)

    def posture(self, keyframe: str) -> dict[str, float]:
        """Return joint positions of a keyframe, rad: a state of that name in the SRDF of either arm, else home.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming the keyframes there are.
        """
        states = self._described.semantics.states
        groups = [f"{side}_arm" for side in self._described.arm_names]
        known = sorted({name for group, name in states if group in groups})
        if keyframe not in known:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no keyframe {keyframe!r}; keyframes: {', '.join(known)}")
        found = [states[group, keyframe] for group in groups if (group, keyframe) in states]
        return self.home | {joint: position for state in found for joint, position in state.items()}

    def _spec(self, scene: Scene) -> mujoco.MjSpec:
        return build_spec(self._described, scene, self._cameras, self._mount_seed, self._physics, robot=self._robot)


def without_object(scene: Scene, name: str) -> Scene:
    """Return the scene without an object.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the objects that exist.
    """
    gone = scene.object(name)
    return scene.model_copy(update={"objects": tuple(item for item in scene.objects if item is not gone)})


def with_object(scene: Scene, data: Mapping[str, Any]) -> Scene:
    """Return the scene with one more object.

    Args:
        scene: The present scene.
        data: Keys of `SceneObject`.

    Raises:
        OpenArmError: SCENE_INVALID, when the object is wrong, off the table, or its name is taken.
    """
    item: SceneObject = parse_object(data, scene.table, "object")
    if any(item.name == other.name for other in scene.objects):
        names = ", ".join(other.name for other in scene.objects)
        raise OpenArmError(Code.SCENE_INVALID, f"there is an object {item.name!r} already; names in use: {names}")
    return scene.model_copy(update={"objects": (*scene.objects, item)})
