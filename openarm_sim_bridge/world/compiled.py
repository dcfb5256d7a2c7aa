# SPDX-License-Identifier: Apache-2.0
"""A compiled MuJoCo model together with the addresses that the world uses.

Free objects shift the addresses of joints in `qpos` and `qvel`, so every address is looked up by name
(`jnt_qposadr`, `jnt_dofadr`), never assumed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

Index = NDArray[np.intp]


@dataclass(frozen=True)
class TrackedObject:
    """A free body whose true pose is reported."""

    name: str
    label: str
    size: tuple[float, float, float]  # extents along its own axes, m


@dataclass(frozen=True)
class CompiledWorld:
    """Model and addresses; joint vectors (n,) are in the order of the requested actuated joints."""

    model: mujoco.MjModel
    timestep_ns: int
    qpos: Index  # (n,) address of each actuated joint in qpos
    dof: Index  # (n,) address in qvel
    actuator: Index  # (n,) index in ctrl
    effort_limit: Array  # (n,) N m or N, infinite where there is none
    start_qpos: Array  # (nq,) home posture, objects at their start
    objects: tuple[TrackedObject, ...]
    object_qpos: tuple[int, ...]
    object_dof: tuple[int, ...]


def compile_world(
    spec: mujoco.MjSpec,
    *,
    joint_names: Sequence[str],
    home: Mapping[str, float],
    objects: Sequence[TrackedObject],
    period_ns: int,
) -> CompiledWorld:
    """Compile a model and look up its addresses.

    Args:
        spec: The model. Its automatic reset is switched off: a diverged simulation that silently restarts would be
            a teleport; the world reports it instead.
        joint_names: Actuated joints; each needs one actuator.
        home: Start position of joints by name, rad or m; joints coupled by an equality follow.
        objects: Free bodies to report, by their body names.
        period_ns: Length of a control tick.

    Raises:
        OpenArmError: CONFIG_INVALID, when MuJoCo refuses the model, the tick is not a whole number of time steps, or a
            joint, actuator or body is missing.
    """
    spec.option.disableflags = int(spec.option.disableflags) | int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    try:
        model = spec.compile()
    except ValueError as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"MuJoCo refuses the model: {error}") from error
    try:
        joints = [model.joint(name).id for name in joint_names]
        free = [_free_joint(model, tracked.name) for tracked in objects]
        start = start_qpos(model, home)
    except KeyError as error:  # MuJoCo's message lists the valid names
        raise OpenArmError(Code.CONFIG_INVALID, f"the model lacks a joint or body: {error.args[0]}") from error
    actuator = _actuators(model, joint_names, joints)
    limited = model.actuator_forcelimited[actuator].astype(bool)
    return CompiledWorld(
        model=model,
        timestep_ns=_timestep_ns(model.opt.timestep, period_ns),
        qpos=model.jnt_qposadr[joints].astype(np.intp),
        dof=model.jnt_dofadr[joints].astype(np.intp),
        actuator=actuator,
        effort_limit=np.where(limited, model.actuator_forcerange[actuator, 1], np.inf),
        start_qpos=start,
        objects=tuple(objects),
        object_qpos=tuple(int(model.jnt_qposadr[j]) for j in free),
        object_dof=tuple(int(model.jnt_dofadr[j]) for j in free),
    )


def joint_slices(model: mujoco.MjModel, joint: int) -> tuple[slice, slice]:
    """Return the slices of a joint of any type in qpos and in qvel."""
    width_q, width_v = {0: (7, 6), 1: (4, 3)}.get(int(model.jnt_type[joint]), (1, 1))
    q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    return slice(q, q + width_q), slice(v, v + width_v)


def _timestep_ns(timestep: float, period_ns: int) -> int:
    timestep_ns = round(timestep * 1e9)
    if timestep_ns <= 0 or period_ns % timestep_ns or abs(timestep_ns - timestep * 1e9) > 1e-3:
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"a control tick of {period_ns / 1e6:g} ms is not a whole number of physics steps of {timestep * 1e3:g} ms;"
            " choose a time step that divides it, for example 2 or 1 ms",
        )
    return timestep_ns


def _actuators(model: mujoco.MjModel, names: Sequence[str], joints: Sequence[int]) -> Index:
    by_joint = {
        int(model.actuator_trnid[i, 0]): i
        for i in range(model.nu)
        if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
    }
    idle = [name for name, joint in zip(names, joints, strict=True) if joint not in by_joint]
    if idle:
        raise OpenArmError(Code.CONFIG_INVALID, f"the model has no actuator for the joints {', '.join(idle)}")
    return np.array([by_joint[joint] for joint in joints], dtype=np.intp)


def _free_joint(model: mujoco.MjModel, body_name: str) -> int:
    joint = int(model.body(body_name).jntadr[0])
    if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        raise OpenArmError(Code.CONFIG_INVALID, f"object {body_name!r} is not a body with a free joint in the model")
    return joint


def start_qpos(model: mujoco.MjModel, home: Mapping[str, float]) -> Array:
    """Return the configuration (nq,) with some joints at given positions, and those coupled to them.

    Raises:
        KeyError: When a joint is missing.
    """
    start = model.qpos0.copy()
    for name, value in home.items():
        start[model.joint(name).qposadr[0]] = value
    for equality in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        follower, leader = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
        if leader >= 0:
            f, x = model.jnt_qposadr[follower], model.jnt_qposadr[leader]
            offset = np.polynomial.polynomial.polyval(start[x] - model.qpos0[x], model.eq_data[equality, :5])
            start[f] = model.qpos0[f] + offset
    return start
