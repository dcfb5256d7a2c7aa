# SPDX-License-Identifier: Apache-2.0
"""The executor of the bridge in lock-step: steps the world, publishes /sim/tick, and waits for every /sim/ack.

All in one thread. A tick that carries a camera frame, or at which commands are due, is a barrier: time stands still
until each participant has handled everything that was sent up to it and has said what it sent itself. Only then does
the bridge handle what was sent to it, in an order that does not depend on arrival, and goes on.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

from openarm_interfaces.msg import SimAck, SimTick

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import ns_to_stamp
from openarm_common.ros.lockstep import check_senders
from openarm_common.ros.lockstep_executor import LockstepExecutor, channels_msg, missing_of, receives_of
from openarm_common.ros.lockstep_node import ACK_TOPIC, QOS_TICK, TICK_TOPIC, LockstepNode
from openarm_sim_bridge.config import BarrierConfig
from openarm_sim_bridge.pacing import RateDivider

if TYPE_CHECKING:
    from openarm_sim_bridge.cameras.camera_feed import CameraFeed
    from openarm_sim_bridge.simulation import Simulation

_CAMERAS = "mujoco_cameras"
_GATHER_S = 0.1
_TELL_S = 5.0


class LeadExecutor(LockstepExecutor):
    """Leads a lock-step.

    Args:
        node: The bridge.
        simulation: Steps; driven.
        images: The process that draws, if there is one.
        config: Participants and patience.
    """

    def __init__(
        self, node: LockstepNode, simulation: Simulation, images: CameraFeed | None, config: BarrierConfig
    ) -> None:
        super().__init__(node)
        self._simulation = simulation
        self._images = images
        self._config = config
        self._commands = RateDivider(config.command_rate)
        self._ticks = node.create_publisher(SimTick, TICK_TOPIC, QOS_TICK)
        node.create_subscription(SimAck, ACK_TOPIC, self._on_ack, QOS_TICK)
        self._sequence = 0
        self._acks: dict[str, SimAck] = {}
        self._sent: dict[str, int] = {}
        self._told: dict[str, int] = {}
        self._receivers: dict[str, int] = {}
        self._mine = receives_of(node)
        self._tell_at = time.monotonic() + _TELL_S

    @property
    def begun(self) -> bool:
        """Whether all participants were there and simulated time goes on."""
        return self._sequence > 0

    def spin(self) -> None:
        """Gather the participants, then step until shutdown.

        Raises:
            OpenArmError: CONFIG_INVALID, when two send on one channel; TIMEOUT, naming who did not answer a tick.
        """
        while self._context.ok() and not self._is_shutdown:
            if self.begun:
                self._advance()
            else:
                self._gather()

    # --- before the first tick
    def _gather(self) -> None:
        known = {name: ack for name, ack in self._acks.items() if name in self._config.participants}
        complete = len(known) == len(self._config.participants)
        if complete and not self._receivers:
            self._connect(known)
        waiting = self._waiting(known)
        if not waiting:
            self._sent |= self._sent_here()
            self._barrier()
            self.node.get_logger().info(f"lock-step of {', '.join(known) or 'nobody else'} begins")
            return
        if time.monotonic() > self._tell_at:
            self._tell_at += _TELL_S
            text = "; ".join(f"{name}: {what}" for name, what in waiting.items())
            self.node.get_logger().warning(f"the lock-step waits for {text}")
        self._simulation.tell()
        channels = channels_msg(dict.fromkeys(self._receivers, 0), self._receivers)  # none until all are there
        self._ticks.publish(SimTick(stamp=ns_to_stamp(self._simulation.world.t_ns), channels=channels))
        until = time.monotonic() + _GATHER_S
        while (left := until - time.monotonic()) > 0.0:
            self.spin_once(timeout_sec=left)

    def _connect(self, acks: Mapping[str, SimAck]) -> None:
        """Work out who sends what to whom."""
        senders: dict[str, dict[str, int]] = {self.node.get_name(): dict(self.books.sent)}
        if self._images is not None:
            senders[_CAMERAS] = dict(self._images.report.sent)
        receives: dict[str, frozenset[str]] = {self.node.get_name(): frozenset(self._mine)}
        for name, ack in acks.items():
            senders[name] = {item.name: item.sent for item in ack.sends}
            receives[name] = frozenset(ack.receives)
        check_senders(senders, receives)
        sent: dict[str, int] = {}
        for channels in senders.values():
            sent |= channels
        self._receivers = {name: sum(name in names for names in receives.values()) for name in sent}
        self._sent = {name: count for name, count in sent.items() if self._receivers[name]}
        self._acks.clear()

    def _waiting(self, known: Mapping[str, SimAck]) -> dict[str, str]:
        """What every participant (and the bridge) still waits for."""
        waiting = {name: "to be started" for name in self._config.participants if name not in known}
        waiting |= {name: ack.missing for name, ack in known.items() if ack.missing}
        if not self._receivers:
            return waiting or {self.node.get_name(): "a first look at the others"}
        channels = {item.name: item for item in channels_msg(self._sent, self._receivers)}
        if here := missing_of(self, channels):
            waiting[self.node.get_name()] = here
        if self._images is not None:
            listeners = self._images.report.listeners
            deaf = [name for name, n in listeners.items() if n < self._receivers.get(name, 0)]
            if deaf:
                waiting[_CAMERAS] = f"listeners of {', '.join(deaf)}"
        return waiting

    # --- ticks
    def _advance(self) -> None:
        simulation, before = self._simulation, self._simulation.ticks
        wait_s = simulation.turn()
        self.settle()
        if simulation.ticks != before:
            drawn = self._images is not None and self._images.finish(self._config.timeout)
            if self._commands.due(simulation.world.t_ns) or drawn:
                self._barrier()
            return
        self.spin_once(timeout_sec=wait_s)
        if simulation.paused or simulation.fault:
            self.handle(simulation.world.t_ns, self._due())  # of those who take no part: a reset, a step

    def _barrier(self) -> None:
        """Publish a tick, wait for everybody, and handle what came."""
        self._sequence += 1
        self._sent |= self._sent_here()
        fresh = {name: n for name, n in self._sent.items() if self._sequence == 1 or n != self._told.get(name, 0)}
        self._told |= fresh
        t_ns = self._simulation.world.t_ns
        self._acks.clear()
        self._ticks.publish(
            SimTick(sequence=self._sequence, stamp=ns_to_stamp(t_ns), channels=channels_msg(fresh, self._receivers))
        )
        deadline = time.monotonic() + self._config.timeout
        while late := [name for name in self._config.participants if name not in self._acks]:
            self._wait(deadline, f"{' and '.join(late)} did not answer")
        for ack in self._acks.values():
            self._sent |= {item.name: item.sent for item in ack.sends if self._receivers.get(item.name)}
        due = self._due()
        if self._sequence == 1:
            self.inbox.begin(due, self.books.latched.__contains__)
        while missing := self.inbox.missing(due):
            self._wait(deadline, f"messages that were sent did not come, on {', '.join(missing)}, at")
        self.handle(t_ns, due)

    def _wait(self, deadline: float, what: str) -> None:
        left_s = deadline - time.monotonic()
        if left_s <= 0.0:
            t_s = self._simulation.world.t_ns * 1e-9
            raise OpenArmError(
                Code.TIMEOUT,
                f"{what} tick {self._sequence} ({t_s:.3f} s) within {self._config.timeout:g} s; the run ends, because"
                " going on without would not be the same run. See the node's log",
            )
        self.spin_once(timeout_sec=left_s)

    def _due(self) -> dict[str, int]:
        return {name: n for name, n in self._sent.items() if name in self._mine}

    def _sent_here(self) -> dict[str, int]:
        """What this process and the one that draws have sent to participants."""
        sent = dict(self.books.sent)
        if self._images is not None:
            sent |= self._images.report.sent
        return {name: n for name, n in sent.items() if self._receivers.get(name)}

    def _on_ack(self, ack: SimAck) -> None:
        if ack.sequence == self._sequence:
            self._acks[ack.node] = ack
