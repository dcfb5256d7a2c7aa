# SPDX-License-Identifier: Apache-2.0
"""Orders of several objects: which to pick next and where to put it, until nothing is left or nothing can be done.

No ROS: the client or a campaign takes the next request from `Order.next` and reports to `Order.done`
what came of it. Base frame, m.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product, takewhile

from openarm_common.errors import Code, OpenArmError
from openarm_common.wanted import EASIEST, takes_all
from openarm_grasp.perception.detections import SAME_PLACE
from openarm_grasp.planning.options import NO_WAY
from openarm_grasp.planning.place import SAME_SPOT
from openarm_grasp.requests.bins import Bins
from openarm_grasp.requests.request import GraspRequest, Spot

#: With these there is nothing more to ask for, whatever it is; with the last, of the arm that was asked for by name.
_OVER = (Code.CANCELLED, Code.ROBOT_LOST, Code.STOPPED, Code.NOT_READY)
_WITHOUT_ARM = _OVER[1:]
#: The arm of a request that any arm may carry out.
_ANY_ARM = "auto"
#: There is no more of it in view.
GONE = (Code.UNKNOWN_OBJECT, Code.NOTHING_DETECTED)
#: What is refused so may be taken where others are pushed away from it.
_BY_PLACE = (*(code for code in NO_WAY if code is not Code.TOO_WIDE), *GONE)
#: What is refused so may lie on others, keep a hand from them, or lie badly itself; the likelier first.
_IN_THE_WAY = (Code.TOO_WIDE, Code.IN_COLLISION, Code.NO_PLAN, Code.UNREACHABLE)
#: With these the camera had not shown enough yet: another look may.
_NOT_SEEN = (Code.STALE_DATA, Code.TIMEOUT)
#: Requests in vain, one after the other, until a label is given up: that saw nothing, and that moved an arm.
_UNSEEN, _IN_VAIN = 3, 10
#: Things that are asked for by their places at most, while nothing moves.
_MOST = 10
#: Things that are pushed aside at most, one after the other in vain.
_PUSHES = 3


@dataclass(frozen=True)
class Left:
    """An object that an order left where it is.

    Attributes:
        label: Words that it was asked for by.
        where: Position where it was seen, base frame, m; None: that is not known.
        code: Why it was left.
        why: Why, in a sentence.
        after: Requests by then after which things lay, or were seen, otherwise.
        arm: The arm that could not take it; "auto": neither could.
    """

    label: str
    where: Spot | None
    code: Code
    why: str
    after: int
    arm: str = _ANY_ARM

    def __str__(self) -> str:
        """Sentence for the report."""
        at = "" if self.where is None else f" at ({self.where[0]:.3f}, {self.where[1]:.3f}) m"
        return f"{self.label}{at}: {self.code}: {self.why}"


@dataclass(frozen=True)
class _InVain:
    """A request that placed nothing.

    Attributes:
        request: Request that was made.
        code: Code of the answer.
        touched: An arm has moved for it.
        seen: The object was seen.
    """

    request: GraspRequest
    code: Code
    touched: bool
    seen: bool

    @property
    def aside(self) -> bool:
        """Whether something was to be pushed aside."""
        return self.request.phase == "aside"


@dataclass
class Order:
    """Objects to be picked in rounds: of those that fit, the easiest first.

    In a round everything in view is asked for once: of each of several arms, by its name, as soon as it is free (list
    scheduling, Graham 1966). All else is asked for when no arm is at work, of whichever. What cannot be taken is left,
    and asked for in another round when an arm has moved anything since: it may have been in the way, or have hidden it,
    or lie otherwise itself. After a round in which nothing has moved, each thing that fits into a hand is asked for by
    where it is: what stands close to it may be pushed aside then. Where whatever there is is wanted, what no hand takes
    is pushed aside itself at last, since things may lie below it. The order ends when nothing is left, when nothing
    moves any more, or when all that moves does so in vain.

    Attributes:
        labels: Words for objects, in this order; each is asked for until none is left, as often as `each` says at most.
        bins: Bins that they go into; None: to free spots.
        each: Most objects of one label, or of each label; 0: all.
        arms: Arms that work at the same time; fewer than two: one request at a time.
        placed: Labels that were placed, in order.
        left: Objects that could not be taken.
        failed: Labels that could not be asked for, or were never there, and why.
        running: Requests that are being carried out.
        over: The robot cannot go on.
    """

    labels: Sequence[str]
    bins: Bins | None = None
    each: int | Mapping[str, int] = 0
    arms: Sequence[str] = ()
    placed: list[str] = field(default_factory=list[str])
    left: list[Left] = field(default_factory=list[Left])
    failed: dict[str, str] = field(default_factory=dict[str, str])
    running: list[GraspRequest] = field(default_factory=list[GraspRequest])
    over: bool = False
    #: What is asked for, by label, and the labels of whatever there is.
    _asks: dict[str, GraspRequest] = field(default_factory=dict[str, GraspRequest])
    _any: set[str] = field(default_factory=set[str])
    #: Where what was placed stands, and what a hand may hold.
    _stand: list[Spot] = field(default_factory=list[Spot])
    _held: list[str] = field(default_factory=list[str])
    #: Arms that cannot go on.
    _stopped: set[str] = field(default_factory=set[str])
    #: Labels of which an arm has nothing more in view in this round, and what the round before had left.
    _asked: set[tuple[str, str]] = field(default_factory=set[tuple[str, str]])
    _before: list[Left] = field(default_factory=list[Left])
    #: Places that things were asked for by in this round.
    _by_place: list[Spot] = field(default_factory=list[Spot])
    #: Requests after which things lay, or were seen, otherwise.
    _moved: int = 0
    #: Requests since the newest success.
    _in_vain: list[_InVain] = field(default_factory=list[_InVain])

    def __post_init__(self) -> None:
        """Refuse an order that asks for nothing, or for what has no bin.

        Raises:
            OpenArmError: INVALID_ARGUMENT.
        """
        if not self.labels or not all(self.labels):
            raise OpenArmError(Code.INVALID_ARGUMENT, f"an order needs labels, got {list(self.labels)}")
        homeless = [label for label in self.labels if self.bins is not None and not self.bins.of(label)]
        if homeless and self.bins is not None:
            known = ", ".join(self.bins.classes) or "no label"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no bin for {', '.join(homeless)}; there are bins for {known}")
        self._asks = {label: replace(GraspRequest.of(label), selection="") for label in self.labels}
        self._any = {label for label, ask in self._asks.items() if takes_all(ask.label)}

    def next(self) -> GraspRequest | None:
        """The next request that may begin now; None: not before another has ended, or, when none runs, never."""
        asked = None if self.over else self._of_free_arm() or (None if self.running else self._alone())
        self.running += [] if asked is None else [asked]
        return asked

    @property
    def _able(self) -> list[str]:
        return [arm for arm in self.arms if arm not in self._stopped]

    def _of_free_arm(self) -> GraspRequest | None:
        """A request for an arm that is free while the other may be at work."""
        busy = {ask.arm for ask in self.running}
        if len(self._able) < 2 or self._held or _ANY_ARM in busy:
            return None
        wanted = self._wanted(*(self.label_of(ask) for ask in self.running))
        free = ((arm, label) for arm in self._able if arm not in busy for label in wanted)
        return next((self._easiest(label, arm) for arm, label in free if not self._exhausted(label, arm)), None)

    def _alone(self) -> GraspRequest | None:
        """A request that is carried out while no other is, by whichever arm can go on."""
        arm = self._able[0] if self._stopped else _ANY_ARM
        if self._held:
            held = self._held[0]
            return replace(self._asks[held], arm=arm, phase="place", place_choices=self._spots(held))
        wanted = self._wanted()
        for label in wanted:
            if not self._exhausted(label, arm):
                return self._easiest(label, arm)
        left = [one for one in self.left if one.label in wanted]
        if self._given_up or not left:
            return None
        if any(one.after < self._moved for one in left):
            out_of_reach = (one for one in self.left if one.arm != _ANY_ARM and one.code is Code.UNREACHABLE)
            self._before, self._asked, self._by_place = self.left, set(), []
            self.left = [replace(one, after=self._moved) for one in out_of_reach]  # of one arm
            return self._of_free_arm() or self._alone()
        stay = tuple(self._stand)
        for one in left:
            if one.where is not None and one.code in _BY_PLACE and not self._was_asked_for(one.where):
                ask, spots = self._asks[one.label], self._spots(one.label)
                return replace(ask, arm=arm, object_at=one.where, exclude_near=stay, place_choices=spots)
        for code, one in product(_IN_THE_WAY, left):
            if one.code is code and one.where is not None and self._may_push(one.label, one.where):
                ask = self._asks[one.label]
                return replace(ask, arm=arm, object_at=one.where, exclude_near=stay, phase="aside")
        return None

    def _wanted(self, *taken: str) -> list[str]:
        """Labels of which more is wanted when those that are taken have been placed."""
        labels = dict.fromkeys(self.labels)
        return [label for label in labels if label not in self.failed and not self._enough(label, *taken)]

    def _exhausted(self, label: str, arm: str) -> bool:
        """Whether an arm has nothing more of a label in view; whichever arm has not when none has."""
        if {(label, arm), (label, _ANY_ARM)} & self._asked:
            return True
        return arm == _ANY_ARM and bool(self._able) and all((label, one) in self._asked for one in self._able)

    def _easiest(self, label: str, arm: str) -> GraspRequest:
        """A request for any object of a label; whatever it was asked for as, what was placed or left is excluded.

        What an arm reached, but could not take, may have come free when anything has been moved since.
        """

        def stays(one: Left) -> bool:
            moved = one.code is not Code.UNREACHABLE and one.after < self._moved
            return one.arm == _ANY_ARM or (one.arm == arm and not moved)

        left = (one.where for one in self.left if one.where is not None and stays(one))
        # of one bin, the last arm fills the other end
        spots = self._spots(label)[:: -1 if arm in self.arms[1:] else 1]
        ask, stay = self._asks[label], (*self._stand, *left)
        return replace(ask, arm=arm, selection=EASIEST, exclude_near=stay, place_choices=spots)

    @property
    def _given_up(self) -> bool:
        return sum(one.touched and not one.aside for one in self._in_vain) >= _IN_VAIN

    @property
    def _unseen(self) -> int:
        """How many requests in a row have seen nothing."""
        blind = takewhile(lambda one: one.code in _NOT_SEEN and not one.seen, reversed(self._in_vain))
        return sum(1 for _ in blind)

    @property
    def _otherwise(self) -> int:
        """How many things were not seen at their places: they are seen as parts of something else now."""
        by_place = (one for one in self._in_vain if one.request.object_at is not None and not one.aside)
        return sum(one.code in GONE and not one.seen for one in by_place)

    def _may_push(self, label: str, where: Spot) -> bool:
        pushed = [one.request.object_at for one in self._in_vain if one.aside]
        known = any(spot is not None and math.dist(where, spot[:2]) < SAME_SPOT for spot in pushed)
        return label in self._any and len(pushed) < _PUSHES and not known

    def _enough(self, label: str, *taken: str) -> bool:
        most = self.each if isinstance(self.each, int) else self.each.get(label, 1)
        return 0 < most <= [*self.placed, *taken].count(label)

    def _at(self, spot: Spot, label: str = "") -> Iterator[Left]:
        """What was left about there, of a label, or of any."""
        near = (one for one in self.left if one.where is not None and math.dist(one.where, spot) < SAME_SPOT)
        return (one for one in near if label in ("", one.label))

    def _was_asked_for(self, where: Spot) -> bool:
        return len(self._by_place) > 2 * _MOST or any(math.dist(where, spot) < SAME_SPOT for spot in self._by_place)

    def _spots(self, label: str) -> tuple[Spot, ...]:
        return () if self.bins is None else self.bins.bins[self.bins.of(label)].slots(self.bins.spacing)

    def label_of(self, request: GraspRequest) -> str:
        """Which of the labels a request is for."""
        wanted = request.label, request.place_on
        return next(label for label, ask in self._asks.items() if (ask.label, ask.place_on) == wanted)

    def done(
        self,
        request: GraspRequest,
        code: Code,
        message: str,
        placed: Sequence[float] = (),
        seen: Sequence[float] | None = None,
        *,
        touched: bool = False,
        held: bool = False,
        by: str = "",
    ) -> Left | None:
        """Note what came of a request, and return what it leaves; None for nothing that was not left before.

        Args:
            request: Request from `next`.
            code: Code of the answer.
            message: Message of the answer.
            placed: (x, y) where the object stands now, when it was placed.
            seen: (x, y) where it was seen last, when it was.
            touched: An arm has moved for it.
            held: A hand may hold it still: it is put down before anything else. An arm that cannot do that is left out;
                the last one ends the label.
            by: Arm that carried it out; "": none did.
        """
        label, after, arm = self.label_of(request), self._moved, request.arm
        if request in self.running:
            self.running.remove(request)
        self._moved += touched or code is Code.OK
        self._in_vain.append(_InVain(request, code, touched, seen is not None))
        if request.phase == "aside" and code not in _OVER:
            return None
        self.left = [one for one in self.left if one.label != label or one.where is not None]
        where = None if seen is None else (float(seen[0]), float(seen[1]))
        placing = request.phase == "place"
        self._held = self._held[1:] if placing else self._held
        mine = arm if arm in self.arms else by
        if (code in _WITHOUT_ARM or (placing and held)) and mine in self._able and len(self._able) > 1:
            self._stopped.add(mine)  # the other goes on; what a hand keeps was left before
            left = Left(label, where, code, f"{mine} arm: {message}", after)
            return self._leave(left) if touched and not placing else None
        if held and not placing:
            self._held.append(label)
        if placing and code is Code.NOT_READY:
            return None  # no hand holds anything: it is where it was seen last
        if code is Code.OK:
            self._place(label, placed, seen, placing=placing)
            return None
        if (placing and held) or code in (*_OVER, Code.INVALID_ARGUMENT):
            self.failed[label], self.over = f"{code}: {message}", self.over or code in _OVER
            return None
        if request.object_at is not None:
            spot = (float(request.object_at[0]), float(request.object_at[1]))
            self._by_place += [spot, *([] if where is None else [where])]
            if code not in GONE:  # what is not seen there any more stays on the list of what was left
                self.left = [one for one in self.left if one not in tuple(self._at(spot))]
        if where is None and code in GONE:
            if request.object_at is None:
                return self._none_left(label, arm, code, message)
            self._moved += self._otherwise < _UNSEEN
            return None
        unseen = self._unseen
        if self._given_up or unseen >= _UNSEEN or (where is None and not unseen):
            self._asked.add((label, arm))
        if code in GONE and where is not None and any(self._at(where, label)):
            return None
        return self._leave(Left(label, where, code, message, after, arm))

    def _place(self, label: str, placed: Sequence[float], seen: Sequence[float] | None, *, placing: bool) -> None:
        """Note that an object of a label was placed; what was placed before, and is seen in pieces, was so in vain."""
        if placing and self.left:
            self.left.pop()  # what was left in the hand
        again = [] if seen is None else [spot for spot in self._stand if math.dist(spot, seen[:2]) < SAME_PLACE]
        self._stand = [spot for spot in self._stand if spot not in again]
        if len(placed) >= 2:
            self._stand.append((float(placed[0]), float(placed[1])))
        if again:
            if self._given_up:
                self._asked.add((label, _ANY_ARM))
            return
        taken = [] if seen is None else [*self._at((float(seen[0]), float(seen[1])))]  # by an arm that could
        self.left = [one for one in self.left if one not in taken]
        self._in_vain, self._before = [], []
        self.placed.append(label)
        if self._enough(label):
            self.left = [one for one in self.left if one.label != label]

    def _none_left(self, label: str, arm: str, code: Code, message: str) -> Left | None:
        """Nothing more of a label is in view besides what was left; what was left before and is out of view is, too.

        What one arm does not see, with the other at home, the other does not see either, besides what the first left.
        """
        mine = any((one.label, one.arm) == (label, arm) for one in self.left)
        self._asked.add((label, arm if mine else _ANY_ARM))
        if not self._exhausted(label, _ANY_ARM) or any(one.label == label for one in self.left):
            return None
        gone = (one for one in self._before if one.label == label and one.where is not None)
        self.left += [replace(one, after=self._moved) for one in gone]
        if label in self.placed or any(one.label == label for one in self.left):
            return None
        return self._leave(Left(label, None, code, message, self._moved))

    def _leave(self, one: Left) -> Left:
        """Leave an object; what an arm has left that the other could not take either, neither takes."""
        other = [] if one.where is None else [left for left in self._at(one.where, one.label) if left.arm != one.arm]
        self.left = [left for left in self.left if left not in other]
        self.left.append(replace(one, arm=_ANY_ARM) if other else one)
        return self.left[-1]

    @property
    def outcome(self) -> str:
        """SUCCESS when nothing is left, PARTIAL when something was placed, else FAILED."""
        if not self.faults():
            return "SUCCESS"
        return "PARTIAL" if self.placed else "FAILED"

    def faults(self) -> tuple[str, ...]:
        """What could not be done, a sentence each."""
        return (*map(str, self.left), *(f"{label}: {why}" for label, why in self.failed.items()))
