# SPDX-License-Identifier: Apache-2.0
"""Streams matched by stamp."""

from __future__ import annotations

import pytest

from openarm_perception.detection.matching import StampMatcher


@pytest.fixture
def complete() -> list[tuple[int, dict[str, str]]]:
    """What came together."""
    return []


@pytest.fixture
def matcher(complete) -> StampMatcher[str]:
    """Two streams."""
    return StampMatcher(("color", "depth"), lambda t_ns, items: complete.append((t_ns, items)), capacity=3)


def test_equal_stamps_come_together_in_any_order(matcher, complete) -> None:
    matcher.add("color", 10, "c10")
    matcher.add("depth", 10, "d10")
    matcher.add("depth", 20, "d20")
    matcher.add("color", 20, "c20")
    assert complete == [(10, {"color": "c10", "depth": "d10"}), (20, {"color": "c20", "depth": "d20"})]
    assert matcher.dropped == 0


def test_different_stamps_never_do(matcher, complete) -> None:
    for t in range(0, 100, 10):
        matcher.add("color", t, "c")
        matcher.add("depth", t + 1, "d")
    assert complete == []


def test_a_lost_message_costs_its_moment_only(matcher, complete) -> None:
    matcher.add("color", 10, "c10")
    matcher.add("color", 20, "c20")
    matcher.add("depth", 20, "d20")
    matcher.add("depth", 10, "d10")
    assert [t for t, _ in complete] == [20]
    assert matcher.dropped == 1


def test_time_may_start_again(matcher, complete) -> None:
    """A restarted simulation stamps from zero: what waits from before does not block it."""
    for t in (1000, 1010, 1020):
        matcher.add("color", t, "old")
    for t in (0, 10, 20, 30):
        matcher.add("color", t, "c")
        matcher.add("depth", t, "d")
    assert [t for t, _ in complete] == [0, 10, 20, 30]


def test_cleared_moments_are_gone(matcher, complete) -> None:
    matcher.add("color", 10, "c10")
    matcher.clear()
    matcher.add("depth", 10, "d10")
    assert complete == []
