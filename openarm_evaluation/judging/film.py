# SPDX-License-Identifier: Apache-2.0
"""Pictures and films of a run. Images are (h, w, 3) RGB; times are ns of simulated time."""

from __future__ import annotations

import queue
import threading
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code, OpenArmError

Picture = NDArray[np.uint8]

#: Frames a second of the small animation, and how much faster than life it plays.
ANIMATION_FPS = 8.0
ANIMATION_SPEED = 2.0
ANIMATION_WIDTH = 480


def save_picture(path: Path, rgb: Picture) -> None:
    """Write one image; the format is the name's ending.

    Raises:
        OpenArmError: ENVIRONMENT, when it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)):
        raise OpenArmError(Code.ENVIRONMENT, f"{path} could not be written")


class Film:
    """Writes frames to a video as they come, in a thread of its own, and keeps a small version for an animation.

    A film runs at the pace of simulated time: a frame that comes late is shown until the next.

    Args:
        path: Path of the video (.mp4).
        fps: Frames a second of simulated time.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self._path = path
        self._fps = fps
        self._frames: queue.Queue[tuple[int, Picture] | None] = queue.Queue(maxsize=64)
        self._writer: cv2.VideoWriter | None = None
        self._first_ns: int | None = None
        self._written = 0
        self._small: list[Picture] = []
        self.dropped = 0
        self._thread = threading.Thread(target=self._work, name="film", daemon=True)
        self._thread.start()

    def add(self, t_ns: int, rgb: Picture) -> None:
        """Add a frame; it is dropped (and counted) when the writer is far behind."""
        try:
            self._frames.put_nowait((t_ns, rgb))
        except queue.Full:
            self.dropped += 1

    def close(self) -> int:
        """Finish the video; return its number of frames."""
        self._frames.put(None)
        self._thread.join()
        if self._writer is not None:
            self._writer.release()
            self._writer = None
        return self._written

    def save_animation(self, path: Path) -> bool:
        """Write the small animation (.webp, or .gif at forty times the size); False when there were too few frames."""
        if len(self._small) < 2:
            return False
        animation = cv2.Animation()
        animation.frames = self._small
        milliseconds = round(1000.0 / (ANIMATION_FPS * ANIMATION_SPEED))
        animation.durations = [milliseconds] * len(self._small)
        animation.loop_count = 0
        options = [cv2.IMWRITE_WEBP_QUALITY, 90] if path.suffix == ".webp" else []
        return bool(cv2.imwriteanimation(str(path), animation, options))

    def _work(self) -> None:
        while (item := self._frames.get()) is not None:
            self._append(*item)

    def _append(self, t_ns: int, rgb: Picture) -> None:
        height, width = rgb.shape[:2]
        bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
        if self._writer is None or self._first_ns is None:
            self._first_ns = t_ns
            code = cv2.VideoWriter.fourcc(*"mp4v")
            self._writer = cv2.VideoWriter(str(self._path), code, self._fps, (width, height))
            if not self._writer.isOpened():
                raise OpenArmError(Code.ENVIRONMENT, f"{self._path}: this OpenCV cannot write mp4v videos")
        seconds = (t_ns - self._first_ns) * 1e-9
        while self._written <= seconds * self._fps:
            self._writer.write(bgr)
            self._written += 1
        if len(self._small) <= seconds * ANIMATION_FPS:
            size = (ANIMATION_WIDTH, round(height * ANIMATION_WIDTH / width))
            self._small.append(cv2.resize(bgr, size, interpolation=cv2.INTER_AREA).astype(np.uint8))
