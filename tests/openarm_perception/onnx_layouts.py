# SPDX-License-Identifier: Apache-2.0
"""Outputs of networks in every layout that is read, for an image of 640x480 pixels and an input of 320x256."""

from __future__ import annotations

from typing import Any

import numpy as np

#: Two boxes in the image: left, top, right, bottom.
BOX, BALL = (200, 100, 260, 160), (400, 200, 480, 320)
SEGMENT, OBB, POSE = {"task": "segment"}, {"task": "obb"}, {"task": "pose", "kpt_shape": "[5, 3]"}
MASKS = np.zeros((1, 32, 64, 80), np.float32)


def fitted(left, top, right, bottom) -> np.ndarray:
    """A box of the image in the input, which has it at half its size, 8 rows lower: x, y, width, height."""
    return np.array([(left + right) / 4, (top + bottom) / 4 + 8, (right - left) / 2, (bottom - top) / 2])


def stretched(left, top, right, bottom) -> np.ndarray:
    """A box in shares of the image, which fills the input."""
    return np.array([(left + right) / 1280, (top + bottom) / 960, (right - left) / 640, (bottom - top) / 480])


def shares(*box) -> np.ndarray:
    return fitted(*box) / (320, 256, 320, 256)


def upright(*box) -> np.ndarray:
    """Of a box that is turned by 90 degrees."""
    return fitted(*box)[[0, 1, 3, 2]]


def corners(*box) -> np.ndarray:
    x, y, width, height = fitted(*box)
    return np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2])


def columns(place, *more, first=(), n=100) -> np.ndarray:
    """(1, n, channels): a score for each class; no more than the first two say something."""
    rows = [[*place(*BOX), *first, 0.9, 0.2, *more], [*place(*BALL), *first, 0.1, 0.6, *more]]
    return np.array([rows + [[0.0] * len(rows[0])] * (n - 2)], np.float32)


def rows(place, *more, n=300) -> np.ndarray:
    """(1, n, channels): the best score and its class."""
    found = [[*place(*BOX), 0.9, 0, *more], [*place(*BALL), 0.6, 1, *more]]
    return np.array([found + [[0.0] * len(found[0])] * (n - 2)], np.float32)


def turned(output: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(output.transpose(0, 2, 1))


def labelled() -> dict[str, np.ndarray]:
    """What RT-DETR's makers export: boxes in pixels of the size that it is given, here that of the input."""
    scale, found = np.array([320, 256, 320, 256]), rows(stretched, n=2)
    x, y, w, h = (found[..., :4] * scale).transpose(2, 0, 1)
    boxes = np.stack([x - w / 2, y - h / 2, x + w / 2, y + h / 2], axis=2)
    return {"labels": found[..., 5].astype(np.int64), "boxes": boxes.astype(np.float32), "scores": found[..., 4]}


#: Outputs that say all the same, and what else the file has.
READ: dict[str, tuple[Any, dict[str, Any]]] = {
    "YOLOv8": (turned(columns(fitted)), {}),
    "YOLOv8 in shares": (turned(columns(shares)), {}),
    "YOLOv8 in halves": ({"a": turned(columns(fitted)).astype(np.float16)}, {"kind": 10}),
    "YOLOv8 of bytes": (turned(columns(fitted)), {"kind": 2}),
    "YOLOv8 transposed": (columns(fitted), {}),
    "YOLOv8 and what it came from": ({"a": turned(columns(fitted)), "b": MASKS}, {}),
    "YOLOv8-seg": ({"a": turned(columns(fitted, *[-3.0] * 32)), "b": MASKS}, {"metadata": SEGMENT}),
    "YOLOv8-pose": (turned(columns(fitted, *[-3.0] * 15)), {"metadata": POSE}),
    "YOLOv8-obb": (turned(columns(upright, np.pi / 2)), {"metadata": OBB}),
    "YOLOv5": (columns(fitted, first=(1.0,), n=5040), {}),
    "YOLOv5-seg": ({"a": columns(fitted, *[-3.0] * 32, first=(1.0,), n=5040), "b": MASKS}, {}),
    "end to end": (rows(corners), {"metadata": {"end2end": "True"}}),
    "end to end, of few": (rows(corners, n=2), {}),
    "end to end, seg": ({"a": rows(corners, *[-3.0] * 32), "b": MASKS}, {"metadata": SEGMENT}),
    "end to end, pose": (rows(corners, *[-3.0] * 15), {"metadata": POSE}),
    "end to end, obb": (rows(upright, np.pi / 2), {"metadata": OBB}),
    "RT-DETR": (columns(stretched, n=300), {}),
    "RT-DETR in rows": (rows(stretched), {"metadata": {"head": "RTDETRDecoder"}}),
    "RT-DETR of its makers": (labelled(), {"second": "orig_target_sizes"}),
}
