# SPDX-License-Identifier: Apache-2.0
"""The end of processes that are forked, and run no other program."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from typing import NoReturn


def run_and_exit(work: Callable[[], object]) -> NoReturn:
    """Do the work of a forked process, and end it as Python would: exit code, message of SystemExit, traceback.

    Destructors of libraries are not run: some (lttng-ust, which rclpy loads) wait for threads of the process before the
    fork.
    """
    code = 0
    try:
        work()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            sys.stderr.write(f"{end.code}\n")
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
