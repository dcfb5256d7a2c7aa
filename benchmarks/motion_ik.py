# SPDX-License-Identifier: Apache-2.0
"""Inverse kinematics compared with peers: pinocchio's kinematics with the loop in Python, ikpy and mink. rad, m.

Targets are tool poses of random configurations within the limits: uniform ones, and such with each joint, at a
probability of 1/3, within 0.02 rad of a limit. An OpenArm v2, a Panda and a UR5e are measured, too.
"""

from __future__ import annotations

import contextlib
import importlib
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from benchmarks.report import Row
from benchmarks.robot_models import ROBOTS
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_work
from openarm_common.scene.scene import Scene
from openarm_common.types import Array
from openarm_motion.kinematics.chain import ArmKinematics
from openarm_motion.kinematics.inverse import InverseKinematics
from openarm_motion.planning.arm import Arm
from openarm_sim_bridge.world.model import compile_model

#: What counts as reached: position (m) and rotation (rad).
TOLERANCE = (1e-4, 1e-3)
#: Seed of the poses.
_SEED = 60_000
#: Probability of a joint to be near a limit, and how near, rad.
_NEAR = (1.0 / 3.0, 0.02)
#: Target of the 95th percentile, ms, by method.
_P95 = {"closed form": 0.2, "numeric": 1.0}


@dataclass(frozen=True, eq=False)
class IkArm:
    """What inverse kinematics is measured on."""

    description: RobotDescription
    inverse: InverseKinematics

    @property
    def kinematics(self) -> ArmKinematics:
        """The chain."""
        return self.inverse.kinematics

    def targets(self, count: int, *, at_limits: bool) -> Array:
        """Tool poses (count, 4, 4) of random configurations within the limits."""
        chain, rng = self.kinematics, np.random.default_rng(_SEED)
        shape = (count, chain.n)
        states = rng.uniform(chain.lower, chain.upper, shape)
        if at_limits:
            near, depth = rng.random(shape) < _NEAR[0], rng.uniform(0.0, _NEAR[1], shape)
            limit = np.where(rng.random(shape) < 0.5, chain.lower + depth, chain.upper - depth)
            states = np.where(near, limit, states)
        return chain.fk_many(states)


def ik_rows(arms: Mapping[str, Arm], count: int, peer_count: int) -> list[Row]:
    """Rows of the arms together, each compared with one peer, then of each arm, kind of pose, and kind of answer."""
    ours = {name: IkArm(arm.description, arm.inverse) for name, arm in arms.items()}
    targets = {name: arm.targets(count, at_limits=False) for name, arm in ours.items()}
    solved, times = _measure(ours, targets, _one, count)
    n, rows = len(times), []
    for key, label, make, most in (
        ("", "pinocchio in Python, 20 restarts", PinocchioIk, peer_count),
        ("_ikpy", "ikpy", IkpyIk, max(peer_count // 5, 5)),
        ("_mink", "mink (daqp), 60 iterations", MinkIk, max(peer_count // 2, 5)),
    ):
        remark, peer_share, peer_p95 = _peer(ours, targets, make, most)
        p95 = float(np.percentile(times, 95))
        rows.append(Row(f"ik_success{key}", solved, "%", "higher", 99.9, label + remark, peer_share, n))
        rows.append(Row(f"ik_p95{key}_ms", p95, "ms", "lower", 0.2, label + remark, peer_p95, n))
    for name, arm in {**ours, **_others()}.items():
        for kind in ("uniform", "limits"):
            poses = arm.targets(count, at_limits=kind == "limits")
            rows += _rows_of(f"ik_{name}_{kind}", arm, poses, peer_count)
    return rows


def _rows_of(metric: str, arm: IkArm, poses: Array, peer_count: int) -> list[Row]:
    """One configuration near the middle of the limits, compared with pinocchio; then all goals of a plan."""
    at, label = {"": poses}, "pinocchio in Python, 20 restarts"
    solved, times = _measure({"": arm}, at, _one, len(poses))
    peer_solved, peer_times = _measure({"": arm}, at, PinocchioIk, peer_count)
    label += f", n={len(peer_times)}"
    p50, p95 = (float(np.percentile(times, p)) for p in (50, 95))
    peer_p50, peer_p95 = (float(np.percentile(peer_times, p)) for p in (50, 95))
    most, n = _P95[arm.inverse.method.split(" (")[0]], len(times)
    all_solved, all_times = _measure({"": arm}, at, _goals, len(poses))
    return [
        Row(f"{metric}_success", solved, "%", "higher", 99.9, label, peer_solved, n),
        Row(f"{metric}_median_ms", p50, "ms", "lower", None, label, peer_p50, n),
        Row(f"{metric}_p95_ms", p95, "ms", "lower", most, label, peer_p95, n),
        Row(f"{metric}_goals_success", all_solved, "%", "higher", 99.9, n=n),
        Row(f"{metric}_goals_median_ms", float(np.percentile(all_times, 50)), "ms", "lower", None, n=n),
        Row(f"{metric}_goals_p95_ms", float(np.percentile(all_times, 95)), "ms", "lower", None, n=n),
    ]


def _others() -> dict[str, IkArm]:
    """The first arm of the other robots."""
    out: dict[str, IkArm] = {}
    for name in ("openarm_v2", *ROBOTS):
        description = RobotDescription.load(name)
        tool = description.tcp_link(description.arm_names[0])
        out[name] = IkArm(description, InverseKinematics(ArmKinematics(description, tool)))
    return out


def reached(pose: Array, target: Array) -> bool:
    """Whether a pose is within the tolerance of a target."""
    away = pin.log3(pose[:3, :3].T @ target[:3, :3])
    near = float(np.linalg.norm(pose[:3, 3] - target[:3, 3])) <= TOLERANCE[0]
    return near and float(np.linalg.norm(away)) <= TOLERANCE[1]


def _one(arm: IkArm) -> Callable[[Array], list[Array]]:
    """What solves one configuration as `/motion/compute_ik` does, from the middle of the limits."""

    def solve(target: Array) -> list[Array]:
        return [arm.inverse.nearest(target).q]

    return solve


def _goals(arm: IkArm) -> Callable[[Array], list[Array]]:
    """What finds the goals of a plan to a pose."""

    def solve(target: Array) -> list[Array]:
        return [solution.q for solution in arm.inverse.solutions(target)]

    return solve


def _measure(
    arms: Mapping[str, IkArm],
    targets: Mapping[str, Array],
    make: Callable[[IkArm], Callable[[Array], list[Array]]],
    count: int,
) -> tuple[float, list[float]]:
    """The share solved (%), every configuration within limits and tolerance, and the times, ms."""
    times: list[float] = []
    solved = 0
    for name, arm in arms.items():
        solve = make(arm)
        solve(targets[name][0])
        for target in targets[name][:count]:
            begin = time.perf_counter()
            found = solve(target)
            times.append((time.perf_counter() - begin) * 1e3)
            solved += bool(found) and all(
                reached(arm.kinematics.fk(q), target) and arm.kinematics.margin(q) >= -1e-6 for q in found
            )
    return 100.0 * solved / len(times), times


def _peer(
    arms: Mapping[str, IkArm],
    targets: Mapping[str, Array],
    make: Callable[[IkArm], Callable[[Array], list[Array]]],
    count: int,
) -> tuple[str, float | None, float | None]:
    """A remark, the share solved (%) and the 95th percentile (ms); none of a peer that is not installed."""
    try:
        share, times = _measure(arms, targets, make, count)
    except ModuleNotFoundError as error:
        return f": {error.name} is not installed", None, None
    return f", n={len(times)}", share, float(np.percentile(times, 95))


class PinocchioIk:
    """Damped least squares with pinocchio's kinematics, the loop in Python."""

    def __init__(self, arm: IkArm) -> None:
        full = pin.buildModelFromXML(arm.description.urdf)
        others = [i for i, name in enumerate(full.names) if i > 0 and name not in arm.kinematics.names]
        self._model = pin.buildReducedModel(full, others, pin.neutral(full))
        self._data = self._model.createData()
        self._frame = self._model.getFrameId(arm.kinematics.tool_link)
        self._rng = np.random.default_rng(0)

    def __call__(self, target: Array, restarts: int = 20, iterations: int = 100) -> list[Array]:
        """The best configuration found."""
        model, data = self._model, self._data
        lower, upper = model.lowerPositionLimit, model.upperPositionLimit
        goal, q = pin.SE3(target), 0.5 * (lower + upper)
        for _ in range(restarts + 1):
            for _ in range(iterations):
                pin.computeJointJacobians(model, data, q)
                here = pin.updateFramePlacement(model, data, self._frame)
                error = pin.log6(here.actInv(goal)).vector
                if reached(here.homogeneous, target):
                    return [q]
                J = pin.getFrameJacobian(model, data, self._frame, pin.LOCAL)
                step = J.T @ np.linalg.solve(J @ J.T + (0.5 * error @ error + 1e-6) * np.eye(6), error)
                q = np.clip(q + np.clip(step, -0.6, 0.6), lower, upper)
            q = self._rng.uniform(lower, upper)
        return [q]


class IkpyIk:
    """ikpy's own optimisation over the chain from the root to the tool."""

    def __init__(self, arm: IkArm) -> None:
        chains: Any = importlib.import_module("ikpy.chain")
        elements = [arm.description.root]
        for joint in arm.description.chain(arm.kinematics.tool_link):
            elements += [joint.name, joint.child]
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(), contextlib.suppress(UserWarning):
            warnings.simplefilter("ignore")
            path = Path(folder) / "robot.urdf"
            path.write_text(arm.description.urdf, encoding="utf-8")
            self._chain = chains.Chain.from_urdf_file(str(path), base_elements=elements)
        links = self._chain.links
        self._columns = [i for i, link in enumerate(links) if link.name in arm.kinematics.names]
        self._chain.active_links_mask[:] = [i in self._columns for i in range(len(links))]
        middle = 0.5 * (arm.kinematics.lower + arm.kinematics.upper)
        self._start = np.zeros(len(links))
        self._start[self._columns] = middle

    def __call__(self, target: Array) -> list[Array]:
        """What it finds from the middle of the limits."""
        found = self._chain.inverse_kinematics_frame(target, initial_position=self._start, orientation_mode="all")
        return [np.asarray(found)[self._columns]]


class MinkIk:
    """mink's differential inverse kinematics on the MuJoCo model, from the middle of the limits."""

    def __init__(self, arm: IkArm) -> None:
        self._mink: Any = importlib.import_module("mink")
        importlib.import_module("daqp")
        model = compile_model(RobotDescription.load(), Scene(name="bench", table=robot_work().table, objects=()), {})
        self._columns = [int(model.joint(name).qposadr[0]) for name in arm.kinematics.names]
        self._dofs = [int(model.joint(name).dofadr[0]) for name in arm.kinematics.names]
        self._configuration = self._mink.Configuration(model)
        self._task = self._mink.FrameTask(arm.kinematics.tool_link, "body", position_cost=1.0, orientation_cost=0.2)
        self._limits = [self._mink.ConfigurationLimit(model)]
        self._middle = 0.5 * (arm.kinematics.lower + arm.kinematics.upper)
        self._rest = np.zeros(model.nq)

    def __call__(self, target: Array, iterations: int = 60) -> list[Array]:
        """Where it is after so many steps, or when it is there."""
        q = self._rest.copy()
        q[self._columns] = self._middle
        self._configuration.update(q)
        self._task.set_target(self._mink.SE3.from_matrix(target))
        for _ in range(iterations):
            error = self._task.compute_error(self._configuration)
            if np.linalg.norm(error[:3]) < TOLERANCE[0] / 2 and np.linalg.norm(error[3:]) < TOLERANCE[1] / 2:
                break
            speed = self._mink.solve_ik(self._configuration, [self._task], 1.0, "daqp", 1e-9, limits=self._limits)
            still = np.zeros_like(speed)
            still[self._dofs] = speed[self._dofs]
            self._configuration.integrate_inplace(still, 1.0)
        return [np.array(self._configuration.q[self._columns])]
