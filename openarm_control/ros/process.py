# SPDX-License-Identifier: Apache-2.0
"""The process of a node whose thread keeps time: its scheduling, its collections, its end when the thread ends."""

from __future__ import annotations

import gc
import sys
import traceback
from collections.abc import Callable
from typing import Any, TypeVar

from openarm_common.priority import use_fifo
from openarm_common.ros.node import BaseNode, ConfigT


class ControlNode(BaseNode[ConfigT]):
    """A node with a thread that controls.

    Attributes:
        scheduling: Scheduling of the process, for /diagnostics.
    """

    scheduling = ""

    def use_real_time_priority(self, priority: int) -> None:
        """Request real-time scheduling of this process; 0: stay with the ordinary one."""
        if priority:
            self.scheduling = use_fifo(priority)
            self.get_logger().info(f"scheduled as {self.scheduling}")

    def on_crash(self, error: Exception) -> None:
        """End the process after an unexpected error of the thread, so that it is restarted."""
        self.get_logger().fatal(f"the control thread ended: {error!r}\n{''.join(traceback.format_exception(error))}")
        self.context.try_shutdown()


NodeT = TypeVar("NodeT", bound=ControlNode[Any])


def timely(make: Callable[[], NodeT], priority: Callable[[NodeT], int]) -> NodeT:
    """Make a node in a process of its own, in which nothing holds its control thread up for long.

    Args:
        make: Makes it.
        priority: Priority of its process under SCHED_FIFO.
    """
    sys.setswitchinterval(0.0005)  # the thread must not wait 5 ms, the default, for another one
    node = make()
    node.use_real_time_priority(priority(node))
    gc.collect()
    gc.freeze()  # what is there now stays; later collections are short
    return node
