# SPDX-License-Identifier: Apache-2.0
"""Runs in process repeat to the last bit: every joint position at every control tick, and the row of the report."""

from __future__ import annotations

import pytest

from benchmarks.determinism import busy, run_in_new_process


@pytest.mark.slow
@pytest.mark.requirement("N-18")
def test_the_same_seed_is_the_same_run_to_the_last_bit_also_beside_a_busy_process() -> None:
    first = run_in_new_process("nominal", [3], noise=True)
    assert first.codes == ("OK",)
    assert first.sim_s > 5.0
    with busy(1):
        again = run_in_new_process("nominal", [3], noise=True)
    assert (again.motion, again.rows) == (first.motion, first.rows)
    other = run_in_new_process("nominal", [4], noise=True)
    assert other.motion != first.motion
