# SPDX-License-Identifier: Apache-2.0
"""Degraded mode: a graph goes on without a node that can be spared, and not without one that can't."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path

import pytest

from openarm_bringup.supervision import runs
from openarm_bringup.supervision.graph import Restart
from openarm_bringup.supervision.keeper import NodeState
from openarm_common.errors import OpenArmError
from tests.openarm_bringup.test_supervisor import in_loop, running, toy

pytestmark = pytest.mark.usefixtures("own_state")


@in_loop
async def test_a_node_that_can_be_spared_is_given_up_and_the_rest_goes_on(tmp_path: Path) -> None:
    """Degraded: the eye is lost for good, the arm stays under control, and `ps` says so."""
    nodes = {
        "eye": toy(tmp_path, "eye", restart=Restart(policy="never"), essential=False),
        "arm": toy(tmp_path, "arm", restart=Restart(policy="never")),
    }
    async with running(tmp_path, nodes) as run:
        await run.supervisor.wait_ready()
        waiting = asyncio.create_task(run.supervisor.wait_stop_asked())
        os.kill(run.supervisor.pid("eye"), signal.SIGKILL)
        await run.until(lambda: run.seen("eye")[-1] == NodeState.FAILED)
        (record,) = runs.running()
        assert record.health == "degraded, without eye"
        assert run.supervisor.states()["arm"] == NodeState.READY
        assert not waiting.done()
        assert "goes on without it" in run.events[-1].detail
        os.kill(run.supervisor.pid("arm"), signal.SIGKILL)
        with pytest.raises(OpenArmError) as caught:
            await waiting
    assert caught.value.message.startswith("arm ended by signal 9")


@in_loop
async def test_a_node_that_can_be_spared_comes_back_when_what_it_lacked_is_there_again(tmp_path: Path) -> None:
    full = tmp_path / "full"
    spec = toy(tmp_path, "map", restart=Restart(backoff=0.01, max=2, retry=0.1), essential=False)
    *python, code, ready = spec.command
    guarded = f"import os, sys; os.path.exists({str(full)!r}) and sys.exit('no room'); {code}"
    nodes = {"map": spec.model_copy(update={"command": (*python, guarded, ready)})}
    async with running(tmp_path, nodes) as run:
        await run.supervisor.wait_ready()
        full.touch()
        os.kill(run.supervisor.pid("map"), signal.SIGKILL)
        await run.until(lambda: run.seen("map").count(NodeState.FAILED) == 2)
        assert "tries again in 0.1 s: map ended with code 1 after 2 restarts" in run.events[-1].detail
        full.unlink()
        await run.until(lambda: run.seen("map")[-1] == NodeState.READY)
        (record,) = runs.running()
        assert record.health == "ready"
