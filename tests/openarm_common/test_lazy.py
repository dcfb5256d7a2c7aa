# SPDX-License-Identifier: Apache-2.0
"""Lazily imported public names."""

from __future__ import annotations

import pytest

from openarm_common.lazy import attach


def test_a_public_name_is_imported_from_its_module_when_it_is_used() -> None:
    get, names = attach("openarm_common", {"Code": "errors"})
    from openarm_common.errors import Code

    assert get("Code") is Code
    assert names() == ["Code"]


def test_an_unknown_name_is_refused_with_the_public_ones() -> None:
    get, _ = attach("openarm_common", {"Code": "errors"})
    with pytest.raises(AttributeError, match="'Cod'; public names: Code"):
        get("Cod")
