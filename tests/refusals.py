# SPDX-License-Identifier: Apache-2.0
"""What a test expects of a call that must be refused."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import ParamSpec

import pytest

from openarm_common.errors import Code, OpenArmError

P = ParamSpec("P")


@contextmanager
def refuses(code: Code, match: str | None = None) -> Iterator[pytest.ExceptionInfo[OpenArmError]]:
    """Expect an error with this code, in whose text the pattern is found."""
    with pytest.raises(OpenArmError, match=match) as caught:
        yield caught
    assert caught.value.code is code, caught.value


def refused(match: str | None, call: Callable[P, object], /, *args: P.args, **kwargs: P.kwargs) -> OpenArmError:
    """Make a call that must be refused; the error, in whose text the pattern is found."""
    with pytest.raises(OpenArmError, match=match) as caught:
        call(*args, **kwargs)
    return caught.value
