# SPDX-License-Identifier: Apache-2.0
"""The thread that keeps a camera open: it opens it again when it is gone."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress

from openarm_common.errors import OpenArmError
from openarm_hardware.cameras.source import CameraFrame, CameraSource

#: A picture is waited for so long at a time; a camera that gave none for so long is opened again, s.
_READ_S, _SILENT_S = 0.2, 2.0
#: Between two attempts to open a camera: at first, and at most, s.
_RETRY_S, _RETRY_MOST_S = 0.5, 5.0


class CameraFeed:
    """Reads a camera until `close`.

    Args:
        source: The camera.
        take: Called with each picture, in the thread of the feed.
        silent_s: A camera that gave no picture for so long is opened again.

    Attributes:
        device: Name of the device, in words; empty while it is not open.
        fault: Why there are no pictures; empty: there are.
        frames: Pictures so far.
        opened: Number of times that it was opened.
    """

    def __init__(self, source: CameraSource, take: Callable[[CameraFrame], None], silent_s: float = _SILENT_S) -> None:
        self._source, self._take, self._silent_s = source, take, silent_s
        self.device, self.fault = "", "the camera is being opened"
        self.frames = self.opened = 0
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """End the thread and close the camera."""
        self._ends.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        wait_s = _RETRY_S
        while not self._ends.is_set():
            try:
                self.device = self._source.open()
                self.opened += 1
                if self._read():
                    wait_s = _RETRY_S
            except OpenArmError as error:
                self.fault = error.message
            except Exception as error:  # of a library: the camera is opened again, and what it was is said
                self.fault = f"the camera failed: {error!r}"
            finally:
                self.device = ""
                with suppress(Exception):
                    self._source.close()
            self._ends.wait(wait_s)
            wait_s = min(2.0 * wait_s, _RETRY_MOST_S)

    def _read(self) -> bool:
        """Hand on pictures until there are none; return whether there were any."""
        silent_s, found = 0.0, False
        while not self._ends.is_set():
            frame = self._source.read(_READ_S)
            if frame is not None:
                silent_s, found, self.fault = 0.0, True, ""
                self.frames += 1
                self._take(frame)
                continue
            silent_s += _READ_S
            if silent_s > self._silent_s:
                self.fault = f"{self.device} gave no picture for {silent_s:.1f} s; it is opened again"
                return found
        return found
