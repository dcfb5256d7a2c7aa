# SPDX-License-Identifier: Apache-2.0
"""Services of the simulation: reset and exchange the world, pause, step, add, remove and move objects.

Work that takes longer than a tick (reading a scene, compiling a model) runs in a worker thread; the world itself
changes between two ticks, in the thread of the simulation.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, TypeVar

from geometry_msgs.msg import PoseStamped
from openarm_interfaces.srv import MoveObject, RemoveObject, ResetWorld, SetPause, SpawnObject, StepSimulation

from openarm_common.errors import Code, OpenArmError
from openarm_common.objects.posed import posed_object
from openarm_common.ros.convert import pose_to_matrix, xyz
from openarm_common.ros.node import BaseNode
from openarm_common.scene.scene import Scene, load_scene
from openarm_common.types import Array
from openarm_control.controller import PositionCommand
from openarm_control.joints import arm_groups, gripper_groups
from openarm_control.trajectory import limits_of
from openarm_sim_bridge.ros.state_publisher import WORLD_FRAME
from openarm_sim_bridge.simulation import Simulation
from openarm_sim_bridge.world.stage import Stage, with_object, without_object

T = TypeVar("T")

_ANSWER_S = 1.0
_UPRIGHT = 1e-3


def serve(node: BaseNode[Any], kind: Any, name: str, work: Callable[[Any], Awaitable[str]]) -> None:
    """Offer a service that answers with the message that `work` returns, or with its error.

    Args:
        node: Owner.
        kind: Type of the service; its response has `success` and `message`.
        name: Absolute name.
        work: Is given the request.
    """

    async def on_request(request: Any, response: Any) -> Any:
        try:
            response.message = await work(request)
            response.success = True
        except OpenArmError as error:
            response.success = False
            response.message = str(error)
            node.get_logger().warning(str(error))
        return response

    node.create_service(kind, name, on_request)


def between_ticks(simulation: Simulation, fn: Callable[[], T]) -> T:
    """Run a short function in the thread of the simulation and wait for it; call from a worker thread.

    Raises:
        OpenArmError: TIMEOUT, and what the function raises.
    """
    try:
        return simulation.call(fn).result(timeout=_ANSWER_S)
    except TimeoutError as error:
        raise OpenArmError(Code.TIMEOUT, f"the physics did not answer within {_ANSWER_S:.0f} s") from error


class SimulationServer:
    """/sim/reset_world, /sim/set_pause, /sim/step, and /sim/spawn_object, remove_object, move_object.

    Args:
        node: Owner.
        stage: Makes worlds.
        scene: The scene that is simulated.
        simulation: Simulation whose world it is.
        stays: The robot stays where it is when the world is reset: its joints are those of motors that hold it.
    """

    def __init__(
        self, node: BaseNode[Any], stage: Stage, scene: Scene, simulation: Simulation, *, stays: bool = False
    ) -> None:
        self._node = node
        self._stage = stage
        self._limits = limits_of(*arm_groups(node.description).values(), *gripper_groups(node.description).values())
        self._loaded = self._present = scene
        self._simulation = simulation
        self._stays = stays
        self._changing = threading.Lock()
        serve(node, StepSimulation, "/sim/step", self._step)
        for kind, name, work in (
            (ResetWorld, "reset_world", self._reset),
            (SetPause, "set_pause", self._pause),
            (SpawnObject, "spawn_object", self._spawn),
            (RemoveObject, "remove_object", self._remove),
            (MoveObject, "move_object", self._move),
        ):
            serve(node, kind, f"/sim/{name}", partial(node.in_thread, work))

    # --- work, in a worker thread
    def _reset(self, request: ResetWorld.Request) -> str:
        with self._changing:
            if request.seed < 0:
                raise OpenArmError(Code.SCENE_INVALID, f"seed is {request.seed}, expected 0 or more")
            scene = load_scene(request.scene, request.seed) if request.scene else self._loaded
            joints, objects = self._start_of(request, scene)
            world = self._simulation.world
            compiled = None if scene == self._present else self._stage.compile(world, scene)

            def change() -> None:
                start = world.posture() if self._stays and not joints else joints
                if compiled is None:
                    world.reset(start, objects)
                else:
                    world.exchange(compiled, start, objects)

            between_ticks(self._simulation, lambda: self._simulation.restart(change))
            self._loaded = self._present = scene
        return f"scene {scene.name!r} with {len(scene.objects)} objects"

    def _start_of(self, request: ResetWorld.Request, scene: Scene) -> tuple[dict[str, float], dict[str, Array]]:
        """Return joint positions and object poses of a request that differ from the start of the scene."""
        keyframe = request.keyframe
        joints = self._stage.posture(keyframe) if keyframe not in ("", "home") else dict[str, float]()
        command = PositionCommand.checked(request.joint_names, request.joint_positions, self._limits)
        if command.unknown:
            known = ", ".join(self._stage.joint_names)
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no joint {command.unknown[0]!r}; joints: {known}")
        if len(request.object_names) != len(request.object_poses):
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"{len(request.object_names)} object names and {len(request.object_poses)} poses, expected as many",
            )
        objects = {
            name: _pose_of(name, pose, scene)
            for name, pose in zip(request.object_names, request.object_poses, strict=True)
        }
        return joints | dict(command.positions), objects

    def _pause(self, request: SetPause.Request) -> str:
        between_ticks(self._simulation, lambda: self._simulation.set_paused(request.paused))
        return "paused" if request.paused else "running"

    async def _step(self, request: StepSimulation.Request) -> str:
        """Wait in the executor, not in a worker thread: many steps take long."""
        node, simulation = self._node, self._simulation
        stepped = await node.in_thread(between_ticks, simulation, lambda: simulation.advance(request.steps))
        return f"simulated time is {await node.awaitable(stepped) * 1e-9:.3f} s"

    def _spawn(self, request: SpawnObject.Request) -> str:
        self._extend(lambda scene: with_object(scene, _object_of(request, scene.table.top_z)))
        return f"{request.name!r} is in the world"

    def _remove(self, request: RemoveObject.Request) -> str:
        self._extend(lambda scene: without_object(scene, request.name))
        return f"{request.name!r} is out of the world"

    def _extend(self, change: Callable[[Scene], Scene]) -> None:
        with self._changing:
            scene = change(self._present)
            compiled = self._stage.compile(self._simulation.world, scene)
            between_ticks(self._simulation, lambda: self._simulation.world.extend(compiled))
            self._present = scene

    def _move(self, request: MoveObject.Request) -> str:
        with self._changing:
            T = _pose_of(request.name, request.pose, self._present)
            between_ticks(self._simulation, lambda: self._simulation.world.move_object(request.name, T))
        return f"{request.name!r} is at ({', '.join(f'{v:.3f}' for v in T[:3, 3])}) m in {WORLD_FRAME}"


def _pose_of(name: str, pose: PoseStamped, scene: Scene) -> Array:
    """Return T_world_object of an object of a scene.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the objects that exist; as `_pose_in_world`.
    """
    return _pose_in_world(pose, scene.table.top_z, scene.object(name).size[2])


def _pose_in_world(pose: PoseStamped, table_top_z: float, height: float) -> Array:
    """Return T_world_object of an object of some height; z = 0 on the table puts it on its bottom.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a frame that is neither table nor world, or a tilted object.
    """
    frame = pose.header.frame_id or "table"
    if frame not in ("table", WORLD_FRAME):
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"pose is in the frame {frame!r}, expected 'table' (also when empty) or 'world'"
        )
    T = pose_to_matrix(pose.pose)
    if T[2, 2] < 1.0 - _UPRIGHT:
        raise OpenArmError(Code.INVALID_ARGUMENT, "the pose is tilted, expected a turn about z only")
    if frame == "table":
        T[2, 3] = table_top_z + (T[2, 3] or 0.5 * height)
    return T


def _object_of(request: SpawnObject.Request, table_top_z: float) -> dict[str, Any]:
    """Return the keys of a `SceneObject` from a request.

    Raises:
        OpenArmError: INVALID_ARGUMENT, as `_pose_in_world`; of a mesh, as `posed_object`.
    """
    if request.shape == "mesh":
        own: dict[str, Any] = {"object": request.object, "side": request.side}
        height = posed_object(request.object, request.side).size[2]
    else:
        own = {"size": tuple(xyz(request.size).tolist()), "color": request.color}
        height = request.size.z
    T = _pose_in_world(request.pose, table_top_z, height)
    return {
        "name": request.name,
        "shape": request.shape,
        **own,
        "mass": request.mass,
        "position": tuple(T[:3, 3].tolist()),
        "yaw": math.atan2(T[1, 0], T[0, 0]),
    }
