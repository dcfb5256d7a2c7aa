# SPDX-License-Identifier: Apache-2.0
"""Lazily imported public names."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from openarm_common.lazy import attach

ROOT = Path(__file__).parents[2]
PUBLIC = [path.parent.name for path in ROOT.glob("openarm_*/__init__.py") if "attach(" in path.read_text("utf-8")]


@pytest.fixture
def package(tmp_path: Path) -> str:
    file = tmp_path / "__init__.py"
    file.write_text("if TYPE_CHECKING:\n    from openarm_common.errors import Code\n", "utf-8")
    return str(file)


def test_a_public_name_is_imported_from_its_module_when_it_is_used(package: str) -> None:
    get, names = attach("face", package)
    from openarm_common.errors import Code

    assert get("Code") is Code
    assert names() == ["Code"]


def test_an_unknown_name_is_refused_with_the_public_ones(package: str) -> None:
    get, _ = attach("face", package)
    with pytest.raises(AttributeError, match="'Cod'; public names: Code"):
        get("Cod")


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_of_a_package_can_be_imported(name: str) -> None:
    face = import_module(name)
    assert 0 < len(face.__all__) <= 12
    assert dir(face) == sorted(face.__all__)
    for public in face.__all__:
        assert getattr(getattr(face, public), "__name__", public) == public  # constants have none


def test_importing_a_package_imports_none_of_its_modules() -> None:
    code = "import sys, openarm_common; print([m for m in sys.modules if m.startswith('openarm_common.')])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert run.stdout.strip() == "['openarm_common.lazy']"
