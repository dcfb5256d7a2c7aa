# SPDX-License-Identifier: Apache-2.0
"""Scheduling of the process that keeps time, as ros2_control does it: real-time where the system allows it.

Control and simulated physics take 1 to 2 ms of every 10 ms, but on a machine with two busy cores an ordinary thread
that wakes up may wait several milliseconds for its turn. Under SCHED_FIFO it does not wait.
"""

from __future__ import annotations

import os


def use_fifo(priority: int) -> str:
    """Schedule every thread of this process as SCHED_FIFO; what they start later is scheduled as usual.

    All of them, because a thread that may be preempted while it holds the interpreter holds up the one that may not.

    Args:
        priority: 1 to 99; 0 leaves everything as it is.

    Returns:
        Description of how the process is scheduled now.
    """
    if priority == 0:
        return "SCHED_OTHER"
    try:
        for thread in os.listdir("/proc/self/task"):
            os.sched_setscheduler(int(thread), os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError:
        return (
            f"SCHED_OTHER: this user may not use real-time priority {priority}; joint states are late when the machine "
            f"is busy. To allow it: `ulimit -r {priority}` (an rtprio line in /etc/security/limits.conf), or "
            "--cap-add=SYS_NICE in a container"
        )
    return f"SCHED_FIFO {priority}"
