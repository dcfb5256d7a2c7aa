# SPDX-License-Identifier: Apache-2.0
"""Messages of any type: plausible ones, and the same with values that no node should trust."""

from __future__ import annotations

import array
import copy
import random
from collections.abc import Iterator
from typing import Any

from openarm_bringup.messages import SEQUENCE, interface
from openarm_common.robot.description import RobotDescription

_ARM = RobotDescription.load().arm_joints("right")
#: Values of fields of these names that requests of the suite have; others are words or small numbers.
_SENSE: dict[str, tuple[Any, ...]] = {
    "arm": ("left", "right"),
    "frame_id": ("", "table", "openarm_body_link0"),
    "label": ("red", "blue"),
    "shape": ("box", "cylinder", "sphere", "mesh"),
    "color": ("red",),
    "named": ("home", "official_home"),
    "joint_names": (list(_ARM),),
    "name": (list(_ARM), "red", "camera_drop"),
    "positions": ([0.0, 2.0, 0.0, 1.2, 0.0, 0.0, 0.4],),
    "position": ([0.0, 2.0, 0.0, 1.2, 0.0, 0.0, 0.4], [0.02]),
    "joint_positions": ([0.0, 2.0, 0.0, 1.2, 0.0, 0.0, 0.4],),
    "velocities": ([],),
    "accelerations": ([],),
    "effort": ([],),
    "velocity": ([],),
    "start": ([],),
    "velocity_scale": (0.0, 0.5),
    "expected_scene_version": (0,),
    "phase": ("", "pick"),
    "plan_only": (True, False),
    "path": ("session.npz", "map.bt", "map.ot"),
    "scene": ("", "demo", "random"),
    "timeout": (0.0, 5.0),
    "w": (1.0,),
}
_WORDS = ("left", "right", "auto", "red", "box", "home", "table", "world", "all", "free", "occupied", "{}", "", "wrist")
_TEXTS = (
    "", " ", "x" * 1_000_000, "x" * 5000, "\n", "\x1b[2J\x1b]0;x\x07", "é\U0001f916\u202e", "%s%n", "../x",
    "~nosuchuser/x", "{a: &a [*a]}", "[" * 5000, "nan", "1e999", "no_such_frame", "a\nb",
)  # fmt: skip
_FLOATS = (
    float("nan"), float("inf"), float("-inf"), 1e308, -1e308, 1e-320, 0.0, -0.0, -1.0, 1.0, 1e6, 1e-9, 3.4e38, 1e18,
)  # fmt: skip
_LENGTHS = (0, 1, 2, 3, 7, 100, 10_000)
#: A list that is made longer takes no more, bytes: more is refused by the sender's own middleware.
_MOST = 32_000_000


def plausible(kind: Any, rng: random.Random, depth: int = 0) -> Any:
    """Make a message of a type whose fields have values of the right order, and words that mean something."""
    message = kind()
    for name, field in kind.get_fields_and_field_types().items():
        present = getattr(message, name)
        fitting = [
            v for v in _SENSE.get(name, ()) if type(v) is type(present) or (type(v), field[:8]) == (list, "sequence")
        ]
        value = copy.copy(rng.choice(fitting)) if fitting else _value(present, field, rng, depth)
        setattr(message, name, value)
    return message


def _value(present: Any, kind: str, rng: random.Random, depth: int) -> Any:
    match = SEQUENCE.match(kind)
    if match is not None:
        count = int(match["size"]) if match["size"] else rng.choice((0, 1, 2, 7)) if depth < 4 else 0
        inner = match["of"] or match["array"]
        if inner in ("uint8", "octet"):
            return array.array("B", bytes(count)) if inner == "uint8" else [b"\0"] * count
        return [_value(None, inner, rng, depth + 1) for _ in range(min(count, int(match["most"] or count)))]
    if "/" in kind:
        package, _, short = kind.partition("/")
        return plausible(interface(f"{package}/msg/{short}"), rng, depth + 1)
    if kind.startswith(("string", "wstring")):
        return rng.choice(_WORDS)
    if kind in ("float", "double"):
        return rng.choice((0.0, 0.1, 0.3, 1.0, rng.uniform(-1.0, 1.0)))
    if kind == "boolean":
        return rng.random() < 0.5
    return (
        present
        if kind == "octet" and present is not None
        else b"\0"
        if kind == "octet"
        else rng.choice((0, 0, 1, 2, 3))
    )


def hostile(sound: Any, rng: random.Random) -> Any:
    """Return a copy of a message with some of its fields replaced by hostile values of their type."""
    message = copy.deepcopy(sound)
    for _ in range(rng.choice((1, 1, 2, 4))):
        places = list(_fields(message))
        if places:
            owner, name, kind = rng.choice(places)
            setattr(owner, name, _bad(getattr(owner, name), kind, rng))
    return message


def _fields(message: Any) -> Iterator[tuple[Any, str, str]]:
    """Every field of a message and of those in it, the latter of sequences by their first and last."""
    for name, kind in message.get_fields_and_field_types().items():
        yield message, name, kind
        value = getattr(message, name)
        inner = [value[0], value[-1]] if isinstance(value, list) and value else [value]
        for one in inner:
            if hasattr(one, "get_fields_and_field_types"):
                yield from _fields(one)


def _weight(value: Any) -> int:
    """Bytes of a value, about."""
    if isinstance(value, str):
        return len(value)
    if hasattr(value, "get_fields_and_field_types"):
        return sum(_weight(getattr(value, name)) for name in value.get_fields_and_field_types())
    if isinstance(value, list) and value and not isinstance(value[0], int | float):
        return sum(map(_weight, value))
    return 8 * len(value) if hasattr(value, "__len__") else 8


def _bad(present: Any, kind: str, rng: random.Random) -> Any:
    match = SEQUENCE.match(kind)
    if match is not None:
        inner, values = match["of"] or match["array"], list(present)
        if match["size"]:
            return [_bad(value, inner, rng) if rng.random() < 0.5 else value for value in values]
        way = rng.randrange(4)
        if way == 0:
            values = values[:-1] if len(values) < 1000 else values[: rng.choice((0, 1, len(values) - 1))]
        elif way == 1:
            values = values * 2
        elif way == 2 and values and len(values) < 1000:
            at = rng.randrange(len(values))
            values[at] = _bad(copy.deepcopy(values[at]), inner, rng)
        else:
            one = values[0] if values else _value(None, inner, rng, 3)
            count = rng.choice(_LENGTHS) if "/" not in inner else rng.choice(_LENGTHS[:6])
            values = [one] * min(count, _MOST // (1 + _weight(one)))
        values = values[: int(match["most"] or len(values))]
        return array.array("B", values) if inner == "uint8" else values
    if "/" in kind:
        return hostile(present, rng) if rng.random() < 0.5 else type(present)()
    if kind.startswith(("string", "wstring")):
        return rng.choice(_TEXTS)
    if kind == "double":
        return rng.choice(_FLOATS)
    if kind == "float":
        return rng.choice(
            [value for value in _FLOATS if value != value or abs(value) < 3.5e38 or abs(value) == float("inf")]
        )
    if kind == "boolean":
        return not present
    if kind == "octet":
        return bytes([rng.choice((0, 1, 255))])
    bits = int(kind.lstrip("uint"))
    low, high = (0, 2**bits - 1) if kind[0] == "u" else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return rng.choice((low, high, 0, 1, high // 2, max(low, -1), min(high, 480), min(high, 10**9)))
