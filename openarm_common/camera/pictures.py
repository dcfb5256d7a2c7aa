# SPDX-License-Identifier: Apache-2.0
"""Compressed pictures: files of images, and the depth of `compressed_depth_image_transport`."""

from __future__ import annotations

import io
import struct
import warnings
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.kernels import kernel
from openarm_common.types import Bytes, Floats

#: Most pixels of a picture.
MOST_PIXELS = 32_000_000
_PNG = b"\x89PNG"
#: Header of compressed depth: format, and two parameters of inverse depth; of RVL, width and height follow.
_HEAD, _SIZE = struct.Struct("<iff"), struct.Struct("<ii")


def decode_picture(data: bytes, where: str) -> NDArray[Any]:
    """Decode a PNG, JPEG or the like, as it is in the file: (h, w), or (h, w, channels) with blue first.

    Args:
        data: Content of the file; its header is asked before anything is unpacked.
        where: Subject of the error.

    Raises:
        OpenArmError: BAD_IMAGE, when it is none, damaged, or larger than `MOST_PIXELS`.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data)) as head:
                width, height = head.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise _bad(f"{where} is no image that can be read, expected PNG or JPEG: {type(error).__name__}") from error
    if width * height > MOST_PIXELS:
        raise _bad(f"{where} is {width}x{height} pixels, expected at most {MOST_PIXELS}")
    if data.startswith(_PNG) and not _is_whole(data):
        raise _bad(f"{where} is damaged: a part of the PNG is longer than all of it; copy it again")
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        picture = None
    if picture is None or picture.shape[:2] != (height, width):  # pyright: ignore[reportUnnecessaryComparison]
        raise _bad(f"{where} is damaged, or of a form that is not read; expected PNG or JPEG")
    return picture


def _is_whole(png: bytes) -> bool:
    """Whether no part of a PNG says that it is longer than what follows: memory is taken for what it says."""
    at = 8
    while at + 12 <= len(png):
        (length,) = struct.unpack_from(">I", png, at)
        at += 12 + length
    return at <= len(png)


def decode_depth(data: bytes, encoding: str, where: str) -> NDArray[np.uint16] | Floats:
    """Decode the depth of a CompressedImage `…/compressedDepth`: uint16 counts (h, w), or float32 m.

    The layout is that of ROS 2's image_transport_plugins; RVL is Wilson 2017, "Fast lossless depth image compression".

    Args:
        data: Content of the message.
        encoding: 16UC1, or 32FC1, which is inverse depth.
        where: Subject of the error.

    Raises:
        OpenArmError: BAD_IMAGE, when it is damaged.
    """
    if len(data) <= _HEAD.size + _SIZE.size:
        raise _bad(f"{where} has {len(data)} bytes of compressed depth, expected a header of 12 and a picture")
    _, a, b = _HEAD.unpack_from(data)
    body = data[_HEAD.size :]
    counts = decode_picture(body, where) if body.startswith(_PNG) else _of_rvl(body, where)
    if counts.ndim != 2 or counts.dtype != np.uint16:
        raise _bad(f"{where} has compressed depth of {counts.dtype} {counts.shape}, expected 16 bits of one channel")
    if encoding != "32FC1":
        return counts
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(a) / (counts.astype(np.float32) - np.float32(b))
    return np.where(counts > 0, depth, np.float32(np.nan)).astype(np.float32)


def _of_rvl(body: bytes, where: str) -> NDArray[np.uint16]:
    width, height = _SIZE.unpack_from(body)
    if not (width > 0 and height > 0 and width * height <= MOST_PIXELS):
        raise _bad(f"{where} has compressed depth of {width}x{height} pixels; expected PNG, or RVL of a picture")
    words = np.frombuffer(body[_SIZE.size : len(body) - len(body) % 4], "<u4")
    out = np.zeros(width * height, np.uint16)
    if _unpack_rvl(words.astype(np.uint32), out) != len(out):
        raise _bad(f"{where} has compressed depth that is damaged or cut")
    return out.reshape(height, width)


@kernel
def _number(words: NDArray[np.uint32], nibble: int) -> tuple[int, int]:
    """Return a number and the nibble after it: three bits each, the lowest first, the fourth says whether more follow.

    The number is -1 where the data end.
    """
    value, shift = 0, 0
    while nibble < 8 * len(words) and shift < 33:
        bits = (int(words[nibble >> 3]) >> (28 - 4 * (nibble & 7))) & 15
        nibble += 1
        value |= (bits & 7) << shift
        shift += 3
        if not bits & 8:
            return value, nibble
    return -1, nibble


@kernel
def _unpack_rvl(words: NDArray[np.uint32], out: NDArray[np.uint16]) -> int:
    """Unpack runs of zeros and of differences; return how many pixels there were, -1 for data that are damaged."""
    nibble, done, value = 0, 0, 0
    while done < len(out):
        zeros, nibble = _number(words, nibble)
        others, nibble = _number(words, nibble)
        if zeros < 0 or others < 0 or zeros + others > len(out) - done or zeros + others == 0:
            return -1
        done += zeros
        for _ in range(others):
            code, nibble = _number(words, nibble)
            if code < 0:
                return -1
            value += (code >> 1) ^ -(code & 1)
            out[done] = value & 0xFFFF
            done += 1
    return done


def to_bytes(picture: NDArray[Any]) -> Bytes:
    """Return a picture of 8 or 16 bits with 8."""
    return (picture >> 8).astype(np.uint8) if picture.dtype == np.uint16 else picture.astype(np.uint8, copy=False)


def _bad(text: str) -> OpenArmError:
    return OpenArmError(Code.BAD_IMAGE, text)
