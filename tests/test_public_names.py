# SPDX-License-Identifier: Apache-2.0
"""The examples with which packages introduce their public names."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = sorted(path.parent.name for path in ROOT.glob("openarm_*/__init__.py"))


@pytest.mark.parametrize("package", PACKAGES)
def test_the_example_of_a_package_runs(package: str) -> None:
    result = doctest.testmod(importlib.import_module(package))
    assert result.attempted > 0
    assert result.failed == 0
