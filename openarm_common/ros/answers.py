# SPDX-License-Identifier: Apache-2.0
"""Service responses with `success`, `code` and `message`: filled by the work, or by the reason why it was refused."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

from openarm_common.errors import Code, OpenArmError

ResponseT = TypeVar("ResponseT")


def answering(work: Callable[[Any, ResponseT], str]) -> Callable[[Any, ResponseT], ResponseT]:
    """Return the callback of a service whose work takes request and response, and returns the message."""
    return lambda request, response: answer(response, lambda: work(request, response))


def answer(response: ResponseT, work: Callable[[], str]) -> ResponseT:
    """Return the response with the message that the work returns, or with the error that it raises."""
    try:
        return _filled(response, Code.OK, work())
    except OpenArmError as error:
        return _filled(response, error.code, error.message)


async def answer_async(response: ResponseT, work: Callable[[], Awaitable[str]]) -> ResponseT:
    """Return the response as `answer` does, of a coroutine."""
    try:
        return _filled(response, Code.OK, await work())
    except OpenArmError as error:
        return _filled(response, error.code, error.message)


def _filled(response: ResponseT, code: Code, message: str) -> ResponseT:
    fields: Any = response
    fields.success, fields.code, fields.message = code is Code.OK, code.value, message
    return response
