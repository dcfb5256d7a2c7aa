# SPDX-License-Identifier: Apache-2.0
"""The simulated world: one MuJoCo model and its state, stepped tick by tick.

Frame `world` (x forward, y left, z up, m). Joint vectors are in the order of `World.joint_names`; positions are rad
(finger joints: m), velocities rad/s (m/s), efforts N m (N).

Commands go to the actuators (`data.ctrl`) and to nothing else; `qpos` is written in one place, `World._place`, which
is used when the world is made, reset or exchanged. Simulated time is an integer number of nanoseconds and never goes
back, not even when the world is reset. Free objects shift the addresses of joints in `qpos` and `qvel`, so every
address is looked up by name, never assumed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.scene import SceneObject
from openarm_common.types import Array
from openarm_sim_bridge.world.touch import contact_wrench, wrist_wrench

Index = NDArray[np.intp]

_DIVERGED = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
    mujoco.mjtWarning.mjWARN_BADCTRL,  # MuJoCo would continue with all targets zero
)
#: Something that is put into a running world may touch what is there by this much, m.
_OVERLAP_ALLOWED = 1e-3


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
    objects: tuple[SceneObject, ...]
    object_qpos: tuple[int, ...]
    object_dof: tuple[int, ...]


@dataclass(frozen=True)
class JointReadout:
    """State of the actuated joints at `t_ns`, arrays (n,)."""

    t_ns: int
    position: Array
    velocity: Array
    effort: Array


@dataclass(frozen=True)
class ObjectReadout:
    """Where a tracked object is: pose, linear (m/s) and angular (rad/s) velocity (3,) in the frame `world`."""

    object: SceneObject
    T_world_object: Array
    linear: Array
    angular: Array


@dataclass(frozen=True)
class Snapshot:
    """What a renderer needs to draw one tick; `model` is shared and not to be changed."""

    model: mujoco.MjModel
    t_ns: int
    qpos: Array


class World:
    """The one mutable object of the simulation. Not thread-safe: one thread steps it.

    Args:
        spec: The model; compiled here.
        joint_names: Actuated joints, in the order of every joint vector. Each needs one actuator.
        home: Start position of joints by name; others start at the model's reference position. Joints that an
            equality couples to another follow it.
        objects: Free bodies to report, by their body names.
        period_ns: Length of a control tick.

    Raises:
        OpenArmError: CONFIG_INVALID, as `compile`.
    """

    def __init__(
        self,
        spec: mujoco.MjSpec,
        *,
        joint_names: Sequence[str],
        home: Mapping[str, float],
        objects: Sequence[SceneObject] = (),
        period_ns: int = 10_000_000,
    ) -> None:
        self.joint_names = tuple(joint_names)
        self.period_ns = period_ns
        self.t_ns = 0
        self._home = dict(home)
        self._effort_limits: dict[int, float] = {}
        self.exchange(self.compile(spec, objects))

    # --- time
    @property
    def timestep_ns(self) -> int:
        """Length of a physics step."""
        return self._compiled.timestep_ns

    @property
    def steps_per_tick(self) -> int:
        """Physics steps of a control tick."""
        return self.period_ns // self._compiled.timestep_ns

    def step(self, steps: int) -> None:
        """Advance by a number of physics steps.

        Raises:
            OpenArmError: INTERNAL, when the physics diverged; the world must be reset then.
        """
        mujoco.mj_step(self.model, self.data, nstep=steps)
        self.t_ns += steps * self._compiled.timestep_ns
        for warning in _DIVERGED:
            status = self.data.warning[warning]
            if status.number:
                text = mujoco.mju_warningText(int(warning), int(status.lastinfo))
                raise OpenArmError(
                    Code.INTERNAL, f"the physics diverged at {self.t_ns * 1e-9:.3f} s: {text} Reset the world."
                )

    # --- commands
    def set_targets(self, targets: Array) -> None:
        """Set the position targets (n,) of all actuated joints; the actuators clamp them to their ranges."""
        self.data.ctrl[self._compiled.actuator] = targets

    def set_effort_limits(self, limits: Mapping[int, float]) -> None:
        """Limit the effort of actuators by joint index, N m or N; the limit of the model is never exceeded."""
        if limits != self._effort_limits:
            self._effort_limits = dict(limits)
            self._apply_effort_limits()

    # --- readings
    def read_joints(self) -> JointReadout:
        """Return the positions, velocities and actuator efforts of the actuated joints."""
        c, d = self._compiled, self.data
        return JointReadout(self.t_ns, d.qpos[c.qpos], d.qvel[c.dof], d.actuator_force[c.actuator])

    def target_lead_s(self) -> Array:
        """Return the time (n,) by which each joint lags behind a moving target: damping over stiffness, s."""
        c, m = self._compiled, self.model
        kp = m.actuator_gainprm[c.actuator, 0]
        damping = m.dof_damping[c.dof] - m.actuator_biasprm[c.actuator, 2]
        return np.divide(damping, kp, out=np.zeros_like(kp), where=kp > 0.0)

    def effort_limits(self) -> Array:
        """Return the effort limits (n,) of the actuators in the model, N m or N; infinite where there is none."""
        return self._compiled.effort_limit.copy()

    def objects(self) -> tuple[ObjectReadout, ...]:
        """Return pose and twist of every tracked object: ground truth, for judges alone, not for controllers."""
        c, d = self._compiled, self.data
        out: list[ObjectReadout] = []
        for tracked, q, v in zip(c.objects, c.object_qpos, c.object_dof, strict=True):
            w, x, y, z = d.qpos[q + 3 : q + 7]
            T = se3.make(se3.matrix_from_quat_xyzw((x, y, z, w)), d.qpos[q : q + 3])
            # A free joint's linear velocity is in the world frame, its angular velocity in the body frame.
            out.append(ObjectReadout(tracked, T, d.qvel[v : v + 3].copy(), T[:3, :3] @ d.qvel[v + 3 : v + 6]))
        return tuple(out)

    def wrist_wrench(self, body: str) -> tuple[Array, Array]:
        """Return the force and torque (3,) of the wrist sensor of a body, in its frame; as `touch.wrist_wrench`."""
        return wrist_wrench(self.data, body)

    def pad_wrench(self, link: str) -> tuple[Array, Array]:
        """Return contact force and torque (3,) on the pad of a finger link, in its frame: a simulated sensor."""
        return contact_wrench(self.model, self.data, self.model.geom(f"{link}_pad_collision").id)

    def snapshot(self) -> Snapshot:
        """Copy the configuration for a renderer."""
        return Snapshot(self.model, self.t_ns, self.data.qpos.copy())

    # --- reset and exchange
    def reset(self, joints: Mapping[str, float] | None = None, objects: Mapping[str, Array] | None = None) -> None:
        """Put robot and objects back to their start, at rest; simulated time continues.

        Args:
            joints: Start positions by name of joints that do not start at home, rad or m.
            objects: T_world_object (4, 4) by name of objects that start elsewhere.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming the objects that exist; SCENE_INVALID, when something would overlap
                (checked where something starts elsewhere). The world is then as before.
        """
        c, d = self._compiled, self.data
        start = start_qpos(self.model, self._home | dict(joints or {}))
        for name, T in (objects or {}).items():
            self._set_free_pose(start, c.object_qpos[self.object_index(name)], T)
        ctrl = np.zeros(self.model.nu)
        ctrl[c.actuator] = start[c.qpos]
        before = d.qpos.copy(), d.qvel.copy(), d.ctrl.copy()
        self._place(start, np.zeros(self.model.nv), ctrl)
        overlap = self._overlap(set(range(self.model.nbody))) if joints or objects else ""
        if overlap:
            self._place(*before)
            raise OpenArmError(Code.SCENE_INVALID, overlap)
        self._effort_limits.clear()
        self._apply_effort_limits()

    def compile(self, spec: mujoco.MjSpec, objects: Sequence[SceneObject]) -> CompiledWorld:
        """Compile a world for `exchange` or `extend`. Slow (tens of ms), changes nothing, may run in any thread.

        Args:
            spec: The model. Its automatic reset is switched off: a diverged simulation that silently restarts would be
                a teleport; the world reports it instead.
            objects: Free bodies to report, by their body names.

        Raises:
            OpenArmError: CONFIG_INVALID, when MuJoCo refuses the model, the tick is not a whole number of time steps,
                or a joint, actuator or body is missing.
        """
        spec.option.disableflags = int(spec.option.disableflags) | int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        try:
            model = spec.compile()
        except ValueError as error:
            raise OpenArmError(Code.CONFIG_INVALID, f"MuJoCo refuses the model: {error}") from error
        try:
            joints = [model.joint(name).id for name in self.joint_names]
            free = [_free_joint(model, item.name) for item in objects]
            start = start_qpos(model, self._home)
        except KeyError as error:  # MuJoCo's message lists the valid names
            raise OpenArmError(Code.CONFIG_INVALID, f"the model lacks a joint or body: {error.args[0]}") from error
        actuator = _actuators(model, self.joint_names, joints)
        limited = model.actuator_forcelimited[actuator].astype(bool)
        return CompiledWorld(
            model=model,
            timestep_ns=_timestep_ns(model.opt.timestep, self.period_ns),
            qpos=model.jnt_qposadr[joints].astype(np.intp),
            dof=model.jnt_dofadr[joints].astype(np.intp),
            actuator=actuator,
            effort_limit=np.where(limited, model.actuator_forcerange[actuator, 1], np.inf),
            start_qpos=start,
            objects=tuple(objects),
            object_qpos=tuple(int(model.jnt_qposadr[j]) for j in free),
            object_dof=tuple(int(model.jnt_dofadr[j]) for j in free),
        )

    def exchange(
        self,
        compiled: CompiledWorld,
        joints: Mapping[str, float] | None = None,
        objects: Mapping[str, Array] | None = None,
    ) -> None:
        """Take another world, at its start; fast. Arguments and errors as `reset`."""
        before = (self._compiled, self.model, self.data) if hasattr(self, "_compiled") else None
        self._use(compiled)
        try:
            self.reset(joints, objects)
        except OpenArmError:
            if before is not None:
                self._compiled, self.model, self.data = before
            raise

    def extend(self, compiled: CompiledWorld) -> None:
        """Take a world that holds more or less, and keep the state of joints and targets that both have; fast.

        Raises:
            OpenArmError: SCENE_INVALID, when something new overlaps something that is there; the world is then as
                before.
        """
        before, old, old_model = self._compiled, self.data, self.model
        self._use(compiled)
        qpos, qvel, ctrl = compiled.start_qpos.copy(), np.zeros(self.model.nv), np.zeros(self.model.nu)
        known: set[int] = set()
        for joint in range(self.model.njnt):
            old_joint = mujoco.mj_name2id(old_model, mujoco.mjtObj.mjOBJ_JOINT, self.model.joint(joint).name)
            if old_joint < 0:
                continue
            known.add(int(self.model.jnt_bodyid[joint]))
            q, v, state = self.model.jnt_qposadr[joint], self.model.jnt_dofadr[joint], old.joint(old_joint)
            qpos[q : q + len(state.qpos)] = state.qpos
            qvel[v : v + len(state.qvel)] = state.qvel
        ctrl[compiled.actuator] = old.ctrl[before.actuator]
        self._apply_effort_limits()
        self._place(qpos, qvel, ctrl)
        new = {body for body in range(self.model.nbody) if self.model.body_dofnum[body] == 6} - known
        overlap = self._overlap(new)
        if overlap:
            self._compiled, self.model, self.data = before, old_model, old
            raise OpenArmError(Code.SCENE_INVALID, overlap)

    def move_object(self, name: str, T_world_object: Array) -> None:
        """Put a tracked object elsewhere, at rest, as a person would; everything else continues.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming the objects that exist; SCENE_INVALID, when something else is there
                (the object then stays where it was).
        """
        c, d = self._compiled, self.data
        at = self.object_index(name)
        q, v = c.object_qpos[at], c.object_dof[at]
        before = d.qpos.copy(), d.qvel.copy(), d.ctrl.copy()
        qpos, qvel, ctrl = (part.copy() for part in before)
        self._set_free_pose(qpos, q, T_world_object)
        qvel[v : v + 6] = 0.0
        self._place(qpos, qvel, ctrl)
        overlap = self._overlap({int(self.model.dof_bodyid[v])})
        if overlap:
            self._place(*before)
            raise OpenArmError(Code.SCENE_INVALID, overlap)

    def object_index(self, name: str) -> int:
        """Return the place of a tracked object in `objects`.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming the objects that exist.
        """
        names = [item.name for item in self._compiled.objects]
        if name not in names:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no object {name!r}; objects: {', '.join(names) or 'none'}")
        return names.index(name)

    @staticmethod
    def _set_free_pose(qpos: Array, address: int, T_world_object: Array) -> None:
        qpos[address : address + 3] = T_world_object[:3, 3]
        qpos[address + 3 : address + 7] = np.roll(se3.quat_xyzw_from_matrix(T_world_object[:3, :3]), 1)

    def _overlap(self, of: set[int]) -> str:
        """Return a sentence about bodies that overlap others; empty when they only touch."""
        m = self.model
        for contact in self.data.contact:
            bodies = [int(m.geom_bodyid[geom]) for geom in (contact.geom1, contact.geom2)]
            if not of.isdisjoint(bodies) and contact.dist < -_OVERLAP_ALLOWED:
                # The one that can be put elsewhere is named first: an object, else what moves.
                one, other = sorted(bodies, key=lambda body: (body not in of, -int(m.body_dofnum[body])))
                place = ", ".join(f"{v:.3f}" for v in contact.pos)
                return (
                    f"{m.body(one).name!r} would overlap {m.body(other).name!r} by {-contact.dist * 1e3:.0f} mm at"
                    f" ({place}) m in world; choose another place or posture"
                )
        return ""

    def _place(self, qpos: Array, qvel: Array, ctrl: Array) -> None:
        """Write a whole state; the only place where `qpos` is written: a running world moves by forces alone."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = qpos
        self.data.qvel[:] = qvel
        self.data.ctrl[:] = ctrl
        mujoco.mj_forward(self.model, self.data)

    def _use(self, compiled: CompiledWorld) -> None:
        self._compiled = compiled
        self.model: mujoco.MjModel = compiled.model
        self.data = mujoco.MjData(compiled.model)

    def _apply_effort_limits(self) -> None:
        for joint, actuator in enumerate(self._compiled.actuator):
            limit = min(self._effort_limits.get(joint, np.inf), float(self._compiled.effort_limit[joint]))
            if np.isfinite(limit):
                self.model.actuator_forcerange[actuator] = (-limit, limit)


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
