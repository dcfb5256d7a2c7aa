# SPDX-License-Identifier: Apache-2.0
"""Messages of a bag, deserialised."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rclpy.serialization import deserialize_message

from openarm_bringup.bags.bag import Bag
from openarm_bringup.messages import interface


def messages_of(bag: Bag, topics: Iterable[str]) -> dict[str, list[Any]]:
    """Return the messages of each topic, in the order in which they were received; none of a topic that is missing."""
    found: dict[str, list[Any]] = {topic: [] for topic in topics}
    for record in bag.records(list(found)):
        found[record.topic].append(deserialize_message(record.data, interface(record.type)))
    return found
