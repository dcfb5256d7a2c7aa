# SPDX-License-Identifier: Apache-2.0
"""Orders of several objects and their bins."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_grasp.requests.bins import Bin, Bins, load_bins
from openarm_grasp.requests.orders import Order
from openarm_grasp.requests.request import GraspRequest
from tests.refusals import refused

BINS = Bins(
    bins={"left": Bin(x=(0.16, 0.28), y=(0.20, 0.44)), "right": Bin(x=(0.16, 0.28), y=(-0.32, -0.20))},
    classes={"red": "left", "blue": "right"},
)


def peek(order: Order) -> GraspRequest | None:
    """The next request, which is not begun."""
    ask = order.next()
    order.running = [one for one in order.running if one is not ask]
    return ask


def carry_out(
    order: Order, codes: dict[str, Code] | None = None, table: dict[str, int] | None = None
) -> list[GraspRequest]:
    """Answer every request: from `codes` by label, else OK while there is one on the table."""
    asked: list[GraspRequest] = []
    table = {"red": 9, "blue": 9} if table is None else dict(table)
    while ask := order.next():
        asked.append(ask)
        assert len(asked) < 50
        label = order.label_of(ask)
        code = (codes or {}).get(label, Code.OK if table.get(label) else Code.UNKNOWN_OBJECT)
        if code is Code.OK:
            table[label] -= 1
        order.done(ask, code, "injected")
    return asked


def labels(order: Order, asked: list[GraspRequest]) -> list[str]:
    return [order.label_of(ask) for ask in asked]


class Heap:
    """Objects at places, of which some lie under others: those can be taken when nothing is over them.

    What is pushed aside moves by 20 cm, and hides nothing more, where it is one of `yields`.
    """

    def __init__(self, places: dict[str, tuple[float, float]], under: dict[str, str], never: tuple[str, ...] = (),
                 hidden: dict[str, str] | None = None, yields: tuple[str, ...] = ()):  # fmt: skip
        self.places, self.under, self.never, self.taken = dict(places), under, never, list[str]()
        self.hidden, self.yields, self.aside = hidden or {}, yields, list[str]()

    def clear(self, order: Order) -> int:
        asked = 0
        while ask := order.next():
            asked += 1
            assert asked < 100
            in_view = {n: at for n, at in self.places.items() if n not in self.hidden}
            there = [n for n, at in in_view.items() if all(np.hypot(*np.subtract(at, p)) > 0.05
                                                               for p in ask.exclude_near)]  # fmt: skip
            if ask.object_at is not None:
                there = [n for n in there if self.places[n] == ask.object_at]
            if not there:
                order.done(ask, Code.UNKNOWN_OBJECT, "no more")
                continue
            name = there[0]
            if ask.phase == "aside":
                self.aside.append(name)
                if name in self.yields:
                    self.places[name] = (self.places[name][0], self.places[name][1] + 0.2)
                    self.hidden = {n: by for n, by in self.hidden.items() if by != name}
                code = Code.OK if name in self.yields else Code.UNREACHABLE
                order.done(ask, code, "", seen=(*self.places[name], 0.4), touched=name in self.yields)
                continue
            if name in self.never or self.under.get(name) in self.places:
                order.done(ask, Code.IN_COLLISION, f"{name} has no room", seen=(*self.places[name], 0.4))
                continue
            order.done(ask, Code.OK, "", placed=(0.3, 1.0 + 0.1 * len(self.taken)), seen=(*self.places[name], 0.4))
            self.taken.append(name)
            del self.places[name]
        return asked


HEAP = {"lowest": (0.2, 0.0), "middle": (0.26, 0.0), "top": (0.32, 0.0)}


@pytest.mark.requirement("R-17")
def test_a_heap_is_cleared_from_its_top_whatever_is_asked_for_first():
    heap, order = Heap(HEAP, {"lowest": "middle", "middle": "top"}), Order(("anything",))
    heap.clear(order)
    assert heap.taken == ["top", "middle", "lowest"]
    assert order.outcome == "SUCCESS"
    assert order.faults() == ()


@pytest.mark.requirement("R-17", "P-02")
def test_what_cannot_be_taken_is_listed_with_place_and_reason():
    heap, order = Heap(HEAP, {}, never=("middle", "lowest")), Order(("anything",))
    asked = heap.clear(order)
    assert heap.taken == ["top"]
    assert asked == 11  # two in vain, one taken, none more; both again, none more; each by its place; each aside
    assert order.outcome == "PARTIAL"
    assert {one.where: one.code for one in order.left} == {HEAP[n]: Code.IN_COLLISION for n in ("lowest", "middle")}
    assert "anything at (0.200, 0.000) m: IN_COLLISION: lowest has no room" in order.faults()


@pytest.fixture
def order() -> Order:
    return Order(("anything",))


@pytest.mark.requirement("R-17")
def test_what_no_hand_takes_is_pushed_aside_for_what_it_hides(order):
    heap = Heap(HEAP, {}, never=("top",), hidden={"lowest": "top", "middle": "top"}, yields=("top",))
    heap.clear(order)
    assert heap.taken == ["lowest", "middle"]
    assert heap.aside.count("top") == 1 + 3  # uncovers both; then in vain, until it is given up
    assert [one.where for one in order.left] == [heap.places["top"]]


def test_nothing_is_pushed_aside_for_an_order_of_something_particular():
    heap, order = Heap(HEAP, {}, never=("top",), yields=("top",)), Order(("red",))
    heap.clear(order)
    assert heap.aside == []


def test_a_label_that_fails_in_vain_again_and_again_is_given_up():
    order, asked = Order(("anything",)), 0
    while ask := order.next():
        asked += 1
        assert asked < 20
        order.done(ask, Code.GRASP_MISSED, "it rolled away", seen=(0.2 + 0.1 * asked, 0.0), touched=True)
    assert asked == 10
    assert order.outcome == "FAILED"


@pytest.mark.requirement("R-17")
def test_what_a_hand_still_holds_is_put_down_before_anything_else():
    order = Order(("anything",), BINS.model_copy(update={"rest": "right"}))
    order.done(order.next(), Code.PLACE_FAILED, "the hand keeps it", seen=(0.3, 0.0), touched=True, held=True)
    ask = order.next()
    assert (ask.phase, ask.place_choices) == ("place", BINS.bins["right"].slots(BINS.spacing))
    order.done(ask, Code.OK, "", placed=(0.22, -0.26))
    assert order.placed == ["anything"]
    assert order.left == []
    order.done(order.next(), Code.GRASP_LOST, "it fell", seen=(0.3, 0.1), touched=True, held=True)
    order.done(order.next(), Code.NOT_READY, "no hand holds anything")
    ask = order.next()
    assert (ask.phase, ask.exclude_near) == ("all", ((0.22, -0.26), (0.3, 0.1)))


def test_a_hand_that_cannot_let_go_ends_the_order(order):
    order.done(order.next(), Code.PLACE_FAILED, "the hand keeps it", seen=(0.3, 0.0), touched=True, held=True)
    order.done(order.next(), Code.PLACE_FAILED, "no free spot", touched=True, held=True)
    assert order.next() is None
    assert order.faults()[-1] == "anything: PLACE_FAILED: no free spot"


@pytest.mark.requirement("P-21")
def test_a_hand_that_cannot_let_go_does_not_stop_the_other_arm() -> None:
    crew = Crew(Order(("anything",), arms=ARMS), dict(ROW), left=(-9.0, 9.0), right=(-9.0, 9.0))
    crew.begin()
    full, other = crew.order.running
    crew.at.pop(id(full))
    crew.order.done(full, Code.PLACE_FAILED, "the hand keeps it", seen=(0.3, 0.3), touched=True, held=True, by="left")
    del crew.objects["a"]
    crew.end(other)
    placing = crew.order.next()
    assert (placing.phase, placing.arm) == ("place", "auto")
    assert crew.order.done(placing, Code.PLACE_FAILED, "no free spot", touched=True, held=True, by="left") is None
    crew.work()
    assert [arm for arm, _ in crew.taken] == ["right"] * 5
    assert crew.order.faults() == ("anything at (0.300, 0.300) m: PLACE_FAILED: the hand keeps it",)


def test_words_are_read_once_and_requests_have_fields() -> None:
    order = Order(("easiest red in: tray", "largest can"))
    first = order.next()
    assert (first.label, first.selection, first.place_on) == ("red", "easiest", "tray")
    assert order.label_of(first) == "easiest red in: tray"
    order.done(first, Code.UNKNOWN_OBJECT, "none")
    assert order.next().label == "largest can"


def test_what_was_let_go_elsewhere_is_asked_for_again(order):
    order.done(order.next(), Code.GRASP_LOST, "it has turned", seen=(0.3, 0.0), touched=True, held=True)
    order.done(order.next(), Code.PLACE_FAILED, "let go where it met something", seen=(0.2, 0.1), touched=True)
    assert peek(order) == GraspRequest("anything", selection="easiest", exclude_near=((0.3, 0.0), (0.2, 0.1)))


def test_a_camera_that_shows_nothing_is_asked_again_three_times_at_most():
    order = Order(("red",))
    order.done(order.next(), Code.STALE_DATA, "1 of 3 frames")
    order.done(order.next(), Code.STALE_DATA, "1 of 3 frames")
    order.done(order.next(), Code.OK, "", placed=(0.3, 0.2))
    for _ in range(3):
        order.done(order.next(), Code.STALE_DATA, "no frame")
    assert order.next() is None
    assert order.faults() == ("red: STALE_DATA: no frame",)


def test_a_robot_that_is_lost_ends_the_order():
    order = Order(("red", "blue"))
    order.done(order.next(), Code.ROBOT_LOST, "silent")
    assert order.next() is None
    assert order.faults() == ("red: ROBOT_LOST: silent",)


@pytest.mark.requirement("P-03")
def test_one_bin_per_class():
    order = Order(("red", "blue"), BINS, each=1)
    red, blue = carry_out(order)
    assert len(red.place_choices) == 2
    assert all(0.20 < y < 0.44 for _, y in red.place_choices)
    assert blue.place_choices == ((0.22, -0.26),)
    assert order.outcome == "SUCCESS"


@pytest.mark.requirement("P-03")
def test_a_bin_offers_places_that_are_apart():
    order = Order(("red", "blue"), Bins(bins={"tray": Bin(x=(0.15, 0.39), y=(0.10, 0.34))}, rest="tray"), each=2)
    for ask in carry_out(order):
        places = ask.place_choices
        assert len(places) == 4
        assert min(np.hypot(a[0] - b[0], a[1] - b[1]) for i, a in enumerate(places) for b in places[:i]) >= 0.1199


@pytest.mark.requirement("P-03")
def test_all_of_a_label_until_none_is_left():
    order = Order(("red",))
    assert labels(order, carry_out(order, table={"red": 3})) == ["red"] * 4
    assert order.placed == ["red"] * 3
    assert order.outcome == "SUCCESS"


@pytest.mark.requirement("P-02")
def test_an_order_done_in_part_says_so():
    order = Order(("red", "blue"), each=1)
    carry_out(order, {"red": Code.TOO_WIDE})
    assert order.outcome == "PARTIAL"
    assert order.faults() == ("red: TOO_WIDE: injected",)
    assert order.placed == ["blue"]


def test_a_label_that_was_never_there_failed():
    order = Order(("red",), each=5)
    carry_out(order, table={})
    assert order.outcome == "FAILED"
    assert "UNKNOWN_OBJECT" in order.faults()[0]


@pytest.mark.requirement("P-19")
def test_a_full_bin_is_the_reason_for_what_is_left():
    order = Order(("red",), BINS)
    order.done(order.next(), Code.OK, "", (0.2, 0.2, 0.4), (0.3, 0.0, 0.42))
    order.done(order.next(), Code.PLACE_FAILED, "none of 2 places is free", seen=(0.3, 0.1, 0.42))
    last = order.next()
    assert last == GraspRequest(
        "red",
        selection="easiest",
        exclude_near=((0.2, 0.2), (0.3, 0.1)),
        place_choices=BINS.bins["left"].slots(BINS.spacing),
    )
    order.done(last, Code.UNKNOWN_OBJECT, "no more")
    assert order.next() is None
    assert order.faults() == ("red at (0.300, 0.100) m: PLACE_FAILED: none of 2 places is free",)


def test_orders_and_bins_that_make_no_sense_are_refused(tmp_path):
    refused("no bin for green; there are bins for red, blue", Order, ("green",), BINS)
    refused("an order needs labels", Order, ())
    path = tmp_path / "bins.yaml"
    path.write_text("bins: {a: {x: [0.2, 0.1], y: [0.0, 0.1]}}\nrest: b\n")
    assert refused("must ascend", load_bins, path).code is Code.CONFIG_INVALID
    path.write_text("bins: {a: {x: [0.1, 0.2], y: [0.0, 0.1]}}\nrest: b\n")
    refused("no bin 'b'; bins: a", load_bins, path)


def test_what_others_block_is_asked_for_again_when_they_are_gone():
    order = Order(("red", "blue"), each=1)
    order.done(order.next(), Code.IN_COLLISION, "blue is in the way")
    assert peek(order) == GraspRequest("blue", selection="easiest")
    order.done(order.next(), Code.OK, "")
    assert peek(order) == GraspRequest("red", selection="easiest")
    order.done(order.next(), Code.OK, "")
    assert order.next() is None
    assert order.outcome == "SUCCESS"


def test_what_stays_blocked_failed_with_its_reason():
    order = Order(("red", "blue"))
    carry_out(order, {"red": Code.NO_PLAN, "blue": Code.NO_PLAN})
    assert order.faults() == ("red: NO_PLAN: injected", "blue: NO_PLAN: injected")
    assert order.outcome == "FAILED"


@pytest.mark.requirement("P-03")
def test_what_an_order_has_placed_it_does_not_pick_again():
    order = Order(("red",), each={"red": 2})
    order.done(order.next(), Code.OK, "", (0.3, -0.2, 0.4))
    assert peek(order) == GraspRequest("red", selection="easiest", exclude_near=((0.3, -0.2),))
    order.done(order.next(), Code.OK, "", (0.2, -0.2, 0.4))
    assert order.next() is None
    assert order.outcome == "SUCCESS"


@pytest.mark.requirement("P-03", "R-18")
def test_what_was_placed_is_not_asked_for_again_by_another_word():
    order = Order(("cola", "can"), each=1)
    order.done(order.next(), Code.OK, "", (0.3, 0.2, 0.4))
    assert peek(order) == GraspRequest("can", selection="easiest", exclude_near=((0.3, 0.2),))


@pytest.mark.requirement("R-17")
def test_what_was_placed_and_is_taken_again_by_a_piece_of_it_counts_once_and_does_not_go_on_for_ever():
    order, at = Order(("anything",)), (0.3, 0.2)
    order.done(order.next(), Code.OK, "", at, (0.3, 0.0))
    for n in range(100):
        if (ask := order.next()) is None:
            break
        to = (0.3, 0.2 + 0.1 * (n % 2))
        order.done(ask, Code.OK, "", to, at, touched=True)
        at = to
        assert getattr(peek(order), "exclude_near", (at,)) == (at,)
    assert order.next() is None
    assert (order.placed, order.outcome) == (["anything"], "SUCCESS")


@pytest.mark.requirement("R-17")
def test_an_order_ends_though_things_seem_to_stand_elsewhere_each_time():
    order, rng, asked = Order(("anything",)), np.random.default_rng(0), 0
    while ask := order.next():
        asked += 1
        assert asked < 60
        easy = ask.object_at is None
        if easy and len(ask.exclude_near) >= 4:
            order.done(ask, Code.UNKNOWN_OBJECT, "no more")
            continue
        x, y = rng.uniform((0.2, -0.2), (0.4, 0.2))
        order.done(ask, Code.IN_COLLISION, "no room", seen=(x, y, 0.4))
    assert order.outcome == "FAILED"


@pytest.mark.requirement("R-17", "P-02")
@pytest.mark.parametrize("touched", [False, True])
def test_what_is_not_seen_any_more_where_it_was_left_stays_on_the_list(order, touched):
    order.done(order.next(), Code.OK, "", placed=(0.3, 1.0), seen=(0.3, 0.1, 0.4))
    order.done(order.next(), Code.IN_COLLISION, "no room", seen=(0.26, 0.0, 0.4))
    order.done(order.next(), Code.UNKNOWN_OBJECT, "no more")
    ask = order.next()
    assert ask.object_at == (0.26, 0.0)
    order.done(ask, Code.UNKNOWN_OBJECT, "not there", touched=touched)
    while ask := order.next():
        order.done(ask, Code.UNKNOWN_OBJECT, "no more")
    assert order.outcome == "PARTIAL"
    assert [one.code for one in order.left] == [Code.IN_COLLISION]


@pytest.mark.requirement("R-17")
def test_what_an_arm_has_moved_in_vain_is_asked_for_again():
    order, tries = Order(("anything",)), 0
    while ask := order.next():
        if ask.exclude_near:
            order.done(ask, Code.UNKNOWN_OBJECT, "no more")
            continue
        tries += 1
        order.done(ask, Code.GRASP_LOST, "it has turned", seen=(0.30 + 0.01 * tries, 0.08, 0.4), touched=True)
    assert tries == 10
    assert len(order.left) == 1


@pytest.mark.requirement("R-17", "P-03")
def test_an_order_that_has_taken_what_it_was_asked_for_leaves_nothing():
    order = Order(("red",), each=1)
    order.done(order.next(), Code.IN_COLLISION, "no room", seen=(0.30, 0.08, 0.4))
    order.done(order.next(), Code.OK, "", placed=(0.3, 1.0), seen=(0.2, 0.0, 0.4))
    assert order.next() is None
    assert order.outcome == "SUCCESS"


@pytest.mark.requirement("R-17")
def test_what_a_push_has_moved_out_of_sight_does_not_end_an_order(order):
    for x in (0.2, 0.3):
        order.done(order.next(), Code.IN_COLLISION, "no room", seen=(x, 0.1, 0.4))
    order.done(order.next(), Code.UNKNOWN_OBJECT, "no more")
    ask = order.next()
    assert ask.object_at == (0.2, 0.1)
    order.done(ask, Code.UNKNOWN_OBJECT, "not there after the push", touched=True)
    assert peek(order) == GraspRequest("anything", selection="easiest")


@pytest.mark.requirement("R-17")
def test_what_is_not_at_its_place_may_be_a_part_of_something_that_is_seen_whole_now():
    order, asked = Order(("anything",)), 0
    order.done(order.next(), Code.IN_COLLISION, "no room", seen=(0.43, 0.06, 0.4))
    order.done(order.next(), Code.UNKNOWN_OBJECT, "no more")
    ask = order.next()
    assert ask.object_at == (0.43, 0.06)
    order.done(ask, Code.UNKNOWN_OBJECT, "it is seen at (0.36, 0.07)")
    assert peek(order) == GraspRequest("anything", selection="easiest")
    while ask := order.next():
        asked += 1
        assert asked < 10
        order.done(ask, Code.UNKNOWN_OBJECT, "no more")
    assert [one.code for one in order.left] == [Code.IN_COLLISION]


@pytest.mark.requirement("R-17", "P-02")
def test_what_is_seen_for_a_moment_does_not_keep_for_good_from_what_it_is_a_part_of(order):
    order.done(order.next(), Code.IN_COLLISION, "no room", seen=(0.30, 0.08, 0.4))
    order.done(order.next(), Code.OK, "", placed=(0.3, 1.0), seen=(0.33, -0.1, 0.4))
    order.done(order.next(), Code.UNKNOWN_OBJECT, "not there at the second look", seen=(0.40, 0.18, 0.4))
    assert peek(order).exclude_near == ((0.3, 1.0), (0.30, 0.08), (0.40, 0.18))
    order.done(order.next(), Code.UNKNOWN_OBJECT, "no more")
    assert peek(order).exclude_near == ((0.3, 1.0),)  # what has no room any more may have it now
    order.done(order.next(), Code.IN_COLLISION, "no room", seen=(0.30, 0.08, 0.4))
    order.done(order.next(), Code.UNKNOWN_OBJECT, "not there at the second look", seen=(0.40, 0.18, 0.4))
    order.done(order.next(), Code.UNKNOWN_OBJECT, "no more")
    for where in ((0.30, 0.08), (0.40, 0.18)):
        ask = order.next()
        assert ask.object_at == where
        order.done(ask, Code.UNKNOWN_OBJECT, "not there", seen=(*where, 0.4))
    while ask := order.next():
        order.done(ask, Code.UNKNOWN_OBJECT, "no more")
    assert [(one.where, one.code) for one in order.left] == [
        ((0.30, 0.08), Code.IN_COLLISION),
        ((0.40, 0.18), Code.UNKNOWN_OBJECT),
    ]


class Crew:
    """Arms that each take what they reach of objects on a table, in the order in which requests began.

    Attributes:
        within: Range of y that each arm reaches, m.
        at: What each request is at; no other request takes it.
        together: Requests that ran while another did.
    """

    def __init__(self, order: Order, objects: dict[str, tuple[float, float]], **within: tuple[float, float]) -> None:
        self.order, self.objects, self.within = order, objects, within
        self.at: dict[int, str] = {}
        self.asked, self.taken, self.together = list[GraspRequest](), list[tuple[str, str]](), 0

    def begin(self) -> None:
        while (ask := self.order.next()) is not None:
            self.asked.append(ask)
            assert len(self.asked) < 60
            self.together += len(self.order.running) > 1
            free = [n for n, at in self.objects.items() if n not in self.at.values() and at not in ask.exclude_near]
            self.at[id(ask)] = next((n for n in free if ask.object_at in (None, self.objects[n])), "")

    def end(self, ask: GraspRequest, code: Code | None = None, **how: bool) -> None:
        """End a request: what is reached is placed."""
        name = self.at.pop(id(ask))
        if code is not None or not name:
            self.order.done(ask, code or Code.UNKNOWN_OBJECT, "injected", **how)
            return
        x, y = self.objects[name]
        bands = [self.within[ask.arm]] if ask.arm in self.within else self.within.values()
        if not any(low <= y <= high for low, high in bands):
            self.order.done(ask, Code.UNREACHABLE, f"{name} is too far", seen=(x, y, 0.4))
            return
        self.taken.append((ask.arm, name))
        del self.objects[name]
        self.order.done(ask, Code.OK, "", placed=(1.0, 0.1 * len(self.taken)), seen=(x, y, 0.4), touched=True)

    def work(self, last: int = 0) -> None:
        """Let the request end that began first, or last, until the order has ended."""
        self.begin()
        while self.order.running:
            self.end(self.order.running[last])
            self.begin()


ARMS = ("left", "right")
ROW = {name: (0.3, round(0.3 - 0.1 * i, 1)) for i, name in enumerate("abcdef")}
BOTH = {"left": (-0.1, 9.0), "right": (-9.0, 0.1)}


@pytest.mark.requirement("R-17")
@pytest.mark.parametrize("last", [0, -1])
def test_each_arm_takes_the_next_object_as_soon_as_it_is_free_and_what_only_one_reaches_is_left_to_it(last) -> None:
    crew = Crew(Order(("anything",), arms=ARMS), dict(ROW), **BOTH)
    crew.work(last)
    assert sorted(name for _, name in crew.taken) == list("abcdef")
    assert crew.order.outcome == "SUCCESS"
    assert all(("right", name) not in crew.taken for name in "ab")
    assert all(("left", name) not in crew.taken for name in "ef")
    assert crew.together >= 4


def test_an_arm_that_has_ended_never_waits_for_the_other() -> None:
    crew = Crew(Order(("anything",), arms=ARMS), dict(ROW), left=(-9.0, 9.0), right=(-9.0, 9.0))
    crew.begin()
    slow = next(ask for ask in crew.order.running if ask.arm == "right")
    for _ in range(5):
        crew.end(next(ask for ask in crew.order.running if ask is not slow))
        crew.begin()
    assert [arm for arm, _ in crew.taken] == ["left"] * 5
    crew.end(slow)
    crew.work()
    assert (len(crew.taken), crew.order.outcome) == (6, "SUCCESS")


@pytest.mark.requirement("P-02")
def test_what_an_arm_does_in_vain_never_stops_the_other() -> None:
    crew = Crew(Order(("anything",), arms=ARMS), dict(ROW), left=(-9.0, 9.0), right=(-9.0, 9.0))
    crew.begin()
    while crew.order.running:
        ask = crew.order.running[0]
        crew.end(ask, Code.GRASP_MISSED if ask.arm == "right" else None, touched=True)
        crew.begin()
    assert crew.order.placed == ["anything"] * 6


@pytest.mark.requirement("P-21")
@pytest.mark.parametrize("code", [Code.STOPPED, Code.ROBOT_LOST, Code.NOT_READY])
def test_one_arm_goes_on_when_the_other_is_stopped_or_missing(code) -> None:
    crew = Crew(Order(("anything",), arms=ARMS), dict(ROW), left=(-9.0, 9.0), right=(-9.0, 9.0))
    crew.begin()
    crew.end(next(ask for ask in crew.order.running if ask.arm == "left"), code)
    crew.work()
    assert [arm for arm, _ in crew.taken] == ["right"] * 6
    assert crew.order.outcome == "SUCCESS"
    assert all(ask.arm == "right" for ask in crew.asked[2:])


def test_an_order_ends_when_both_arms_are_stopped_or_one_is_cancelled() -> None:
    for codes in ((Code.STOPPED, Code.STOPPED), (Code.CANCELLED, None)):
        crew = Crew(Order(("anything",), arms=ARMS), dict(ROW), **BOTH)
        crew.begin()
        for ask, code in zip([*crew.order.running], codes, strict=True):
            crew.end(ask, code)
        assert crew.order.next() is None
        assert crew.order.over


def test_what_one_arm_cannot_take_is_left_when_the_other_cannot_either_and_listed_once() -> None:
    crew = Crew(Order(("anything",), arms=ARMS), dict(ROW) | {"far": (0.9, 0.0)}, left=(0.01, 9.0), right=(-9.0, -0.01))
    crew.work()
    assert len(crew.taken) == 5
    assert {one.where for one in crew.order.left} == {(0.9, 0.0), (0.3, 0.0)}
    assert crew.order.outcome == "PARTIAL"


def test_what_one_arm_could_not_take_is_asked_of_the_other_when_the_first_sees_nothing_else() -> None:
    order = Order(("anything",), arms=ARMS)
    left, right = order.next(), order.next()
    assert (left.arm, right.arm, order.next()) == ("left", "right", None)
    order.done(left, Code.UNREACHABLE, "too far", seen=(0.3, -0.3, 0.4))
    again = order.next()
    assert (again.arm, again.exclude_near) == ("left", ((0.3, -0.3),))
    assert order.done(again, Code.UNKNOWN_OBJECT, "no more") is None
    assert order.next() is None
    order.done(right, Code.OK, "", placed=(0.2, 0.1), seen=(0.3, 0.0), touched=True)
    last = order.next()
    assert (last.arm, last.exclude_near) == ("right", ((0.2, 0.1),))
    order.done(last, Code.OK, "", placed=(0.2, 0.2), seen=(0.3, -0.3), touched=True)
    order.done(order.next(), Code.UNKNOWN_OBJECT, "no more")
    assert (order.next(), order.outcome, order.placed) == (None, "SUCCESS", ["anything"] * 2)


def test_what_one_arm_sees_nothing_besides_is_not_looked_for_by_the_other_again() -> None:
    order = Order(("anything",), arms=ARMS)
    left, right = order.next(), order.next()
    order.done(left, Code.UNKNOWN_OBJECT, "nothing besides what the right arm is at")
    assert order.next() is None
    order.done(right, Code.OK, "", placed=(0.2, 0.1), seen=(0.3, 0.0), touched=True)
    assert (order.next(), order.outcome, order.faults()) == (None, "SUCCESS", ())


def test_no_more_objects_are_asked_for_at_once_than_are_wanted() -> None:
    order = Order(("red", "blue"), BINS, each=1, arms=ARMS)
    first, second = order.next(), order.next()
    assert [ask.label for ask in (first, second)] == ["red", "blue"]
    assert first.place_choices == BINS.bins["left"].slots(BINS.spacing)
    assert second.place_choices == BINS.bins["right"].slots(BINS.spacing)[::-1]  # of one bin, from its other end
    order.done(first, Code.OK, "", placed=(0.2, 0.1))
    assert order.next() is None
    order.done(second, Code.OK, "", placed=(0.2, -0.1))
    assert (order.next(), order.outcome) == (None, "SUCCESS")


@pytest.mark.requirement("R-17")
def test_what_a_hand_still_holds_is_put_down_when_the_other_arm_has_ended() -> None:
    order = Order(("anything",), arms=ARMS)
    left, right = order.next(), order.next()
    order.done(left, Code.PLACE_FAILED, "the hand keeps it", seen=(0.3, 0.2), touched=True, held=True)
    assert order.next() is None
    order.done(right, Code.PLACE_FAILED, "so does the other", seen=(0.3, -0.2), touched=True, held=True)
    for _ in ARMS:
        placing = order.next()
        assert (placing.phase, placing.arm, order.next()) == ("place", "auto", None)
        order.done(placing, Code.OK, "", placed=(0.2, 0.1))
    assert {order.next().arm, order.next().arm} == {"left", "right"}


def test_what_other_things_keep_an_arm_from_is_asked_of_it_again_when_anything_has_been_moved() -> None:
    order = Order(("anything",), arms=ARMS)
    left, right = order.next(), order.next()
    order.done(right, Code.IN_COLLISION, "orange is in the way", seen=(0.3, -0.3, 0.4))
    other = order.next()
    assert (other.arm, other.exclude_near) == ("right", ((0.3, -0.3),))
    order.done(other, Code.UNREACHABLE, "too far", seen=(0.3, 0.4, 0.4))
    order.done(left, Code.OK, "", placed=(0.2, 0.1), seen=(0.3, 0.2, 0.4), touched=True)
    assert {ask.arm: ask.exclude_near for ask in (order.next(), order.next())} == {
        "left": ((0.2, 0.1),),
        "right": ((0.2, 0.1), (0.3, 0.4)),
    }
