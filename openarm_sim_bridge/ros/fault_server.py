# SPDX-License-Identifier: Apache-2.0
"""The services that make things go wrong on purpose: /sim/inject_fault and /sim/clear_faults."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

from openarm_interfaces.srv import ClearFaults, InjectFault

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import BaseNode
from openarm_sim_bridge.faults.faults import FAULTS, Fault, parse_fault
from openarm_sim_bridge.ros.simulation_server import answer, between_ticks
from openarm_sim_bridge.simulation import Simulation


class FaultServices:
    """Injects and clears faults. They outlast a reset of the world.

    Args:
        node: Owner.
        simulation: Works the faults of robot and world.
        cameras: Names of the cameras.
        tell_cameras: Hands the active faults of cameras to who draws; called in a worker thread.
    """

    def __init__(
        self,
        node: BaseNode[Any],
        simulation: Simulation,
        cameras: Collection[str],
        tell_cameras: Callable[[tuple[Fault, ...]], None],
    ) -> None:
        self._node = node
        self._simulation = simulation
        self._cameras = tuple(cameras)
        self._tell_cameras = tell_cameras
        self._of_cameras: dict[str, Fault] = {}
        node.create_service(InjectFault, "/sim/inject_fault", self._on_inject)
        node.create_service(ClearFaults, "/sim/clear_faults", self._on_clear)

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the faults that are active."""
        return (*self._of_cameras, *self._simulation.faults.active)

    async def _on_inject(self, request: InjectFault.Request, response: InjectFault.Response) -> InjectFault.Response:
        work = self._node.in_thread(self._inject, request.name, request.parameters, request.seed)
        return await answer(self._node, response, work)

    async def _on_clear(self, request: ClearFaults.Request, response: ClearFaults.Response) -> ClearFaults.Response:
        return await answer(self._node, response, self._node.in_thread(self._clear, request.name))

    def _inject(self, name: str, parameters: str, seed: int) -> str:
        fault = parse_fault(name, parameters, seed)
        camera = getattr(fault.parameters, "camera", "")
        if camera and camera not in self._cameras:
            known = ", ".join(self._cameras) or "none"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no camera {camera!r}; cameras: {known}")
        if fault.of_camera:
            self._of_cameras[name] = fault
            self._tell_cameras(tuple(self._of_cameras.values()))
        else:
            between_ticks(self._simulation, lambda: self._simulation.faults.inject(fault, self._simulation.world))
        return f"{name}: {fault.parameters}"

    def _clear(self, name: str) -> str:
        if name and name not in FAULTS:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no fault {name!r}; faults: {', '.join(FAULTS)}")
        was = [active for active in self.active if name in ("", active)]
        if name:
            self._of_cameras.pop(name, None)
        else:
            self._of_cameras.clear()
        self._tell_cameras(tuple(self._of_cameras.values()))
        between_ticks(self._simulation, lambda: self._simulation.faults.clear(name))
        return f"cleared: {', '.join(was) or 'nothing'}"
