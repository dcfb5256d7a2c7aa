# SPDX-License-Identifier: Apache-2.0
"""Frames of one camera: what its streams publish with one stamp, and the posture of the robot at that stamp.

A frame waits in a bounded queue until its posture is known. It is never paired with the newest joint state: what can't
be answered at its stamp is refused, with the reason.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.posture import JointNeed, Posture, PostureTracker

T = TypeVar("T")

#: Stamps of which some streams have come and others not.
_INCOMPLETE = 5


_NOWHERE = Posture(np.eye(4), {})


@dataclass(frozen=True, eq=False)
class Frame(Generic[T]):
    """What the streams of a camera published with one stamp.

    Attributes:
        t_ns: The stamp.
        frame_id: Coordinate frame of the images.
        items: One of each stream, by its name.
        posture: Posture of the robot and of the camera at the stamp; identity and no joints where none is tracked.
    """

    t_ns: int
    frame_id: str
    items: Mapping[str, T]
    posture: Posture = _NOWHERE


class FrameStream(Generic[T]):
    """Matches the streams of a camera by stamp and waits for the posture of the robot. Single-threaded.

    Args:
        streams: Names of the streams that make a frame.
        tracker: Tracker of the robot; None: frames need no posture.
        frame_id: Coordinate frame that every item must have; empty: any.
        pose_of: Frame whose pose is looked up; empty: that of the items.
        joints: Whether the joints are needed.
        capacity: Frames that may wait. Then the oldest gives way; while it still waits for joint states, the new one
            does, so that of frames that come faster than joint states some are answered.
        max_rate: Frames a second of the stamps, Hz; others are passed over; 0: all.

    Attributes:
        received: Streams of which something has come.
        counts: Frames by what became of them: `taken`, `refused` (no posture), `early` (before the first joint state),
            `superseded` (by a newer one), `overrun` (the queue was full), `incomplete` (a stream did not come).
    """

    def __init__(
        self,
        streams: Sequence[str],
        tracker: PostureTracker | None = None,
        frame_id: str = "",
        *,
        pose_of: str = "",
        joints: JointNeed = "none",
        capacity: int = 5,
        max_rate: float = 0.0,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._streams = tuple(streams)
        self._tracker = tracker
        self._frame_id, self._pose_of = frame_id, pose_of
        self._joints: JointNeed = joints
        self._capacity = capacity
        self._period_ns = 0.999e9 / max_rate if max_rate else 0.0
        self._last_ns: int | None = None
        self.received: set[str] = set()
        self._partial: dict[int, dict[str, T]] = {}
        #: With the moment when each arrived, s.
        self._waiting: deque[tuple[Frame[T], float]] = deque()

    @property
    def waiting_ns(self) -> int | None:
        """Stamp of the newest frame that waits; None without one."""
        return self._waiting[-1][0].t_ns if self._waiting else None

    @property
    def silent(self) -> list[str]:
        """Streams of which nothing has come."""
        return [stream for stream in self._streams if stream not in self.received]

    def given_up(self) -> dict[str, int]:
        """Return how many frames were given up, for a report: incomplete, or waiting while the queue was full."""
        return {key: self.counts[key] for key in ("incomplete", "overrun")}

    def add(self, stream: str, t_ns: int, frame_id: str, item: T, now: float) -> None:
        """Add an item; when it completes the frame of its stamp, earlier stamps are given up.

        Args:
            stream: Its name.
            t_ns: Stamp.
            frame_id: Coordinate frame.
            item: Message or array.
            now: When it arrived, s.

        Raises:
            OpenArmError: BAD_IMAGE, for another coordinate frame: a link frame (x forward), or unaligned depth.
        """
        if self._frame_id and frame_id != self._frame_id:
            raise OpenArmError(
                Code.BAD_IMAGE,
                f"{stream} is in frame {frame_id!r}, expected the optical frame {self._frame_id!r}"
                " (z forward, x right), shared by colour, depth and CameraInfo",
            )
        self.received.add(stream)
        items = self._partial.setdefault(t_ns, {})
        items[stream] = item
        if len(items) == len(self._streams):
            self.counts["incomplete"] += sum(1 for t in self._partial if t < t_ns)
            # later stamps are kept unless time went back, in which case they fall to the limit below
            self._partial = {t: partial for t, partial in self._partial.items() if t > t_ns}
            self._enqueue(Frame(t_ns, frame_id, items), now)
        while len(self._partial) > _INCOMPLETE:
            # the first in order of arrival, not of stamps: a restarted simulation starts again from zero
            del self._partial[next(iter(self._partial))]
            self.counts["incomplete"] += 1

    def _enqueue(self, frame: Frame[T], now: float) -> None:
        # a stamp before the last one is a restarted simulation, not a frame that came too early
        if self._last_ns is not None and 0 <= frame.t_ns - self._last_ns < self._period_ns:
            return
        self._last_ns = frame.t_ns
        if self._waiting and self._waiting[-1][0].t_ns == frame.t_ns:
            return
        if len(self._waiting) == self._capacity:
            self.counts["overrun"] += 1
            if self._pending(*self._waiting[0], now):
                return
            self._waiting.popleft()
        self._waiting.append((frame, now))

    def take(self, now: float) -> Frame[T] | None:
        """Take the newest frame whose posture is known; older ones are given up. None while all of them wait.

        Args:
            now: s.

        Raises:
            OpenArmError: STALE_DATA or NO_TRANSFORM, why the newest was refused, when no other one can be had.
        """
        refusal: OpenArmError | None = None
        for i in range(len(self._waiting) - 1, -1, -1):
            frame, since = self._waiting[i]
            try:
                posture = self._posture(frame, since, now)
            except OpenArmError as error:
                del self._waiting[i]
                early = error.code is Code.STALE_DATA and self._tracker is not None and self._tracker.starting(now)
                self.counts["early" if early else "refused"] += 1
                refusal = refusal or (None if early else error)
                continue
            if posture is None:
                continue
            for _ in range(i + 1):
                self._waiting.popleft()
            self.counts["superseded"] += i
            self.counts["taken"] += 1
            return replace(frame, posture=posture)
        if refusal is not None:
            raise refusal
        return None

    def clear(self) -> None:
        """Forget what waits, and the rate."""
        self._partial.clear()
        self._waiting.clear()
        self.received.clear()
        self._last_ns = None

    def _pending(self, frame: Frame[T], since: float, now: float) -> bool:
        name = self._pose_of or frame.frame_id
        return self._tracker is not None and self._tracker.pending(name, frame.t_ns, since, now, self._joints)

    def _posture(self, frame: Frame[T], since: float, now: float) -> Posture | None:
        if self._tracker is None:
            return frame.posture
        return self._tracker.posture(self._pose_of or frame.frame_id, frame.t_ns, since, now, self._joints)
