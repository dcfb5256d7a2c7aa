# SPDX-License-Identifier: Apache-2.0
"""Commands run in this process."""

from __future__ import annotations

import pytest

from openarm_bringup import cli


def calibrate(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    """Exit code and output of `openarm calibrate`."""
    code = cli.run(["calibrate", *argv])
    out, err = capsys.readouterr()
    return code, out, err
