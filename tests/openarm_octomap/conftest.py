# SPDX-License-Identifier: Apache-2.0
"""The reference map that liboctomap made, and the images it is made of."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

DATA = Path(__file__).parent / "data"


@pytest.fixture(scope="session")
def reference() -> ModuleType:
    """The script that made the files in `data`; `reference.data` is their folder."""
    spec = importlib.util.spec_from_file_location("make_reference", DATA / "make_reference.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.data = DATA  # type: ignore[attr-defined]
    return module
