# SPDX-License-Identifier: Apache-2.0
"""Intrinsics, images, and compressed depth."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from benchmarks.fuzz.alter import altered_bytes, altered_yaml
from benchmarks.fuzz.files.reader import Reader


def pictures(folder: Path) -> list[Reader]:
    """Make readers of pictures."""
    import cv2

    from openarm_common.camera.cameras import Intrinsics
    from openarm_common.camera.lens import Lens
    from openarm_common.camera.lens_files import camera_info, read_lens
    from openarm_common.camera.pictures import decode_depth, decode_picture
    from openarm_perception.frames.images import read_depth
    from openarm_perception.geometry.depth import DepthLimits

    lens = Lens(Intrinsics(64, 48, 60.0, 61.0, 31.5, 23.5))
    plain, bent = b"[0.0, 0.0, 0.0, 0.0, 0.0]", b"[-0.1, 0.01, 0.001, -0.001, 0.0]"
    info = camera_info("camera", lens.intrinsics).encode().replace(plain, bent)
    kalibr = b"cam0:\n  intrinsics: [60, 61, 31.5, 23.5]\n  distortion_model: radtan\n  resolution: [64, 48]\n"
    kalibr += b"  distortion_coeffs: [-0.1, 0.01, 0.0, 0.0]\n"
    rows = b"60 0 31.5\n0 61 23.5\n0 0 1\n"
    storage = (
        b"%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n"
    )
    storage += b"   dt: d\n   data: [ 60., 0., 31.5, 0., 61., 23.5, 0., 0., 1. ]\n"
    rng = np.random.default_rng(0)
    depth = rng.integers(400, 900, (48, 64)).astype(np.uint16)
    png, jpeg = (
        cv2.imencode(form, rng.integers(0, 255, (48, 64, 3)).astype(np.uint8))[1].tobytes() for form in (".png", ".jpg")
    )
    tiff = cv2.imencode(".tiff", depth.astype(np.float32))[1].tobytes()
    deep = cv2.imencode(".png", depth)[1].tobytes()
    head = struct.pack("<iff", 1, 1e4, -990.0)
    # runs of RVL: 3072 zeros, and zeros with differences
    rvl = struct.pack("<ii", 64, 48) + b"".join(struct.pack("<I", int(word)) for word in rng.integers(0, 2**32, 2000))

    def of(path: Path) -> object:
        return read_lens(path, (64, 48))

    def picture(path: Path) -> object:
        return decode_picture(path.read_bytes(), "the image")

    def depths(path: Path) -> object:
        data = path.read_bytes()
        return [decode_depth(data, encoding, "the image") for encoding in ("16UC1", "32FC1")]

    np.save(folder / "depth.npy", depth)
    np.save(folder / "metres.npy", depth / 1000.0)
    arrays = tuple((folder / f"{name}.npy").read_bytes() for name in ("depth", "metres"))

    def array(path: Path) -> object:
        return read_depth(path, lens, None, DepthLimits())

    return [
        Reader("pictures/depth.npy", arrays, altered_bytes, array),
        Reader("lens/info.yaml", (info, kalibr, storage), altered_yaml, of),
        Reader("lens/info.yml", (info, kalibr, storage, rows), altered_bytes, of),
        Reader("pictures/image", (png, jpeg, tiff, deep), altered_bytes, picture),
        Reader("pictures/depth", (head + deep, head + rvl), altered_bytes, depths),
    ]
