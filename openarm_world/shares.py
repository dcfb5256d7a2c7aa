# SPDX-License-Identifier: Apache-2.0
"""The one question on an object: moved so, how many of its points are seen, seen through, or hidden?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.depth_view import DepthImage, DepthView
from openarm_common.kernels import kernel
from openarm_common.types import Array, Floats
from openarm_world.config import WorldConfig

#: States of points.
SEEN, FREE, HIDDEN = np.int8(1), np.int8(-1), np.int8(0)
#: Pixel of the image that a cloud makes, rad: three reach from a point to the next one, where clouds have every second.
_PIXEL = 0.002
#: Half the width of that image, pixels: 50 degrees.
_HALF = 600
#: Steps of the search for a motion, m; rounds of each; more points say nothing new.
_STEPS, _ROUNDS, _POINTS = (0.008, 0.004, 0.002, 0.001), 8, 500
#: Motions whose shares seen differ by less explain an image as well.
_AS_WELL = 0.01


@dataclass(frozen=True)
class Shares:
    """Shares of the points of an object; their sum is 1.

    Attributes:
        seen: Depth ends at them.
        free: Depth ends behind them: the camera sees through.
        hidden: Depth ends in front of them, or is not measured, or they are out of the image.
    """

    seen: float
    free: float
    hidden: float

    @property
    def in_view(self) -> float:
        """Share of the points that says anything."""
        return self.seen + self.free

    @property
    def left(self) -> float:
        """Share of those in view that is not where it should be; 0 when none is in view."""
        return self.free / self.in_view if self.in_view else 0.0


def explain(points: Array, T_motion: Array, view: DepthView, config: WorldConfig = WorldConfig()) -> Shares:  # noqa: B008 - frozen
    """Ask where the points of an object are that has moved.

    Args:
        points: (n, 3) on its surface, where it was, base frame, m.
        T_motion: (4, 4) how it has moved since, in the base frame; the identity: it stands.
        view: Depth without the noise of single pixels.
        config: Thresholds of what counts as seen.
    """
    state = look(points, T_motion, view, config)
    n = max(len(state), 1)
    seen, free = np.count_nonzero(state == SEEN) / n, np.count_nonzero(state == FREE) / n
    return Shares(seen, free, 1.0 - seen - free)


def fit(
    points: Array,
    T_motion: Array,
    view: DepthView,
    config: WorldConfig = WorldConfig(),  # noqa: B008 - frozen
    *,
    turns: bool = True,
) -> tuple[Array, Shares]:
    """Find the motion (4, 4) near to one with which most points are seen, and the shares.

    By coordinate descent, and then to the middle of what explains the image as well. Where something has come to rest a
    little elsewhere, or its camera is a little elsewhere than believed, the motion says by how much, and the shares
    judge the shape.

    Args:
        points: (n, 3) as of `explain`, at least one.
        T_motion: Same as for `explain`.
        view: Same as for `explain`.
        config: Same as for `explain`.
        turns: True if it may have turned about the vertical, too, and not only shifted.
    """
    some = points[:: max(1, len(points) // _POINTS)]
    middle = se3.apply(T_motion, some).mean(axis=0)
    reach = max(float(np.linalg.norm(some - some.mean(axis=0), axis=1).max()), _STEPS[0])  # its ends turn by a step

    def moved(x: Array) -> Array:
        return se3.make(se3.rot_z(x[3] / reach), middle + x[:3]) @ se3.make(p=-middle) @ T_motion

    def score(x: Array) -> float:
        return explain(some, moved(x), view, config).seen

    x, axes = np.zeros(4), np.eye(4)[: 3 + turns]
    best = score(x)
    for step in _STEPS:
        for _ in range(_ROUNDS):
            before = best
            for way in (*axes, *-axes):
                if (now := score(x + step * way)) > best:
                    best, x = now, x + step * way
            if best == before:
                break
    for axis in axes:
        ends = [0, 0]
        for k, way in enumerate((axis, -axis)):
            while ends[k] < _ROUNDS and score(x + (ends[k] + 1) * _STEPS[-1] * way) > best - _AS_WELL:
                ends[k] += 1
        x = x + 0.5 * (ends[0] - ends[1]) * _STEPS[-1] * axis
    return moved(x), explain(some, moved(x), view, config)


def view_of(points: Floats, camera: Array) -> DepthView:
    """Return the depth image that points make from where they were seen; where there is none it has no depth.

    Args:
        points: (n, 3) base frame, m.
        camera: (3,) origin of the optical frame that they were seen in, base frame, m.
    """
    ahead = points.mean(axis=0, dtype=np.float64) - camera if len(points) else np.array([0.0, 0.0, -1.0])
    T_base_camera = se3.make(se3.rotation_from_z_y(ahead, np.eye(3)[np.abs(ahead).argmin()]), camera)
    local = se3.apply(se3.inverse(T_base_camera), points.astype(np.float64))
    local = local[np.abs(local[:, :2]).max(axis=1) < _HALF * _PIXEL * local[:, 2]]
    u, v = (np.floor(local[:, :2] / local[:, 2:] / _PIXEL + 0.5).astype(np.int64) + _HALF).T
    size, f = 2 * _HALF + 1, 1.0 / _PIXEL
    depth = np.full((size, size), np.inf, np.float32)
    np.minimum.at(depth, (v, u), local[:, 2].astype(np.float32))
    depth[np.isinf(depth)] = np.nan
    return DepthView(depth, Intrinsics(size, size, f, f, _HALF, _HALF), T_base_camera, 0.0, np.inf)


def look(
    points: Array,
    T_motion: Array,
    view: DepthView,
    config: WorldConfig = WorldConfig(),  # noqa: B008 - frozen
) -> NDArray[np.int8]:
    """Return the state (n,) of each point, SEEN, FREE or HIDDEN; arguments as `explain`."""
    T, lens = se3.inverse(view.T_base_camera) @ T_motion, view.intrinsics
    pinhole = np.array([lens.fx, lens.fy, lens.cx, lens.cy])
    state = np.empty(len(points), np.int8)
    points = np.ascontiguousarray(points, np.float64)
    _look(points, T, view.depth, view.scale, pinhole, config.noise, config.least_noise, state)
    return state


@kernel
def _look(
    points: Array,
    T: Array,
    depth: DepthImage,
    scale: np.float32,
    pinhole: Array,
    noise: float,
    least: float,
    state: NDArray[np.int8],
) -> None:
    """Judge each point by the 3 x 3 pixels about its own: it is rounded to one of them, and surfaces slope."""
    height, width = depth.shape
    fx, fy, cx, cy = pinhole
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        d = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        state[i] = 0
        if d <= 0.0:
            continue
        u = int(np.floor((T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / d * fx + cx + 0.5))
        v = int(np.floor((T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / d * fy + cy + 0.5))
        if not (1 <= u < width - 1 and 1 <= v < height - 1):
            continue
        within = max(noise * d * d, least)
        behind, nearer, at = False, False, False
        for a in range(v - 1, v + 2):
            for b in range(u - 1, u + 2):
                measured = depth[a, b] * scale
                if not measured > 0.0:  # nor NaN
                    continue
                off = measured - d
                behind |= off > within
                nearer |= off < -within
                at |= abs(off) <= within
        state[i] = 1 if at else -1 if behind and not nearer else 0
