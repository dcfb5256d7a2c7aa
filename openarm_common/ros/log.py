# SPDX-License-Identifier: Apache-2.0
"""The logger of nodes: what others put into a message can neither move the cursor nor forge a line."""

from __future__ import annotations

from typing import Any

from rclpy.impl import rcutils_logger

from openarm_common.printable import LONGEST_LINE, printable_lines

# Throttling and the place of a call are those of the caller of this file.
rcutils_logger._internal_callers.append(__file__)  # pyright: ignore[reportPrivateUsage]


class PrintableLogger(rcutils_logger.RcutilsLogger):
    """Logs text with what is not printable escaped, and lines after the first indented."""

    def log(self, message: Any, severity: Any, **kwargs: Any) -> bool:
        """Log a message as `RcutilsLogger.log` does."""
        text = str(message)
        if len(text) > LONGEST_LINE:
            text = f"{text[: LONGEST_LINE - 1]}…"
        return super().log(printable_lines(text, "    ", colours=False), severity, **kwargs)
