# SPDX-License-Identifier: Apache-2.0
"""How numba compiles the kernels of the suite: without the GIL, and the code is kept beside the source."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit, types
from numba.core.registry import CPUDispatcher

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "no_cfunc_wrapper": True}
F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a function at its first call."""
    return _compiled(function)


def bare_kernel(function: F) -> F:
    """Compile a function that makes no array, without counting references to its arguments.

    Numba counts a reference to each array argument of a function that it does not inline, with an atomic operation at
    either end. A check of two shapes takes a dozen arrays: that was more than half of its time. The caller holds them.
    """
    return _compiled(function, error_model="numpy", _nrt=False)


class _Inner(CPUDispatcher):
    """A function that Python can't call: it would have no entry for it."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError(f"{self.__name__} is called by kernels only")


def inner_kernel(function: F) -> F:
    """The same of a function that only kernels call."""
    inner: Any = _compiled(function, error_model="numpy", _nrt=False, no_cpython_wrapper=True)
    inner.__class__ = _Inner
    return inner


def inlined_kernel(function: F) -> F:
    """Compile a small function into each of its callers."""
    return _compiled(function, inline="always")


def _compiled(function: F, **options: Any) -> F:
    compiled: Any = njit(**_OPTIONS, **options)(function)
    resolve = compiled.get_call_template

    def get_call_template(args: Any, kws: Any) -> Any:
        """Compile for the type of a constant, as for that of a variable, where numba would for each of its values."""
        return resolve(tuple(map(types.unliteral, args)), {name: types.unliteral(kind) for name, kind in kws.items()})

    compiled.get_call_template = get_call_template
    return compiled
