# SPDX-License-Identifier: Apache-2.0
"""Learning a hand: where its fingers stop, closed on nothing and wide open, and how they press then.

Zeros of motors, thickness of pads and stops differ from hand to hand, so no hand reads what its drawing says. m, N.
"""

from __future__ import annotations

from openarm_common.errors import Code, OpenArmError
from openarm_common.records import now
from openarm_common.robot.zeros import HandReach
from openarm_grasp.evidence.verdicts import Evidence, learn_command
from openarm_grasp.robot.skills import Skills

#: Shares of the drawn opening: an empty hand stays open by no more than the one, and opens by no less than the other.
CLOSED, OPENED = 0.1, 0.6
#: Gaps of two closings on nothing differ by no more, m.
_REPEATED = 0.001


async def learn_hand(robot: Skills, arm: str, settle: float) -> HandReach:
    """Close a hand on nothing, open and close it again, and return what it reads at both ends.

    Args:
        robot: Carries out.
        arm: Arm of the hand.
        settle: Longest wait for the fingers to rest, s.

    Raises:
        OpenArmError: NOT_READY, when something is between the fingers, or keeps them from opening: an object is not
            learned as the end of a hand. One that was open then is opened again.
    """
    hand = robot.description.described.hand(arm)
    drawn = hand.parts.opening
    wide = robot.aperture(arm) >= 2.0 * OPENED * drawn

    async def at(finger: float, what: str) -> Evidence:
        what = f"{arm} hand: {what}"
        if not await robot.robot.grip(arm, hand.joint, hand.position(finger), what):
            raise OpenArmError(Code.EXECUTION_FAILED, f"{what}: the fingers neither arrived nor stopped")
        return await robot.measure(arm, 0.0, settle=settle)

    def refuse(text: str) -> OpenArmError:
        text = f"the {arm} hand {text}; take out what is between its fingers, then {learn_command(arm)}"
        return OpenArmError(Code.NOT_READY, f"{text}; nothing was learned")

    if robot.held_box(arm) is not None:
        raise refuse("holds what was picked")
    first = await at(0.0, "close on nothing")
    if not abs(first.gap) <= 2.0 * CLOSED * drawn:
        if wide:
            await at(drawn, "open again")
        raise refuse(f"closes to {first.gap * 1e3:.1f} mm, expected 0 to {2e3 * CLOSED * drawn:.1f} mm of an empty one")
    opened = (await at(drawn, "open")).gap
    if not opened >= 2.0 * OPENED * drawn:
        raise refuse(f"opens to {opened * 1e3:.1f} mm, expected {2e3 * OPENED * drawn:.1f} to {2e3 * drawn:.1f} mm")
    closed = await at(0.0, "close on nothing again")
    if abs(closed.gap - first.gap) > _REPEATED:
        raise refuse(f"closes to {first.gap * 1e3:.1f} mm, and then to {closed.gap * 1e3:.1f} mm")
    return HandReach(closed=0.5 * closed.gap, opened=min(0.5 * opened, drawn), effort=abs(closed.effort), learned=now())
