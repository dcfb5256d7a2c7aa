# SPDX-License-Identifier: Apache-2.0
"""Reads session files (`SampleSet.save` writes them); whatever is wrong with one is told, and nothing in it is run."""

from __future__ import annotations

import hashlib
import json
import math
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openarm_calibration.board.detect import Detection
from openarm_calibration.sampling.samples import Sample, SampleSet, SessionHead
from openarm_common.config import validate
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription

#: What is kept of each sample beside the JSON.
_ARRAYS = ("ids", "pixels", "pose", "png")


def load_session(path: Path, description: RobotDescription) -> tuple[SampleSet, str]:
    """Read a session file; returns the samples and the hash.

    Raises:
        OpenArmError: CONFIG_INVALID, when it is missing, damaged, no session, or of another robot.
    """
    _require_archive(path)
    try:
        with np.load(path, allow_pickle=False) as data:
            text = bytes(data["head"]).decode()
            document = json.loads(text)
            head = validate(SessionHead, document["head"], f"{path}:head")
            out = SampleSet(head, description)
            for k, entry in enumerate(document["samples"]):
                out.add(_sample(entry, {name: data[f"{name}_{k}"] for name in _ARRAYS}, out))
    except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{path} is no session file, or damaged: {type(error).__name__}: {error}"
        ) from error
    return out, hashlib.sha256(text.encode()).hexdigest()


def _require_archive(path: Path) -> None:
    """Say what a file is that is no archive at all."""
    try:
        with path.open("rb") as file:
            begin = file.read(2)
    except FileNotFoundError as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"session file {path} does not exist") from error
    except OSError as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"can't read session file {path}: {error.strerror}") from error
    if begin != b"PK":
        what = "is empty" if not begin else "is no session file: expected an .npz archive of samples"
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} {what}")


def _sample(entry: dict[str, Any], arrays: Mapping[str, NDArray[Any]], samples: SampleSet) -> Sample:
    """A sample of a session file.

    Raises:
        KeyError, TypeError, ValueError: When something is missing or has no sense.
        OpenArmError: CONFIG_INVALID, when its joints are those of another robot.
    """
    name = str(entry["name"])
    if arrays["ids"].dtype.kind not in "iu":
        raise ValueError(f"sample {name} has ids of type {arrays['ids'].dtype}, expected integers")
    ids, pixels = arrays["ids"].astype(np.int64), arrays["pixels"].astype(np.float64)
    pose = arrays["pose"].astype(np.float64)
    if pixels.shape != (len(ids), 2) or not np.isfinite(pixels).all() or len(ids) < 4:
        raise ValueError(f"sample {name} has {len(ids)} ids and pixels {pixels.shape}; expected 4 or more, all finite")
    if len(np.unique(ids)) != len(ids) or ids.min() < 0 or ids.max() >= len(samples.board.points):
        raise ValueError(f"sample {name} has marks that its board does not have, or twice")
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"sample {name} has a pose {pose.shape} that is none")
    joints = _joints(entry["joints"])
    missing = [joint for joint in samples.joint_names if joint not in joints]
    if missing:
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"sample {name} is of another robot: it lacks {', '.join(missing)}; it has"
            f" {', '.join(joints) or 'no joints'}",
        )
    track = tuple((int(t), _joints(state)) for t, state in entry["track"])
    if any(state.keys() != joints.keys() for _, state in track):
        raise ValueError(f"sample {name} has a track of other joints")
    return Sample(
        name, int(entry["t_image_ns"]), int(entry["t_joints_ns"]), joints, float(entry["speed"]),
        Detection(ids, pixels, float(entry["residual"])), pose, arrays["png"].tobytes(), track,
    )  # fmt: skip


def _joints(state: Mapping[str, Any]) -> dict[str, float]:
    joints = {str(name): float(value) for name, value in state.items()}
    if not all(math.isfinite(value) for value in joints.values()):
        raise ValueError("a joint position is not finite")
    return joints


def session_path(text: str) -> Path:
    """Path of a session file that was asked for.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it is empty.
    """
    if not text:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, "path is empty; expected the name of a session file that ends in .npz"
        )
    return Path(text).expanduser()
