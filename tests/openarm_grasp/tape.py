# SPDX-License-Identifier: Apache-2.0
"""What a robot was asked for and what it answered, tick by tick, and its file."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from openarm_common.detection import Detection
from openarm_common.errors import Code
from openarm_common.labelled_cloud import LabelledCloud
from openarm_grasp.evidence.verdicts import Verdict
from openarm_grasp.perception.detections import Frame
from openarm_grasp.planning.candidates import Box
from openarm_grasp.robot.interface import Planned

#: Points of clouds are kept in steps of this, m; the noise of depth is larger.
_STEP = 5e-4
#: Joint positions are kept in steps of this, rad or m.
_FINE = 1e-6
#: Poses of objects are kept in steps of this, m.
_TRUE = 1e-5
#: Arrays of so few numbers stand in the text.
_SMALL = 16
_KINDS = {kind.__name__: kind for kind in (Detection, LabelledCloud, Frame, Planned, Verdict, Box)}


@dataclass
class Call:
    """A question to the robot and its answer.

    Attributes:
        what: Method and arguments that are compared word by word.
        poses: Arguments that are compared by number, flat.
        end: Tick at which the answer came.
        answer: The answer.
        error: Or the error: code, message, refusals.
    """

    what: list[Any]
    poses: np.ndarray
    end: int = -1
    answer: Any = None
    error: tuple[str, str, Mapping[str, Verdict] | None] | None = None


@dataclass
class Tape:
    """What a robot answered.

    Attributes:
        joints: Names.
        objects: Names.
        clock_ns: Time at each tick.
        state_ns: Stamp of the newest joint state at each tick.
        q: (ticks, joints).
        truth: (ticks, objects, 7) position, m, and quaternion xyzw of each object, for the test.
    """

    joints: tuple[str, ...]
    objects: tuple[str, ...]
    clock_ns: list[int] = field(default_factory=list[int])
    state_ns: list[int] = field(default_factory=list[int])
    q: list[np.ndarray] = field(default_factory=list[np.ndarray])
    truth: list[np.ndarray] = field(default_factory=list[np.ndarray])
    calls: list[Call] = field(default_factory=list[Call])

    def write(self, path: Path) -> None:
        """Write a .npz file."""
        arrays: list[np.ndarray] = []
        calls = [[c.what, packed(c.poses, arrays), c.end, packed(c.answer, arrays), packed(c.error, arrays)]
                 for c in self.calls]  # fmt: skip
        data = {
            "calls": np.frombuffer(json.dumps([self.joints, self.objects, calls]).encode(), np.uint8),
            "clock_ns": np.diff(np.array(self.clock_ns), prepend=0),
            "state_ns": np.diff(np.array(self.state_ns), prepend=0),
            "q": _steps(self.q, _FINE),
            "truth": _steps(self.truth, _TRUE),
        } | {f"array{k}": array for k, array in enumerate(arrays)}
        path.parent.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as file:
            for name, array in data.items():
                buffer = io.BytesIO()
                np.lib.format.write_array(buffer, np.ascontiguousarray(array))
                file.writestr(zipfile.ZipInfo(f"{name}.npy"), buffer.getvalue(), zipfile.ZIP_LZMA)

    @classmethod
    def read(cls, path: Path) -> Tape:
        """Read what `write` has written."""
        with np.load(path) as data:
            arrays = {name: data[name] for name in data.files}
        joints, objects, calls = json.loads(arrays["calls"].tobytes())
        tape = cls(tuple(joints), tuple(objects))
        tape.clock_ns = np.cumsum(arrays["clock_ns"]).tolist()
        tape.state_ns = np.cumsum(arrays["state_ns"]).tolist()
        tape.q = list(np.cumsum(arrays["q"].T, axis=0) * _FINE)
        tape.truth = list(np.cumsum(arrays["truth"].T, axis=0).reshape(len(tape.q), len(objects), 7) * _TRUE)
        for what, poses, end, answer, error in calls:
            poses, answer, error = (unpacked(one, arrays) for one in (poses, answer, error))
            tape.calls.append(Call(what, poses, end, answer, error))
        return tape


def _steps(rows: Sequence[np.ndarray], step: float) -> np.ndarray:
    """Changes from row to row in whole steps, (numbers, rows)."""
    table = np.round(np.array(rows).reshape(len(rows), -1) / step).astype(np.int32)
    return np.diff(table, axis=0, prepend=0 * table[:1]).T


def packed(value: Any, arrays: list[np.ndarray]) -> Any:
    """Value as JSON, its arrays apart."""

    def array(one: np.ndarray) -> int:
        arrays.append(one)
        return len(arrays) - 1

    if isinstance(value, LabelledCloud):
        steps = np.round(value.points / _STEP).astype(np.int16)
        steps = np.diff(steps, axis=0, prepend=0 * steps[:1]).T
        return {"cloud": [array(steps), array(value.labels.astype(np.uint16)), array(value.camera)]}
    if isinstance(value, np.ndarray):
        small = value.size <= _SMALL and value.dtype == np.float64
        return {"values": [value.shape, value.ravel().tolist()]} if small else {"array": array(value)}
    if isinstance(value, Code):
        return {"code": value.value}
    if is_dataclass(value):
        kind = next(
            name for name, known in _KINDS.items() if isinstance(value, known)
        )  # of a detection, what grasping reads
        return {kind: {f.name: packed(getattr(value, f.name), arrays) for f in fields(_KINDS[kind])}}
    if isinstance(value, Mapping):
        return {"map": [[key, packed(one, arrays)] for key, one in value.items()]}
    if isinstance(value, tuple | list):
        return [packed(one, arrays) for one in value]
    return value.item() if isinstance(value, np.generic) else value


def unpacked(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Value that `packed` has packed."""
    if isinstance(value, list):
        return tuple(unpacked(one, arrays) for one in value)
    if not isinstance(value, dict):
        return value
    ((kind, of),) = value.items()
    if kind == "array":
        return arrays[f"array{of}"]
    if kind == "values":
        return np.array(of[1], np.float64).reshape(of[0])
    if kind == "code":
        return Code(of)
    if kind == "Frames":  # of recordings that were made with their frame
        return unpacked(of["frames"], arrays)
    if kind == "map":
        return {key: unpacked(one, arrays) for key, one in of}
    if kind == "cloud":
        steps, labels, camera = (arrays[f"array{k}"] for k in of)
        points = np.cumsum(steps.T, axis=0, dtype=np.int16).astype(np.float32) * np.float32(_STEP)
        return LabelledCloud(points, labels.astype(np.uint32), camera)
    return _KINDS[kind](**{name: unpacked(one, arrays) for name, one in of.items()})
