# SPDX-License-Identifier: Apache-2.0
"""Orders of several objects and their bins."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_grasp.requests.orders import Bin, Bins, Order, load_bins
from openarm_grasp.requests.request import GraspRequest

BINS = Bins(
    bins={"left": Bin(x=(0.16, 0.28), y=(0.20, 0.44)), "right": Bin(x=(0.16, 0.28), y=(-0.32, -0.20))},
    classes={"red": "left", "blue": "right"},
)


def carry_out(
    order: Order, codes: dict[GraspRequest, Code] | None = None, table: dict[str, int] | None = None
) -> list[GraspRequest]:
    """Answer every request: from `codes`, else OK while there is one on the table."""
    asked: list[GraspRequest] = []
    table = {"red": 9, "blue": 9} if table is None else dict(table)
    while ask := order.next():
        asked.append(ask)
        assert len(asked) < 50
        code = (codes or {}).get(ask, Code.OK if table.get(ask.label) else Code.UNKNOWN_OBJECT)
        if code is Code.OK:
            table[ask.label] -= 1
        order.done(ask, code, "injected")
    return asked


@pytest.mark.requirement("P-03")
def test_one_bin_per_class():
    order = Order(("red", "blue"), BINS)
    red, blue = carry_out(order)
    assert red.place is not None
    assert 0.20 < red.place[1] < 0.44
    assert blue.place == (0.22, -0.26)
    assert order.outcome == "SUCCESS"


@pytest.mark.requirement("P-03")
def test_a_single_bin_takes_all_in_slots_of_their_own():
    order = Order(("red", "blue"), Bins(bins={"tray": Bin(x=(0.15, 0.39), y=(0.10, 0.34))}, rest="tray"), each=2)
    places = [ask.place for ask in carry_out(order)]
    assert len(set(places)) == 4
    assert min(np.hypot(a[0] - b[0], a[1] - b[1]) for i, a in enumerate(places) for b in places[:i]) >= 0.1199


@pytest.mark.requirement("P-03")
def test_all_of_a_label_until_none_is_left():
    order = Order(("red",), each=20)
    assert [ask.label for ask in carry_out(order, table={"red": 3})] == ["red"] * 4
    assert order.placed == ["red"] * 3
    assert order.outcome == "SUCCESS"


@pytest.mark.requirement("P-02")
def test_an_order_done_in_part_says_so():
    order = Order(("red", "blue"))
    carry_out(order, {GraspRequest("red"): Code.TOO_WIDE})
    assert order.outcome == "PARTIAL"
    assert order.faults() == {"red": "TOO_WIDE: injected"}
    assert order.placed == ["blue"]


def test_a_label_that_was_never_there_failed():
    order = Order(("red",), each=5)
    carry_out(order, table={})
    assert order.outcome == "FAILED"
    assert "UNKNOWN_OBJECT" in order.faults()["red"]


@pytest.mark.requirement("P-19")
def test_a_taken_slot_is_passed_over_and_a_full_bin_named():
    first, second = BINS.bins["left"].slots(BINS.spacing)
    order = Order(("red",), BINS, each=3)
    asked = carry_out(order, {GraspRequest("red", place=first): Code.IN_COLLISION})
    assert [ask.place for ask in asked] == [first, second]
    assert order.placed == ["red"]
    assert order.faults() == {"red": "bin 'left' is full: it has 2 places"}


def test_orders_and_bins_that_make_no_sense_are_refused(tmp_path):
    with pytest.raises(OpenArmError, match="no bin for green; there are bins for red, blue"):
        Order(("green",), BINS)
    with pytest.raises(OpenArmError, match="an order needs labels"):
        Order(())
    path = tmp_path / "bins.yaml"
    path.write_text("bins: {a: {x: [0.2, 0.1], y: [0.0, 0.1]}}\nrest: b\n")
    with pytest.raises(OpenArmError, match="must ascend") as error:
        load_bins(path)
    assert error.value.code is Code.CONFIG_INVALID
    path.write_text("bins: {a: {x: [0.1, 0.2], y: [0.0, 0.1]}}\nrest: b\n")
    with pytest.raises(OpenArmError, match="no bin 'b'; bins: a"):
        load_bins(path)


def test_what_others_block_is_asked_for_again_when_they_are_gone():
    order = Order(("red", "blue"))
    assert order.next() == GraspRequest("red")
    order.done(GraspRequest("red"), Code.IN_COLLISION, "blue is in the way")
    assert order.next() == GraspRequest("blue")
    order.done(GraspRequest("blue"), Code.OK, "")
    assert order.next() == GraspRequest("red")
    order.done(GraspRequest("red"), Code.OK, "")
    assert order.next() is None
    assert order.outcome == "SUCCESS"


def test_what_stays_blocked_failed_with_its_reason():
    order = Order(("red", "blue"))
    carry_out(order, {GraspRequest("red"): Code.NO_PLAN, GraspRequest("blue"): Code.NO_PLAN})
    assert order.faults() == {"red": "NO_PLAN: injected", "blue": "NO_PLAN: injected"}
    assert order.outcome == "FAILED"


@pytest.mark.requirement("P-03")
def test_what_an_order_has_placed_it_does_not_pick_again():
    order = Order(("red",), each={"red": 2})
    order.done(order.next(), Code.OK, "", (0.3, -0.2, 0.4))
    assert order.next() == GraspRequest("red", exclude_near=((0.3, -0.2),))
    order.done(order.next(), Code.OK, "", (0.2, -0.2, 0.4))
    assert order.next() is None
    assert order.outcome == "SUCCESS"


def test_what_others_hide_is_asked_for_again_when_they_are_gone():
    order = Order(("red", "blue"))
    order.done(GraspRequest("red"), Code.NOTHING_DETECTED, "something hides its outline")
    order.done(GraspRequest("blue"), Code.OK, "", (0.3, 0.2, 0.4))
    assert order.next() == GraspRequest("red", exclude_near=((0.3, 0.2),))
    order.done(GraspRequest("red"), Code.TOO_WIDE, "for good")
    assert order.next() is None
    assert order.faults() == {"red": "TOO_WIDE: for good"}


@pytest.mark.requirement("P-03", "R-18")
def test_what_was_placed_is_not_asked_for_again_by_another_word():
    order = Order(("cola", "can"))
    order.done(GraspRequest("cola"), Code.OK, "", (0.3, 0.2, 0.4))
    assert order.next() == GraspRequest("can", exclude_near=((0.3, 0.2),))
