# SPDX-License-Identifier: Apache-2.0
"""Samples from a recording: where the robot stood still, which image of each standstill is used, why others are not.

The gate is that of the node (`gate.match`). Of the images of one standstill one is enough: they
show the same but for their noise. Stamps in ns, joint positions in rad.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openarm_calibration.board.detect import detect
from openarm_calibration.board.detection import BoardDetection
from openarm_calibration.sampling.gate import GateConfig, Matched, match
from openarm_calibration.sampling.samples import SampleSet
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer

State = tuple[int, Mapping[str, float]]
#: Finds the board in a grey image (h, w), and returns the image to keep.
Look = Callable[[NDArray[np.uint8]], tuple[BoardDetection, NDArray[np.uint8]]]

#: Images with joints nearer to each other than this are of one standstill, rad.
SAME_POSTURE = 0.01
#: Joint states after an image that the gate uses.
_AHEAD_NS = 1_000_000_000
#: Of the images of a standstill: which are examined until one shows the board, as shares of their number.
_TRIES = (0.5, 0.75, 0.999)


@dataclass
class Stretch:
    """Images one after the other with the same answer of the gate.

    Args:
        stamps: Stamps of the images.
        robot: Robot at each, where the gate accepts them.
        code: OK, or the gate's.
        reason: Why no image of it is taken, as far as is known; of the first image.
        sample: Name of the sample that was taken.
    """

    stamps: list[int]
    robot: list[Matched]
    code: Code
    reason: str
    sample: str = ""

    @property
    def tries(self) -> dict[int, Matched]:
        """Images to examine, and the robot at each."""
        if self.code != Code.OK:
            return {}
        chosen = {int(share * len(self.stamps)) for share in _TRIES}
        return {self.stamps[k]: self.robot[k] for k in sorted(chosen)}


def stretches(
    stamps: Iterable[int], states: Sequence[State], names: tuple[str, ...], robot: RobotDescription, gate: GateConfig
) -> list[Stretch]:
    """Divide the images of a recording by the answer of the gate.

    Args:
        stamps: Stamps of the images.
        states: Joint states in the order of their stamps.
        names: Joints that move camera or board.
        robot: Their robot.
        gate: When it is at rest.
    """
    # states enter as if the images were live, so that the gate reads a few seconds and not an hour
    buffer = RobotStateBuffer(robot, capacity=2000)
    out: list[Stretch] = []
    fed = 0
    for t_ns in sorted(stamps):
        while fed < len(states) and states[fed][0] <= t_ns + _AHEAD_NS:
            t, joints = states[fed]
            buffer.add_joint_state(t, tuple(joints), tuple(joints.values()))
            fed += 1
        try:
            matched = match(buffer, t_ns, names, gate)
        except OpenArmError as error:
            if not out or out[-1].code != error.code:
                out.append(Stretch([], [], error.code, error.message))
        else:
            if not out or out[-1].code != Code.OK or _far(out[-1].robot[0], matched, names):
                out.append(Stretch([], [], Code.OK, ""))
            out[-1].robot.append(matched)
        out[-1].stamps.append(t_ns)
    return out


def _far(a: Matched, b: Matched, names: Sequence[str]) -> bool:
    return any(abs(a.joints[name] - b.joints[name]) > SAME_POSTURE for name in names)


class Picker:
    """Takes a sample of each standstill from the images that are offered to it.

    Args:
        samples: Grows.
        found: The recording's stretches; updated with what became of them.
        look: Finds the board in an image, and returns the image to keep; by `detect`, as it is, when None.
    """

    def __init__(self, samples: SampleSet, found: Sequence[Stretch], look: Look | None = None) -> None:
        self.samples = samples
        self._look: Look = look or (lambda image: (detect(samples.board, image), image))
        self._open = {t: (stretch, matched) for stretch in found for t, matched in stretch.tries.items()}

    def wants(self, t_ns: int) -> bool:
        """Return whether the image of this stamp is to be examined."""
        return t_ns in self._open and not self._open[t_ns][0].sample

    def offer(self, t_ns: int, image: NDArray[np.uint8], optics: Intrinsics) -> None:
        """Look at an image (h, w), grey, and take it if it shows the board.

        Args:
            t_ns: Stamp.
            image: (h, w), grey.
            optics: Intrinsics of the image.
        """
        stretch, matched = self._open[t_ns]
        try:
            if optics != self.samples.head.optics:
                raise OpenArmError(Code.BAD_IMAGE, f"the intrinsics changed: fx {optics.fx:.2f} here")
            sample = self.samples.take(t_ns, matched, *self._look(image))
        except OpenArmError as error:
            stretch.reason = stretch.reason or error.message
        else:
            stretch.sample, stretch.reason = sample.name, ""

    def refuse(self, t_ns: int, error: OpenArmError) -> None:
        """Say why the image of a stamp can't be looked at."""
        stretch, _ = self._open[t_ns]
        stretch.reason = stretch.reason or error.message


def rows(found: Sequence[Stretch]) -> list[dict[str, Any]]:
    """Return what `--json` writes of a recording; seconds from its first image."""
    if not found:
        return []
    first = found[0].stamps[0]
    return [
        {
            "from_s": round((stretch.stamps[0] - first) * 1e-9, 3),
            "to_s": round((stretch.stamps[-1] - first) * 1e-9, 3),
            "images": len(stretch.stamps),
            "sample": stretch.sample,
            "code": str(stretch.code if stretch.code != Code.OK or stretch.sample else Code.NOTHING_DETECTED),
            "reason": stretch.reason,
        }
        for stretch in found
    ]


def summary(found: Sequence[Stretch]) -> str:
    """Return lines for a terminal: each standstill, and the images between them together."""
    lines: list[str] = []
    between: Counter[Code] = Counter()
    why: dict[Code, str] = {}
    for stretch, row in zip(found, rows(found), strict=True):
        if stretch.code != Code.OK:
            between[stretch.code] += len(stretch.stamps)
            why.setdefault(stretch.code, stretch.reason)
            continue
        span = f"{row['from_s']:8.2f} to {row['to_s']:8.2f} s"
        lines.append(f"  {span} {row['images']:5d} images  {stretch.sample or stretch.reason}")
    lines += [f"  {count:5d} images not used, {code}, such as: {why[code]}" for code, count in between.items()]
    return "\n".join(["standstills of the robot, and the sample of each", *lines])
