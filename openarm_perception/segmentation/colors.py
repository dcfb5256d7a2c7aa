# SPDX-License-Identifier: Apache-2.0
"""What colours say about groups of patches: parts of one plain colour that touch are one thing.

The head of a hammer and its handle meet in a notch, as two boxes do. Colour tells them apart from these where all of
both is of one colour that is not grey. Shadows leave the shares of red and green as they are (chromaticity).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from openarm_common.types import Array, Bytes
from openarm_perception.segmentation.kernels import Labels

#: Chromaticities are alike within this; grey is nearer than this to the middle.
_ALIKE, _GREY = 0.03, 0.06
#: A group has one colour when so many of its pixels are alike; darker pixels (sum of three) have none.
_PLAIN, _DARK = 0.8, 60
#: They have a common border, so long in roots of the area of the smaller, where depth steps by no more than this, mm.
_COMMON, _STEP = 0.3, 30


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
    root = root.copy()
    on = patch > 0
    label = root[patch[on]]
    total = rgb[on].astype(np.float64).sum(axis=1)
    share = rgb[on][:, :2] / np.maximum(total, 1.0)[:, None]
    color = {int(i): _plain(share[label == i], total[label == i]) for i in np.unique(label)}
    size = np.bincount(label, minlength=len(root))
    a, b = root[border[:, 0]], root[border[:, 1]]
    between = a != b
    if not between.any():
        return root
    pairs, index = np.unique(np.sort(np.stack([a[between], b[between]]), axis=0), axis=1, return_inverse=True)
    whole = np.bincount(index.ravel(), weights=border[between, 2] <= _STEP)
    for k in np.argsort(-whole, kind="stable"):
        first, second = (int(i) for i in pairs[:, k])
        mine, other = color[first], color[second]
        if mine is None or other is None or np.abs(mine - other).max() > _ALIKE:
            continue
        if whole[k] >= _COMMON * np.sqrt(min(size[first], size[second])):
            root[root == root[second]] = root[first]
    return root


def _plain(share: Array, total: Array) -> Array | None:
    """Return the chromaticity (2,) of most pixels, given theirs (n, 2) and their sums (n,); None of many colours."""
    light = total > _DARK
    if np.count_nonzero(light) < 0.5 * len(total):
        return None
    middle = np.median(share[light], axis=0)
    alike = np.abs(share[light] - middle).max(axis=1) <= _ALIKE
    return middle if alike.mean() >= _PLAIN and np.abs(middle - 1.0 / 3.0).max() > _GREY else None
