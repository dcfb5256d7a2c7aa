# SPDX-License-Identifier: Apache-2.0
"""Who holds which arm."""

from __future__ import annotations

import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.holds import LEASE, ArmHolds

MINE, OTHER = b"12345678", b"abcdefgh"


@pytest.mark.requirement("P-21")
def test_an_arm_follows_its_holder_alone_until_that_releases_it_or_dies() -> None:
    holds = ArmHolds()
    holds.check("right", b"", 0.0)
    holds.announce(MINE, "the grasp node (a grasp of 'red')", ["right"], 0.0)
    for goal in (b"", OTHER * 2):
        with pytest.raises(OpenArmError, match=r"right arm is held by the grasp node \(a grasp of 'red'\)") as error:
            holds.check("right", goal, LEASE)
        assert error.value.code is Code.BUSY
    assert holds.refused == 2
    holds.check("right", MINE * 2, LEASE)
    holds.check("left", OTHER * 2, LEASE)
    assert (holds.key_of("right", LEASE), holds.key_of("left", LEASE)) == (MINE, b"")

    holds.check("right", OTHER * 2, LEASE + 0.01)  # not repeated: its holder has died
    holds.announce(MINE, "again", ["right", "left"], 5.0)
    holds.announce(OTHER, "later", ["right"], 5.1)
    assert holds.key_of("right", 5.2) == MINE  # the first counts
    holds.announce(MINE, "again", [], 5.3)
    assert (holds.key_of("right", 5.4), holds.key_of("left", 5.4)) == (OTHER, b"")


def test_no_more_than_a_few_holders_are_listened_to() -> None:
    holds = ArmHolds()
    for k in range(100):
        holds.announce(bytes([k]) * 8, "flood", ["left"], 0.0)
    assert len(holds._holds) == 8
    holds.announce(MINE, "one", ["right"], 2.0)
    assert holds.key_of("right", 2.0) == MINE
