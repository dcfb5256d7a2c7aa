# SPDX-License-Identifier: Apache-2.0
"""Lost messages are counted from the numbers of their publishers, whoever of several has sent them."""

from __future__ import annotations

import random
from collections.abc import Sequence

import pytest

from openarm_bringup.bags.losses import Arrivals


def missing(numbers: Sequence[int], publishers: int) -> int:
    arrivals = Arrivals()
    return sum(arrivals.missing(number, lambda: publishers) for number in numbers)


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        ([1, 2, 3], 0),
        ([500, 501, 502], 0),  # heard from there on
        ([1, 2, 5, 6, 9], 4),
        ([7, 8, 1, 2, 3], 0),  # the publisher was started again
        ([7, 8, 1, 2, 4], 1),
    ],
)
def test_gaps_of_one_publisher(numbers: list[int], lost: int) -> None:
    assert missing(numbers, 1) == lost


@pytest.mark.parametrize("seed", range(20))
def test_several_publishers_in_any_order(seed: int) -> None:
    """Interleaved streams that start anywhere: nothing is counted when all came, and all is counted that did not."""
    rng = random.Random(seed)
    starts = rng.sample(range(1, 10_000, 500), 4)
    streams = [list(range(start, start + 50)) for start in starts]
    for whole in (True, False):
        left = [list(stream) for stream in streams]
        dropped = 0
        if not whole:
            for stream in left:
                for _ in range(5):
                    stream.pop(rng.randrange(10, len(stream) - 1))
                    dropped += 1
        heads = [stream.pop(0) for stream in left]  # each is heard before anything is lost
        mixed = heads + [rng.choice([s for s in left if s]).pop(0) for _ in range(sum(map(len, left)))]
        assert missing(mixed, 4) == dropped


def test_a_publisher_that_comes_later_is_no_loss() -> None:
    arrivals = Arrivals()
    assert [arrivals.missing(n, lambda: 1) for n in (1, 2)] == [0, 0]
    assert [arrivals.missing(n, lambda: 2) for n in (900, 3, 901)] == [0, 0, 0]


def test_the_last_messages_of_a_publisher_that_has_gone_are_counted_too() -> None:
    assert missing((500, 501, 503), 0) == 1
