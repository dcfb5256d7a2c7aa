# SPDX-License-Identifier: Apache-2.0
"""Requests in words: "red cube left of the can", "the largest box", "anything blue nearest to the left cylinder".

A request is attributes (colour, shape, size, side) of one object, and its relation to another that is described in the
same way. Sides are those of the robot's view: left is +y of the base frame, right -y, behind +x, in front -x.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from openarm_common.detection import Detection
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


@dataclass(frozen=True)
class Request:
    """What is asked for: words of the object, and the relation to the object of another request."""

    words: tuple[str, ...]
    relation: str = ""
    other: Request | None = None


_CHOICES: Mapping[str, Callable[[Detection], float]] = {
    "largest": lambda one: -float(np.prod(one.size)),
    "biggest": lambda one: -float(np.prod(one.size)),
    "smallest": lambda one: float(np.prod(one.size)),
    "tallest": lambda one: -one.size[2],
    "lowest": lambda one: one.size[2],
    "leftmost": lambda one: -float(one.p_base[1]),
    "left": lambda one: -float(one.p_base[1]),
    "rightmost": lambda one: float(one.p_base[1]),
    "right": lambda one: float(one.p_base[1]),
    "nearest": lambda one: float(np.hypot(*one.p_base[:2])),
    "farthest": lambda one: -float(np.hypot(*one.p_base[:2])),
}


def parse(text: str, labels: Sequence[str]) -> Request:
    """Read a request.

    Args:
        text: Words; relations may follow each other.
        labels: Colours and classes that the detector gives.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the word that is not known, and those that are.
    """
    spoken = " ".join(re.findall(r"[a-z0-9_]+", text.lower())).replace("closest", "nearest")
    spoken = spoken.replace("to the left of", "left of")
    spoken = spoken.replace("to the right of", "right of")
    match = re.search(rf"\b({'|'.join(_RELATIONS)})\b", spoken)
    head, relation, tail = (spoken[: match.start()], match[1], spoken[match.end() :]) if match else (spoken, "", "")
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


def resolve(request: Request, detections: Sequence[Detection]) -> Detection:
    """Return the object that is asked for: of those that fit, the nearest to the other one, else the most certain.

    Raises:
        OpenArmError: NOTHING_DETECTED, naming what fits no object, and the objects that there are.
    """
    return _select(request, detections)[0]


def _select(request: Request, detections: Sequence[Detection]) -> list[Detection]:
    """Return what fits, best first; never empty."""
    fitting = sorted((one for one in detections if _fits(one, request.words)), key=lambda one: -one.score)
    if request.other is not None:
        others = _select(request.other, detections)
        reach = {id(one): _reach(one, others, _RELATIONS[request.relation]) for one in fitting}
        fitting = sorted((t for t in fitting if math.isfinite(reach[id(t)])), key=lambda one: reach[id(one)])
    for word in request.words:
        if word in _CHOICES:
            fitting.sort(key=_CHOICES[word])
    if not fitting:
        there = ", ".join(f"{t.label} {t.kind}".strip() for t in detections) or "nothing"
        asked = " ".join(request.words) + (f" {request.relation} …" if request.relation else "")
        raise OpenArmError(Code.NOTHING_DETECTED, f"no object is {asked!r}; in view: {there}")
    return fitting


def _reach(one: Detection, others: Sequence[Detection], side: tuple[float, float] | None) -> float:
    """Return the distance to the nearest of the others in the relation, m; infinite without one."""
    best = math.inf
    for other in others:
        step = (one.p_base - other.p_base)[:2]
        distance = float(np.linalg.norm(step))
        # more to that side than to any other
        if one is not other and (side is None or float(step @ side) >= math.cos(math.pi / 4.0) * distance):
            best = min(best, distance)
    return best


def _fits(one: Detection, words: Sequence[str]) -> bool:
    for word in words:
        if word in SHAPE_WORDS:
            if one.kind not in SHAPE_WORDS[word] and one.label != word:
                return False
        elif word not in ANY_WORDS and word not in _CHOICES and word not in (one.label, one.kind):
            return False
    return True
