# SPDX-License-Identifier: Apache-2.0
"""Orders of several objects: which to pick next and where to put it, until nothing is left or nothing can be done.

No ROS: the client or a campaign takes the next request from `Order.next` and reports to `Order.done`
what came of it. Bins are rectangles on the table, base frame, m.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from openarm_common.config import Config, Interval, load_config
from openarm_common.errors import Code, OpenArmError
from openarm_grasp.requests.request import GraspRequest

#: (x, y), base frame, m.
Spot = tuple[float, float]
#: With these another place in a bin may be had.
_BLOCKED = (Code.IN_COLLISION, Code.UNREACHABLE, Code.NO_PLAN)
#: Nothing changes these. With any other, what others hid or blocked may be had when they have been taken away.
_FINAL = (Code.TOO_WIDE, Code.INVALID_ARGUMENT, Code.CANCELLED, Code.ROBOT_LOST, Code.STOPPED, Code.NOT_READY)
#: There is no more of it in view.
_GONE = (Code.UNKNOWN_OBJECT, Code.NOTHING_DETECTED)


class Bin(Config):
    """A rectangle on the table."""

    x: Interval = Field(description="near and far edge, m")
    y: Interval = Field(description="right and left edge, m")

    def slots(self, spacing: float) -> tuple[Spot, ...]:
        """Places for objects, row by row, `spacing` apart; a small bin has one, in its middle."""
        return tuple((x, y) for x in _steps(*self.x, spacing) for y in _steps(*self.y, spacing))


def _steps(low: float, high: float, spacing: float) -> list[float]:
    n = max(1, int((high - low) / spacing + 1e-9))
    middle = (low + high) / 2.0
    return [round(float(v), 4) for v in middle + (np.arange(n) - (n - 1) / 2.0) * spacing]


class Bins(Config):
    """Bins, and which class belongs into which."""

    bins: dict[str, Bin] = Field(min_length=1, description="by name")
    classes: dict[str, str] = Field(default_factory=dict, description="name of the bin by label; others go to `rest`")
    rest: str = Field(default="", description="bin of labels that `classes` lacks; empty: they are left alone")
    spacing: float = Field(default=0.12, gt=0.02, le=0.5, description="between the middles of two objects, m")

    @model_validator(mode="after")
    def _known(self) -> Self:
        for name in (*self.classes.values(), self.rest):
            if name and name not in self.bins:
                raise ValueError(f"there is no bin {name!r}; bins: {', '.join(self.bins)}")
        return self

    def of(self, label: str) -> str:
        """Name of the bin of a label; "" when it belongs into none."""
        return self.classes.get(label, self.rest)


def load_bins(path: Path) -> Bins:
    """Read bins from a YAML file.

    Raises:
        OpenArmError: CONFIG_INVALID, naming file and key.
    """
    return load_config(path, Bins)


@dataclass
class Order:
    """Objects to be picked one after the other.

    Attributes:
        labels: Words for objects, in this order; each is asked for until none is left, as often as `each` says at most.
        bins: Where they go; None: to free spots.
        each: Most objects of one label, or of each label.
        placed: Labels that were placed, in order.
        failed: What could not be done: label and reason.
    """

    labels: Sequence[str]
    bins: Bins | None = None
    each: int | Mapping[str, int] = 1
    placed: list[str] = field(default_factory=list[str])
    failed: dict[str, str] = field(default_factory=dict[str, str])
    _used: Counter[str] = field(default_factory=Counter[str])
    _blocked: dict[str, tuple[int, str]] = field(default_factory=dict[str, tuple[int, str]])
    _stand: list[Spot] = field(default_factory=list[Spot])

    def __post_init__(self) -> None:
        """Refuse an order that asks for nothing, or for what has no bin.

        Raises:
            OpenArmError: INVALID_ARGUMENT.
        """
        if not self.labels or not all(self.labels):
            raise OpenArmError(Code.INVALID_ARGUMENT, f"an order needs labels, got {list(self.labels)}")
        homeless = [label for label in self.labels if self.bins is not None and not self.bins.of(label)]
        if homeless and self.bins is not None:
            known = ", ".join(self.bins.classes) or "no label"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no bin for {', '.join(homeless)}; there are bins for {known}")

    def next(self) -> GraspRequest | None:
        """The next request; None when the order has ended."""
        for label in dict.fromkeys(self.labels):
            most = self.each if isinstance(self.each, int) else self.each.get(label, 1)
            if label in self.failed or self.placed.count(label) >= most:
                continue
            if label in self._blocked and self._blocked[label][0] == len(self.placed):
                continue  # nothing has been taken away since
            stand = tuple(self._stand)  # whatever it was asked for as, it is not asked for again
            if self.bins is None:
                return GraspRequest(label, exclude_near=stand)
            name = self.bins.of(label)
            slots = self.bins.bins[name].slots(self.bins.spacing)
            at = self._used[name]
            if at < len(slots):
                return GraspRequest(label, place=slots[at], exclude_near=stand)
            self.failed[label] = f"bin {name!r} is full: it has {len(slots)} places"
        self.failed |= {label: why for label, (_, why) in self._blocked.items()}
        return None

    def done(self, request: GraspRequest, code: Code, message: str, where: Sequence[float] = ()) -> None:
        """Note what came of a request; `where` (x, y) is where the object stands now, when it was placed."""
        label = request.label
        self._blocked.pop(label, None)
        next_slot = code is Code.OK or (code in _BLOCKED and request.place is not None)
        if self.bins is not None and next_slot:
            self._used[self.bins.of(label)] += 1
        if code is Code.OK:
            self.placed.append(label)
            if len(where) >= 2:
                self._stand.append((float(where[0]), float(where[1])))
        elif code in _FINAL:
            self.failed[label] = f"{code}: {message}"
        elif self.bins is None or not next_slot:
            # No more of it in view, when some was placed, is what was asked for.
            why = "" if code in _GONE and label in self.placed else f"{code}: {message}"
            self._blocked[label] = (len(self.placed), why)

    @property
    def outcome(self) -> str:
        """SUCCESS when nothing failed, PARTIAL when something was placed, else FAILED."""
        if not any(self.failed.values()):
            return "SUCCESS"
        return "PARTIAL" if self.placed else "FAILED"

    def faults(self) -> Mapping[str, str]:
        """What could not be done, by label."""
        return {label: why for label, why in self.failed.items() if why}
