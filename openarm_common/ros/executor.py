# SPDX-License-Identifier: Apache-2.0
"""An executor of one thread that keeps its wait set.

For each callback rclpy's executors gather all entities of all nodes, open their handles and make a wait set, three
times over. With twenty services and a topic at 100 Hz that takes more time than the callbacks do. Here it is done when
an entity was made or destroyed. Callback groups, coroutines, tasks, guard conditions and waitables are treated alike.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterable
from contextlib import ExitStack, suppress
from typing import Any

from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import Executor, ExternalShutdownException, TimeoutObject
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.task import Future, Task

#: Takes what is ready of an entity; returns what runs its callback, or None when nothing is left to do.
_Take = Callable[[Any], Callable[[], Awaitable[None]] | None]
#: Kinds of entities, by their names in a node and in a wait set, in the order in which their callbacks run.
_KINDS = (
    ("timers", "timer"),
    ("subscriptions", "subscription"),
    ("guards", "guard_condition"),
    ("clients", "client"),
    ("services", "service"),
)


class WaitSetExecutor(Executor):
    """Runs callbacks in the thread that spins, as `rclpy.executors.SingleThreadedExecutor`.

    Args:
        context: Context of the nodes; None: the default one.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        #: Held while `_kept`, `_stale` or `_waiting` change.
        self._keeping = threading.RLock()
        self._kept: _Kept | None = None
        #: A thread waits on `_kept`, which changed meanwhile.
        self._waiting = self._stale = False
        #: There were tasks at the last wait.
        self._busy = False
        self._ready = deque[tuple[Any, _Take]]()
        super().__init__(context=context)

    def wake(self) -> None:
        """Wait anew: an entity was made or destroyed, or a future is done."""
        self._let_go()
        super().wake()

    def add_node(self, node: Any) -> bool:
        """Run the callbacks of a node; return whether it is new here."""
        added = super().add_node(node)
        if added:  # rclpy calls this again within, with its lock held: nothing may be waited for then
            self._let_go()
        return added

    def remove_node(self, node: Any) -> None:
        """Leave a node alone."""
        super().remove_node(node)
        self._let_go()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """End; callbacks that run are not waited for, as they run in the thread that spins."""
        with self._keeping:
            self._let_go()
            return super().shutdown(timeout_sec)

    def __del__(self) -> None:
        """Close what is open."""
        self._let_go()
        super().__del__()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Run a callback that is ready, or wait for one for `timeout_sec`; without a limit when that is negative."""
        self._run_one(timeout_sec, lambda: False)

    def spin_once_until_future_complete(self, future: Future, timeout_sec: float | TimeoutObject | None = None) -> None:
        """As `spin_once`; end when a future is done, too."""
        future.add_done_callback(lambda _: self.wake())
        self._run_one(timeout_sec.timeout if isinstance(timeout_sec, TimeoutObject) else timeout_sec, future.done)

    def _run_one(self, timeout_sec: float | None, done: Callable[[], bool]) -> None:
        end = None if timeout_sec is None or timeout_sec < 0.0 else time.monotonic() + timeout_sec
        while not self._is_shutdown and not done():
            if self._ready:
                if self._begin(*self._ready.popleft()):
                    return
            elif self._resume():
                return
            else:
                self._wait(None if end is None else max(0.0, end - time.monotonic()))
                if not self._ready and end is not None and time.monotonic() >= end:
                    return

    # --- callbacks
    def _begin(self, entity: Any, take: _Take) -> bool:
        """Run the callback of an entity up to its first wait; return False when its group does not let it."""
        group = entity.callback_group
        if not group.beginning_execution(entity):
            return False

        async def run() -> None:
            try:
                callback = None
                with suppress(InvalidHandle):  # it was destroyed meanwhile
                    callback = take(entity)
                if callback is not None:
                    await callback()
            finally:
                group.ending_execution(entity)

        task = Task(run, executor=self)
        task()
        if not task.done():
            with self._tasks_lock:
                self._tasks.append((task, None, None))
        _raise_error(task)
        return True

    def _resume(self) -> bool:
        """Resume all tasks; return whether one of them ended, which may be what another one waits for."""
        with self._tasks_lock:
            tasks: list[Task] = [task for task, _, _ in self._tasks]
        try:
            for task in tasks:
                task()
                _raise_error(task)
        finally:
            with self._tasks_lock:
                self._tasks = [one for one in self._tasks if not one[0].done() and not one[0].cancelled()]
        return any(task.done() for task in tasks)

    def _take_timer(self, tmr: Any) -> Any:
        with tmr.handle:  # one that was cancelled is in the wait set as one that is ready
            return super()._take_timer(tmr) if tmr.handle.is_timer_ready() else None

    # --- waiting
    def _wait(self, timeout_sec: float | None) -> None:
        """Wait until something is ready, the executor is woken, or the time is over."""
        with self._keeping:
            if self._is_shutdown:
                return
            if not self._context.ok():
                raise ExternalShutdownException
            new = self._kept is None
            if self._kept is None:
                self._kept = _Kept(self.get_nodes(), (self._guard, self._sigint_gc), self._context)
            with self._tasks_lock:
                was_busy, self._busy = self._busy, bool(self._tasks)
            if new or was_busy or self._busy:  # tasks keep others of their groups from running
                self._kept.select(self.can_execute)
            kept, self._waiting = self._kept, True
        try:
            found = kept.wait(timeout_sec)
            if not self._is_shutdown and not self._context.ok():
                raise ExternalShutdownException
            self._ready.extend((entity, getattr(self, f"_take_{kind}")) for kind, entity in found)
        finally:
            with self._keeping:
                self._waiting = False
                if self._stale:
                    self._let_go()

    def _let_go(self) -> None:
        """Close the wait set, and let what was destroyed go, now or when the thread that waits on it wakes."""
        with self._keeping:
            self._stale = self._waiting
            if not self._waiting and self._kept is not None:
                self._kept.close()
                self._kept = None


class _Kept:
    """A wait set, what it waits for, and the open handles of that.

    Args:
        nodes: Nodes whose entities are waited for.
        guards: Guard conditions of the executor.
        context: Context of both.
    """

    def __init__(self, nodes: Iterable[Any], guards: Iterable[Any], context: Context) -> None:
        self._guards = [guard.handle for guard in guards]
        with ExitStack() as handles:
            self._entities = {
                kind: [one for node in nodes for one in getattr(node, name) if _entered(handles, one.handle)]
                for name, kind in _KINDS
            }
            self._waitables = [one for node in nodes for one in node.waitables if _entered(handles, one)]
            for handle in (*self._guards, context.handle):
                handles.enter_context(handle)  # pyright: ignore[reportArgumentType]
            self._set: Any = self._make(context)
            self._by_pointer = {
                kind: {entity.handle.pointer: entity for entity in entities}
                for kind, entities in self._entities.items()
            }
            self._handles = handles.pop_all()

    def _make(self, context: Context) -> Any:
        """Return a wait set with room for all."""
        counts = {kind: len(entities) for kind, entities in self._entities.items()}
        counts["guard_condition"] += len(self._guards)
        counts["event"] = 0
        for waitable in self._waitables:
            more = waitable.get_num_entities()
            for kind in counts:
                counts[kind] += getattr(more, f"num_{kind}s")
        order = ("subscription", "guard_condition", "timer", "client", "service", "event")
        return _rclpy.WaitSet(*(counts[kind] for kind in order), context.handle)

    def close(self) -> None:
        """Close the handles."""
        self._handles.close()

    def select(self, can_execute: Callable[[Any], bool]) -> None:
        """Wait for the entities alone whose callbacks can be executed."""
        selected = {kind: list(filter(can_execute, entities)) for kind, entities in self._entities.items()}
        self._selected_guards = selected["guard_condition"]
        self._selected_waitables = list(filter(can_execute, self._waitables))
        self._additions = [(self._set.add_guard_condition, handle) for handle in self._guards]
        for kind, entities in selected.items():
            add = getattr(self._set, f"add_{kind}")
            self._additions += [(add, entity.handle) for entity in entities]

    def wait(self, timeout_sec: float | None) -> list[tuple[str, Any]]:
        """Wait for `timeout_sec` at most, without a limit when it is None; return kinds and entities that are ready."""
        for guard in self._selected_guards:
            if guard._executor_triggered:  # while its group was busy
                guard.trigger()
        self._set.clear_entities()
        for add, handle in self._additions:
            add(handle)
        for waitable in self._selected_waitables:
            waitable.add_to_wait_set(self._set)
        self._set.wait(-1 if timeout_sec is None else round(timeout_sec * 1e9))
        found = [("waitable", waitable) for waitable in self._selected_waitables if waitable.is_ready(self._set)]
        for kind, entities in self._by_pointer.items():
            found += [(kind, entities[key]) for key in self._set.get_ready_entities(kind) if key in entities]
        for kind, entity in found:
            if kind == "guard_condition":
                entity._executor_triggered = True
        return found


def _entered(handles: ExitStack, handle: Any) -> bool:
    """Open a handle; return whether it is still there."""
    try:
        handles.enter_context(handle)
    except InvalidHandle:
        return False
    return True


def _raise_error(task: Task) -> None:
    error = task.exception()
    if error is not None:
        raise error
