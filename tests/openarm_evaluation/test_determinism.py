# SPDX-License-Identifier: Apache-2.0
"""Runs in process repeat to the last bit: every joint position at every control tick, and the row of the report."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from benchmarks.determinism import Run, run_in_new_process


@pytest.mark.long
@pytest.mark.requirement("N-18")
def test_the_same_seed_is_the_same_run_to_the_last_bit_also_next_to_a_busy_process() -> None:
    first = run(3)
    assert first.codes == ("OK",)
    assert first.sim_s > 5.0
    with ThreadPoolExecutor() as pool:  # the process of the other seed keeps a core busy
        again, other = pool.map(run, (3, 4))
    assert (again.motion, again.rows) == (first.motion, first.rows)
    assert other.motion != first.motion


def run(seed: int) -> Run:
    """Run a task in a process of its own."""
    return run_in_new_process("nominal", [seed], noise=True)
