# SPDX-License-Identifier: Apache-2.0
"""Kernels: what they are compiled for, who may call them, and that it is said."""

from __future__ import annotations

from typing import Any

import pytest
from numba import njit
from numba.core.caching import NullCache

from openarm_common.compiling import announce
from openarm_common.kernels import bare_kernel, inner_kernel, kernel


@inner_kernel
def _plus(a: int, up: bool) -> int:
    return a + 1 if up else a - 1


@bare_kernel
def _twice(a: int) -> int:
    return _plus(_plus(0, True) + a, False) + _plus(a, up=True) + _plus(3, False)


@kernel
def _all(a: int) -> int:
    return _twice(a) + _twice(7)


def test_a_constant_is_compiled_for_as_a_variable_is() -> None:
    for one in (_plus, _twice, _all):
        one._cache = NullCache()  # what an earlier run has compiled would have no signatures
    assert _all(5) == (5 + 6 + 2) + (7 + 8 + 2)
    compiled: Any = _plus
    assert len(compiled.signatures) == 1


def test_python_calls_no_inner_kernel() -> None:
    _all(5)
    with pytest.raises(TypeError, match="_plus is called by kernels only"):
        _plus(1, up=True)


def test_a_package_is_said_to_be_compiled_once_and_those_of_others_are_not() -> None:
    said: list[str] = []
    announce(said.append)
    for package in ("openarm_toy.shapes", "openarm_toy.shapes", "numpy_toy", "openarm_toy.maps"):

        def function(a: int) -> int:
            return a

        function.__module__ = f"{package}.kernels"
        njit(function)(1)
    assert said == [
        f"compiling kernels of openarm_toy.{name}: once, and it takes some seconds" for name in ("shapes", "maps")
    ]
