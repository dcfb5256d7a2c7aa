# SPDX-License-Identifier: Apache-2.0
"""Requests in words: "red cube left of the can", "the largest box", "anything blue nearest to the left cylinder".

A request is attributes (colour, shape, size, side) of one object, and how it stands to another that is told of in the
same way. Sides are those of the robot's view: left is +y of the base frame, right -y, behind +x, in front -x.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code, OpenArmError

#: Words for shapes, and the kinds that each fits.
SHAPE_WORDS: Mapping[str, frozenset[str]] = {
    "box": frozenset({"box", "cube"}),
    "block": frozenset({"box", "cube"}),
    "cube": frozenset({"cube"}),
    "cylinder": frozenset({"cylinder", "can"}),
    "can": frozenset({"can"}),
    "sphere": frozenset({"sphere"}),
    "ball": frozenset({"sphere"}),
}
ANY_WORDS = frozenset({"object", "thing", "one", "anything"})
_FILLERS = frozenset({"the", "a", "an", "is", "that", "pick", "grasp", "take", "up", "me", "please"})
_RELATIONS = {
    "left of": (0.0, 1.0),
    "right of": (0.0, -1.0),
    "in front of": (-1.0, 0.0),
    "behind": (1.0, 0.0),
    "next to": None,
    "beside": None,
    "nearest to": None,
}
#: A cube is a box whose edges differ by less; a can is a cylinder at least this many times as tall as wide.
CUBE_RATIO, CAN_RATIO = 1.15, 1.5


@dataclass(frozen=True)
class Thing:
    """An object to choose from: label (its colour, or its class), kind, position (3,), m, extents, m, and score."""

    label: str
    kind: str
    position: NDArray[np.float64]
    size: tuple[float, float, float]
    score: float


@dataclass(frozen=True)
class Request:
    """What is asked for: words of the object, and the relation to the object of another request."""

    words: tuple[str, ...]
    relation: str = ""
    other: Request | None = None


def kind_of(shape: str, size: tuple[float, float, float]) -> str:
    """The name for a shape (box, cylinder, sphere) of measured extents, m, the last the height: also cube or can."""
    if shape == "box":
        return "cube" if max(size) <= CUBE_RATIO * min(size) else "box"
    if shape == "cylinder":
        return "can" if size[2] >= CAN_RATIO * max(size[:2]) else "cylinder"
    return shape


_CHOICES: Mapping[str, Callable[[Thing], float]] = {
    "largest": lambda thing: -float(np.prod(thing.size)),
    "biggest": lambda thing: -float(np.prod(thing.size)),
    "smallest": lambda thing: float(np.prod(thing.size)),
    "tallest": lambda thing: -thing.size[2],
    "lowest": lambda thing: thing.size[2],
    "leftmost": lambda thing: -float(thing.position[1]),
    "left": lambda thing: -float(thing.position[1]),
    "rightmost": lambda thing: float(thing.position[1]),
    "right": lambda thing: float(thing.position[1]),
    "nearest": lambda thing: float(np.hypot(*thing.position[:2])),
    "farthest": lambda thing: -float(np.hypot(*thing.position[:2])),
}


def parse(text: str, labels: Sequence[str]) -> Request:
    """Read a request.

    Args:
        text: Words; relations may follow each other.
        labels: Colours and classes that the detector gives.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the word that is not known, and those that are.
    """
    told = " ".join(re.findall(r"[a-z0-9_]+", text.lower())).replace("closest", "nearest")
    told = told.replace("to the left of", "left of")
    told = told.replace("to the right of", "right of")
    match = re.search(rf"\b({'|'.join(_RELATIONS)})\b", told)
    head, relation, tail = (told[: match.start()], match[1], told[match.end() :]) if match else (told, "", "")
    words = tuple(word for word in head.split() if word not in _FILLERS)
    known = {*labels, *SHAPE_WORDS, *ANY_WORDS, *_CHOICES}
    for word in words:
        if word not in known:
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"{word!r} in {text!r} is not known; labels: {', '.join(labels)}; shapes: {', '.join(SHAPE_WORDS)};"
                f" choices: {', '.join(_CHOICES)}; relations: {', '.join(_RELATIONS)}",
            )
    if not words:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{text!r} names no object; expected words such as: red cube")
    return Request(words, relation, parse(tail, labels) if match else None)


def resolve(request: Request, things: Sequence[Thing]) -> Thing:
    """The object that is asked for: of those that fit, the nearest to the other one, else the most certain.

    Raises:
        OpenArmError: NOTHING_DETECTED, naming what fits no object, and the objects that there are.
    """
    return _select(request, things)[0]


def _select(request: Request, things: Sequence[Thing]) -> list[Thing]:
    """What fits, best first; never empty."""
    fitting = sorted((thing for thing in things if _fits(thing, request.words)), key=lambda thing: -thing.score)
    if request.other is not None:
        others = _select(request.other, things)
        reach = {id(thing): _reach(thing, others, _RELATIONS[request.relation]) for thing in fitting}
        fitting = sorted((t for t in fitting if math.isfinite(reach[id(t)])), key=lambda thing: reach[id(thing)])
    for word in request.words:
        if word in _CHOICES:
            fitting.sort(key=_CHOICES[word])
    if not fitting:
        there = ", ".join(f"{t.label} {t.kind}".strip() for t in things) or "nothing"
        asked = " ".join(request.words) + (f" {request.relation} …" if request.relation else "")
        raise OpenArmError(Code.NOTHING_DETECTED, f"no object is {asked!r}; in view: {there}")
    return fitting


def _reach(thing: Thing, others: Sequence[Thing], side: tuple[float, float] | None) -> float:
    """Distance to the nearest of the others to which it stands as asked, m; infinite without one."""
    best = math.inf
    for other in others:
        step = (thing.position - other.position)[:2]
        distance = float(np.linalg.norm(step))
        # more to that side than to any other
        if thing is not other and (side is None or float(step @ side) >= math.cos(math.pi / 4.0) * distance):
            best = min(best, distance)
    return best


def _fits(thing: Thing, words: Sequence[str]) -> bool:
    for word in words:
        if word in SHAPE_WORDS:
            if thing.kind not in SHAPE_WORDS[word] and thing.label != word:
                return False
        elif word not in ANY_WORDS and word not in _CHOICES and word not in (thing.label, thing.kind):
            return False
    return True
