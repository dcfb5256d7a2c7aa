# SPDX-License-Identifier: Apache-2.0
"""Text of message definitions (`ros2msg`), made from the installed Python classes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg

from openarm_bringup.bags.storage import DAMAGE
from openarm_bringup.messages import interface
from openarm_common.fields import SEQUENCE

_LINE = "=" * 80
_EVENT = "_Event"
#: Definitions that are longer are not parsed, characters.
_LONGEST = 200_000
_PRIMITIVES = {"float": "float32", "double": "float64", "boolean": "bool", "octet": "byte"}


def definition(message: type[Any]) -> str:
    """Return the text of a message's definition, from its Python class.

    Args:
        message: A class that rosidl generated.
    """
    lines = [f"{_ros_type(kind)} {name}" for name, kind in message.get_fields_and_field_types().items()]
    return "\n".join([*_constants(message), *lines]) + "\n"


def _ros_type(kind: str) -> str:
    match = SEQUENCE.match(kind)
    if match is None:
        return _PRIMITIVES.get(kind, kind)
    if match["array"]:
        return f"{_ros_type(match['array'])}[{match['size']}]"
    return f"{_ros_type(match['of'])}[{'<=' + match['most'] if match['most'] else ''}]"


def _constants(message: type[Any]) -> list[str]:
    # rosidl keeps them on the metaclass, without their type; the hash of a type does not hold constants.
    values: Mapping[str, Any] = getattr(type(message), f"_{type(message).__name__}__constants", {})
    kinds = {bool: "bool", int: "int64", float: "float64", str: "string", bytes: "byte"}
    return [f"{kinds[type(value)]} {name}={value!r}" for name, value in values.items() if type(value) in kinds]


def nested_types(message: type[Any]) -> list[str]:
    """Names, such as `std_msgs/msg/Header`, of the types of a message's fields that are messages themselves."""
    found: list[str] = []
    for kind in message.get_fields_and_field_types().values():
        match = SEQUENCE.match(kind)
        base = (match["of"] or match["array"]) if match else kind
        if "/" in base:
            package, _, short = base.partition("/")
            # those of a service or an action have an underscore, and are next to what they are in
            of = message.__module__.split(".")[1] if "_" in short else "msg"
            found.append(f"{package}/{of}/{short.removeprefix('msg/')}")
    return found


def is_event(kind: str) -> bool:
    """Whether a type is that of the events of a service (`std_srvs/srv/SetBool_Event`)."""
    return "/srv/" in kind and kind.endswith(_EVENT)


def event_definition(kind: str) -> str:
    """Return the text that rosbag2 keeps for the events of a service: its request and response.

    Args:
        kind: Kind, same as for `is_event`; installed.
    """
    service = interface(kind.removesuffix(_EVENT))
    request, response = definition(service.Request), definition(service.Response)
    nested = _nested([*nested_types(service.Request), *nested_types(service.Response)])
    return f"{_LINE}\nSRV: {kind.removesuffix(_EVENT)}\n{request}---\n{response}{nested}"


def full_definition(message: type[Any]) -> str:
    """The definition of a message, followed by those of the types in it, each once.

    Args:
        message: A class that rosidl generated: of a message, or of the request or response of a service.
    """
    return definition(message) + _nested(nested_types(message))


def _nested(waiting: list[str]) -> str:
    """The definitions of types, and of those in them, each once."""
    parts, seen = list[str](), set[str]()
    while waiting:
        name = waiting.pop(0)
        if name in seen:
            continue
        seen.add(name)
        kind = interface(name)
        parts.append(f"{_LINE}\nMSG: {name.replace('/msg/', '/')}\n{definition(kind)}")
        waiting += nested_types(kind)
    return "".join(parts)


def changed_type(recorded: MessageDefinition, kind: str) -> str:
    """Return the first type whose fields are not those of the installed one; empty where all are, or none is known.

    Constants are left out of it: they are not in the bytes of a message.

    Args:
        recorded: Definition that the bag has.
        kind: Kind of the messages, such as `sensor_msgs/msg/Image`; installed.
    """
    if len(recorded.data) > _LONGEST:
        return kind
    if recorded.format is MessageDefinitionFormat.NONE or not recorded.data.strip():
        return ""
    msg = recorded.format is MessageDefinitionFormat.MSG
    if is_event(kind) and msg:
        service = interface(kind.removesuffix(_EVENT))
        parts = zip(_halves(recorded.data), (service.Request, service.Response), strict=True)
    else:
        parts = [(recorded.data, interface(kind))]
    for text, message in parts:
        try:
            theirs = get_types_from_msg(text, kind) if msg else get_types_from_idl(text)
        except (TypesysError, *DAMAGE):
            return kind
        ours = get_types_from_msg(full_definition(message), kind)
        for name, (_, fields) in ours.items():
            if theirs.get(name, ((), ()))[1] != fields:
                return name
    return ""


def _halves(text: str) -> tuple[str, str]:
    """The request and the response of a service's definition, each with the types in both."""
    service, line, nested = re.sub(rf"\A{_LINE}\nSRV: .*\n", "", text).partition(_LINE)
    request, _, response = f"\n{service}".partition("\n---")
    return f"{request}\n{line}{nested}", f"{response}\n{line}{nested}"
