# SPDX-License-Identifier: Apache-2.0
"""The schedule of requests and faults."""

from itertools import islice

import pytest
from hypothesis import given
from hypothesis import strategies as st

from openarm_common.errors import OpenArmError
from openarm_evaluation.chaos.schedule import HOLDING, KINDS, STATES, known_kinds, rounds

ARMS = ("left", "right")
NODES = ["bridge", "motion", "grasp"]


@pytest.mark.long
@given(seed=st.integers(0, 2**32), kinds=st.lists(st.sampled_from(sorted(KINDS)), unique=True, min_size=1))
def test_a_seed_repeats_its_faults_and_every_kind_has_its_turn(seed: int, kinds: list[str]) -> None:
    number = 3 * len(kinds)
    first = list(islice(rounds(seed, kinds, NODES, ARMS), number))
    assert first == list(islice(rounds(seed, kinds, NODES, ARMS), number))
    drawn = [one.fault.kind for one in first if one.fault is not None]
    assert all(drawn.count(kind) == 3 for kind in kinds)
    for one in first:
        assert one.fault is not None
        assert one.fault.when in STATES
        assert bool(one.fault.node) == (one.fault.kind in ("kill", "stop", "detector", "plans"))
        assert one.fault.node in NODES or one.fault.kind not in ("kill", "stop")
        assert one.fault.when in HOLDING or one.fault.kind not in ("intruder", "rival")
    killed = [one.fault.node for one in first if one.fault and one.fault.kind == "kill"]
    assert not killed or sorted(killed) == sorted(NODES)


def test_seeds_differ_and_without_kinds_nothing_goes_wrong() -> None:
    assert list(islice(rounds(1, list(KINDS), NODES, ARMS), 9)) != list(islice(rounds(2, list(KINDS), NODES, ARMS), 9))
    assert all(one.fault is None for one in islice(rounds(1, known_kinds(["none"]), NODES, ARMS), 9))


def test_an_unknown_kind_is_refused_with_the_choices() -> None:
    with pytest.raises(OpenArmError, match="no fault is called 'earthquake'; choose of kill, stop"):
        known_kinds(["kill", "earthquake"])
    assert known_kinds([]) == tuple(KINDS)
