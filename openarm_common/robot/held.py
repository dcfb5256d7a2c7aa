# SPDX-License-Identifier: Apache-2.0
"""What hands hold: boxes that hang on links; m."""

from __future__ import annotations

from dataclasses import dataclass

from openarm_common.types import Array


@dataclass(frozen=True, eq=False)
class HeldBox:
    """A box that hangs on a link.

    Attributes:
        name: Name for people.
        link: Link that carries it.
        T_link_box: Its middle in the link, (4, 4).
        size: Edges (3,), m.
    """

    name: str
    link: str
    T_link_box: Array
    size: tuple[float, float, float]
