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

from bisect import insort
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.scene import SceneObject
from openarm_common.types import Array, Ints
from openarm_control.joints import JointReadout
from openarm_sim_bridge.world.hardware import Encoders
from openarm_sim_bridge.world.touch import contact_wrench, imu, wrist_wrench

Index = NDArray[np.intp]

#: Length of a control tick, ns.
PERIOD_NS = 10_000_000
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
    objects: Mapping[str, SceneObject]  # by their names, which their free joints have too


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
        objects: Free bodies to report, by the names of their free joints.
        period_ns: Length of a control tick.
        encoders: Encoders that commands and joint states go through; None is the truth.
        sleep: Whether objects at rest are left out of the physics until something that moves touches them.

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
        period_ns: int = PERIOD_NS,
        encoders: Encoders | None = None,
        sleep: bool = True,
    ) -> None:
        self.joint_names = tuple(joint_names)
        self.period_ns = period_ns
        self._sleep = int(mujoco.mjtEnableBit.mjENBL_SLEEP) if sleep else 0
        self.t_ns = 0
        self._home = dict(home)
        self._encoders = encoders or Encoders.exact(len(self.joint_names))
        #: Targets that have not taken effect yet: when they do, of which joints, and what.
        self._late: list[tuple[int, Index, Array]] = []
        self.delay_commands(np.zeros(len(self.joint_names)))
        self._use(self.compile(spec, objects))
        self.reset()

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
        end_ns = self.t_ns + steps * self._compiled.timestep_ns
        while self._late and self._late[0][0] < end_ns:
            self._advance(self._late[0][0])
            self._take_due(self.t_ns)
        self._advance(end_ns)
        for warning in _DIVERGED:
            status = self.data.warning[warning]
            if status.number:
                text = mujoco.mju_warningText(int(warning), int(status.lastinfo))
                raise OpenArmError(
                    Code.INTERNAL, f"the physics diverged at {self.t_ns * 1e-9:.3f} s: {text} Reset the world."
                )

    def shift_time(self, ns: int) -> None:
        """Let simulated time go on at another time, as that of a robot whose stamps are of the wall clock."""
        self.t_ns += ns
        self._late = [(due_ns + ns, joints, targets) for due_ns, joints, targets in self._late]

    def _take_due(self, t_ns: int) -> None:
        while self._late and self._late[0][0] <= t_ns:
            _, joints, targets = self._late.pop(0)
            self.data.ctrl[self._compiled.actuator[joints]] = targets

    def _advance(self, t_ns: int) -> None:
        steps = (t_ns - self.t_ns) // self._compiled.timestep_ns
        if steps > 0:
            # In steps alone: whoever else computes with the model finds all bodies where they are.
            self.model.opt.enableflags |= self._sleep
            mujoco.mj_step(self.model, self.data, nstep=steps)
            self.model.opt.enableflags &= ~self._sleep
            self.t_ns += steps * self._compiled.timestep_ns

    # --- commands
    def set_targets(self, targets: Array) -> None:
        """Set the position targets (n,) of all actuated joints; they take effect when the latency is over.

        The actuators clamp them to their ranges.
        """
        true = _stepped(targets, self._encoders.position) - self._encoders.zero
        for latency_ns, joints in self._latencies:
            due_ns = self.t_ns + round(latency_ns / self.timestep_ns) * self.timestep_ns
            insort(self._late, (due_ns, joints, true[joints]), key=_due)
        self._take_due(self.t_ns)

    def delay_commands(self, seconds: Array) -> None:
        """Let targets take effect so much (n,) later than the robot's latency; those under way are forgotten."""
        delays: Ints = np.round(1e9 * (self._encoders.latency_s + seconds)).astype(np.int64)
        self._latencies = [(int(ns), np.flatnonzero(delays == ns)) for ns in np.unique(delays)]
        self._late.clear()

    def set_effort_limits(self, limits: Array) -> None:
        """Limit the effort (n,) of the actuators, N m or N; the limit of the model is never exceeded."""
        c = self._compiled
        limits = np.minimum(limits, c.effort_limit)
        self.model.actuator_forcerange[c.actuator] = np.stack([-limits, limits], axis=1)

    def set_laws(self, bias: Array, stiffness: Array, damping: Array) -> None:
        """Let the actuators pull with bias - stiffness q - damping dq (n,), q as encoders see it; not to targets."""
        at, model = self._compiled.actuator, self.model
        bias = bias - stiffness * self._encoders.zero
        model.actuator_gainprm[at, 0] = 0.0
        model.actuator_biastype[at] = mujoco.mjtBias.mjBIAS_AFFINE
        model.actuator_biasprm[at, :3] = np.stack([bias, -stiffness, -damping], axis=1)

    # --- readings
    def true_joints(self) -> JointReadout:
        """Return positions with the errors of the joint zeros, and all else exactly: what encoders of motors see."""
        c, d = self._compiled, self.data
        position = d.qpos[c.qpos] + self._encoders.zero
        return JointReadout(self.t_ns, position, d.qvel[c.dof].copy(), d.actuator_force[c.actuator].copy())

    def read_joints(self) -> JointReadout:
        """Return the positions, velocities and actuator efforts of the actuated joints, as their encoders have them."""
        c, d, e = self._compiled, self.data, self._encoders
        return JointReadout(
            self.t_ns,
            _stepped(d.qpos[c.qpos] + e.zero, e.position),
            _stepped(d.qvel[c.dof], e.velocity),
            _stepped(d.actuator_force[c.actuator], e.effort),
        )

    def effort_limits(self) -> Array:
        """Return the effort limits (n,) of the actuators in the model, N m or N; infinite where there is none."""
        return self._compiled.effort_limit.copy()

    def objects(self) -> tuple[ObjectReadout, ...]:
        """Return pose and twist of every tracked object: ground truth, for judges alone, not for controllers."""
        return tuple(self.object(name) for name in self._compiled.objects)

    def object(self, name: str) -> ObjectReadout:
        """Return pose and twist of a tracked object.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming the objects that exist.
        """
        state = self.data.joint(self._free_joint(name).id)
        w, x, y, z = state.qpos[3:]
        T = se3.make(se3.matrix_from_quat_xyzw((x, y, z, w)), state.qpos[:3])
        # A free joint's linear velocity is in the world frame, its angular velocity in the body frame.
        return ObjectReadout(self._compiled.objects[name], T, state.qvel[:3].copy(), T[:3, :3] @ state.qvel[3:])

    def wrist_wrench(self, body: str) -> tuple[Array, Array]:
        """Return the force and torque (3,) of the wrist sensor of a body, in its frame; as `touch.wrist_wrench`."""
        return wrist_wrench(self.data, body)

    def imu(self, body: str) -> tuple[Array, Array]:
        """Return rate of turn and acceleration (3,) of the IMU of a body, in its frame; as `touch.imu`."""
        return imu(self.data, body)

    def pad_wrench(self, link: str) -> tuple[Array, Array]:
        """Return contact force and torque (3,) on the pad of a finger link, in its frame: a simulated sensor."""
        return contact_wrench(self.model, self.data, self.model.geom(f"{link}_pad_collision").id)

    def snapshot(self) -> Snapshot:
        """Copy the configuration for a renderer."""
        return Snapshot(self.model, self.t_ns, self.data.qpos.copy())

    # --- reset and exchange
    def posture(self) -> dict[str, float]:
        """Return where the joints are, as `reset` takes it."""
        return dict(zip(self.joint_names, self.data.qpos[self._compiled.qpos].tolist(), strict=True))

    def reset(self, joints: Mapping[str, float] | None = None, objects: Mapping[str, Array] | None = None) -> None:
        """Put robot and objects back to their start, at rest; simulated time continues.

        Args:
            joints: Start positions by name of joints that do not start at home, rad or m.
            objects: T_world_object (4, 4) by name of objects that start elsewhere.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming the objects that exist; SCENE_INVALID, when something would overlap
                (checked where something starts elsewhere). The world is then as before.
        """
        c = self._compiled
        start = start_qpos(self.model, self._home | dict(joints or {}))
        for name, T in (objects or {}).items():
            self._set_pose(start, name, T)
        ctrl = np.zeros(self.model.nu)
        ctrl[c.actuator] = start[c.qpos]
        bodies = set(range(self.model.nbody)) if joints or objects else set[int]()
        self._place_apart(start, np.zeros(self.model.nv), ctrl, bodies)
        self.set_effort_limits(c.effort_limit)

    def compile(self, spec: mujoco.MjSpec, objects: Sequence[SceneObject]) -> CompiledWorld:
        """Compile a world for `exchange` or `extend`. Slow (tens of ms), changes nothing, may run in any thread.

        Args:
            spec: The model. Its automatic reset is switched off: a diverged simulation that silently restarts would be
                a teleport; the world reports it instead.
            objects: Free bodies to report, by the names of their free joints.

        Raises:
            OpenArmError: CONFIG_INVALID, when MuJoCo refuses the model, the tick is not a whole number of time steps,
                or a joint or actuator is missing.
        """
        spec.option.disableflags = int(spec.option.disableflags) | int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        model = compiled_model(spec)
        try:
            joints = [model.joint(name).id for name in self.joint_names]
            tracked = {model.joint(item.name).name: item for item in objects}
            start = start_qpos(model, self._home)
        except KeyError as error:  # MuJoCo's message lists the valid names
            raise OpenArmError(Code.CONFIG_INVALID, f"the model lacks a joint: {error.args[0]}") from error
        driven = model.actuator_trnid[:, 0].tolist()
        idle = [name for name, joint in zip(self.joint_names, joints, strict=True) if joint not in driven]
        if idle:
            raise OpenArmError(Code.CONFIG_INVALID, f"the model has no actuator for the joints {', '.join(idle)}")
        actuator = np.array([driven.index(joint) for joint in joints], dtype=np.intp)
        limited = model.actuator_forcelimited[actuator].astype(bool)
        return CompiledWorld(
            model=model,
            timestep_ns=_timestep_ns(model.opt.timestep, self.period_ns),
            qpos=model.jnt_qposadr[joints].astype(np.intp),
            dof=model.jnt_dofadr[joints].astype(np.intp),
            actuator=actuator,
            effort_limit=np.where(limited, model.actuator_forcerange[actuator, 1], np.inf),
            start_qpos=start,
            objects=tracked,
        )

    def exchange(
        self,
        compiled: CompiledWorld,
        joints: Mapping[str, float] | None = None,
        objects: Mapping[str, Array] | None = None,
    ) -> None:
        """Take another world, at its start; fast. Arguments and errors as `reset`."""
        with self._exchanged(compiled):
            self.reset(joints, objects)

    def extend(self, compiled: CompiledWorld) -> None:
        """Take a world that holds more or less, and keep the state of joints and targets that both have; fast.

        Raises:
            OpenArmError: SCENE_INVALID, when something new overlaps something that is there; the world is then as
                before.
        """
        old, old_data = self._compiled, self.data
        with self._exchanged(compiled):
            model = self.model
            qpos, qvel, ctrl = compiled.start_qpos.copy(), np.zeros(model.nv), np.zeros(model.nu)
            new: set[int] = set()
            for joint in map(model.joint, range(model.njnt)):
                if mujoco.mj_name2id(old.model, mujoco.mjtObj.mjOBJ_JOINT, joint.name) < 0:
                    new.add(int(joint.bodyid[0]))
                    continue
                q, v, state = joint.qposadr[0], joint.dofadr[0], old_data.joint(joint.name)
                qpos[q : q + len(state.qpos)] = state.qpos
                qvel[v : v + len(state.qvel)] = state.qvel
            ctrl[compiled.actuator] = old_data.ctrl[old.actuator]
            model.actuator_forcerange[compiled.actuator] = old.model.actuator_forcerange[old.actuator]
            self._place_apart(qpos, qvel, ctrl, new)

    def move_object(self, name: str, T_world_object: Array) -> None:
        """Put a tracked object elsewhere, at rest, as a person would; everything else continues.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming the objects that exist; SCENE_INVALID, when something else is there
                (the object then stays where it was).
        """
        qpos, qvel, ctrl = self._state()
        self._set_pose(qpos, name, T_world_object)
        joint = self._free_joint(name)
        v = joint.dofadr[0]
        qvel[v : v + 6] = 0.0
        self._place_apart(qpos, qvel, ctrl, {int(joint.bodyid[0])})

    def _free_joint(self, name: str) -> Any:
        """Return MuJoCo's view of the free joint of a tracked object."""
        names = self._compiled.objects
        if name not in names:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no object {name!r}; objects: {', '.join(names) or 'none'}")
        return self.model.joint(name)

    def _set_pose(self, qpos: Array, name: str, T_world_object: Array) -> None:
        q = self._free_joint(name).qposadr[0]
        qpos[q : q + 3] = T_world_object[:3, 3]
        qpos[q + 3 : q + 7] = np.roll(se3.quat_xyzw_from_matrix(T_world_object[:3, :3]), 1)

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

    def _state(self) -> tuple[Array, Array, Array]:
        """Return copies of `qpos`, `qvel` and `ctrl`."""
        return self.data.qpos.copy(), self.data.qvel.copy(), self.data.ctrl.copy()

    def _place_apart(self, qpos: Array, qvel: Array, ctrl: Array, bodies: set[int]) -> None:
        """Write a whole state; where one of `bodies` would overlap another body, restore the present one and raise."""
        before = self._state()
        self._place(qpos, qvel, ctrl)
        overlap = self._overlap(bodies)
        if overlap:
            self._place(*before)
            raise OpenArmError(Code.SCENE_INVALID, overlap)

    def _place(self, qpos: Array, qvel: Array, ctrl: Array) -> None:
        """Write a whole state; the only place where `qpos` is written: a running world moves by forces alone."""
        self._late.clear()
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = qpos
        self.data.qvel[:] = qvel
        self.data.ctrl[:] = ctrl
        mujoco.mj_forward(self.model, self.data)

    def _use(self, compiled: CompiledWorld) -> None:
        self._compiled = compiled
        self.model: mujoco.MjModel = compiled.model
        self.data = mujoco.MjData(compiled.model)

    @contextmanager
    def _exchanged(self, compiled: CompiledWorld) -> Iterator[None]:
        """Use another world, and go back to the present one when the block raises an OpenArmError."""
        before = self._compiled, self.model, self.data
        self._use(compiled)
        try:
            yield
        except OpenArmError:
            self._compiled, self.model, self.data = before
            raise


def _due(late: tuple[int, Index, Array]) -> int:
    return late[0]


def _stepped(values: Array, steps: Array) -> Array:
    """Round to whole steps; a step of 0 keeps the value."""
    return np.where(steps > 0.0, np.round(values / np.where(steps > 0.0, steps, 1.0)) * steps, values)


def compiled_model(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a model.

    Raises:
        OpenArmError: CONFIG_INVALID, with MuJoCo's reason.
    """
    try:
        return spec.compile()
    except ValueError as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"MuJoCo refuses the model: {error}") from error


def _timestep_ns(timestep: float, period_ns: int) -> int:
    timestep_ns = round(timestep * 1e9)
    if timestep_ns <= 0 or period_ns % timestep_ns or abs(timestep_ns - timestep * 1e9) > 1e-3:
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"a control tick of {period_ns / 1e6:g} ms is not a whole number of physics steps of {timestep * 1e3:g} ms;"
            " choose a time step that divides it, for example 2 or 1 ms",
        )
    return timestep_ns


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
