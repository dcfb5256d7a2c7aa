# SPDX-License-Identifier: Apache-2.0
"""Messages of a bag, deserialised."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message

from openarm_bringup.bags.bag import Bag, Record, damaged
from openarm_bringup.bags.storage import DAMAGE
from openarm_bringup.messages import interface
from openarm_common.errors import Code, OpenArmError

#: Some writers fill up a message to a multiple of 4 bytes.
_PADDING = 3


def no_message(bag: Bag, record: Record) -> OpenArmError:
    """Return the error of a record whose bytes are not of its type."""
    return OpenArmError(
        Code.INVALID_ARGUMENT,
        f"{bag.path} has a message of {record.topic} at {record.t_ns} ns that is no {record.type}"
        f" ({len(record.data)} bytes); the bag is damaged",
    )


def message_of(bag: Bag, record: Record) -> Any:
    """Return the message of a record.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when its bytes are not of its type.
    """
    try:
        message = deserialize_message(record.data, interface(record.type))
    except OpenArmError:
        raise
    # rclpy raises types of its own, and those of the middleware's parser
    except Exception as error:
        raise _changed(bag, record) or no_message(bag, record) from error
    # bytes of other fields may make a message, too, but not all of them
    changed = _changed(bag, record)
    if changed and abs(len(serialize_message(message)) - len(record.data)) > _PADDING:
        raise changed
    return message


def _changed(bag: Bag, record: Record) -> OpenArmError | None:
    """Return the error of a record whose type has other fields than the installed one."""
    why = bag.why_not(record.topic)
    text = f"{bag.path}: {why}; read it with the version that made it"
    return OpenArmError(Code.INVALID_ARGUMENT, text) if why else None


def messages_of(bag: Bag, topics: Iterable[str]) -> dict[str, list[Any]]:
    """Return the messages of each topic, in the order in which they were received; none of a topic that is missing.

    Raises:
        OpenArmError: INVALID_ARGUMENT, as `message_of`.
    """
    found: dict[str, list[Any]] = {topic: [] for topic in topics}
    for record in bag.records(list(found)):
        found[record.topic].append(message_of(bag, record))
    return found


@contextmanager
def contents(bag: Bag) -> Iterator[None]:
    """Turn what reading the fields of a damaged message ends in into one sentence.

    Raises:
        OpenArmError: INVALID_ARGUMENT.
    """
    try:
        yield
    except DAMAGE as error:
        raise damaged(bag.path, error) from error
