# SPDX-License-Identifier: Apache-2.0
"""Networks: ONNX."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np

from benchmarks.fuzz.alter import HOSTILE, TEXTS, altered_bytes
from benchmarks.fuzz.files.reader import Reader
from openarm_common.resources import models_dir


def networks(folder: Path) -> list[Reader]:
    """Make readers of networks."""
    from openarm_perception.detection.network import NetworkConfig, NetworkDetector
    from tests.openarm_perception.onnx_file import write_network
    from tests.openarm_perception.onnx_layouts import READ

    image = np.zeros((120, 160, 3), np.uint8)

    def read(path: Path) -> None:
        NetworkDetector(NetworkConfig(model=str(path))).detect(image)

    def alter(data: bytes, rng: random.Random) -> bytes:
        """Where structure is: at both ends, and in what is text."""
        way = rng.random()
        if way < 0.3:
            return altered_bytes(data[:4000], rng) + data[4000:]
        if way < 0.6:
            return data[:-6000] + altered_bytes(data[-6000:], rng)
        if way < 0.75 and b"names" in data:
            at = data.rindex(b"names")
            return data[:at] + altered_bytes(data[at : at + 200], rng) + data[at + 200 :]
        return altered_bytes(data, rng)

    def other(_: bytes, rng: random.Random) -> bytes:
        """A file of any layout, with other outputs, metadata or inputs."""
        output, more = READ[rng.choice(list(READ))]
        arrays: dict[str, np.ndarray] = dict(output) if isinstance(output, dict) else {"output0": output}
        for name in rng.sample(list(arrays), rng.randrange(len(arrays) + 1)):
            one = arrays[name]
            arrays[name] = rng.choice((
                one[:, :-1], one[..., :-1], one[0], one[:, :0], one.swapaxes(1, -1), one.repeat(2, axis=-1), one - 1,
                one * one.dtype.type(90), *(np.full_like(one, value) for value in (1, 127)),
                *(np.full_like(one, value) for value in (np.inf, np.nan) if one.dtype.kind == "f"),
            ))  # fmt: skip
        metadata = {"names": "{0: 'box', 1: 'ball'}", "task": "detect", **more.get("metadata", {})}
        for key in rng.sample(list(metadata), rng.randrange(len(metadata) + 1)):
            texts = (*map(str, HOSTILE), *(text.decode("latin-1") for text in TEXTS), "pose", "obb", "['a']")
            metadata[key] = rng.choice(texts)
        shapes = [(1, 3, 0, 320), (1, 3, 2**40, 2**40), ("n", 3, "h", "w"), (3,), (), *[(1, 3, 256, 320)] * 9]
        options = {**more, "names": "", "metadata": metadata, "shape": rng.choice(shapes)}
        return write_network(folder / "other.onnx", arrays, **options).read_bytes()

    sound = ((models_dir() / "detector/shapes_320x256.onnx").read_bytes(),)
    return [Reader("altered.onnx", sound, alter, read), Reader("altered.onnx", (b"",), other, read)]
