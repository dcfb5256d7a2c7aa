# SPDX-License-Identifier: Apache-2.0
"""The services of the simulation: reset and exchange the world, pause, step, add, remove and move objects.

What takes longer than a tick (reading a scene, compiling a model) runs in a worker thread; the world itself changes
between two ticks, in the thread of the simulation.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import Future as ThreadFuture
from typing import Any, TypeVar

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from openarm_interfaces.srv import MoveObject, RemoveObject, ResetWorld, SetPause, SpawnObject, StepSimulation
from rclpy.task import Future

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import pose_to_matrix, xyz
from openarm_common.ros.node import BaseNode
from openarm_common.scene.scene import Scene, load_scene
from openarm_sim_bridge.ros.state_publisher import WORLD_FRAME
from openarm_sim_bridge.simulation import Simulation
from openarm_sim_bridge.world.compiled import CompiledWorld
from openarm_sim_bridge.world.stage import Stage, with_object, without_object

T = TypeVar("T")

_ANSWER_S = 1.0
_UPRIGHT = 1e-3


async def answer(node: BaseNode[Any], response: Any, work: Awaitable[str]) -> Any:
    """Fill `success` and `message` of a response with the outcome of some work."""
    try:
        response.message = await work
        response.success = True
    except OpenArmError as error:
        response.success = False
        response.message = str(error)
        node.get_logger().warning(str(error))
    return response


def between_ticks(simulation: Simulation, fn: Callable[[], T]) -> T:
    """Run a short function in the thread of the simulation and wait for it; not for the executor.

    Raises:
        OpenArmError: TIMEOUT, and what the function raises.
    """
    try:
        return simulation.call(fn).result(timeout=_ANSWER_S)
    except TimeoutError as error:
        raise OpenArmError(Code.TIMEOUT, f"the physics did not answer within {_ANSWER_S:.0f} s") from error


class SimulationServices:
    """/sim/reset_world, /sim/set_pause, /sim/step, and /sim/spawn_object, remove_object, move_object.

    Args:
        node: Owner.
        stage: Makes worlds.
        scene: The scene that the world shows.
        simulation: Whose world it is.
        on_scene: Called (in a worker thread) with a scene that was loaded.
    """

    def __init__(
        self,
        node: BaseNode[Any],
        stage: Stage,
        scene: Scene,
        simulation: Simulation,
        on_scene: Callable[[Scene], None],
    ) -> None:
        self._node = node
        self._stage = stage
        self._loaded = self._present = scene
        self._simulation = simulation
        self._on_scene = on_scene
        self._changing = threading.Lock()
        node.create_service(ResetWorld, "/sim/reset_world", self._on_reset)
        node.create_service(SetPause, "/sim/set_pause", self._on_pause)
        node.create_service(StepSimulation, "/sim/step", self._on_step)
        node.create_service(SpawnObject, "/sim/spawn_object", self._on_spawn)
        node.create_service(RemoveObject, "/sim/remove_object", self._on_remove)
        node.create_service(MoveObject, "/sim/move_object", self._on_move)

    # --- callbacks
    async def _on_reset(self, request: ResetWorld.Request, response: ResetWorld.Response) -> ResetWorld.Response:
        return await answer(self._node, response, self._node.in_thread(self._reset, request))

    async def _on_pause(self, request: SetPause.Request, response: SetPause.Response) -> SetPause.Response:
        return await answer(self._node, response, self._node.in_thread(self._pause, request.paused))

    async def _on_step(
        self, request: StepSimulation.Request, response: StepSimulation.Response
    ) -> StepSimulation.Response:
        return await answer(self._node, response, self._step(request.steps))

    async def _on_spawn(self, request: SpawnObject.Request, response: SpawnObject.Response) -> SpawnObject.Response:
        return await answer(self._node, response, self._node.in_thread(self._spawn, request))

    async def _on_remove(self, request: RemoveObject.Request, response: RemoveObject.Response) -> RemoveObject.Response:
        return await answer(self._node, response, self._node.in_thread(self._remove, request.name))

    async def _on_move(self, request: MoveObject.Request, response: MoveObject.Response) -> MoveObject.Response:
        return await answer(self._node, response, self._node.in_thread(self._move, request.name, request.pose))

    # --- work, in a worker thread
    def _reset(self, request: ResetWorld.Request) -> str:
        with self._changing:
            if request.seed < 0:
                raise OpenArmError(Code.SCENE_INVALID, f"seed is {request.seed}, expected 0 or more")
            scene = load_scene(request.scene, request.seed) if request.scene else self._loaded
            joints, objects = self._start_of(request, scene)
            if scene == self._present:
                between_ticks(self._simulation, lambda: self._reset_world(joints, objects))
            else:
                compiled = self._stage.compile(self._simulation.world, scene)
                between_ticks(self._simulation, lambda: self._exchange(compiled, joints, objects))
            self._loaded = self._present = scene
        self._on_scene(scene)
        return f"scene {scene.name!r} with {len(scene.objects)} objects"

    def _start_of(
        self, request: ResetWorld.Request, scene: Scene
    ) -> tuple[dict[str, float], dict[str, NDArray[np.float64]]]:
        """Which joints and objects start elsewhere than at home and in their places of the scene."""
        keyframe = request.keyframe
        joints = self._stage.posture(keyframe) if keyframe not in ("", "home") else dict[str, float]()
        command = self._simulation.controller.check_command(request.joint_names, request.joint_positions)
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

    def _pause(self, paused: bool) -> str:
        between_ticks(self._simulation, lambda: self._simulation.set_paused(paused))
        return "paused" if paused else "running"

    async def _step(self, steps: int) -> str:
        """Wait in the executor, not in a worker thread: many steps take long."""
        begun = self._node.in_thread(between_ticks, self._simulation, lambda: self._simulation.advance(steps))
        stepped = Future(executor=self._node.executor)

        def done(stepping: ThreadFuture[int]) -> None:
            error = stepping.exception()
            stepped.set_result(stepping.result()) if error is None else stepped.set_exception(error)
            if self._node.executor is not None:
                self._node.executor.wake()

        (await begun).add_done_callback(done)
        t_ns: Any = await stepped
        return f"simulated time is {t_ns * 1e-9:.3f} s"

    def _spawn(self, request: SpawnObject.Request) -> str:
        with self._changing:
            scene = with_object(self._present, _object_of(request, self._present.table.top_z))
            compiled = self._stage.compile(self._simulation.world, scene)
            between_ticks(self._simulation, lambda: self._simulation.world.extend(compiled))
            self._present = scene
        return f"{request.name!r} is in the world"

    def _remove(self, name: str) -> str:
        with self._changing:
            scene = without_object(self._present, name)
            compiled = self._stage.compile(self._simulation.world, scene)
            between_ticks(self._simulation, lambda: self._simulation.world.extend(compiled))
            self._present = scene
        return f"{name!r} is out of the world"

    def _move(self, name: str, pose: PoseStamped) -> str:
        with self._changing:
            T = _pose_of(name, pose, self._present)
            between_ticks(self._simulation, lambda: self._simulation.world.move_object(name, T))
        return f"{name!r} is at ({', '.join(f'{v:.3f}' for v in T[:3, 3])}) m in {WORLD_FRAME}"

    # --- between two ticks
    def _reset_world(self, joints: Mapping[str, float], objects: Mapping[str, NDArray[np.float64]]) -> None:
        self._simulation.world.reset(joints, objects)
        self._simulation.restart()

    def _exchange(
        self, compiled: CompiledWorld, joints: Mapping[str, float], objects: Mapping[str, NDArray[np.float64]]
    ) -> None:
        self._simulation.world.exchange(compiled, joints, objects)
        self._simulation.restart()


def _pose_of(name: str, pose: PoseStamped, scene: Scene) -> NDArray[np.float64]:
    """T_world_object of an object of a scene.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the objects that exist; as `_pose_in_world`.
    """
    there = {item.name: item for item in scene.objects}
    if name not in there:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"no object {name!r}; objects: {', '.join(there) or 'none'}")
    T, stands = _pose_in_world(pose, scene.table.top_z)
    if stands:
        T[2, 3] += 0.5 * there[name].size[2]
    return T


def _pose_in_world(pose: PoseStamped, table_top_z: float) -> tuple[NDArray[np.float64], bool]:
    """T_world_object, and whether its height is that of what the object shall stand on (z = 0 on the table).

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
    stands = frame == "table" and T[2, 3] == 0.0
    if frame == "table":
        T[2, 3] += table_top_z
    return T, stands


def _object_of(request: SpawnObject.Request, table_top_z: float) -> dict[str, Any]:
    """Keys of a `SceneObject`.

    Raises:
        OpenArmError: INVALID_ARGUMENT, as `_pose_in_world`.
    """
    T, stands = _pose_in_world(request.pose, table_top_z)
    x, y, z = (float(v) for v in T[:3, 3])
    return {
        "name": request.name,
        "shape": request.shape,
        "size": tuple(xyz(request.size).tolist()),
        "color": request.color,
        "mass": request.mass,
        "position": (x, y) if stands else (x, y, z),
        "yaw": math.atan2(T[1, 0], T[0, 0]),
    }
