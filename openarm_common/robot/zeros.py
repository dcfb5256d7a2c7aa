# SPDX-License-Identifier: Apache-2.0
"""The zeros of the joints, and the reach of the hands, that hold in a process: a file, which `OPENARM_ZEROS` names.

It holds for processes that this one starts, too. Whoever starts a graph writes what is stored (see `learned`)
into its run folder, so that all its nodes have the same zeros from their start to their end. rad.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path

import yaml
from pydantic import Field

from openarm_common.config import Config, load_yaml, validate
from openarm_common.resources import write_whole

ZEROS = "OPENARM_ZEROS"
#: What the zeros of a real robot are stored as.
REAL = "zeros"


class HandReach(Config):
    """What one hand reads at both ends of its fingers: no hand stops where its drawing does."""

    closed: float = Field(ge=-0.05, le=0.05, description="finger of the hand closed on nothing, m")
    opened: float = Field(gt=0.0, le=0.1, description="finger of the hand as far open as it gets, m")
    effort: float = Field(default=0.0, ge=0.0, le=1e4, description="force of the fingers closed on nothing, N")
    learned: str = Field(default="", max_length=40, description="when, as ISO 8601")

    def __str__(self) -> str:
        """Return the gaps of both ends, and when they were learned."""
        return f"{self.closed * 2e3:.1f} to {self.opened * 2e3:.1f} mm, learned {self.learned or 'undated'}"


class Zeros(Config):
    """Zeros of the joints (where a joint is, minus what its encoder reports), and hands as they were learned."""

    robot: str = Field(description="name of the robot")
    of: str = Field(default=REAL, description="zeros: a real robot; else the simulated one that they are of")
    offsets: dict[str, float] = Field(description="by joint, rad")
    hands: dict[str, HandReach] = Field(default_factory=dict[str, HandReach], description="by arm")


def zeros_path() -> str:
    """Return the file of the zeros of this process; "": the joints have those of the description."""
    return os.environ.get(ZEROS, "")


def zeros_of() -> str:
    """Return the robot that the zeros of this process are of."""
    return Path(zeros_path()).stem or REAL


def read_zeros(path: Path) -> Zeros:
    """Read a file of zeros.

    Raises:
        OpenArmError: CONFIG_INVALID, when it is missing or damaged.
    """
    return validate(Zeros, load_yaml(path), str(path))


def keep_zeros(zeros: Zeros, folder: Path) -> Path:
    """Write zeros to a folder for processes to come, and return the file for `OPENARM_ZEROS`.

    Raises:
        OpenArmError: ENVIRONMENT, when the folder can't be written.
    """
    path = folder / f"{zeros.of}.yaml"
    write_whole(path, yaml.safe_dump(zeros.model_dump(mode="json"), sort_keys=False).encode())
    return path


def zeros_label(offsets: Mapping[str, float]) -> str:
    """Return a short hash of zeros, by which a mount says with which ones it was found; "" of none."""
    if not any(offsets.values()):
        return ""
    return hashlib.sha256(json.dumps(dict(offsets), sort_keys=True).encode()).hexdigest()[:12]
