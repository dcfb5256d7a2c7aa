# SPDX-License-Identifier: Apache-2.0
"""Which objects a request in words means: "cola", "red can", "the largest box", "red cube left of the can".

Each word must be an attribute of the object (its name, colour or shape), or choose among those that fit; a relation
compares it with another object that is described in the same way. No word is known beforehand: the attributes of what
is in view are the vocabulary. The easiest object lies under nothing, has room around it, and is seen surely. Capitals
and punctuation make no difference. Sides are those of the robot's view: left is +y of the base frame, right -y, behind
+x, in front -x.
"""

from __future__ import annotations

import math
import string
import unicodedata
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from openarm_common.detection import Described, Detection, gap
from openarm_common.errors import Code, OpenArmError

Words = tuple[str, ...]

_ALSO = {"box": "block", "sphere": "ball"}
_ANY = frozenset({"object", "thing", "one", "anything"})
_FILLERS = frozenset({"the", "a", "an", "is", "that", "pick", "grasp", "take", "up", "me", "please"})
_RELATIONS: Mapping[Words, tuple[float, float] | None] = {
    ("left", "of"): (0.0, 1.0),
    ("to", "the", "left", "of"): (0.0, 1.0),
    ("right", "of"): (0.0, -1.0),
    ("to", "the", "right", "of"): (0.0, -1.0),
    ("in", "front", "of"): (-1.0, 0.0),
    ("behind",): (1.0, 0.0),
    ("next", "to"): None,
    ("beside",): None,
    ("nearest", "to"): None,
    ("closest", "to"): None,
}
#: Chooses what needs the least to be taken; or, of those that need about so little, the outermost on a side.
EASIEST, EASIEST_LEFT, EASIEST_RIGHT = "easiest", "easiest_left", "easiest_right"
_CHOICES: Mapping[str, Callable[[Detection, Sequence[Detection]], float | tuple[float, float]]] = {
    EASIEST: lambda one, others: _trouble(one, others),
    EASIEST_LEFT: lambda one, others: (round(_trouble(one, others)), -float(one.p_base[1])),
    EASIEST_RIGHT: lambda one, others: (round(_trouble(one, others)), float(one.p_base[1])),
    "largest": lambda one, _: -float(np.prod(one.size)),
    "biggest": lambda one, _: -float(np.prod(one.size)),
    "smallest": lambda one, _: float(np.prod(one.size)),
    "tallest": lambda one, _: -one.size[2],
    "lowest": lambda one, _: one.size[2],
    "leftmost": lambda one, _: -float(one.p_base[1]),
    "left": lambda one, _: -float(one.p_base[1]),
    "rightmost": lambda one, _: float(one.p_base[1]),
    "right": lambda one, _: float(one.p_base[1]),
    "nearest": lambda one, _: float(np.hypot(*one.p_base[:2])),
    "closest": lambda one, _: float(np.hypot(*one.p_base[:2])),
    "farthest": lambda one, _: -float(np.hypot(*one.p_base[:2])),
}
#: Which of several that fit comes first; "": as they are given.
SELECTIONS = ("", *_CHOICES)
#: Boxes nearer than this touch; a top that is so much higher is over another; more room counts no more, m.
_TOUCHING, _HIGHER, _ROOM = 0.005, 0.01, 0.05
_NO_PUNCTUATION = str.maketrans(dict.fromkeys(string.punctuation, " "))


def fits(text: str, one: Described) -> bool:
    """Return whether an object is what words without a relation ask for; no words ask for any."""
    words = _words(text)
    return not words or _read(words, one) is not None


def takes_all(text: str) -> bool:
    """Return whether words ask for whatever there is, as `anything` does."""
    return all(word in _ANY | _FILLERS for word in _words(text))


def select(text: str, detections: Sequence[Detection], selection: str = "") -> tuple[Detection, ...]:
    """Return the objects that are asked for.

    Args:
        text: Words; relations may follow each other. Without any, all are.
        detections: Objects in view, the first choice at the front.
        selection: Selection among what the words leave open, of `SELECTIONS`.

    Returns:
        The best first, at least one: by the choice in the words, the distance to the object of a relation, or else by
        the selection, or in the order in which they are given.

    Raises:
        OpenArmError: NOTHING_DETECTED, when nothing is in view; UNKNOWN_OBJECT, listing what is.
    """
    if not detections:
        raise OpenArmError(Code.NOTHING_DETECTED, f"nothing is in view (asked for {text or 'any object'!r})")
    if selection:
        choice, given = _CHOICES[selection], detections
        detections = sorted(given, key=lambda one: choice(one, given))
    words = _words(text)
    return tuple(_select(text, words, detections) if words else detections)


def describe(detections: Sequence[Described]) -> str:
    """Name objects with their attributes, such as `cola (blue, can, cylinder), red (cube, box)`."""
    texts: set[str] = set()
    for one in detections:
        further = [attribute for attribute in one.attributes if attribute != one.label]
        texts.add(f"{one.label} ({', '.join(further)})" if further else one.label)
    return ", ".join(sorted(texts)) or "nothing"


def _words(text: str) -> Words:
    """Fold text so that what a user writes and what a network's author wrote compare."""
    plain = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", text).casefold())
    return tuple(plain.translate(_NO_PUNCTUATION).split() or plain.split())


def _select(text: str, words: Words, detections: Sequence[Detection]) -> list[Detection]:
    """Return what fits, best first; never empty."""
    read = [(one, choices) for one in detections if (choices := _read(words, one)) is not None]
    if read:
        # what is called so is meant rather than what the words choose: `left shoe`
        least = min(len(choices) for _, choices in read)
        found = [one for one, choices in read if len(choices) == least]
        for word in next(choices for _, choices in read if len(choices) == least):
            found.sort(key=lambda one: _CHOICES[word](one, detections))
        return found
    found = []
    relation = next((r for r in ((i, r) for i in range(len(words)) for r in _RELATIONS) if _at(words, *r)), None)
    if relation is not None:
        at, phrase = relation
        head, tail = words[:at], words[at + len(phrase) :]
        others = _select(" ".join(tail), tail, detections)
        reach = {one: _reach(one, others, _RELATIONS[phrase]) for one in _select(" ".join(head), head, detections)}
        found = sorted((one for one in reach if math.isfinite(reach[one])), key=lambda one: reach[one])
    if not found:
        raise OpenArmError(Code.UNKNOWN_OBJECT, f"no {text!r} in view; in view: {describe(detections)}")
    return found


def _read(words: Words, one: Described) -> Words | None:
    """Return the choices among words of which each describes the object; None when one does not, or none names it."""
    also = (_ALSO[attribute] for attribute in one.attributes if attribute in _ALSO)
    own = [_words(attribute) for attribute in (*one.attributes, *also)]
    #: By how many words are read: whether none has named anything, and the choices among them.
    best: dict[int, tuple[bool, Words]] = {0: (True, ())}
    for at, word in enumerate(words):
        if at not in best:
            continue
        unnamed, choices = best[at]
        steps = [(len(term), False, choices) for term in own if _at(words, at, term)]
        steps += [(1, False, choices)] * (word in _ANY) + [(1, unnamed, choices)] * (word in _FILLERS)
        steps += [(1, False, (*choices, word))] * (word in _CHOICES)
        for length, without, chosen in steps:
            known = best.get(at + length, (True, words))
            best[at + length] = min(known, (without, chosen), key=lambda way: (way[0], len(way[1])))
    unnamed, choices = best.get(len(words), (True, ()))
    return None if unnamed else choices


def _at(words: Words, at: int, phrase: Words) -> bool:
    return words[at : at + len(phrase)] == phrase


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


def _trouble(one: Detection, detections: Sequence[Detection]) -> float:
    """How hard an object is to take: what lies over it counts most, then neighbours, then a box that is unsure.

    Fingers go down to about the middle of an object: what is lower is in no way.
    """
    higher = [(gap(one, other), other.top) for other in detections if other is not one and other.top > one.p_base[2]]
    under = sum(distance < _TOUCHING and top > one.top + _HIGHER for distance, top in higher)
    crowd = 1.0 - min([_ROOM, *(distance for distance, _ in higher)]) / _ROOM
    return 2.0 * under + crowd + (1.0 - one.score) + 4.0 * (not one.measured)
