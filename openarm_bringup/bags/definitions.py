# SPDX-License-Identifier: Apache-2.0
"""Message definitions with all that they are made of, as MCAP and Foxglove expect them (`ros2msg`)."""

from __future__ import annotations

from typing import Any

from openarm_bringup.bags.bag import definition, message_class, nested_types

_LINE = "=" * 80


def full_definition(message: type[Any]) -> str:
    """The definition of a message, followed by those of the types in it, each once.

    Args:
        message: A class that rosidl generated: of a message, or of the request or response of a service.
    """
    parts, waiting, seen = [definition(message)], nested_types(message), set[str]()
    while waiting:
        name = waiting.pop(0)
        if name in seen:
            continue
        seen.add(name)
        kind = message_class(name)
        parts.append(f"{_LINE}\nMSG: {name.replace('/msg/', '/')}\n{definition(kind)}")
        waiting += nested_types(kind)
    return "".join(parts)
