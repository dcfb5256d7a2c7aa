# SPDX-License-Identifier: Apache-2.0
"""Announcement of who holds which arm, on /arm_holds: a holder repeats it, and its goals begin with its key.

Whoever executes motions of an arm asks `HoldListener.check`. This keeps clients from disturbing each other; it keeps
nobody out who wants to.
"""

from __future__ import annotations

import os
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from unique_identifier_msgs.msg import UUID

from openarm_common.robot.holds import KEY_BYTES, LEASE, ArmHolds
from openarm_common.ros.node import BaseNode, reliable, until_shutdown

#: Where holds are announced: `hardware_id` is the key, hexadecimal; `name` the holder; the keys of `values` the arms.
TOPIC = "/arm_holds"
_DEPTH = 10
#: Longest name of a holder that is shown.
_LONGEST = 120


class Holder:
    """Announces what one client of the arms holds.

    Args:
        node: Node of the client.
    """

    def __init__(self, node: BaseNode[Any]) -> None:
        self._key = os.urandom(KEY_BYTES)
        self._context = node.context
        self._publisher = node.create_publisher(DiagnosticStatus, TOPIC, reliable(_DEPTH))
        self._arms: list[str] = []
        #: What others read when they are refused.
        self.name = ""
        self._timer = node.create_timer(LEASE / 5.0, self._publish, clock=node.steady_clock, autostart=False)

    def hold(self, arm: str) -> None:
        """Hold an arm, too."""
        if arm not in self._arms:
            self._arms.append(arm)
            self._timer.reset()
            self._publish()

    def release(self) -> None:
        """Hold no arm any more."""
        if self._arms:
            self._arms = []
            self._timer.cancel()
            self._publish()

    def goal_id(self) -> UUID:
        """A new id for a goal of this holder."""
        return _goal_id(self._key)

    def _publish(self) -> None:
        values = [KeyValue(key=arm) for arm in self._arms]
        with until_shutdown(self._context):
            self._publisher.publish(DiagnosticStatus(name=self.name, hardware_id=self._key.hex(), values=values))


class HoldListener:
    """Hears which arms are held; methods as `ArmHolds`.

    Args:
        node: Node of what executes motions.
    """

    def __init__(self, node: BaseNode[Any]) -> None:
        self._holds = ArmHolds()
        #: First bytes of the last goal of each arm that was not refused.
        self._served: dict[str, bytes] = {}
        node.create_subscription(DiagnosticStatus, TOPIC, self._on_hold, reliable(_DEPTH))

    @property
    def refused(self) -> int:
        """Goals and commands that were refused."""
        return self._holds.refused

    def check(self, arm: str, goal_id: bytes = b"") -> None:
        """Refuse what does not come from the one that holds the arm.

        Raises:
            OpenArmError: BUSY, naming the holder.
        """
        self._holds.check(arm, goal_id, time.monotonic())
        self._served[arm] = goal_id[:KEY_BYTES]

    def goal_id(self, arm: str) -> UUID:
        """A new id for a goal that serves the one that holds the arm, or whose goal was checked last.

        The announcement of a hold may arrive later than a goal of its holder, and elsewhere earlier than here.
        """
        return _goal_id(self._holds.key_of(arm, time.monotonic()) or self._served.get(arm, b""))

    def _on_hold(self, message: DiagnosticStatus) -> None:
        try:
            key = bytes.fromhex(message.hardware_id)
        except ValueError:
            return
        if len(key) == KEY_BYTES:
            who = message.name[:_LONGEST].encode("unicode_escape").decode()
            arms = [value.key for value in message.values[:_DEPTH]]
            self._holds.announce(key, who or "another client", arms, time.monotonic())


def _goal_id(key: bytes) -> UUID:
    return UUID(uuid=list((key + os.urandom(2 * KEY_BYTES))[: 2 * KEY_BYTES]))
