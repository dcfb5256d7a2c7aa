# SPDX-License-Identifier: Apache-2.0
"""Random draws that end, whatever they are drawn for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar

from openarm_common.errors import Code, OpenArmError

T = TypeVar("T")


def first_fit(what: str, way_out: str, draw: Callable[[], T | None], most: int = 1000) -> T:
    """Return the first draw that fits.

    Args:
        what: Description of what is drawn, by which seed, and of what must hold for it.
        way_out: Advice on what to change where nothing fits.
        draw: Draws once; None: it does not fit.
        most: Draws.

    Raises:
        OpenArmError: INVALID_ARGUMENT, with both, when none fits; what `draw` raises.
    """
    for _ in range(most):
        if (found := draw()) is not None:
            return found
    raise OpenArmError(Code.INVALID_ARGUMENT, f"{what}: none of {most} draws fits; {way_out}")


def until(done: Callable[[], bool], what: str, way_out: str, most: int) -> Iterator[int]:
    """Yield the numbers of draws until there are enough of what fits; arguments and errors as `first_fit`.

    Args:
        done: Asked before each draw.
        what: Description of what is drawn.
        way_out: Advice on what to change.
        most: Draws.
    """
    for number in range(most):
        if done():
            return
        yield number
    if not done():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{what}: too few of {most} draws fit; {way_out}")
