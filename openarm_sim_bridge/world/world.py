# SPDX-License-Identifier: Apache-2.0
"""The simulated world: one MuJoCo model and its state, stepped tick by tick.

Frame `world` (x forward, y left, z up, m). Joint vectors are in the order of `World.joint_names`; positions are rad
(finger joints: m), velocities rad/s (m/s), efforts N m (N).

Commands go to the actuators (`data.ctrl`) and to nothing else; `qpos` is written in one place, `World._place`, which
is used when the world is made, reset or exchanged. Simulated time is an integer number of nanoseconds and never goes
back, not even when the world is reset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_sim_bridge.world.compiled import CompiledWorld, TrackedObject, compile_world, joint_slices, start_qpos
from openarm_sim_bridge.world.touch import contact_wrench, wrist_wrench

_DIVERGED = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
    mujoco.mjtWarning.mjWARN_BADCTRL,  # MuJoCo would continue with all targets zero
)
#: Something that is put into a running world may touch what is there by this much, m.
_OVERLAP_ALLOWED = 1e-3


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

    object: TrackedObject
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
        OpenArmError: CONFIG_INVALID, as `compile_world`.
    """

    def __init__(
        self,
        spec: mujoco.MjSpec,
        *,
        joint_names: Sequence[str],
        home: Mapping[str, float],
        objects: Sequence[TrackedObject] = (),
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

    def step_tick(self) -> None:
        """Advance by one control tick.

        Raises:
            OpenArmError: INTERNAL, when the physics diverged.
        """
        self.step(self.steps_per_tick)

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

    def body_pose(self, name: str) -> Array:
        """Return T_world_body, (4, 4), at the present time. For tests and judges.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming the bodies that exist.
        """
        body = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, name)
        if body < 0:
            known = ", ".join(self.model.body(b).name for b in range(self.model.nbody))
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no body {name!r} in the world; bodies: {known}")
        mujoco.mj_kinematics(self.model, self.data)  # after a step, xpos is that of the step's beginning
        return se3.make(self.data.xmat[body].reshape(3, 3), self.data.xpos[body])

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
        return wrist_wrench(self.model, self.data, body)

    def pad_wrench(self, link: str) -> tuple[Array, Array]:
        """Return contact force and torque (3,) on the pad of a finger link, in its frame: a simulated sensor."""
        pad = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_GEOM, f"{link}_pad_collision")
        return contact_wrench(self.model, self.data, (pad,))

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
            self._set_free_pose(start, c.object_qpos[self._object(name)], T)
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

    def compile(self, spec: mujoco.MjSpec, objects: Sequence[TrackedObject]) -> CompiledWorld:
        """Compile a world for `exchange`. Slow (tens of ms), changes nothing, may run in any thread.

        Raises:
            OpenArmError: CONFIG_INVALID, as `compile_world`.
        """
        return compile_world(
            spec, joint_names=self.joint_names, home=self._home, objects=objects, period_ns=self.period_ns
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
            q, v = joint_slices(self.model, joint)
            old_q, old_v = joint_slices(old_model, old_joint)
            qpos[q], qvel[v] = old.qpos[old_q], old.qvel[old_v]
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
        at = self._object(name)
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

    def _object(self, name: str) -> int:
        names = [tracked.name for tracked in self._compiled.objects]
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
