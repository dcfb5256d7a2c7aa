# SPDX-License-Identifier: Apache-2.0
"""What colours say about groups of patches: parts of one plain colour that touch are one thing.

The head of a hammer and its handle meet in a notch, as two boxes do. Colour tells them apart from these where all of
both is of one colour that is not grey. Shadows leave the shares of red and green as they are (chromaticity). So are
parts one thing, whatever their colour, when neither depth nor colour steps along their common border.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from openarm_common.types import Array, Bytes, Mask
from openarm_perception.segmentation.kernels import Labels

#: Chromaticities are alike within this; grey is nearer than this to the middle.
_ALIKE, _GREY = 0.03, 0.06
#: A group has one colour when so many of its pixels are alike; darker pixels (sum of three) have none.
_PLAIN, _DARK = 0.8, 60
#: They have a common border, so long in roots of the area of the smaller, where depth steps by no more than this, mm.
_COMMON, _STEP = 0.3, 30
#: Across a border without an edge, pixels so far on both sides of it differ by no more than this in each channel, for
#: this share of it; next to it an image mixes both. And depth is whole along this share.
_BESIDE, _EDGE, _SMOOTH, _UNBROKEN = 2, 20, 0.6, 0.75


def join_alike(root: Labels, patch: Labels, border: Labels, rgb: Bytes) -> NDArray[np.int32]:
    """Join groups that touch and have the same plain colour.

    Args:
        root: (n,) group of each patch.
        patch: (h, w) patch of each pixel, 0: none.
        border: (k, 3) as of `borders`.
        rgb: (h, w, 3).

    Returns:
        (n,) groups.
    """
    on = patch > 0
    label = root[patch[on]]
    total = rgb[on].astype(np.float64).sum(axis=1)
    share = rgb[on][:, :2] / np.maximum(total, 1.0)[:, None]
    color = {int(i): _plain(share[label == i], total[label == i]) for i in np.unique(label)}

    def alike(first: int, second: int) -> bool:
        mine, other = color[first], color[second]
        return mine is not None and other is not None and bool(np.abs(mine - other).max() <= _ALIKE)

    return _joined(root, patch, border, border[:, 2] <= _STEP, alike)


def join_smooth(root: Labels, patch: Labels, border: Labels, rgb: Bytes) -> NDArray[np.int32]:
    """Join groups along whose border neither depth nor colour steps, whatever their colours; as `join_alike`."""
    smooth = _smooth(root[patch], rgb)
    return _joined(root, patch, border, border[:, 2] == 0, lambda a, b: (a, b) in smooth, least=_UNBROKEN)


def _joined(
    root: Labels, patch: Labels, border: Labels, whole: Mask, alike: Callable[[int, int], bool], least: float = 0.0
) -> NDArray[np.int32]:
    """Join groups that are alike and have a common border, which is whole (k,) along some share at least."""
    root = root.copy()
    size = np.bincount(root[patch[patch > 0]], minlength=len(root))
    a, b = root[border[:, 0]], root[border[:, 1]]
    between = a != b
    if not between.any():
        return root
    pairs, index = np.unique(np.sort(np.stack([a[between], b[between]]), axis=0), axis=1, return_inverse=True)
    length, unbroken = np.bincount(index.ravel()), np.bincount(index.ravel(), weights=whole[between])
    for k in np.argsort(-unbroken, kind="stable"):
        first, second = (int(i) for i in pairs[:, k])
        common = unbroken[k] >= _COMMON * np.sqrt(min(size[first], size[second]))
        if common and unbroken[k] >= least * length[k] and alike(first, second):
            root[root == root[second]] = root[first]
    return root


def _smooth(label: Labels, rgb: Bytes) -> set[tuple[int, int]]:
    """Return the pairs of labels (h, w), smaller first, along whose common border no edge of colour runs."""
    pairs, steps = list[NDArray[np.int64]](), list[NDArray[np.bool_]]()
    for axis in (0, 1):
        n = label.shape[axis]
        ends = [np.take(label, np.arange(k, n - 2 * _BESIDE + k), axis=axis) for k in range(2 * _BESIDE + 1)]
        a, b = ends[0], ends[-1]
        across = (a != b) & (a > 0) & (b > 0)
        for one in ends[1:-1]:
            across &= (one == a) | (one == b)
        first = np.take(rgb, np.arange(n - 2 * _BESIDE), axis=axis)[across].astype(np.int64)
        last = np.take(rgb, np.arange(2 * _BESIDE, n), axis=axis)[across].astype(np.int64)
        pairs.append(np.sort(np.stack([a[across], b[across]], axis=-1).astype(np.int64), axis=-1))
        steps.append(np.abs(first - last).max(axis=1) <= _EDGE)
    found, index = np.unique(np.concatenate(pairs), axis=0, return_inverse=True)
    share = np.bincount(index.ravel(), weights=np.concatenate(steps)) / np.maximum(np.bincount(index.ravel()), 1)
    return {(int(i), int(j)) for (i, j), s in zip(found, share, strict=True) if s >= _SMOOTH}


def _plain(share: Array, total: Array) -> Array | None:
    """Return the chromaticity (2,) of most pixels, given theirs (n, 2) and their sums (n,); None of many colours."""
    light = total > _DARK
    if np.count_nonzero(light) < 0.5 * len(total):
        return None
    middle = np.median(share[light], axis=0)
    alike = np.abs(share[light] - middle).max(axis=1) <= _ALIKE
    return middle if alike.mean() >= _PLAIN and np.abs(middle - 1.0 / 3.0).max() > _GREY else None
