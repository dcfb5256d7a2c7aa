# SPDX-License-Identifier: Apache-2.0
"""Who holds which arm: for as long as a request goes on, an arm that it moves follows nobody else. Times in s."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from openarm_common.errors import Code, OpenArmError

#: Bytes at the beginning of a goal's id that say whose it is.
KEY_BYTES = 8
#: A hold that is not repeated ends after this long: its holder has died, s.
LEASE = 1.5
#: Holders that are listened to at once.
_MOST = 8


@dataclass(frozen=True)
class _Hold:
    holder: str
    arms: frozenset[str]
    until: float


class ArmHolds:
    """The holds that were announced; of two on one arm the first counts."""

    def __init__(self) -> None:
        self._holds: dict[bytes, _Hold] = {}
        #: Goals and commands that were refused.
        self.refused = 0

    def announce(self, key: bytes, holder: str, arms: Sequence[str], now: float) -> None:
        """Note what a holder holds from now on, in place of what it held before; nothing ends its hold.

        Args:
            key: First bytes of the ids of its goals.
            holder: Name of the holder, for people.
            arms: Names of the arms.
            now: Present time of any clock.
        """
        for other in [k for k, hold in self._holds.items() if hold.until < now or (k == key and not arms)]:
            del self._holds[other]
        if arms and (key in self._holds or len(self._holds) < _MOST):
            self._holds[key] = _Hold(holder, frozenset(arms), now + LEASE)

    def key_of(self, arm: str, now: float) -> bytes:
        """Key of the one that holds an arm; empty when nothing does."""
        return next((key for key, hold in self._holds.items() if arm in hold.arms and hold.until >= now), b"")

    def check(self, arm: str, goal_id: bytes, now: float) -> None:
        """Refuse a goal (by its id), or a command (by none), while another one holds the arm.

        Raises:
            OpenArmError: BUSY, naming the holder.
        """
        key = self.key_of(arm, now)
        if key and goal_id[:KEY_BYTES] != key:
            self.refused += 1
            holder = self._holds[key].holder
            raise OpenArmError(Code.BUSY, f"the {arm} arm is held by {holder}; wait until that has ended, or cancel it")
