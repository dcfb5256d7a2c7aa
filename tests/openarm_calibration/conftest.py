# SPDX-License-Identifier: Apache-2.0
"""A session of the arm's own kinematics with a known mount."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.openarm_calibration.known_session import Known, make_session


@pytest.fixture
def session() -> Callable[..., Known]:
    """`make_session`."""
    return make_session
