# SPDX-License-Identifier: Apache-2.0
"""Suggestions for a name that does not exist."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from openarm_common.errors import Code, OpenArmError

#: Names that an error lists.
_MOST = 40


def unknown(what: str, name: str, known: Iterable[str]) -> OpenArmError:
    """Return the error of a name that does not exist, with similar names, or with all that exist.

    Args:
        what: Kind of the name, such as "topic".
        name: Name that was given.
        known: All that exist.
    """
    names = sorted(known)
    near = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    near += [other for other in names if name.strip("/") and name.strip("/") in other and other not in near][:3]
    some = ", ".join(names[:_MOST]) + (f" and {len(names) - _MOST} more" if len(names) > _MOST else "")
    hint = f"; did you mean {' or '.join(near)}?" if near else f"; there are {some or 'none'}"
    return OpenArmError(Code.INVALID_ARGUMENT, f"no {what} {name!r}{hint}")
