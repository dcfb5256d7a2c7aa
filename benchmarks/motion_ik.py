# SPDX-License-Identifier: Apache-2.0
"""Inverse kinematics compared with peers: pinocchio's kinematics with the loop in Python, ikpy and mink. rad, m."""

from __future__ import annotations

import contextlib
import importlib
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from benchmarks.report import Row
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import Scene, Table
from openarm_common.types import Array
from openarm_motion.planning.arm import Arm
from openarm_sim_bridge.world.model import compile_model

#: What counts as reached: position (m) and rotation (rad).
TOLERANCE = (1e-4, 1e-3)
#: Seed of the poses.
_SEED = 60_000


def ik_rows(arms: Mapping[str, Arm], count: int, peer_count: int) -> list[Row]:
    """Reachable poses: tool poses of random configurations within the limits."""
    times: list[float] = []
    solved = 0
    targets: dict[str, Array] = {}
    for name, arm in arms.items():
        chain = arm.kinematics
        targets[name] = chain.fk_many(np.random.default_rng(_SEED).uniform(chain.lower, chain.upper, (count, chain.n)))
        chain.ik(targets[name][0], tolerance=TOLERANCE)
        for target in targets[name]:
            begin = time.perf_counter()
            result = chain.ik(target, tolerance=TOLERANCE)
            times.append(time.perf_counter() - begin)
            solved += reached(chain.fk(result.q), target) and chain.margin(result.q) >= -1e-9
    n, rows = len(times), []
    share, p95 = 100.0 * solved / n, float(np.percentile(times, 95)) * 1e3
    for key, label, make, most in (
        ("", "pinocchio in Python, 20 restarts", PinocchioIk, peer_count),
        ("_ikpy", "ikpy", IkpyIk, max(peer_count // 5, 5)),
        ("_mink", "mink (daqp), 60 iterations", MinkIk, max(peer_count // 2, 5)),
    ):
        found = _measure(arms, targets, make, most)
        rows.append(Row(f"ik_success{key}", share, "%", "higher", 99.9, label + found[0], found[1], n))
        rows.append(Row(f"ik_p95{key}_ms", p95, "ms", "lower", 0.2, label + found[0], found[2], n))
    return rows


def reached(pose: Array, target: Array) -> bool:
    """Whether a pose is within the tolerance of a target."""
    away = pin.log3(pose[:3, :3].T @ target[:3, :3])
    near = float(np.linalg.norm(pose[:3, 3] - target[:3, 3])) <= TOLERANCE[0]
    return near and float(np.linalg.norm(away)) <= TOLERANCE[1]


def _measure(
    arms: Mapping[str, Arm], targets: Mapping[str, Array], make: Callable[[Arm], Any], count: int
) -> tuple[str, float | None, float | None]:
    """A remark, the share solved (%) and the 95th percentile (ms); none of a peer that is not installed."""
    times: list[float] = []
    solved = 0
    for name, arm in arms.items():
        try:
            peer = make(arm)
        except ModuleNotFoundError as error:
            return f": {error.name} is not installed", None, None
        for target in targets[name][:count]:
            begin = time.perf_counter()
            q = peer.solve(target)
            times.append(time.perf_counter() - begin)
            solved += reached(arm.kinematics.fk(q), target) and arm.kinematics.margin(q) >= -1e-6
    return f", n={len(times)}", 100.0 * solved / len(times), float(np.percentile(times, 95)) * 1e3


class PinocchioIk:
    """Damped least squares with pinocchio's kinematics, the loop in Python."""

    def __init__(self, arm: Arm) -> None:
        full = pin.buildModelFromXML(arm.description.urdf)
        others = [i for i, name in enumerate(full.names) if i > 0 and name not in arm.names]
        self._model = pin.buildReducedModel(full, others, pin.neutral(full))
        self._data = self._model.createData()
        self._frame = self._model.getFrameId(arm.kinematics.tool_link)
        self._rng = np.random.default_rng(0)

    def solve(self, target: Array, restarts: int = 20, iterations: int = 100) -> Array:
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
                    return q
                J = pin.getFrameJacobian(model, data, self._frame, pin.LOCAL)
                step = J.T @ np.linalg.solve(J @ J.T + (0.5 * error @ error + 1e-6) * np.eye(6), error)
                q = np.clip(q + np.clip(step, -0.6, 0.6), lower, upper)
            q = self._rng.uniform(lower, upper)
        return q


class IkpyIk:
    """ikpy's own optimisation over the chain from the root to the tool."""

    def __init__(self, arm: Arm) -> None:
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
        self._columns = [i for i, link in enumerate(links) if link.name in arm.names]
        self._chain.active_links_mask[:] = [i in self._columns for i in range(len(links))]
        middle = 0.5 * (arm.kinematics.lower + arm.kinematics.upper)
        self._start = np.zeros(len(links))
        self._start[self._columns] = middle

    def solve(self, target: Array) -> Array:
        """What it finds from the middle of the limits."""
        found = self._chain.inverse_kinematics_frame(target, initial_position=self._start, orientation_mode="all")
        return np.asarray(found)[self._columns]


class MinkIk:
    """mink's differential inverse kinematics on the MuJoCo model, from the middle of the limits."""

    def __init__(self, arm: Arm) -> None:
        self._mink: Any = importlib.import_module("mink")
        importlib.import_module("daqp")
        model = compile_model(RobotDescription.load(), Scene(name="bench", table=Table(), objects=()), {})
        self._columns = [int(model.joint(name).qposadr[0]) for name in arm.names]
        self._dofs = [int(model.joint(name).dofadr[0]) for name in arm.names]
        self._configuration = self._mink.Configuration(model)
        self._task = self._mink.FrameTask(arm.kinematics.tool_link, "body", position_cost=1.0, orientation_cost=0.2)
        self._limits = [self._mink.ConfigurationLimit(model)]
        self._middle = 0.5 * (arm.kinematics.lower + arm.kinematics.upper)
        self._rest = np.zeros(model.nq)

    def solve(self, target: Array, iterations: int = 60) -> Array:
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
        return np.array(self._configuration.q[self._columns])
