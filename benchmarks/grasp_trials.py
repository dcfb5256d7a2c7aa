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
from openarm_common.robot.folder import robot_work
from openarm_common.scene.scene import Scene, SceneObject
from openarm_common.types import Array
from openarm_grasp.planning.candidates import tcp_height
from openarm_motion.kinematics.chain import ArmKinematics, IkSolution
from openarm_motion.kinematics.inverse import InverseKinematics
from openarm_sim_bridge.world.model import PhysicsConfig, compile_model
from openarm_sim_bridge.world.world import start_qpos

ROBOT, WORK = RobotDescription.load(), robot_work()
#: Arms in turn; objects are drawn before the first.
SIDES = ROBOT.arm_names[::-1]
TABLE, MEASURES = WORK.table, next(iter(ROBOT.hands.values())).parts
OPEN, LIFT, BACK = MEASURES.opening, 0.12, 0.08

_OBJECTS = {
    "cube_4cm": ("box", (0.04, 0.04, 0.04), 0.064),
    "cube_5cm": ("box", (0.05, 0.05, 0.05), 0.10),
    "box": ("box", (0.04, 0.06, 0.08), 0.15),
    "cylinder": ("cylinder", (0.05, 0.05, 0.08), 0.12),
    "can": ("cylinder", (0.066, 0.066, 0.115), 0.35),
    "cube_8cm": ("box", (0.08, 0.08, 0.08), 0.25),  # leaves 4 mm a side in the open hand
}
#: Those that go between the pads of the open hand.
OBJECTS = {kind: shape for kind, shape in _OBJECTS.items() if min(shape[1][:2]) < 2.0 * OPEN - 0.001}
#: Kept from joint limits, rad.
_MARGIN = 0.05
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


class NoGraspError(Exception):
    """The object lies where this simple search finds no grasp, or a way leads out of reach."""


@dataclass(frozen=True)
class Grasp:
    """A grasp of one arm: TCP pose, and the configuration there, whose branch and swivel the whole approach keeps."""

    inverse: InverseKinematics
    T: Array
    start: IkSolution
    width: float

    def q(self, back: float = 0.0, up: float = 0.0, sideways: float = 0.0) -> Array:
        """Joint positions (n,) that far behind, above or to the side of the grasp, m.

        Raises:
            NoGraspError: Out of reach.
        """
        T = self.T.copy()
        T[:3, 3] += np.array([0.0, 0.0, up]) - back * self.T[:3, 2] + sideways * self.T[:3, 0]
        path, reached, _ = self.inverse.follow(np.stack([self.T, T]), self.start, 0.0, math.pi)
        if reached < 2:
            raise NoGraspError(f"out of reach: {back:.3f} m back, {up:.3f} m up, {sideways:.3f} m sideways")
        return path[1]

    def at(self, xy: Array) -> Grasp:
        """Return the same grasp above another place (2,), m.

        Raises:
            NoGraspError: Out of reach.
        """
        T = se3.make(self.T[:3, :3], (*xy, self.T[2, 3]))
        path, reached, _ = self.inverse.follow(np.stack([self.T, T]), self.start, 0.0, math.pi)
        if reached < 2:
            raise NoGraspError(f"out of reach: ({xy[0]:.3f}, {xy[1]:.3f}) m")
        return replace(self, T=T, start=replace(self.start, q=path[1]))

    @property
    def margin(self) -> float:
        """Least distance to a joint limit from pre-grasp over grasp to lift, rad; -1 where one is out of reach."""
        ways = ((0.0, 0.0), (BACK, 0.0), (0.0, LIFT), (BACK / 2, 0.0), (0.0, LIFT / 2))
        try:
            return min(self.inverse.kinematics.margin(self.q(back, up)) for back, up in ways)
        except NoGraspError:
            return -1.0


def grasps(item: SceneObject, inverse: InverseKinematics, error: Array) -> Iterator[Grasp]:
    """Grasps of an object, best first: least tilt, then most room to the joint limits.

    Args:
        item: The object.
        inverse: Of the arm.
        error: x, y (m) and yaw (rad) that the grasp is off by.
    """
    x, y, z = item.size
    if item.shape == "cylinder":
        faces = [(x, item.yaw + i * math.pi / 6) for i in range(6)]
    else:
        faces = sorted([(y, item.yaw), (x, item.yaw + math.pi / 2)])
    for tilt in np.radians([0.0, 15.0, 30.0, 45.0]):
        p = np.array([*(np.array(item.position[:2]) + error[:2]), TABLE.top_z + tcp_height(z, tilt, MEASURES)])
        found: list[tuple[float, Grasp]] = []
        for width, yaw in faces:
            for turn in (0.0, math.pi):
                heading = yaw + turn + error[2]
                approach = (math.sin(tilt) * math.cos(heading), math.sin(tilt) * math.sin(heading), -math.cos(tilt))
                for flip in (1.0, -1.0):
                    across = (-flip * math.sin(heading), flip * math.cos(heading), 0.0)
                    R = se3.rotation_from_z_y(approach, across)
                    T = se3.make(R, p - MEASURES.tcp_shift(0.5 * width) * R[:, 2])
                    ways = (Grasp(inverse, T, solution, width) for solution in inverse.solutions(T, _MARGIN))
                    found += [(grasp.margin, grasp) for grasp in ways]
        for margin, grasp in sorted(found, key=lambda pair: -pair[0])[:6]:
            if margin > _MARGIN:
                yield grasp


def quintic(u: float) -> float:
    """From 0 to 1 with no velocity and acceleration at the ends."""
    return u * u * u * (10 + u * (-15 + 6 * u))


class Trial:
    """One grasp in a world of its own; for the second of two arms all is mirrored."""

    def __init__(self, item: SceneObject, side: str, error: Array, physics: PhysicsConfig | None = None) -> None:
        flipped = item.model_copy(update={"position": (item.position[0], -item.position[1]), "yaw": -item.yaw})
        first = side == SIDES[0]
        self.item = item if first else flipped
        self.side, self.hand = side, ROBOT.hand(side)
        scene = Scene(table=TABLE, objects=(self.item,))
        self.model = compile_model(ROBOT, scene, {}, None, physics)
        self.data = mujoco.MjData(self.model)
        self.steps = round(0.01 / self.model.opt.timestep)
        self.arm = [self.model.actuator(name).id for name in ROBOT.arm_joints(side)]
        self.finger = self.model.actuator(self.hand.joint).id
        self.tcp = self.model.site(ROBOT.tcp_link(side)).id
        self.body = self.model.body(item.name).id
        self.shape = self.model.geom(item.name).id
        self.pads = [self.model.geom(f"{link}_pad_collision").id for link in ROBOT.arm(side).fingers]
        self.joints = [self.hand.joint, *(j.name for j in ROBOT.joints.values() if j.mimic == self.hand.joint)]
        self.start: dict[str, float] = {}
        for arm in ROBOT.arm_names:
            self.start |= ROBOT.group_state(f"{arm}_arm", "home")
        self.start |= dict.fromkeys(self.joints, self.hand.opened)
        self.penetration = self.speed = 0.0
        self.grasp = self._choose(error if first else error * (1.0, -1.0, -1.0))
        self._place(self.grasp.q(BACK))

    def _choose(self, error: Array) -> Grasp:
        inverse = InverseKinematics(ArmKinematics(ROBOT, ROBOT.tcp_link(self.side)), 24)
        for grasp in grasps(self.item, inverse, error):
            ways = (grasp.q(BACK), grasp.q(BACK / 2), grasp.q(), grasp.q(up=LIFT))
            if all(self._free(q) for q in ways):
                return grasp
        raise NoGraspError(f"no grasp of {self.item}")

    def _free(self, q: Array) -> bool:
        self._place(q)
        for contact in self.data.contact:
            names = [self.model.body(self.model.geom_bodyid[g]).name for g in (contact.geom1, contact.geom2)]
            if not ROBOT.links.keys().isdisjoint(names):
                return False
        return True

    def _place(self, q: Array) -> None:
        mujoco.mj_resetData(self.model, self.data)
        at = self.start | dict(zip(ROBOT.arm_joints(self.side), q.tolist(), strict=True))
        self.data.qpos[:] = start_qpos(self.model, at)
        for i in range(self.model.nu):
            self.data.ctrl[i] = at.get(self.model.actuator(i).name, 0.0)
        mujoco.mj_forward(self.model, self.data)

    def target(self, q: Array) -> None:
        """Give the arm a target."""
        self.data.ctrl[self.arm] = q

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
        self.data.ctrl[self.finger] = self.hand.position(position)

    @property
    def gap(self) -> float:
        """Between the fingers, m."""
        return sum(self.hand.finger(float(self.data.joint(name).qpos[0])) for name in self.joints)

    @property
    def effort(self) -> float:
        """By which the fingers press, N: twice that of a pad."""
        return abs(float(self.data.actuator_force[self.finger]) / self.hand.lever)

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
    (x_min, x_max), (y_min, y_max) = WORK.region.x, WORK.region.abs_y
    position = (float(rng.uniform(x_min + 0.02, x_max - 0.02)), float(rng.uniform(0.02 - y_max, -0.02 - y_min)))
    item = SceneObject(
        name=kind, shape=shape, size=size, color="red", mass=mass, position=position, yaw=float(rng.uniform(-3.1, 3.1))
    )
    return item, rng.normal(size=3) * [0.003, 0.003, math.radians(3.0)]
