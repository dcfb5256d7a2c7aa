# SPDX-License-Identifier: Apache-2.0
"""What the motion tests share: the robot at home, a table, and one `Arm` a side (building one takes 0.2 s)."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
import ruckig
from scipy.interpolate import BPoly

from openarm_common.camera.cameras import load_cameras
from openarm_common.camera.housings import with_housings
from openarm_common.robot.description import RobotDescription
from openarm_motion.collision.exact import CollisionScene
from openarm_motion.collision.fast import FastScene
from openarm_motion.collision.solids import Box, box_from
from openarm_motion.config import MotionConfig
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.dual_arm import DualArmScene
from openarm_motion.timing.trajectory import JointLimits, Trajectory

# arms of other builds: name, origin and axis in the frame before, lower and upper limit
_SIX = [  # an offset wrist
    ("waist", (0, 0, 0.10), (0, 0, 1), -2.9, 2.9),
    ("shoulder", (0, 0, 0.20), (0, 1, 0), -1.9, 1.9),
    ("elbow", (0, 0, 0.40), (0, 1, 0), -2.4, 2.4),
    ("forearm", (0, 0.03, 0.20), (0, 0, 1), -2.9, 2.9),
    ("bend", (0, 0, 0.20), (0, 1, 0), -2.0, 2.0),
    ("flange", (0.02, 0, 0.08), (0, 0, 1), -3.0, 3.0),
]
_SEVEN = [  # offsets at elbow and wrist: no closed form
    ("j1", (0, 0, 0.30), (0, 0, 1), -2.8, 2.8),
    ("j2", (0, 0, 0), (0, 1, 0), -1.7, 1.7),
    ("j3", (0, 0, 0.32), (0, 0, 1), -2.8, 2.8),
    ("j4", (0.08, 0, 0), (0, -1, 0), -3.0, -0.1),
    ("j5", (-0.08, 0, 0.38), (0, 0, 1), -2.8, 2.8),
    ("j6", (0, 0, 0), (0, -1, 0), 0.0, 3.7),
    ("j7", (0.09, 0, 0), (0, 0, -1), -2.8, 2.8),
]
_SRS = [  # a straight arm with the roll axes in one line at zero, limits on both sides of the straight elbow
    ("a1", (0, 0, 0.34), (0, 0, 1), -2.9, 2.9),
    ("a2", (0, 0, 0), (0, 1, 0), -2.0, 2.0),
    ("a3", (0, 0, 0.40), (0, 0, 1), -2.9, 2.9),
    ("a4", (0, 0, 0), (0, -1, 0), -2.0, 2.0),
    ("a5", (0, 0, 0.40), (0, 0, 1), -2.9, 2.9),
    ("a6", (0, 0, 0), (0, 1, 0), -2.0, 2.0),
    ("a7", (0, 0, 0.10), (0, 0, 1), -3.0, 3.0),
]


def _serial(name: str, chain: list[tuple[str, tuple[float, ...], tuple[float, ...], float, float]]) -> str:
    """URDF of an arm that has nothing in common with OpenArm; the tool link is `tool`."""
    base = '<collision><geometry><cylinder radius="0.08" length="0.1"/></geometry></collision>'
    parts, parent = [f'<link name="base">{base}</link>'], "base"
    for joint, xyz, axis, lower, upper in chain:
        span = f'lower="{lower}" upper="{upper}"'
        shape = '<collision><origin xyz="0 0 0.03"/><geometry><box size="0.06 0.06 0.06"/></geometry></collision>'
        parts.append(f'<link name="{joint}_link">{shape}</link>')
        parts.append(
            f'<joint name="{joint}" type="{"continuous" if math.isinf(upper) else "revolute"}">'
            f'<parent link="{parent}"/><child link="{joint}_link"/>'
            f'<origin xyz="{xyz[0]} {xyz[1]} {xyz[2]}"/><axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>'
            f'<limit {"" if math.isinf(upper) else span} effort="10" velocity="2"/></joint>'
        )
        parent = f"{joint}_link"
    parts.append(
        f'<link name="tool"/><joint name="tool_joint" type="fixed"><parent link="{parent}"/>'
        '<child link="tool"/><origin xyz="0 0 0.1"/></joint>'
    )
    return f'<robot name="{name}">{"".join(parts)}</robot>'


@pytest.fixture(scope="session")
def description() -> RobotDescription:
    return with_housings(RobotDescription.load(), load_cameras().values())


@pytest.fixture(scope="session")
def table() -> Box:
    """Top of the default table, 0.40 m high."""
    return box_from("table", (0.46, 0.0, 0.38), (0.7, 1.2, 0.04))


@pytest.fixture(scope="session")
def home(description: RobotDescription) -> dict[str, float]:
    """Both arms at home, fingers closed."""
    state = {**description.group_state("left_arm", "home"), **description.group_state("right_arm", "home")}
    return {**state, description.finger_joint("left"): 0.0, description.finger_joint("right"): 0.0}


@pytest.fixture(scope="session")
def arms(description: RobotDescription, table: Box) -> dict[str, Arm]:
    return {side: Arm(side, description, MotionConfig(), [table]) for side in ("left", "right")}


@pytest.fixture(scope="session")
def right(arms: dict[str, Arm]) -> Arm:
    return arms["right"]


@pytest.fixture(scope="session")
def six() -> RobotDescription:
    """Another robot, with six joints."""
    return RobotDescription.from_urdf(_serial("six", _SIX))


@pytest.fixture(scope="session")
def turning() -> dict[str, RobotDescription]:
    """Robots whose first and last joints turn without end: one solved numerically, one in closed form."""
    chains = {"six": _SIX, "straight": _SRS}
    ends = {name: {chain[0][0], chain[-1][0]} for name, chain in chains.items()}
    return {
        name: RobotDescription.from_urdf(
            _serial(name, [(*row[:3], -math.inf, math.inf) if row[0] in ends[name] else row for row in chain])
        )
        for name, chain in chains.items()
    }


@pytest.fixture(scope="session")
def seven() -> RobotDescription:
    """Another robot, with seven joints and no closed form."""
    return RobotDescription.from_urdf(_serial("seven", _SEVEN))


@pytest.fixture(scope="session")
def straight() -> RobotDescription:
    """Another robot with a spherical shoulder and wrist."""
    return RobotDescription.from_urdf(_serial("straight", _SRS))


def both_layers(fast: FastScene, exact: CollisionScene | DualArmScene, states: np.ndarray) -> tuple[int, int]:
    """How many states are free by the fast layer and by the exact one; the fast one is never more generous."""
    free = fast.free_many(states)
    truth = np.array([not exact.collides(q) for q in states])
    assert not np.any(free & ~truth)
    return int(np.sum(free)), int(np.sum(truth))


def down(x: float, y: float, z: float, yaw: float = 0.0) -> np.ndarray:
    """Tool pose that looks straight down with the opening axis at `yaw` in the plane."""
    from openarm_common import se3

    return se3.make(se3.rotation_from_z_y((0, 0, -1), (np.cos(yaw), np.sin(yaw), 0)), (x, y, z))


def shares_of_limits(trajectory: Trajectory, limits: JointLimits) -> list[float]:
    """Greatest velocity, acceleration and jerk over their limits, of the polynomials that a controller interpolates.

    A polynomial lies within its Bernstein coefficients; where those exceed a limit, its extremes are computed.
    """
    t = trajectory.t
    curve = BPoly.from_derivatives(t, np.stack([trajectory.q, trajectory.v, trajectory.a], axis=1))
    found: list[float] = []
    for k, limit in enumerate(limits, 1):
        rate = curve.derivative(k)
        shares = np.abs(rate.c).max(axis=0) / limit
        for i, joint in np.argwhere(shares > 1.0):
            power = _powers(len(rate.c) - 1) @ rate.c[:, i, joint]
            turns = np.roots(np.polyder(power))
            inner = turns.real[(np.abs(turns.imag) < 1e-9) & (turns.real > 0.0) & (turns.real < 1.0)]
            shares[i, joint] = np.abs(np.polyval(power, [0.0, 1.0, *inner])).max() / limit[joint]
        found.append(float(shares.max()))
    return found


@functools.cache
def _powers(n: int) -> np.ndarray:
    """From the Bernstein form of a polynomial of degree n to the factors of its powers, the highest first."""
    return np.array(
        [[(-1) ** (j - i) * math.comb(n, j) * math.comb(j, i) for i in range(n + 1)] for j in range(n, -1, -1)], float
    )


def ruckig_duration(length: float, most: np.ndarray) -> float:
    """Time that Ruckig takes from rest to rest with a greatest velocity, acceleration and jerk (3,), s."""
    query, answer = ruckig.InputParameter(1), ruckig.Trajectory(1)
    query.current_position, query.target_position = [0.0], [length]
    query.max_velocity, query.max_acceleration, query.max_jerk = most[:, None].tolist()
    assert ruckig.Ruckig(1).calculate(query, answer) >= 0
    return float(answer.duration)
