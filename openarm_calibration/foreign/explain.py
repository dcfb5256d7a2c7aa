# SPDX-License-Identifier: Apache-2.0
"""Which convention explains poses of a robot and of a board in its camera.

A wrong form of a rotation turns from pose to pose by other angles than the board does, so that forms are compared
first, by angles alone. Of those that agree the mounts that most pairs agree with are solved, with the lengths of the
board in a unit of their own, for either equation: a camera on the hand, and a fixed one. What can't be found: a camera
on the hand with inverted poses of the robot, or of the board, gives the equation of a fixed one with poses as they are.
So the kind of the camera and the direction of poses are stated, or taken to be T_base_tip and T_camera_board.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from openarm_calibration.foreign.conventions import UNITS, Convention, Unit, inverted, meaning, read, readings
from openarm_calibration.handeye.consensus import ROUNDS, Consensus, agreed
from openarm_calibration.handeye.problem import Setup
from openarm_calibration.handeye.transforms import inverses
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

ROBOT_FRAMES, BOARD_FRAMES = "T_base_tip", "T_camera_board"
#: Most pairs that a search looks at, and most pairs of those.
_MOST, _MOST_PAIRS = 120, 3000
#: Forms are solved whose angles disagree by up to so many times the best, and this, as shares of the angles; and no
#: more than so many: an exchange of axes has the same angles, so that only translations tell it.
_TIMES, _ANGLE, _FORMS = 3.0, 0.01, 60
#: Rounds of weights for all of those, and how many are solved well then.
_ROUGHLY, _WELL = 4, 6
#: What may remain, as a share of what remains of poses that have nothing to do with each other.
_EXPLAINED = 0.25
#: A second convention that leaves less than so many times as much leaves the search open; one that is stated is
#: contradicted by one that leaves so many times less.
_AMBIGUOUS, _CONTRADICTED = 1.5, 2.0
#: A board of another size: its lengths are off by more than this, and without it so many times as much remains.
_SIZE, _BY_SIZE = 0.01, 1.5
#: No board is taken for one so many times as large. Shares below the last are of exact numbers.
_LARGEST, _EXACT = 2.5, 1e-5
#: Of a robot's tip from its base, m, and the units that are found without being stated.
_NEAREST, _FARTHEST = 0.02, 20.0
_FOUND: tuple[Unit, ...] = ("m", "mm")
#: A pose stands out by so many times the median of the residuals.
_STANDS_OUT = 6.0
KIND: dict[Setup, str] = {"in_hand": "eye_in_hand", "to_hand": "eye_to_hand"}


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses as a file writes them, and what is known of them.

    Args:
        rows: (n, k) numbers, position first, or matrices.
        frames: `ROBOT_FRAMES` or `BOARD_FRAMES`.
        rotation: Form of the rotations, "" when it is to be found.
        unit: None: to be found.
        inverse: Whether they are the other way round.
        names: (n,) of the records, for messages.
    """

    rows: Array
    frames: str
    rotation: str = ""
    unit: Unit | None = None
    inverse: bool = False
    names: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A convention, and what it leaves of the poses.

    Args:
        setup: in_hand or to_hand.
        robot: Convention of the robot's poses.
        board: Convention of the board's.
        translation: Deviation of a pair by axis, m at the board; by medians.
        rotation: The same, rad.
        share: The larger of the two as a share of what remains of poses that have nothing to do with each other.
        score: The mean of both shares, geometric; smaller is better.
        scale: Factor for the lengths of the board's poses; 1 unless the board is of another size.
        given: True where it is what is stated.
        consensus: Mounts, in the robot's own unit.
    """

    setup: Setup
    robot: Convention
    board: Convention
    translation: float
    rotation: float
    share: float
    score: float
    scale: float
    given: bool
    consensus: Consensus

    @property
    def fits(self) -> bool:
        """Whether it explains the poses."""
        return self.share < _EXPLAINED

    @property
    def left(self) -> str:
        """What it leaves, in words."""
        return f"{_length(self.translation)} and {math.degrees(self.rotation):.2g}° a pair"

    @property
    def text(self) -> str:
        """In words."""
        size = f", lengths of the board times {self.scale:.3f}" if self.scale != 1.0 and self.fits else ""
        return f"{KIND[self.setup]}; robot: {self.robot.text}; board: {self.board.text}{size}"

    def as_json(self) -> dict[str, object]:
        """Return it for `--json`."""
        return {
            "camera_kind": KIND[self.setup], "robot": self.robot.text, "board": self.board.text,
            "translation": self.translation, "rotation": self.rotation, "scale": self.scale, "fits": self.fits,
        }  # fmt: skip


class Unexplained(OpenArmError):
    """No convention that is stated explains the poses.

    Args:
        message: Why, and what to do.
        tried: All conventions that were tried.
    """

    def __init__(self, message: str, tried: tuple[Hypothesis, ...]) -> None:
        super().__init__(Code.DEGENERATE, message)
        self.tried = tried


def search(robot: Poses, board: Poses, setups: Sequence[Setup]) -> tuple[Hypothesis, ...]:
    """Try conventions; the best first. Those that contradict what is stated are among them.

    Args:
        robot: Its poses, and what is stated of them.
        board: The same of the board in the camera.
        setups: Kinds of cameras that are stated, one or both.

    Raises:
        OpenArmError: CONFIG_INVALID, when the numbers are no poses; DEGENERATE, with fewer than three.
    """
    n = len(robot.rows)
    if n < 3:
        raise OpenArmError(Code.DEGENERATE, f"too few poses: {n}, at least 3 that differ in rotation are needed")
    some = np.unique(np.linspace(0, n - 1, min(n, _MOST)).astype(int))
    apart = np.array(list(itertools.combinations(range(len(some)), 2)), dtype=np.int64)
    apart = apart[:: max(len(apart) // _MOST_PAIRS, 1)]
    A, C = _read_all(robot, some, apart), _read_all(board, some, apart)
    differ = np.array([[np.median(np.abs(a.turns - c.turns)) / max(a.turn, c.turn) for c in C] for a in A])
    pairs = [(int(k) // len(C), int(k) % len(C)) for k in np.argsort(differ, axis=None)]
    chosen = [pair for pair in pairs if differ[pair] <= _TIMES * differ.min() + _ANGLE][:_FORMS]
    chosen += [pair for pair in pairs if A[pair[0]].stated and C[pair[1]].stated][:1]
    every = list(itertools.product(dict.fromkeys(chosen), (False, True)))

    def solved(one: tuple[tuple[int, int], bool], rounds: int) -> Hypothesis:
        (i, j), flipped = one
        return _solved((A[i], robot), (C[j], board), flipped, setups, rounds)

    roughly = {one: solved(one, _ROUGHLY) for one in every}
    best = sorted(every, key=lambda one: roughly[one].score)
    given = next((one for one in best if roughly[one].given), best[0])
    out = [solved(one, ROUNDS) for one in dict.fromkeys((*best[:_WELL], given))]
    return tuple(sorted(out, key=lambda one: one.score))


def decided(tried: tuple[Hypothesis, ...], setups: Sequence[Setup], robot: Poses, board: Poses) -> Hypothesis:
    """Return the convention that explains the poses.

    Args:
        tried: Conventions that `search` returned.
        setups: Kinds of cameras that are stated.
        robot: Poses that `search` was given.
        board: The same of the board.

    Raises:
        Unexplained: When none explains the poses, another one than the stated does, or several do.
    """
    best = tried[0]
    given = next((one for one in tried if one.given), None)
    if not best.fits:
        raise Unexplained(
            f"no convention explains the poses: the best, {best.text}, leaves {best.left}"
            f"{_standing_out(best, robot.names)}; do the poses of robot and board belong together, line by line, and"
            " did the board stand still on its carrier?",
            tried,
        )
    if given is None or not given.fits or given.score > _CONTRADICTED * best.score:
        stated = f"as stated ({given.text}) {given.left} remain; " if given else ""
        raise Unexplained(f"{stated}as {best.text} {best.left}: {_to_type(best, setups, robot, board)}", tried)
    form = given.robot.rotation, given.board.rotation
    for rival in tried:
        other = rival.robot.rotation, rival.board.rotation
        if rival.given and other != form and rival.score < _AMBIGUOUS * given.score:
            raise Unexplained(
                f"{given.text} and {rival.text} explain the poses about as well; give --rotation or --board-rotation,"
                " or more poses with larger rotations",
                tried,
            )
    return given


def table(tried: Sequence[Hypothesis]) -> str:
    """Return lines for a terminal."""
    lines = ["conventions of the poses, by what the mounts leave that most pairs agree with"]
    for one in tried[:8]:
        left = f"  {_length(one.translation):>10} {math.degrees(one.rotation):9.3f}°"
        lines.append(f"{left}  {one.text}{'  <- as stated' if one.given else ''}")
    return "\n".join(lines)


def _length(metres: float) -> str:
    return f"{metres * 1e3:.2f} mm" if metres < 1.0 else f"{metres:.3g} m"


@dataclass(frozen=True, eq=False)
class _Reading:
    """Poses read in one form: T (n, 4, 4) in the file's unit, and the angles between pairs of them, rad."""

    convention: Convention
    T: Array
    turns: Array
    stated: bool

    @property
    def turn(self) -> float:
        """The median of the angles, rad."""
        return max(float(np.median(self.turns)), 1e-9)


def _read_all(poses: Poses, some: NDArray[np.int64], apart: NDArray[np.int64]) -> list[_Reading]:
    """Return some of the poses in each form that they may have."""
    rows = poses.rows[some]
    stated = read(poses.rotation, rows) if poses.rotation else None
    out: list[_Reading] = []
    names = [poses.names[k] for k in some] if poses.names else []
    for convention in readings(rows, poses.frames, names):
        T = read(convention.rotation, rows)
        assert T is not None  # it was read
        R = T[:, :3, :3]
        turns = Rotation.from_matrix(np.swapaxes(R[apart[:, 0]], 1, 2) @ R[apart[:, 1]]).magnitude()
        # forms that give the same poses are read once
        as_stated = not poses.rotation or (stated is not None and float(np.abs(T - stated).max()) < 1e-9)
        out.append(_Reading(convention, T, turns, as_stated))
    return out


def _solved(
    robot: tuple[_Reading, Poses], board: tuple[_Reading, Poses], flipped: bool, setups: Sequence[Setup], rounds: int
) -> Hypothesis:
    """Return what two readings leave with one of the two equations: B = A, or its inverse."""
    (of_A, known_A), (of_C, known_C) = robot, board
    B = inverses(of_A.T) if flipped else of_A.T
    found = agreed(B, of_C.T, scaled=True, rounds=rounds)
    unit_A, unit_C = _units(of_A.T, found.scale, known_A.unit, known_C.unit)
    scale = found.scale * UNITS[unit_A] / UNITS[unit_C]
    plain = of_C.T.copy()
    plain[:, :3, 3] *= UNITS[unit_C] / UNITS[unit_A]
    unscaled = agreed(B, plain, rounds=rounds)
    if abs(scale - 1.0) < _SIZE or unscaled.spread[0] < _BY_SIZE * found.spread[0]:
        found, scale = unscaled, 1.0
    t, r = found.spread
    moved = math.sqrt(sum(float(np.var(T[:, :3, 3], axis=0).mean()) for T in (B, plain)))
    shares = max(t / max(moved, 1e-12), _EXACT), max(r / of_C.turn, _EXACT)
    if not 1.0 / _LARGEST < scale < _LARGEST:
        shares = math.inf, math.inf  # then it is the poses of the robot alone that agree
    # the equation is that of a kind and of directions: of the stated ones, or of the other kind
    setup: Setup | None = next((one for one in setups if _flips(one, known_A, known_C) == flipped), None)
    units = known_A.unit in (None, unit_A) and known_C.unit in (None, unit_C)
    other: Setup = "to_hand" if setups[0] == "in_hand" else "in_hand"
    return Hypothesis(
        other if setup is None else setup,
        replace(of_A.convention, unit=unit_A, inverse=known_A.inverse),
        replace(of_C.convention, unit=unit_C, inverse=known_C.inverse),
        t * UNITS[unit_A], r, max(shares), math.sqrt(math.prod(shares)), scale,
        of_A.stated and of_C.stated and units and setup is not None, found,
    )  # fmt: skip


def _flips(setup: Setup, robot: Poses, board: Poses) -> bool:
    """Return whether poses as they are written are to be inverted for the equation of a kind of camera."""
    return (setup == "in_hand") ^ robot.inverse ^ board.inverse


def _units(A: Array, scale: float, of_robot: Unit | None, of_board: Unit | None) -> tuple[Unit, Unit]:
    """Return the units of robot and board: those that fit the measured scale, and the reach of a robot."""

    def cost(pair: tuple[Unit, Unit]) -> float:
        a, c = pair
        return abs(math.log(max(abs(scale), 1e-12) * UNITS[a] / UNITS[c])) + (3.0 if _unlikely(A, a) else 0.0)

    if of_robot is not None and _unlikely(A, of_robot):
        of_robot = None  # it is said that another one fits
    return min(itertools.product((of_robot,) if of_robot else _FOUND, (of_board,) if of_board else _FOUND), key=cost)


def _unlikely(A: Array, unit: Unit) -> bool:
    """Return whether no robot reaches so far, or so little, from its base."""
    return not _NEAREST < float(np.abs(A[:, :3, 3]).max()) * UNITS[unit] < _FARTHEST


def _standing_out(best: Hypothesis, names: Sequence[str]) -> str:
    """Return which pose is off by far more than the others, in words."""
    away, turned = best.consensus.translations * UNITS[best.robot.unit], best.consensus.rotations
    if len(names) != len(away):
        return ""
    ratio = np.maximum(away / max(float(np.median(away)), 1e-9), turned / max(float(np.median(turned)), 1e-9))
    k = int(np.argmax(ratio))
    if ratio[k] < _STANDS_OUT:
        return ""
    return f"; {names[k]} stands out, {_length(float(away[k]))} and {math.degrees(turned[k]):.2g}° off"


def _to_type(best: Hypothesis, setups: Sequence[Setup], robot: Poses, board: Poses) -> str:
    """Return the options that state a convention in place of those that were stated."""
    words: list[str] = []
    for option, found, stated in (("", best.robot, robot), ("board-", best.board, board)):
        if stated.rotation and found.rotation != stated.rotation:
            words.append(f"--{option}rotation {found.rotation} ({meaning(found.rotation)})")
        if stated.unit and found.unit != stated.unit:
            words.append(f"--{option}unit {found.unit}")
    if best.setup not in setups:
        ways = [one.frames if one.inverse else inverted(one.frames) for one in (best.robot, best.board)]
        words.append(
            f"--frames {ways[0]} or --board-frames {ways[1]}, whichever are the other way round; if it is"
            f" {KIND[best.setup]} indeed, --camera-kind {KIND[best.setup]}"
        )
    return f"give {', '.join(words)}"
