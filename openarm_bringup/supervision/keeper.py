# SPDX-License-Identifier: Apache-2.0
"""Keeps one node of a graph running: start when its needs are ready, readiness, restart, stop."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Protocol

from openarm_bringup.suggest import unknown
from openarm_bringup.supervision import environment, shm
from openarm_bringup.supervision.graph import Ready
from openarm_bringup.supervision.process import NodeProcess
from openarm_common import ports
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_bringup.supervision.supervisor import Supervisor

#: A node without a sign of life for so long hangs, s; asked for with this period, s.
_HANGS_S, _LOOK_S = 10.0, 2.0
#: Period in which is noted what a node uses that is not ready yet, s.
_NOTE_S = 1.0


class Probe(Protocol):
    """Questions to the ROS graph; see `supervision.ros.readiness.ReadinessClient`."""

    def known(self, conditions: Sequence[Ready]) -> frozenset[str]:
        """Return what fulfils the conditions before a start."""
        ...

    def unmet(self, conditions: Sequence[Ready], old: frozenset[str]) -> tuple[str, ...]:
        """Return the conditions that do not hold yet."""
        ...

    def parameters(self, node: str) -> frozenset[str] | None:
        """Return the names of a node's parameters; None as long as it has not answered."""
        ...

    def silence(self, node: str) -> float:
        """Return for how long a node whose process lives has shown no sign of life, s."""
        ...

    def trouble(self, node: str) -> str:
        """Return what a node says on /diagnostics if it is a warning or an error; else empty."""
        ...

    def emergency_stop(self, seconds: float) -> str:
        """Let the joints hold; return the answer of who commands them, or why there is none within so long."""
        ...

    def close(self) -> None:
        """Leave the graph."""
        ...


class NodeState(StrEnum):
    """State of a node."""

    WAITING = "waiting"
    STARTING = "starting"
    READY = "ready"
    BACKOFF = "backoff"
    EXITED = "exited"
    FAILED = "failed"
    STOPPED = "stopped"


class Keeper:
    """One node, from the first start to the stop."""

    def __init__(self, name: str, supervisor: Supervisor) -> None:
        self.name = name
        self.spec = supervisor.graph.nodes[name]
        self.state = NodeState.WAITING
        self.process: NodeProcess | None = None
        self.restarts = 0
        self.ready = asyncio.Event()
        #: What it says on /diagnostics, if that is a warning or an error.
        self.trouble = ""
        self.log = supervisor.log_file(name)
        #: Names in /dev/shm that its processes have used.
        self.mapped: set[str] = set()
        self._supervisor = supervisor
        self._was_ready = False
        self._ports: frozenset[int] = frozenset()

    @property
    def pid(self) -> int | None:
        """Process id while it runs."""
        process = self.process
        return process.pid if process and process.returncode is None else None

    @property
    def dispensable(self) -> bool:
        """Whether the graph goes on when it is given up: one that was never ready shows a fault of the graph itself."""
        return self._was_ready and not self.spec.essential

    async def keep(self, needs: Sequence[Keeper]) -> None:
        """Start the node whenever its needs are ready, until it has ended for good.

        Raises:
            OpenArmError: NOT_READY, when it is given up; INVALID_ARGUMENT, for a parameter that it does not have.
        """
        policy = self.spec.restart
        pause = policy.backoff
        while True:
            for need in needs:
                await need.ready.wait()
            code, why, ready_s = await self._run_once()
            if code == 0 and policy.policy != "always" and self._was_ready:
                self._enter(NodeState.EXITED, why)
                return
            if ready_s > policy.forget_after:
                self.restarts = 0
            if ready_s > 0.0:
                pause = policy.backoff
            # A node that was never ready fails for a reason that a second try will not remove.
            if policy.policy == "never" or not self._was_ready:
                raise self._given_up(why)
            if self.restarts >= policy.max:
                error = self._given_up(f"{why} after {self.restarts} restarts")
                if not self.dispensable:
                    raise error
                # What it lacks may come back: memory that others had taken, a device.
                text = f"the graph goes on without it and tries again in {policy.retry:g} s: {error.message}"
                self._enter(NodeState.FAILED, text)
                await asyncio.sleep(policy.retry)
                continue
            self.restarts += 1
            self._enter(NodeState.BACKOFF, f"{why}; restart {self.restarts} of {policy.max} in {pause:g} s")
            await asyncio.sleep(pause)
            pause = min(2 * pause, policy.backoff_max)

    async def stop(self) -> None:
        """End the process by INT, TERM, KILL."""
        if self.process is None:
            return
        code = self.process.returncode
        if code is None:
            self.mapped |= shm.mapped_by(self.process.pid)
            code = await self.process.stop(self._supervisor.ladder)
        self._supervisor.tell_guard(f"-{self.process.pid}")
        if self.state not in (NodeState.FAILED, NodeState.EXITED):
            self._enter(NodeState.STOPPED, f"killed ({code})" if self.process.killed else f"code {code}")

    async def _run_once(self) -> tuple[int, str, float]:
        """Run the process until it ends; return its exit code, why it ended, and how long it was ready, s."""
        supervisor, conditions = self._supervisor, self.spec.ready
        start = supervisor.starting(self.name)
        # Endpoints of a killed process linger in discovery; only those of the new one count.
        old = await supervisor.ask(lambda probe: probe.known(conditions)) if self._was_ready else frozenset[str]()
        async with supervisor.spawning:
            if supervisor.stop_asked.is_set():
                raise asyncio.CancelledError
            self.process = process = await NodeProcess.start(start, self.log)
            self._ports = frozenset()
            supervisor.tell_guard(f"+{process.pid}")
        self._enter(NodeState.STARTING, f"pid {process.pid}")
        began = time.monotonic()
        ended = asyncio.create_task(process.wait())
        getting_ready = asyncio.create_task(self._get_ready(old))
        tasks: list[asyncio.Task[Any]] = [ended, getting_ready]
        why = ""
        try:
            await asyncio.wait(
                {ended, getting_ready}, timeout=self.spec.ready_timeout, return_when=asyncio.FIRST_COMPLETED
            )
            if not ended.done() and not getting_ready.done():
                unmet = await supervisor.ask(lambda probe: probe.unmet(conditions, old))
                missing = ", ".join(unmet) or "the list of its parameters"
                await process.stop(supervisor.ladder)
                return 1, f"was not ready after {self.spec.ready_timeout:g} s; missing: {missing}", 0.0
            ready_at = time.monotonic()
            if getting_ready.done() and not ended.done():
                getting_ready.result()
                self._was_ready = True
                self.ready.set()
                self._note_what_it_uses(process.pid)
                self._enter(NodeState.READY, f"after {ready_at - began:.1f} s")
                hanging = asyncio.create_task(self._until_it_hangs(process))
                tasks.append(hanging)
                await asyncio.wait({ended, hanging}, return_when=asyncio.FIRST_COMPLETED)
                if not ended.done():
                    why = hanging.result()
                    process.kill()
            code = await ended
        finally:
            for task in tasks:
                task.cancel()
        ready_s = time.monotonic() - ready_at if self.ready.is_set() else 0.0
        self.ready.clear()
        supervisor.tell_guard(f"-{process.pid}")
        if code:
            # It may not have taken leave of the others; its segments would take space that the next start needs.
            supervisor.ports.hold(self._ports)
            supervisor.say(f"removed from /dev/shm: {', '.join(shm.discard(self.mapped)) or 'nothing'}")
        return code, why or (f"ended by signal {-code}" if code < 0 else f"ended with code {code}"), ready_s

    async def _get_ready(self, old: frozenset[str]) -> None:
        conditions, noted_at = self.spec.ready, time.monotonic()
        while conditions and await self._supervisor.ask(lambda probe: probe.unmet(conditions, old)):
            await asyncio.sleep(self._supervisor.poll)
            if self.process is not None and time.monotonic() - noted_at > _NOTE_S:
                self._note_what_it_uses(self.process.pid)
                noted_at = time.monotonic()
        if conditions and self.spec.params and not self._was_ready:
            await self._check_parameters()

    async def _until_it_hangs(self, process: NodeProcess) -> str:
        """Wait until a process runs and shows no sign of life, and note its troubles; return what to say of it."""
        since, silence = time.monotonic(), 0.0
        while min(silence, time.monotonic() - since) < _HANGS_S:
            await asyncio.sleep(_LOOK_S)
            silence = await self._supervisor.ask(lambda probe: probe.silence(self.name))
            trouble = await self._supervisor.ask(lambda probe: probe.trouble(self.name))
            if trouble != self.trouble:
                self.trouble = trouble
                self._supervisor.record()
            if process.stopped:
                since = time.monotonic()
        return f"hung: no sign of life for {silence:.0f} s"

    def _note_what_it_uses(self, pid: int) -> None:
        self.mapped |= shm.mapped_by(pid)
        self._ports |= ports.used_by(pid, environment.domain_id(self._supervisor.graph))

    async def _check_parameters(self) -> None:
        """Refuse parameters that the node does not have; ROS would ignore them silently."""
        while (existing := await self._supervisor.ask(lambda probe: probe.parameters(self.name))) is None:
            await asyncio.sleep(self._supervisor.poll)
        for param in self.spec.params:
            if param not in existing:
                own = [name for name in existing if not name.startswith("qos_overrides")]
                raise unknown(f"parameter of {self.name}", param, own)

    def _given_up(self, why: str) -> OpenArmError:
        tail = "\n".join(list(self.process.tail)[-12:]) if self.process else ""
        return OpenArmError(Code.NOT_READY, f"{self.name} {why}; its log {self.log.path} ends with:\n{tail}")

    def _enter(self, state: NodeState, detail: str) -> None:
        self.state, self.trouble = state, ""
        self._supervisor.changed(self.name, state, detail)
