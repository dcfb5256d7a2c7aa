# SPDX-License-Identifier: Apache-2.0
"""Physical grasps of one object with the suite's model, in short: what `benchmarks.grasp_physics` and tests run.

Pre-grasp, straight approach, close, lift 12 cm, hold, shake, put back, open, retreat; position targets at 100 Hz. Each
grasp aims off the object by an error of pose as a localisation has it. Nothing is welded, and nothing is written to
`qpos` once a trial runs. World frame (x forward, y left, z up); m, rad, s.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import Scene, SceneObject, Table
from openarm_common.types import Array
from openarm_sim_bridge.world.model import PhysicsConfig, compile_model

mirror = RobotDescription.load().mirrored

TABLE = Table()
OPEN, LIFT, BACK = 0.044, 0.12, 0.08
SHOULDER, UPPER, FORE, HAND = np.array([0.0, -0.1535, 0.698]), 0.220, 0.216, 0.1801
LOWER, UPPER_LIMIT = RobotDescription.load().limits(RobotDescription.load().arm_joints("right"))

OBJECTS = {
    "cube_4cm": ("box", (0.04, 0.04, 0.04), 0.064),
    "cube_5cm": ("box", (0.05, 0.05, 0.05), 0.10),
    "box": ("box", (0.04, 0.06, 0.08), 0.15),
    "cylinder": ("cylinder", (0.05, 0.05, 0.08), 0.12),
    "can": ("cylinder", (0.066, 0.066, 0.115), 0.35),
    "cube_8cm": ("box", (0.08, 0.08, 0.08), 0.25),  # leaves 4 mm a side in the open hand
}
#: MuJoCo's own contact and solver settings, and the finger force of the v2 hand.
MUJOCO_DEFAULTS = PhysicsConfig(
    integrator="euler",
    cone="pyramidal",
    impratio=1.0,
    noslip_iterations=0,
    contact_solref=(0.02, 1.0),
    contact_solimp=(0.9, 0.95, 0.001, 0.5, 2.0),
    pad_condim=3,
    object_condim=3,
    finger_force=7.0,
)


def inverse_kinematics(R: Array, p: Array, swivel: float, over: bool) -> Array | None:
    """Joint positions (7,) of the right arm for a TCP pose at one swivel angle; None outside the limits."""
    w = p - HAND * R[:, 2] - SHOULDER
    d = float(np.linalg.norm(w))
    cos_elbow = (d * d - UPPER**2 - FORE**2) / (2 * UPPER * FORE)
    if abs(cos_elbow) > 1:
        return None
    along = w / d
    down = np.array([0.0, 0.0, -1.0]) + along * along[2]
    down /= np.linalg.norm(down)
    a = (d * d + UPPER**2 - FORE**2) / (2 * d * UPPER)
    side = math.cos(swivel) * down + math.sin(swivel) * np.cross(along, down)
    u = a * along + math.sqrt(1 - a * a) * side  # shoulder to elbow
    q = np.zeros(7)
    q[1], q[0] = math.asin(-u[1]), math.atan2(u[0], -u[2])
    if over:
        q[1], q[0] = math.pi - q[1], math.atan2(-u[0], u[2])
    q[3] = math.acos(cos_elbow)
    shoulder = se3.rot_x(math.pi / 2) @ se3.rot_z(q[0]) @ se3.rot_x(math.pi / 2 - q[1])
    g = shoulder.T @ (w - UPPER * u)
    q[2] = math.atan2(g[1], g[0])
    M = (shoulder @ se3.rot_z(q[2]) @ se3.rot_y(q[3])).T @ R
    q[5] = math.asin(np.clip(M[2, 1], -1, 1))
    q[4], q[6] = math.atan2(-M[0, 1], M[1, 1]), math.atan2(-M[2, 0], M[2, 2])
    q[:2] += np.where(q[:2] < LOWER[:2], math.tau, 0.0)
    return q if ((q >= LOWER) & (q <= UPPER_LIMIT)).all() else None


class NoGraspError(Exception):
    """The object lies where this simple search finds no grasp, or a way leads out of reach."""


@dataclass(frozen=True)
class Grasp:
    """A grasp of the right arm: TCP rotation and position, swivel and branch that the whole approach keeps."""

    R: Array
    p: Array
    swivel: float
    over: bool
    width: float

    def q(self, back: float = 0.0, up: float = 0.0, sideways: float = 0.0) -> Array:
        """Joint positions (7,) that far behind, above or to the side of the grasp, m.

        Raises:
            NoGraspError: Out of reach.
        """
        p = self.p - back * self.R[:, 2] + np.array([0.0, 0.0, up]) + sideways * self.R[:, 0]
        q = inverse_kinematics(self.R, p, self.swivel, self.over)
        if q is None:
            raise NoGraspError(f"out of reach: {back:.3f} m back, {up:.3f} m up, {sideways:.3f} m sideways")
        return q

    def at(self, xy: Array) -> Grasp:
        """Return the same grasp above another place (2,), m."""
        return replace(self, p=np.array([*xy, self.p[2]]))


def grasps(item: SceneObject, error: Array) -> Iterator[Grasp]:
    """Grasps of an object of the right half, best first: least tilt, then most room to the joint limits.

    Args:
        item: The object.
        error: x, y (m) and yaw (rad) that the grasp is off by.
    """
    x, y, z = item.size
    if item.shape == "cylinder":
        faces = [(x, item.yaw + i * math.pi / 6) for i in range(6)]
    else:
        faces = sorted([(y, item.yaw), (x, item.yaw + math.pi / 2)])
    for tilt in np.radians([0.0, 15.0, 30.0, 45.0]):
        height = max(0.012 + 0.018 * math.sin(tilt), z / 2 - 0.017, z - 0.045 + 0.03 * math.sin(tilt))
        p = np.array([*(np.array(item.position[:2]) + error[:2]), TABLE.top_z + height])
        found: list[tuple[float, Grasp]] = []
        for width, yaw in faces:
            for turn in (0.0, math.pi):
                heading = yaw + turn + error[2]
                approach = (math.sin(tilt) * math.cos(heading), math.sin(tilt) * math.sin(heading), -math.cos(tilt))
                for flip in (1.0, -1.0):
                    across = (-flip * math.sin(heading), flip * math.cos(heading), 0.0)
                    R = se3.rotation_from_z_y(approach, across)
                    for swivel in np.linspace(-math.pi, math.pi, 24, endpoint=False):
                        for over in (False, True):
                            grasp = Grasp(R, p, float(swivel), over, width)
                            margin = _margin(grasp)
                            if margin > 0.05:
                                found.append((margin, grasp))
        for _, grasp in sorted(found, key=lambda pair: -pair[0])[:6]:
            yield grasp


def _margin(grasp: Grasp) -> float:
    """Least distance to a joint limit from pre-grasp over grasp to lift, rad; -1 where one is out of reach."""
    margin = math.inf
    for back, up in ((0.0, 0.0), (BACK, 0.0), (0.0, LIFT), (BACK / 2, 0.0), (0.0, LIFT / 2)):
        p = grasp.p - back * grasp.R[:, 2] + np.array([0.0, 0.0, up])
        q = inverse_kinematics(grasp.R, p, grasp.swivel, grasp.over)
        if q is None:
            return -1.0
        room = np.minimum(q - LOWER, UPPER_LIMIT - q)
        room[3] += 0.2  # a straight elbow is no hard limit
        margin = min(margin, float(room.min()))
    return margin


def quintic(u: float) -> float:
    """From 0 to 1 with no velocity and acceleration at the ends."""
    return u * u * u * (10 + u * (-15 + 6 * u))


class Trial:
    """One grasp in a world of its own. The left arm does the mirror image of what the right one would."""

    def __init__(self, item: SceneObject, side: str, error: Array, physics: PhysicsConfig | None = None) -> None:
        description = RobotDescription.load()
        flipped = item.model_copy(update={"position": (item.position[0], -item.position[1]), "yaw": -item.yaw})
        self.item = item if side == "right" else flipped
        self.side = side
        scene = Scene(table=TABLE, objects=(self.item,))
        self.model = compile_model(description, scene, {}, None, physics)
        self.data = mujoco.MjData(self.model)
        self.steps = round(0.01 / self.model.opt.timestep)
        self.arm = [self.model.actuator(name).id for name in description.arm_joints(side)]
        self.finger = self.model.actuator(description.finger_joint(side)).id
        self.tcp = self.model.site(description.tcp_link(side)).id
        self.body = self.model.body(item.name).id
        self.shape = self.model.geom(item.name).id
        prefix = f"openarm_{side}_"
        self.pads = [self.model.geom(f"{prefix}{f}_finger_pad_collision").id for f in ("left", "right")]
        self.home = description.group_state("both_arms", "home")
        self.penetration = self.speed = 0.0
        self.grasp = self._choose(item, error)
        self._place(self.grasp.q(BACK))

    def _choose(self, item: SceneObject, error: Array) -> Grasp:
        for grasp in grasps(item, error):
            ways = (grasp.q(BACK), grasp.q(BACK / 2), grasp.q(), grasp.q(up=LIFT))
            if all(self._free(q) for q in ways):
                return grasp
        raise NoGraspError(f"no grasp of {item}")

    def _free(self, q: Array) -> bool:
        self._place(q)
        for contact in self.data.contact:
            names = [self.model.body(self.model.geom_bodyid[g]).name for g in (contact.geom1, contact.geom2)]
            if any(name.startswith("openarm") for name in names):
                return False
        return True

    def _place(self, q: Array) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self.target(q)
        for name, value in self.home.items():
            if not name.startswith(f"openarm_{self.side}"):
                self.data.ctrl[self.model.actuator(name).id] = value
        self.data.ctrl[self.finger] = OPEN
        for i in range(self.model.nu):
            self.data.qpos[self.model.jnt_qposadr[self.model.actuator_trnid[i, 0]]] = self.data.ctrl[i]
        self.data.qpos[self.model.joint(f"openarm_{self.side}_finger_joint2").qposadr[0]] = OPEN
        mujoco.mj_forward(self.model, self.data)

    def target(self, q: Array) -> None:
        """Give the arm a target, of the right arm."""
        self.data.ctrl[self.arm] = q if self.side == "right" else mirror(q)

    def run(self, seconds: float, command: Callable[[float], None] = lambda u: None) -> None:
        """Give `command` the share 0 .. 1 of the time that has passed, at 100 Hz, and watch the object."""
        ticks = round(seconds * 100)
        for i in range(ticks):
            command((i + 1) / ticks)
            mujoco.mj_step(self.model, self.data, self.steps)
            contact = self.data.contact
            held = (contact.geom == self.shape).any(axis=1) & np.isin(contact.geom, self.pads).any(axis=1)
            self.penetration = max(self.penetration, -contact.dist[held].min(initial=0.0))
            address = self.model.jnt_dofadr[self.model.body_jntadr[self.body]]
            self.speed = max(self.speed, float(np.linalg.norm(self.data.qvel[address : address + 3])))

    def fingers(self, position: float) -> None:
        """Give the fingers a target, m from the middle."""
        self.data.ctrl[self.finger] = position

    @property
    def gap(self) -> float:
        """Between the fingers, m."""
        joints = (self.model.joint(f"openarm_{self.side}_finger_joint{i}") for i in (1, 2))
        return float(sum(self.data.qpos[joint.qposadr[0]] for joint in joints))

    @property
    def effort(self) -> float:
        """Of the finger actuator, N."""
        return abs(float(self.data.actuator_force[self.finger]))

    @property
    def position(self) -> Array:
        """Of the object, (3,)."""
        return self.data.xpos[self.body].copy()

    @property
    def in_hand(self) -> Array:
        """Position of the object in the TCP frame."""
        R = self.data.site_xmat[self.tcp].reshape(3, 3)
        return R.T @ (self.data.xpos[self.body] - self.data.site_xpos[self.tcp])

    def pick(self) -> None:
        """Approach from rest, and close."""
        self.run(0.3)
        self.approach()

    def approach(self) -> None:
        """Go to the grasp from behind it, and close."""
        grasp = self.grasp
        self.run(1.2, lambda u: self.target(grasp.q(BACK * (1 - quintic(u)))))
        self.run(0.1)
        self.run(0.6, lambda u: self.fingers(OPEN * (1 - u)))
        self.run(0.5)

    def lift(self) -> None:
        """Lift by 12 cm."""
        self.run(1.4, lambda u: self.target(self.grasp.q(up=LIFT * quintic(u))))

    def shake(self) -> None:
        """Shake for 3 s.

        Raises:
            NoGraspError: The way of shaking leads out of reach.
        """

        def move(u: float) -> None:
            envelope, t = math.sin(math.pi * u), 3.0 * u
            up = LIFT + 0.01 * envelope * math.sin(math.tau * 3.0 * t)
            self.target(self.grasp.q(up=up, sideways=0.02 * envelope * math.sin(math.tau * 2.5 * t)))

        self.run(3.0, move)
        self.run(0.3, lambda u: self.target(self.grasp.q(up=LIFT)))

    def place(self) -> None:
        """Put back, open, leave."""
        grasp = self.grasp
        self.run(1.6, lambda u: self.target(grasp.q(up=LIFT - (LIFT - 0.001) * quintic(u))))
        self.run(0.2)
        self.run(0.5, lambda u: self.fingers(OPEN * u))
        self.run(0.1)
        self.run(1.2, lambda u: self.target(grasp.q(BACK * quintic(u), 0.001)))
        self.run(0.4)


def make(kind: str, seed: int) -> tuple[SceneObject, Array]:
    """Return an object in the right half of the object region, and the error of a grasp (3 mm, 3 degrees)."""
    rng = np.random.default_rng([seed, *kind.encode()])
    shape, size, mass = OBJECTS[kind]
    position = (float(rng.uniform(0.18, 0.34)), float(rng.uniform(-0.40, -0.08)))
    item = SceneObject(
        name=kind, shape=shape, size=size, color="red", mass=mass, position=position, yaw=float(rng.uniform(-3.1, 3.1))
    )
    return item, rng.normal(size=3) * [0.003, 0.003, math.radians(3.0)]
