# SPDX-License-Identifier: Apache-2.0
"""Services of fault injection: /sim/inject_fault and /sim/clear_faults."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import Any

from openarm_interfaces.srv import ClearFaults, InjectFault

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import BaseNode
from openarm_sim_bridge.faults.faults import FAULTS, Fault, parse_fault
from openarm_sim_bridge.ros.simulation_server import between_ticks, serve
from openarm_sim_bridge.simulation import Simulation


class FaultServer:
    """Injects and clears faults. They persist over a reset of the world.

    Args:
        node: Owner.
        simulation: Applies the faults of robot and world.
        cameras: Names of the cameras.
        set_camera_faults: Hands the active faults of cameras to the process that draws; called in a worker thread.
    """

    def __init__(
        self,
        node: BaseNode[Any],
        simulation: Simulation,
        cameras: Collection[str],
        set_camera_faults: Callable[[tuple[Fault, ...]], None],
    ) -> None:
        self._simulation = simulation
        self._cameras = tuple(cameras)
        self._set_camera_faults = set_camera_faults
        self._of_cameras: dict[str, Fault] = {}
        serve(node, InjectFault, "/sim/inject_fault", partial(node.in_thread, self._inject))
        serve(node, ClearFaults, "/sim/clear_faults", partial(node.in_thread, self._clear))

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the faults that are active."""
        return (*self._of_cameras, *self._simulation.faults.active)

    def _inject(self, request: InjectFault.Request) -> str:
        name = request.name
        fault = parse_fault(name, request.parameters, request.seed)
        camera = getattr(fault.parameters, "camera", "")
        if camera and camera not in self._cameras:
            known = ", ".join(self._cameras) or "none"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no camera {camera!r}; cameras: {known}")
        if fault.of_camera:
            self._of_cameras[name] = fault
            self._set_camera_faults(tuple(self._of_cameras.values()))
        else:
            between_ticks(self._simulation, lambda: self._simulation.faults.inject(fault, self._simulation.world))
        return f"{name}: {fault.parameters}"

    def _clear(self, request: ClearFaults.Request) -> str:
        name = request.name
        if name and name not in FAULTS:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no fault {name!r}; faults: {', '.join(FAULTS)}")
        was = [active for active in self.active if name in ("", active)]
        self._of_cameras = {key: fault for key, fault in self._of_cameras.items() if name not in ("", key)}
        self._set_camera_faults(tuple(self._of_cameras.values()))
        between_ticks(self._simulation, lambda: self._simulation.faults.clear(name))
        return f"cleared: {', '.join(was) or 'nothing'}"
