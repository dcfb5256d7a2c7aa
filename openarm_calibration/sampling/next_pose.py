# SPDX-License-Identifier: Apache-2.0
"""The next best pose for a sample, among postures that an arm can take: the core of automatic calibration.

Postures are drawn in joint space, at random and around those that showed the board, so that each is reachable; kept are
those in which all of the board would be in the image, large enough and not behind the robot; and of these the ones that
take most off the predicted error of the camera's mount, with what both mounts are known to by now (twelve unknowns);
where poses are for `calibrate zeros`, off that of the zeros of the joints too, which are then unknowns like the mounts.
Whether a path leads there is decided by the planner. m, rad, px.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from openarm_calibration.board.board import Board
from openarm_calibration.handeye.kinematics import ArmPosture
from openarm_calibration.handeye.observability import UNITS, motion
from openarm_calibration.handeye.problem import BoardView, Extra, assemble, project
from openarm_calibration.handeye.refine import information_at, mount_error
from openarm_calibration.handeye.robust import SolveConfig, solve_robustly
from openarm_calibration.handeye.transforms import inverses
from openarm_calibration.handeye.unknowns import Noise, invert_scaled
from openarm_calibration.sampling.occluders import Occluders
from openarm_calibration.sampling.samples import SampleSet
from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.collision.self_collision import SelfCollision
from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import load_folder, robot_name
from openarm_common.robot.tree import KinematicTree
from openarm_common.types import Array

#: Marks nearer to the edge of the image do not count as seen, px.
EDGE = 12.0
#: Views that are tilted more are not detected well.
MOST_TILT = math.radians(55.0)
#: Samples that advice aims at.
ENOUGH = 12


def visible(board: Board, T_camera_board: Array, optics: Intrinsics, margin: float) -> bool:
    """Return whether all marks would be in the image, not tilted too far, and seen from the front.

    Args:
        board: The board.
        T_camera_board: (4, 4).
        optics: Optics of the camera.
        margin: Kept from the edge of the image in addition to `EDGE`, px.
    """
    direction = T_camera_board[:3, 3] / max(float(np.linalg.norm(T_camera_board[:3, 3])), 1e-9)
    if float(T_camera_board[:3, 2] @ direction) < math.cos(MOST_TILT):
        return False
    row = np.array([optics.fx, optics.fy, optics.cx - margin, optics.cy - margin])
    pixels = project(board.points, board.radius, T_camera_board, row)
    size = np.round((optics.width - 2 * margin, optics.height - 2 * margin))
    inside = (pixels > EDGE) & (pixels < size - 1.0 - EDGE)
    return bool(np.isfinite(pixels).all() and inside.all())


def advice(A: Sequence[Array] | Array) -> str:
    """Return what to do next, in words, for a user who moves the arm by hand.

    Args:
        A: Robot poses so far, (n, 4, 4).
    """
    poses = np.asarray(A, dtype=np.float64).reshape(-1, 4, 4)
    if len(poses) == 0:
        return "take a first sample with all of the board in the image, as large as it fits"
    seen = motion(poses)
    if len(poses) < 3 or seen.rotation < math.radians(30.0) or seen.second < math.radians(15.0):
        return (
            f"rotate about the wrist's {seen.least} axis by 30° or more (so far {math.degrees(seen.rotation):.0f}°, and"
            f" {math.degrees(seen.second):.0f}° about a second axis), with the board in the image"
        )
    if seen.translation < 0.05:
        return "move 5 cm or more nearer to the board, or farther from it, and tilt"
    if len(poses) < ENOUGH:
        return (
            f"{ENOUGH - len(poses)} more of this kind; rotate about the wrist's {seen.least} axis, which turned least"
        )
    return "enough; solve, and check the predicted error"


#: Before the board was seen, its place is known as a person measures it, 1 cm and a few degrees: px of the image.
_RULER = 45.0
#: Postures drawn over the whole range to find a first one.
_FIRST_DRAWS = 20_000
#: A board in the hand keeps this from the table, m: arms that give way to gravity stop lower than they were sent to.
_CLEAR = 0.03
#: Drawn at once.
_BATCH = 250
#: Of postures that are about equally informative the nearest is taken.
_AS_GOOD = 1.1
#: Postures that are enough for the first pose; finding them takes long.
_ENOUGH = 24
#: Postures that differ less from one that can't be reached, or did not show the board, count as the same, rad.
_NEIGHBOUR, _ALIKE = 0.08, 0.25


class SearchConfig(Config):
    """How the next pose is searched for."""

    draws: int = Field(default=5000, ge=250, le=100_000, description="postures drawn for each choice")
    candidates: int = Field(default=100, ge=5, le=5000, description="of them compared by their information")
    step: float = Field(default=0.6, gt=0.0, le=3.0, description="of each joint from a posture that shows the board")
    margin: float = Field(default=12.0, ge=0.0, le=200.0, description="kept from the edge of the image, px")
    smallest: float = Field(default=9.0, ge=2.0, description="diameter of a mark in the image, px")
    joint_margin: float = Field(default=0.06, ge=0.0, le=0.5, description="kept from the joints' limits, rad")
    mount_translation: float = Field(default=0.02, gt=0.0, description="error of the nominal mount that is expected, m")
    mount_rotation: float = Field(default=0.05, gt=0.0, description="the same of its rotation, rad")
    px: float = Field(default=0.1, gt=0.0, description="spread of a mark that poses are chosen for, px")
    robot_translation: float = Field(default=1e-4, gt=0.0, description="spread of the robot, m")
    robot_rotation: float = Field(default=2e-4, gt=0.0, description="spread of the robot, rad")
    zeros: float = Field(
        default=0.0, ge=0.0, le=0.3, description="deviation of joint zeros that poses are to tell too, rad; 0: none"
    )
    seed: int = Field(default=1, ge=0, description="of random postures")


@dataclass(frozen=True, eq=False)
class Belief:
    """What is known of the mounts.

    Args:
        X: (4, 4) mount of the camera (optical frame).
        Z: (4, 4) mount of the board; None before it was detected or configured.
        sigma_translation: Predicted error of X, m; infinite before it was solved for.
        sigma_rotation: Predicted error of X, rad; infinite before it was solved for.
    """

    X: Array
    Z: Array | None
    sigma_translation: float = math.inf
    sigma_rotation: float = math.inf

    @property
    def solved(self) -> bool:
        """Whether the samples determine the mounts."""
        return math.isfinite(self.sigma_translation)


class PoseSearch:
    """Remembers which postures show the board, and proposes the next.

    Args:
        description: The robot.
        nominal: (4, 4) T_parent_optical of the camera as mounted on paper.
        board: (4, 4) mount of the board, roughly; None: unknown.
        config: Parameters of the search.
    """

    def __init__(
        self, description: RobotDescription, nominal: Array, board: Array | None, config: SearchConfig | None = None
    ) -> None:
        self.belief = Belief(nominal, board)
        self._description = description
        self._nominal = nominal
        self._config = config or SearchConfig()
        self._rng = np.random.default_rng(self._config.seed)
        self._occluders = Occluders(description)
        self._contact = SelfCollision(description, tuple(description.joints))
        work = load_folder(robot_name())[1].work
        self._table = None if work is None else work.table
        self._known: list[Array] = []
        self._refused: list[Array] = []
        self._widths: list[float] = []

    def learn(self, samples: SampleSet) -> Belief:
        """Update what is known after a sample was taken.

        Raises:
            OpenArmError: NOT_READY, without samples.
        """
        if not len(samples):
            raise OpenArmError(Code.NOT_READY, "nothing can be learnt without a sample; take one first")
        self._known.append(_vector(samples, samples.samples[-1].joints))
        first = samples.samples[0]
        A = samples.pose(first.joints)
        B = se3.inverse(A) if samples.head.setup == "in_hand" else A
        before = Belief(self._nominal, se3.inverse(B) @ self._nominal @ first.T_camera_board)
        try:
            solution = solve_robustly(samples.problem(), SolveConfig(most_translation=0.02, most_rotation=0.05))
        except OpenArmError as error:
            if error.code != Code.DEGENERATE:
                raise
            self.belief = before  # not enough of them yet
            return before
        X, Z = solution.estimate.X[0], solution.estimate.Z[0]
        offset, angle = mount_error(X, self._nominal)
        credible = offset < 5.0 * self._config.mount_translation and angle < 5.0 * self._config.mount_rotation
        self.belief = Belief(X, Z, *solution.sigma()) if credible else before
        return self.belief

    def refuse(self, q: Array, *, reached: bool = False) -> None:
        """Do not propose a posture (n,) again that can't be reached or did not show the board, nor its neighbours.

        Args:
            q: (n,) rad.
            reached: The arm was there, and the board was not seen.
        """
        self._refused.append(q)
        self._widths.append(_ALIKE if reached else _NEIGHBOUR)

    def propose(self, samples: SampleSet, state: Mapping[str, float], most: int = 12) -> list[Array]:
        """Return the next postures (n,) in the order of `SampleSet.joint_names`, best first.

        Args:
            samples: So far.
            state: Joints as they are now; those that it lacks are taken as 0.
            most: Most poses.

        Raises:
            OpenArmError: NOT_READY, when the position of the board is unknown; UNREACHABLE, when no posture shows it.
        """
        Z = self.belief.Z
        if Z is None:
            raise OpenArmError(
                Code.NOT_READY,
                "the position of the board is not known; configure it, or take a sample that shows the board",
            )
        whole = {**dict.fromkeys(self._description.joints, 0.0), **state}
        found, shadowed = self._showing(samples, Z, whole)
        if not found:
            raise OpenArmError(
                Code.UNREACHABLE,
                f"no posture of {samples.head.carrier!r} shows all of {samples.board.label} to {samples.head.camera!r}"
                f" ({shadowed} would, were the robot not in the way); move the board, or use a smaller one",
            )
        ranked = self._ranked(samples, Z, found)
        here = _vector(samples, state)
        out: list[Array] = []
        while ranked and len(out) < most:
            limit = _AS_GOOD * min(score for score, _ in ranked)
            near = [k for k, (score, _) in enumerate(ranked) if score <= limit]
            best = min(near, key=lambda k: float(np.abs(ranked[k][1] - here).max()))
            out.append(ranked.pop(best)[1])
        return out

    # --- parts
    def _showing(
        self, samples: SampleSet, Z: Array, state: Mapping[str, float]
    ) -> tuple[list[tuple[Array, Array]], int]:
        """Return postures that show the board, with T_camera_board (4, 4); and in how many the robot hides it.

        Until one is found they are drawn from the whole range, then around those that are known.
        """
        config, rng, description = self._config, self._rng, self._description
        lower, upper = description.limits(samples.joint_names, np.pi)
        low, high = lower + config.joint_margin, upper - config.joint_margin
        lift = description.lift
        if lift is not None and lift.joint in samples.joint_names:  # it stays where it is
            k = samples.joint_names.index(lift.joint)
            low[k] = high[k] = state[lift.joint]
        margin, tree = config.margin if self.belief.solved else _RULER, KinematicTree(description, samples.joint_names)
        pool, refused, widths = list(self._known), np.array(self._refused), np.array(self._widths)
        wanted = config.candidates if pool else _ENOUGH
        width, height = (edge / 2.0 for edge in samples.board.size)
        corners = np.array([[x, y, 0.0] for x in (-width, width) for y in (-height, height)])
        plate = np.concatenate([samples.board.points, corners])
        out: list[tuple[Array, Array]] = []
        shadowed, left = 0, config.draws + (0 if pool else _FIRST_DRAWS)
        while left > 0 and len(out) < wanted:
            left -= _BATCH
            if pool:
                # small changes as often as large ones: what can be seen may be a narrow part of what can be reached
                size = config.step * 10.0 ** rng.uniform(-1.0, 0.0, (_BATCH, 1))
                centres = np.array(pool)[rng.integers(len(pool), size=_BATCH)]
                drawn = np.clip(centres + rng.uniform(-size, size, centres.shape), low, high)
            else:
                drawn = rng.uniform(low, high, (_BATCH, len(low)))
            if len(refused):
                away = np.abs(drawn[:, None] - refused).max(axis=2) / widths
                drawn = drawn[away.min(axis=1) > 1.0]
            views = self._views(samples, tree, drawn, Z)
            for k in np.flatnonzero(self._centred(samples, views)):
                q, T = drawn[k], views[k]
                if not visible(samples.board, T, samples.head.optics, margin):
                    continue
                posture = {**state, **_joints(samples, q)}
                links = description.link_poses(posture)
                if self._touches(posture) or self._sinks(samples, links, Z, plate):
                    continue
                shapes = self._occluders.place(links)
                eye = links[samples.head.parent] @ self.belief.X
                if self._occluders.hidden(shapes, eye[:3, 3], se3.apply(eye @ T, plate)):
                    shadowed += 1
                    continue
                out.append((q, T))
                pool.append(q)
                if len(out) == wanted:
                    break
        return out, shadowed

    def _touches(self, posture: Mapping[str, float]) -> bool:
        distances = self._contact.distances(np.array([posture[name] for name in self._description.joints]))
        return self._contact.nearest(distances).distance <= 0.0

    def _sinks(self, samples: SampleSet, links: Mapping[str, Array], Z: Array, plate: Array) -> bool:
        """Return whether a board in the hand, of points (n, 3), is too near to the table."""
        if self._table is None or samples.head.setup != "to_hand":
            return False
        points = se3.apply(links[samples.head.carrier] @ Z, plate)
        (x, y), edges = points[:, :2].T, (*self._table.x, *self._table.y)
        over = (x > edges[0] - _CLEAR) & (x < edges[1] + _CLEAR) & (y > edges[2] - _CLEAR) & (y < edges[3] + _CLEAR)
        return bool((points[over, 2] < self._table.top_z + _CLEAR).any())

    def _views(self, samples: SampleSet, tree: KinematicTree, q: Array, Z: Array) -> Array:
        """Return T_camera_board (n, 4, 4) at postures (n, joints)."""
        head = samples.head
        in_hand = head.setup == "in_hand"
        moving = tree.link_poses(head.parent if in_hand else head.carrier, q)
        fixed = self._description.link_pose(head.base if in_hand else head.parent, {})
        A = se3.inverse(fixed) @ moving
        return se3.inverse(self.belief.X) @ (inverses(A) if in_hand else A) @ Z

    def _centred(self, samples: SampleSet, views: Array) -> NDArray[np.bool_]:
        """(n,) in which views (n, 4, 4) the middle of the board is in the image, and its marks are large enough."""
        optics = samples.head.optics
        pixels = optics.project(views[:, :3, 3])
        inside = (pixels > 0.0).all(axis=1) & (pixels < (optics.width, optics.height)).all(axis=1)
        large = optics.fx * samples.board.feature / np.maximum(views[:, 2, 3], 1e-6) > self._config.smallest
        return inside & large

    def _ranked(self, samples: SampleSet, Z: Array, found: list[tuple[Array, Array]]) -> list[tuple[float, Array]]:
        """Return what each posture leaves of the error (a score, smaller is better), and the posture."""
        config, optics, board = self._config, samples.head.optics, samples.board
        noise = Noise(config.px, config.robot_translation, config.robot_rotation)
        row = np.array([optics.fx, optics.fy, optics.cx, optics.cy])
        X_all, Z_all = self.belief.X[None], Z[None]
        wide = np.array([config.mount_translation] * 3 + [config.mount_rotation] * 3)
        # of the board nothing is taken for granted: a metre and a radian
        deviations = np.concatenate([wide, np.ones(6), np.full(len(samples.joint_names), config.zeros)])
        extras: tuple[Extra, ...] = ("zeros",) if config.zeros else ()
        before: Array = np.diag(deviations[: None if extras else 12] ** -2.0)
        if len(samples):
            before = before + information_at(samples.problem(), X_all, Z_all, noise, extras)
        kinematics = samples.kinematics(samples.joint_names)
        out: list[tuple[float, Array]] = []
        for q, T in found:
            pixels, at = project(board.points, board.radius, T, row), _joints(samples, q)
            view = BoardView(
                board.points, pixels, samples.pose(at), samples.head.setup, board.radius, arm=ArmPosture(kinematics, at)
            )
            gain = information_at(assemble([view], [optics], [T]), X_all, Z_all, noise, extras)
            out.append((_left(invert_scaled(before + gain)), q))
        return out


def _left(covariance: Array) -> float:
    """Return how much error is left, as a score: of the mounts (12, 12), or of mounts and zeros (12 + joints, …).

    Of the camera's mount the sum of its variances. With zeros, some of which a mount takes up whatever the poses are,
    the geometric mean of the variances along all axes of the ellipsoid (D-optimal).
    """
    if len(covariance) == 12:
        return float(np.sum(np.diag(covariance)[:6] / UNITS**2))
    asked = np.r_[0:6, 12 : len(covariance)]
    return float(np.exp(np.linalg.slogdet(covariance[np.ix_(asked, asked)])[1] / len(asked)))


def _joints(samples: SampleSet, q: Array) -> dict[str, float]:
    return dict(zip(samples.joint_names, q.tolist(), strict=True))


def _vector(samples: SampleSet, joints: Mapping[str, float]) -> Array:
    return np.array([joints[name] for name in samples.joint_names])
