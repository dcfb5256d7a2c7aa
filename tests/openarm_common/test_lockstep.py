# SPDX-License-Identifier: Apache-2.0
"""Which message belongs to which tick, and the order in which a tick is handled (N-18)."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.lockstep import Inbox, check_senders


async def nothing() -> None:
    """Stand in for a callback."""


def names(inbox: Inbox, due: dict[str, int]) -> list[tuple[str, int]]:
    return [(item.channel, item.number) for item in inbox.take(due)]


@given(st.randoms(use_true_random=False))
@pytest.mark.requirement("N-18")
def test_the_order_of_a_tick_does_not_depend_on_arrival(shuffle: random.Random) -> None:
    sent = [("/b", 1, 20), ("/b", 2, 30), ("/a", 1, 30), ("/c/request", 1, None), ("/a/request", 1, None)]
    shuffle.shuffle(sent)
    inbox = Inbox()
    for channel, number, stamp_ns in sent:
        inbox.add(channel, nothing, number, stamp_ns)
    order = [("/b", 1), ("/a", 1), ("/b", 2), ("/a/request", 1), ("/c/request", 1)]
    assert names(inbox, dict.fromkeys(("/a", "/b", "/a/request", "/c/request"), 9)) == order


@pytest.mark.requirement("N-18")
def test_what_was_sent_after_the_tick_waits_for_the_next() -> None:
    inbox = Inbox()
    for number in (1, 2, 3):
        inbox.add("/a", nothing, number, number)
    assert names(inbox, {"/a": 2}) == [("/a", 1), ("/a", 2)]
    inbox.close_tick()
    assert names(inbox, {"/a": 3}) == [("/a", 3)]


def test_a_tick_is_complete_when_the_last_message_has_come() -> None:
    inbox = Inbox()
    inbox.add("/a", nothing, 1, 0)
    assert inbox.missing({"/a": 2, "/b": 0}) == {"/a": 2}
    inbox.add("/a", nothing, 2, 0)
    assert inbox.missing({"/a": 2, "/b": 0}) == {}


def test_messages_without_a_number_are_counted() -> None:
    inbox = Inbox()
    for _ in range(2):
        inbox.add("/a/request", nothing)
    assert inbox.heard("/a/request") == 2


def test_what_came_before_the_first_tick_is_forgotten_but_for_latched_topics() -> None:
    inbox = Inbox()
    inbox.add("/joints", nothing, 4, 0)  # 1 to 3 were sent before this node was there
    inbox.add("/held", nothing, 2, 0)
    due = {"/joints": 5, "/held": 2}
    inbox.begin(due, lambda channel: channel == "/held")
    assert inbox.missing(due) == {}
    assert names(inbox, due) == [("/held", 2)]


def test_who_takes_no_part_is_handled_when_it_comes() -> None:
    inbox = Inbox()
    inbox.add("/from_outside", nothing, 7, 0)
    assert names(inbox, {"/a": 0}) == [("/from_outside", 7)]


def test_a_second_sender_on_a_shared_channel_is_refused() -> None:
    inbox = Inbox()
    for _ in range(2):
        inbox.add("/motion/execute/goal_request", nothing)
    inbox.close_tick()
    with pytest.raises(OpenArmError, match=r"2 messages came on /motion/execute/goal_request.*sent 1") as caught:
        inbox.take({"/motion/execute/goal_request": 1})
    assert caught.value.code == Code.INTERNAL


def test_two_participants_may_not_send_on_a_channel_that_a_third_takes_from() -> None:
    senders = {"one": {"/commands": 0, "/mine": 0}, "two": {"/commands": 3, "/mine": 0}}
    check_senders(senders, {"bridge": frozenset({"/other"})})
    with pytest.raises(OpenArmError, match="one and two both send on /commands") as caught:
        check_senders(senders, {"bridge": frozenset({"/commands"})})
    assert caught.value.code == Code.CONFIG_INVALID
