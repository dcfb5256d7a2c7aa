# SPDX-License-Identifier: Apache-2.0
"""One cloud of several cameras in the base frame, each transformed at the stamp of its own image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from openarm_common.types import Array
from openarm_perception.geometry.depth import Points


class CloudMerger:
    """Keeps the newest cloud of each camera and merges them when every camera has a new one.

    Args:
        cameras: Names, in the order of their points in the merged cloud.
        max_age: A cloud this much older than the newest is left out, and its camera not waited for, s.
    """

    def __init__(self, cameras: Sequence[str], max_age: float) -> None:
        self._cameras = tuple(cameras)
        self._max_age_ns = round(max_age * 1e9)
        self.clear()

    def clear(self) -> None:
        """Forget all clouds, and wait for every camera again."""
        self._clouds: dict[str, tuple[int, Points]] = {}
        self._awaited = set(self._cameras)
        self._since_ns: int | None = None

    def add(self, camera: str, t_ns: int, points: Points, T_base_camera: Array) -> tuple[int, Points] | None:
        """Add the cloud of a camera; return the merged one, unless that of another camera is still to come.

        Args:
            camera: Name.
            t_ns: Stamp of its image.
            points: (n, 3) in its optical frame, m.
            T_base_camera: (4, 4) of that frame at the stamp, m.

        Returns:
            Stamp of the newest part, and points (n, 3) in the base frame, m.
        """
        if self._since_ns is not None and t_ns < self._since_ns - self._max_age_ns:
            self.clear()  # time went back: a restarted simulation
        T = T_base_camera.astype(np.float32)
        self._clouds[camera] = (t_ns, points @ T[:3, :3].T + T[:3, 3])
        self._awaited.discard(camera)
        self._since_ns = t_ns if self._since_ns is None else self._since_ns
        newest = max(stamp for stamp, _ in self._clouds.values())
        if self._awaited and newest - self._since_ns < self._max_age_ns:
            return None
        # a camera that fell silent is left out, and not waited for until it is back
        self._clouds = {name: cloud for name, cloud in self._clouds.items() if newest - cloud[0] <= self._max_age_ns}
        self._awaited, self._since_ns = set(self._clouds), newest
        return newest, np.concatenate([self._clouds[name][1] for name in self._cameras if name in self._clouds])
