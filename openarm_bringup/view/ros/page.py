# SPDX-License-Identifier: Apache-2.0
"""The graph for a page: a thread that polls the wanted layers, and requests to the robot."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from typing import Any

from action_msgs.srv import CancelGoal
from openarm_interfaces.action import Pick
from openarm_interfaces.srv import ConfirmPlan, ResetWorld

from openarm_bringup.ros.stop_client import latch, release
from openarm_bringup.view.ros.layers import Layer, makers
from openarm_bringup.view.server import Confirmation, Item, Order, Reset
from openarm_common.camera.cameras import load_cameras, table_camera
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.client import BackgroundNode, ContextNode

_TICK_S = 0.02
_PICK_S = 900.0
_ANSWER_S = 30.0
_URGENT_S = 5.0


class GraphView(ContextNode):
    """Observes the graph and sends requests; a context manager.

    Args:
        on_item: Gets all that is new, in a thread of this object.
        on_end: Gets what ended that thread too early.
        timeout: Longest wait for a server to be there, s.
    """

    def __init__(
        self, on_item: Callable[[Item], object], on_end: Callable[[BaseException], object], *, timeout: float = 3.0
    ) -> None:
        self.description = RobotDescription.load()
        self.cameras = tuple(load_cameras().values())
        self._on_item, self._on_end = on_item, on_end
        self._makers = makers(self.description, self.cameras, table_camera())
        self._wanted: frozenset[str] = frozenset()
        self._ask = BackgroundNode("openarm_view", timeout=timeout)
        self._urgent = BackgroundNode("openarm_view_stop", timeout=timeout)  # nothing else can hold it up
        super().__init__("openarm_view_layers", bare=True)
        self._ended = threading.Event()
        self._stop_picking = threading.Event()
        self._picking = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)

    def __enter__(self) -> GraphView:
        self._thread.start()
        return self

    def close(self) -> None:
        """End the thread and the grasp that was asked for here, and leave the graph."""
        self._ended.set()
        self._stop_picking.set()
        self._thread.join(timeout=5.0)
        self._picking.acquire(timeout=5.0)  # until the grasp that was asked for here knows that it is cancelled
        super().close()
        self._ask.close()
        self._urgent.close()

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of all layers."""
        return tuple(self._makers)

    def want(self, layers: frozenset[str]) -> None:
        """Observe these layers from now on, and no others."""
        self._wanted = layers

    def pick(self, order: Order) -> dict[str, Any]:
        """Ask for a grasp; returns its result when it has ended.

        Raises:
            OpenArmError: NOT_READY, when no grasp node answers; BUSY; TIMEOUT.
        """
        goal = Pick.Goal(label=order.label, arm=order.arm, dry_run=order.dry_run, confirm=order.confirm)
        with self._picking:
            result = self._ask.do(Pick, "/grasp/pick", goal, timeout=_PICK_S, stop=self._stop_picking)
        names = ("success", "outcome", "code", "message", "label", "arm", "attempts", "duration")
        return {name: getattr(result, name) for name in names}

    def confirm(self, answer: Confirmation) -> tuple[bool, str]:
        """Confirm or reject the plan that waits, of whichever client.

        Raises:
            OpenArmError: NOT_READY, when no grasp node answers.
        """
        request = ConfirmPlan.Request(plan_id=answer.plan_id, accept=answer.accept)
        return _said(self._ask.call(ConfirmPlan, "/grasp/confirm", request, _ANSWER_S))

    def cancel(self) -> tuple[bool, str]:
        """Cancel the grasp that runs, of whichever client of the action.

        Raises:
            OpenArmError: NOT_READY, when no grasp node answers.
        """
        # An empty goal id and stamp: all goals.
        answer = self._urgent.call(CancelGoal, "/grasp/pick/_action/cancel_goal", CancelGoal.Request(), _URGENT_S)
        if answer.goals_canceling:
            return True, "cancelled; the arm holds where it is"
        return False, "no grasp runs that was asked for by /grasp/pick"

    def stop(self) -> tuple[bool, str]:
        """Latch the emergency stop of the joints.

        Raises:
            OpenArmError: NOT_READY, when no node offers it; TIMEOUT.
        """
        return latch(self._urgent)

    def release(self) -> tuple[bool, str]:
        """Release the emergency stop.

        Raises:
            OpenArmError: NOT_READY, when no node offers it; TIMEOUT.
        """
        return release(self._urgent)

    def reset(self, order: Reset) -> tuple[bool, str]:
        """Put the simulation back to its start.

        Raises:
            OpenArmError: NOT_READY, when there is no simulation.
        """
        request = ResetWorld.Request(scene=order.scene, seed=order.seed)
        return _said(self._ask.call(ResetWorld, "/sim/reset_world", request, _ANSWER_S))

    def _run(self) -> None:
        open_layers: dict[str, Layer] = {}
        try:
            while not self._ended.wait(_TICK_S):
                wanted = self._wanted
                for name in open_layers.keys() - wanted:
                    open_layers.pop(name).close()
                for name in wanted - open_layers.keys():
                    open_layers[name] = self._makers[name](self._node)
                now = time.monotonic()
                for name, layer in open_layers.items():
                    if now >= layer.due:
                        layer.due = now + layer.period
                        self._poll(name, layer)
        except BaseException as error:  # handed to the server, which ends with it
            self._on_end(error)
        finally:
            for layer in open_layers.values():
                layer.close()

    def _poll(self, name: str, layer: Layer) -> None:
        before = layer.fault
        try:
            for key, payload in layer.update():
                self._on_item(Item(name, key, payload))
        except OpenArmError as error:  # one message that can't be shown
            layer.fault = error.message
        if layer.fault != before:  # none: it is shown again
            text = json.dumps({"kind": "fault", "layer": name, "text": layer.fault})
            self._on_item(Item(name, f"fault:{name}", text))


def _said(answer: Any) -> tuple[bool, str]:
    """What a service says of a request: whether it was fulfilled, and a sentence."""
    return answer.success, answer.message
