# SPDX-License-Identifier: Apache-2.0
"""Whatever field of a MoveIt message is set, it is honoured or refused by its name: over the message definitions."""

from __future__ import annotations

import array
import importlib
from collections.abc import Iterator
from typing import Any

import pytest
from moveit_msgs.action import ExecuteTrajectory, MoveGroup
from moveit_msgs.msg import AttachedCollisionObject, CollisionObject, MotionPlanRequest, PlanningScene
from moveit_msgs.srv import GetCartesianPath, GetPositionFK, GetPositionIK, GetStateValidity

from openarm_common.errors import OpenArmError
from openarm_motion.ros.move_group import fields

pytestmark = pytest.mark.requirement("R-28")

_HONOURED = {
    MotionPlanRequest: fields.PLAN,
    MoveGroup.Goal: fields.MOVE,
    ExecuteTrajectory.Goal: fields.EXECUTE,
    GetCartesianPath.Request: fields.CARTESIAN,
    GetPositionIK.Request: fields.IK,
    GetPositionFK.Request: fields.FK,
    GetStateValidity.Request: fields.VALIDITY,
    PlanningScene: fields.SCENE,
    CollisionObject: fields.OBJECT,
    AttachedCollisionObject: fields.ATTACHED,
}
_NUMBERS = {"double", "float"}


def _type(name: str) -> type | None:
    """The message type of a field, in a list or not; None for one that is no message."""
    package, _, kind = name.removeprefix("sequence<").split("[")[0].split("<")[0].rstrip(">").partition("/")
    kind = kind.split(",")[0]
    return getattr(importlib.import_module(f"{package}.msg"), kind) if kind else None


def _set(message: Any, prefix: str = "") -> Iterator[tuple[str, Any, str, Any]]:
    """Every field below a message: its path, its owner, its name, and a value that is not its default.

    The owner is in the message, with one element in each list on the way to it.
    """
    for name, kind in message.get_fields_and_field_types().items():
        path, inner = prefix + name, _type(kind)
        many = "[" in kind or kind.startswith("sequence<")
        if inner is None:
            yield path, message, name, _value(kind, getattr(message, name))
        elif many:
            yield path, message, name, [inner()]
            element = inner()
            for found in _set(element, f"{path}."):
                setattr(message, name, [element])
                yield found
                setattr(message, name, [])
        else:
            yield from _set(getattr(message, name), f"{path}.")


def _value(kind: str, default: Any) -> Any:
    if kind.startswith("sequence<") or "[" in kind:
        item = _value(kind.removeprefix("sequence<").split("[")[0].rstrip(">"), None)
        length = len(default) if default is not None and len(default) else 1
        typecode = getattr(default, "typecode", "")
        return array.array(typecode, [item] * length) if typecode else [item] * length
    if kind.startswith("string"):
        return "something"
    if kind == "boolean":
        return not default
    if kind == "octet":
        return b"\x03"
    return 0.25 if kind in _NUMBERS else 3


def _covered(path: str, honoured: tuple[str, ...]) -> bool:
    parts = path.split(".")
    prefixes = {".".join(parts[:k]) + ".*" for k in range(1, len(parts) + 1)}
    return path in honoured or bool(prefixes & set(honoured))


def _leads(path: str, honoured: tuple[str, ...]) -> bool:
    """Whether fields below a path are honoured: an empty element of that list asks nothing."""
    return any(known.startswith(f"{path}.") for known in honoured)


def _refusal(message: Any, honoured: tuple[str, ...]) -> str:
    try:
        fields.check_fields(message, honoured, "message")
    except OpenArmError as error:
        return error.message
    return ""


@pytest.mark.parametrize("kind", _HONOURED, ids=lambda kind: kind.__name__)
def test_every_field_that_is_set_is_honoured_or_refused_by_name(kind: type) -> None:
    honoured, seen, refused = _HONOURED[kind], 0, 0
    message = kind()
    assert _refusal(message, honoured) == ""
    for path, owner, name, value in _set(message):
        before = getattr(owner, name)
        setattr(owner, name, value)
        said = _refusal(message, honoured)
        setattr(owner, name, before)
        seen += 1
        if _covered(path, honoured) or _leads(path, honoured):
            assert said == "", path
        else:
            refused += 1
            assert f"field {path}" in said or any(f"field {path[:k]} " in said for k in range(len(path))), (path, said)
    assert seen > 10
    assert refused > 0


@pytest.mark.parametrize("kind", _HONOURED, ids=lambda kind: kind.__name__)
def test_what_is_honoured_exists(kind: type) -> None:
    paths = {path for path, *_ in _set(kind())}
    for known in _HONOURED[kind]:
        stem = known.removesuffix(".*")
        assert any(path == stem or path.startswith(f"{stem}.") for path in paths), known
