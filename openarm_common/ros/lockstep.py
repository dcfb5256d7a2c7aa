# SPDX-License-Identifier: Apache-2.0
"""Lock-step without ROS: which message belongs to which tick, and in which order a tick is handled.

A *channel* is one way that messages take: a topic, or one direction of a service or an action. In lock-step each
channel has one sender, so its messages can be numbered from 1. A tick says up to which number each channel was used; a
receiver waits until it has all of them, handles them in an order that does not depend on when they arrived, and leaves
what comes later for the next tick.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from types import CoroutineType
    from typing import Any

Run: TypeAlias = "Callable[[], CoroutineType[Any, Any, None]]"

#: Later than any stamp: what has none (a request, an answer) is handled after the messages that have one.
_NO_STAMP = 2**63


@dataclass(frozen=True)
class Item:
    """A message that was received: its place in the order, and what handles it."""

    channel: str
    number: int
    stamp_ns: int | None
    run: Run

    @property
    def order(self) -> tuple[int, str, int]:
        """Messages of a tick are handled in this order."""
        return (_NO_STAMP if self.stamp_ns is None else self.stamp_ns, self.channel, self.number)


class Inbox:
    """Messages that were received and not yet handled."""

    def __init__(self) -> None:
        self._items: list[Item] = []
        self._heard: dict[str, int] = {}
        self._before: dict[str, int] = {}

    def add(self, channel: str, run: Run, number: int | None = None, stamp_ns: int | None = None) -> None:
        """Add a message.

        Args:
            channel: Where it came from.
            run: Handles it.
            number: As its sender counts, from 1; None: one after the last that came from there.
            stamp_ns: Of the message, if it has one.
        """
        if number is None:
            number = self._heard.get(channel, 0) + 1
        self._heard[channel] = max(number, self._heard.get(channel, 0))
        self._items.append(Item(channel, number, stamp_ns, run))

    def heard(self, channel: str) -> int:
        """Number of the last message that came from a channel, 0 before the first."""
        return self._heard.get(channel, 0)

    def missing(self, due: Mapping[str, int]) -> dict[str, int]:
        """Channels of `due` that have not come as far as that number."""
        return {channel: number for channel, number in due.items() if self.heard(channel) < number}

    def begin(self, due: Mapping[str, int], keep: Callable[[str], bool]) -> None:
        """Forget what was sent before the first tick, because not every receiver was there to hear it.

        Args:
            due: How far each channel was used by then.
            keep: Whether the sender keeps its last messages for late receivers.
        """
        for channel, number in due.items():
            if not keep(channel):
                self._heard[channel] = max(number, self.heard(channel))
        self._items = [item for item in self._items if keep(item.channel) or item.number > due.get(item.channel, 0)]

    def take(self, due: Mapping[str, int]) -> list[Item]:
        """Take what a tick has to handle, in order.

        From channels that `due` does not name, whose senders take no part, everything is taken that is there.

        Raises:
            OpenArmError: INTERNAL, when another sender than the one that takes part has used a channel.
        """
        for channel, number in self._before.items():
            if number > due.get(channel, number):
                raise OpenArmError(
                    Code.INTERNAL,
                    f"{number} messages came on {channel}, of which the lock-step's own sender sent {due[channel]};"
                    " in lock-step nobody else may use a channel that two participants share",
                )
        now = [item for item in self._items if item.number <= due.get(item.channel, item.number)]
        self._items = [item for item in self._items if item.number > due.get(item.channel, item.number)]
        return sorted(now, key=lambda item: item.order)

    def close_tick(self) -> None:
        """Remember what had come when a tick ended: the next tick must account for it."""
        self._before = dict(self._heard)


def check_senders(senders: Mapping[str, Mapping[str, int]], receives: Mapping[str, frozenset[str]]) -> None:
    """Refuse a lock-step in which two participants send on a channel that a third one takes from.

    Args:
        senders: Messages sent by participant and channel.
        receives: Channels that each participant takes from.

    Raises:
        OpenArmError: CONFIG_INVALID, naming channel and senders.
    """
    wanted = frozenset[str]().union(*receives.values())
    by_channel: dict[str, list[str]] = {}
    for node, channels in senders.items():
        for channel in channels:
            by_channel.setdefault(channel, []).append(node)
    for channel, nodes in sorted(by_channel.items()):
        if channel in wanted and len(nodes) > 1:
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"{' and '.join(sorted(nodes))} both send on {channel}; in lock-step a channel has one sender, so let"
                " one of them not take part, or remap a name",
            )
