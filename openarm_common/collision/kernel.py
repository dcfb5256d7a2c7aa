# SPDX-License-Identifier: Apache-2.0
"""How numba compiles the kernels that are called most."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}
F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a function that makes no array, without the GIL and without counting references to its arguments.

    Numba counts a reference to each array argument of a function that it does not inline, with an atomic operation at
    either end. A check of two shapes takes a dozen arrays: that was more than half of its time. The caller holds them.
    """
    compiled: Any = njit(**_OPTIONS)(function)
    return compiled
