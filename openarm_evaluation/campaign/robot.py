# SPDX-License-Identifier: Apache-2.0
"""The simulated robot in this process: physics, controllers, cameras, detection, map and motion, tick by tick.

The parts are those of the node graph (world, followers, renderer, pipeline, faults); what is missing is only what lies
between them: DDS, processes and the wall clock. World frame = base frame, m, rad; simulated time in ns.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Awaitable, Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import coroutine
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from openarm_common import se3
from openarm_common.camera.cameras import CameraConfig, detector_nodes, load_cameras, stereo_pairs
from openarm_common.camera.depth_view import DepthView
from openarm_common.camera.housings import mounted
from openarm_common.config import Config, load_config
from openarm_common.errors import OpenArmError
from openarm_common.resources import config_dir
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import per_robot
from openarm_common.robot.held import HeldBox
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.robot.self_filter import SelfFilter, SelfFilterConfig
from openarm_common.robot.servos import ServoModel
from openarm_common.robot.work import Table
from openarm_common.robot.zeros import HandReach
from openarm_common.scene.scene import Scene
from openarm_common.types import Array
from openarm_control.arm import End, TrajectoryFollower, TrajectoryOutcome
from openarm_control.trajectory import Trajectory as FollowedTrajectory
from openarm_control.trajectory import TrajectoryError
from openarm_evaluation.campaign.map_feed import SimulatedMap
from openarm_evaluation.campaign.parameters import suite_config
from openarm_evaluation.campaign.stereo import stereo_depth
from openarm_evaluation.judging.judge import Sample
from openarm_grasp.perception.boxes import with_points
from openarm_grasp.perception.detections import Frame, Ids
from openarm_motion.config import FaultsConfig, MotionConfig
from openarm_motion.planning.arm import Arm
from openarm_motion.service.motion_service import MotionService, make_arms, table_box
from openarm_motion.service.robot import GoalOutcome
from openarm_motion.timing.trajectory import Motion
from openarm_octomap.grid import DepthScan
from openarm_octomap.mapper import Frame as MapFrame
from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig, Mask
from openarm_perception.detection.follow import followed
from openarm_perception.detection.kinds import DetectorKind
from openarm_perception.detection.localize import Localizer
from openarm_perception.detection.pipeline import Pipeline, make_pipeline
from openarm_perception.detection.robot import RobotFinder
from openarm_perception.geometry.depth import DepthImage, DepthLimits, View
from openarm_perception.geometry.watch import CameraWatch
from openarm_sim_bridge.cameras.cameras import SimulatedCameras
from openarm_sim_bridge.cameras.renderer import SnapshotRenderer
from openarm_sim_bridge.faults.faults import Fault
from openarm_sim_bridge.robot import SimulatedRobot
from openarm_sim_bridge.world.stage import Stage
from openarm_world.carried import HeldBoxes, carriers
from openarm_world.objects import Objects

T = TypeVar("T")

#: Simulated time that a plan takes, s: a robot's world goes on while it thinks.
PLANNING_S = 0.1
#: Frames of a camera that the map chooses from at an update.
_FRAMES = 5
_TRUTH_NS = 50_000_000
#: How long the joint trace reaches back, s.
_TRACE_S = 60.0


class SimulatedSenses(Config):
    """How well the simulated robot sees and how long that takes, s of simulated time."""

    depth_noise: bool = Field(default=True, description="depth as noisy as a D435's")
    detector: DetectorKind = Field(default="color", description="what finds objects")
    latency: float = Field(default=0.06, ge=0.0, le=1.0, description="from an image to its detections, s")
    sets: tuple[str, ...] = Field(default=(), description="parameters of nodes, node.param=value")

    def parameters(self) -> tuple[str, ...]:
        """Return all of it as parameters of nodes."""
        noise = f"mujoco_bridge.depth_noise.enabled={str(self.depth_noise).lower()}"
        return (noise, *(f"{node}.detector={self.detector}" for node in detector_nodes().values()), *self.sets)


@coroutine
def turn() -> Generator[None, None, None]:
    """Give one control tick; for coroutines of this process."""
    yield


async def together(parts: Sequence[Callable[[], Awaitable[None]]]) -> None:
    """Run coroutines concurrently, tick by tick, until all have ended; then raise the first error."""
    left = [part().__await__() for part in parts]
    faults: list[OpenArmError] = []
    while left:
        for work in list(left):
            try:
                next(work)
            except StopIteration:
                left.remove(work)
            except OpenArmError as error:
                left.remove(work)
                faults.append(error)
        if left:
            await turn()
    if faults:
        raise faults[0]


@dataclass(frozen=True, eq=False)
class Known:
    """What the suite has found of a robot; the rest is as configured and described.

    Args:
        mounts: T_parent_link (4, 4) by camera.
        servos: Servos of the arms as identified, by side; None: as the profile says.
        hands: Hands by arm, as learned.
    """

    mounts: Mapping[str, Array] = field(default_factory=dict[str, Array])
    servos: Mapping[str, ServoModel] | None = None
    hands: Mapping[str, HandReach] = field(default_factory=dict[str, HandReach])


#: Nothing was found.
UNKNOWN = Known()


class SimRobot:
    """One world and all that moves and watches it. One thread.

    Args:
        scene: Scene with the objects on the table.
        senses: Noise and settings of the cameras and detectors.
        mount_seed: Seed of the true camera mounts; None mounts them where the configuration says.
        dynamics_seed: Seed of motors, masses and joint zeros; None: that of the configuration.
        hand_seed: Seed of stops and friction of the fingers; None: that of the configuration.
        known: Calibration of the robot by the suite.
        table: Table that the suite believes in; None: the true one.
        seed: Seed of the noise.
        posture: Joints that start elsewhere than at home, rad by name.
    """

    def __init__(
        self,
        scene: Scene,
        senses: SimulatedSenses,
        *,
        mount_seed: int | None = None,
        dynamics_seed: int | None = None,
        hand_seed: int | None = None,
        known: Known = UNKNOWN,
        table: Table | None = None,
        seed: int = 0,
        posture: Mapping[str, float] | None = None,
    ) -> None:
        self.scene = scene
        self.description = RobotDescription.load().with_hands(known.hands)
        self.cameras = load_cameras()
        self._latency_s, self._sets = senses.latency, senses.parameters()
        self.suite = suite = suite_config(self._sets)
        hardware = suite.bridge.hardware.of_seed(dynamics_seed, hand_seed)
        stage = Stage(self.description, self.cameras, mount_seed, suite.bridge.physics, hardware)
        stage.home |= posture or {}
        bridge = suite.bridge
        self.simulated = SimulatedRobot.on(stage, scene, bridge.trajectory, bridge.gripper, known.servos)
        self.world = self.simulated.world
        self.world_faults = self.simulated.faults
        self._rng = np.random.default_rng([seed, 77])
        noise = (bridge.depth_noise, bridge.colour_noise)
        self._drawing = SimulatedCameras(shared_renderer, self.cameras, *noise, self._rng)
        self.camera_faults, self._pairs = self._drawing.faults, stereo_pairs()
        self.states = RobotStateBuffer(self.description)
        self.efforts: dict[str, float] = {}
        self.tracks: dict[str, list[Sample]] = {item.name: [] for item in scene.objects}
        self.trace: deque[tuple[int, Array, Array]] = deque(maxlen=int(_TRACE_S * 1e9) // self.world.period_ns)
        self.images: dict[str, tuple[int, NDArray[np.uint8], DepthImage]] = {}
        #: The cameras where the suite believes that they are mounted.
        self.mounted = mounted(self.cameras, known.mounts)
        self._arriving: deque[tuple[int, Frame]] = deque()
        self.frames: deque[Frame] = deque(maxlen=64)
        #: What the hands hold, as the planner believes; the detector takes it for a part of the robot.
        self.held: tuple[HeldBox, ...] = ()
        #: What the detector of each camera follows.
        self._objects = {name: Objects(one.objects) for name, one in suite.detectors.items()}
        self._ids = {name: Ids() for name in suite.detectors}
        self._observing = ""
        self._detected_ns = -(10**12)
        self.table = table or scene.table
        self._watches = {name: self._watch(name) for name in suite.detectors}
        self._published_ns = 0
        #: How long plans took, s of wall clock.
        self.planning_s: list[float] = []
        self._silhouette = SelfFilter(self.description, SelfFilterConfig())
        self.map = SimulatedMap(self.description, suite.octomap, self.mounted)
        self._controllers = {arm: _ArmController(self, arm) for arm in self.simulated.controller.arms}
        arms = arms_behind(self._sets, self.table, tuple(self.mounted.values()), tuple(known.hands.items()))
        self.motion = MotionService(self, suite.motion, arms, self.map, (self.description.root,))
        self.motion.on_held = self._take_held
        self._note()

    # --- time
    @property
    def t_ns(self) -> int:
        """Simulated time."""
        return self.world.t_ns

    def tick(self) -> None:
        """Let one control tick pass.

        Raises:
            OpenArmError: INTERNAL, when the physics diverged.
        """
        self.simulated.tick()
        self._note()
        self._see()

    def pass_time(self, seconds: float) -> None:
        """Let time pass with nothing asked of the robot."""
        end_ns = self.t_ns + round(seconds * 1e9)
        while self.t_ns < end_ns:
            self.tick()

    def _note(self) -> None:
        state = self.world.read_joints()
        self.trace.append((state.t_ns, state.position.copy(), state.effort.copy()))
        if self.world_faults.publishes_joints(state.t_ns):
            self.states.add_joint_state(
                state.t_ns, self.world.joint_names, state.position.tolist(), state.velocity.tolist()
            )
            self.efforts = dict(zip(self.world.joint_names, state.effort.tolist(), strict=True))
            self._published_ns = state.t_ns
        if state.t_ns % _TRUTH_NS == 0:
            for readout in self.world.objects():
                q = se3.quat_xyzw_from_matrix(readout.T_world_object[:3, :3])
                sample = Sample(state.t_ns, readout.T_world_object[:3, 3].copy(), q, readout.linear, readout.angular)
                self.tracks[readout.object.name].append(sample)

    # --- what the motion service asks (openarm_motion.service.robot.RobotInterface)
    def state_age(self) -> float:
        """Time since the newest joint state, s."""
        return (self.t_ns - self._published_ns) * 1e-9

    def now(self) -> float:
        """Simulated time, s."""
        return self.t_ns * 1e-9

    def controller(self, arm: str) -> _ArmController:
        """The controller of an arm."""
        return self._controllers[arm]

    async def pause(self) -> None:
        """Let one control tick pass."""
        await turn()

    async def wait(self, seconds: float) -> None:
        """Let simulated time pass."""
        end_ns = self.t_ns + round(seconds * 1e9)
        while self.t_ns < end_ns:
            await turn()

    async def compute(self, work: Callable[[], T], nominal: float = PLANNING_S) -> T:
        """Run work now; a constant time passes for the robot."""
        began = time.perf_counter()
        try:
            return work()
        finally:
            if nominal == PLANNING_S:
                self.planning_s.append(time.perf_counter() - began)
            await self.wait(nominal)

    together = staticmethod(together)

    def _take_held(self) -> None:
        held = self.motion.held_on_links().values()
        self.held = tuple(HeldBox(b.id, link, b.T, tuple(b.size)) for link, boxes in held for b in boxes)

    # --- faults
    def inject(self, fault: Fault) -> None:
        """Begin a fault.

        Raises:
            OpenArmError: INVALID_ARGUMENT or SCENE_INVALID, when it cannot be done in this world.
        """
        if fault.of_camera:
            self.camera_faults.set([fault])
        else:
            self.world_faults.inject(fault, self.world)

    # --- perception
    def observe(self, camera: str) -> None:
        """Begin to detect in the images of a camera, or stop with ""; what was seen before is forgotten."""
        if camera != self._observing:
            self._observing = camera
            self._arriving.clear()
        if not camera:
            self.frames.clear()

    def _see(self) -> None:
        if self.suite.motion.map.use != "off" and self.map.due(self.t_ns):
            scans = (self._scan(name) for name in self.suite.octomap.cameras)
            self.map.update(self.t_ns, [scan for scan in scans if scan is not None], self.held)
        while self._arriving and self._arriving[0][0] <= self.t_ns:
            self.frames.append(self._arriving.popleft()[1])
        camera = self._observing
        if not camera or self.t_ns - self._detected_ns < 0.999e9 / self.suite.detectors[camera].max_rate:
            return
        self._detected_ns = self.t_ns
        if self.camera_faults.drops(camera):
            return
        frame = self.detect(camera)
        if frame is not None:
            late = self._latency_s + self.camera_faults.delay_s(camera)
            self._arriving.append((self.t_ns + round(late * 1e9), frame))

    def detect(self, name: str) -> Frame | None:
        """Detections of the image that a camera takes now; None when the pose of the camera is not known."""
        camera = self.cameras[name]
        stamp_ns = self.camera_faults.stamp_ns(name, self.t_ns)
        rgb, depth = self.draw(name)
        try:
            T_base_camera = self.camera_pose(camera, stamp_ns)
            optics, robot = self._drawing.intrinsics(name), None
            if deep := bool(self.suite.detectors[name].depth_topic):
                view = DepthView(depth, optics, T_base_camera, camera.near, camera.far)
                robot = self._robot_in(name, view, stamp_ns)
            else:
                depth = np.zeros_like(depth)
            seen = View(rgb, depth, optics, T_base_camera, robot)
            withheld = self._watches[name].look(stamp_ns, seen, self.table.top_z)
            perceived = _pipeline(self._sets, name, self.table.top_z).run(
                rgb, depth, optics, T_base_camera, robot, withheld, stamp_ns
            )
        except OpenArmError:
            return None  # as the detector: the frame is skipped, the next may do
        limits = DepthLimits(near=camera.near, far=camera.far)
        objects, perceived, cloud = followed(
            self._objects[name], perceived, seen, limits, stamp_ns, self._carriers(stamp_ns)
        )
        self._objects[name] = objects
        if deep:
            return Frame(stamp_ns, perceived.boxes, cloud.moved(T_base_camera))
        shapes = self._silhouette.shapes(self.states.latest()[1], self.held)
        outline = self._silhouette.outline(optics, T_base_camera, shapes)
        frame = self._ids[name].given(Frame(stamp_ns, perceived.boxes))
        return with_points(frame, optics, T_base_camera, self.table.top_z, outline)

    def _carriers(self, stamp_ns: int) -> Mapping[str, HeldBoxes] | None:
        """What the hands hold at the stamp of an image; None when their posture is not known."""
        try:
            joints = self.states.joints_at(min(stamp_ns, self.states.latest()[0]))
            return carriers(self.description, joints, self.held)
        except OpenArmError:
            return None

    def _watch(self, name: str) -> CameraWatch:
        camera = self.cameras[name]
        limits = DepthLimits(near=camera.near, far=camera.far)
        watch = CameraWatch(self.suite.detectors[name].watch, limits, camera.intrinsics)
        watch.calibrated = camera.intrinsics  # mounts of campaigns are calibrated with them
        return watch

    def _scan(self, name: str) -> MapFrame | None:
        """What the map takes of a camera now; None when the frame is lost or its posture is not known."""
        camera = self.cameras[name]
        # The newest frame since the last update counts: all of them must be lost.
        if all(self.camera_faults.drops(name) for _ in range(_FRAMES)):
            return None
        stamp_ns = self.camera_faults.stamp_ns(name, self.t_ns)
        at_ns = min(stamp_ns, self.states.latest()[0])
        try:
            joints, T_base_camera = self.states.joints_at(at_ns), self.camera_pose(camera, at_ns)
        except OpenArmError:
            return None
        optics = self._drawing.intrinsics(name)
        scan = DepthScan(self.draw(name)[1], optics, T_base_camera, camera.near, camera.far)
        return MapFrame(name, stamp_ns, scan, joints)

    def _robot_in(self, name: str, view: DepthView, stamp_ns: int) -> Mask | None:
        """Pixels of the robot and what it holds; None in a gap of the joint states, as the detector has it."""
        newest_ns, _ = self.states.latest()
        try:
            # the detector waits for joint states of an image's stamp; here they have not come yet
            joints = self.states.joints_at(min(stamp_ns, newest_ns))
        except OpenArmError:
            return None
        return _finder(self._sets, name, tuple(self.mounted.values())).find(view, joints, self.held)[0]

    def draw(self, name: str) -> tuple[NDArray[np.uint8], DepthImage]:
        """Colour and depth (mm) that a camera sees now; the same image for whoever asks in this tick."""
        camera, drawn = self.cameras[name], self.images.get(name)
        if drawn is not None and (drawn[0] == self.t_ns or self.camera_faults.frozen(name)):
            return drawn[1:]
        self._drawing.load(self.world.snapshot())
        rgb = np.empty((camera.height, camera.width, 3), np.uint8)
        depth = np.empty((camera.height, camera.width), np.uint16)
        self._drawing.draw(name, rgb, depth if camera.depth else None)
        if name in self._pairs:
            depth = stereo_depth(name, rgb, self.draw(self._pairs[name])[0])
        self.images[name] = (self.t_ns, rgb, depth)
        return rgb, depth

    def camera_pose(self, camera: CameraConfig, stamp_ns: int) -> Array:
        """T_base_optical (4, 4) of a camera at a stamp, as the suite believes.

        Raises:
            OpenArmError: STALE_DATA, when the camera rides on a joint of which the stamp knows nothing.
        """
        T_parent_link = self.mounted[camera.name].T_parent_link
        T_link_optical = se3.inverse(camera.T_parent_link) @ camera.T_parent_optical
        T_base_parent = self.states.lookup(self.description.root, camera.parent, stamp_ns)
        return T_base_parent @ T_parent_link @ T_link_optical

    def columns(self, names: Sequence[str]) -> list[int]:
        """Places of joints in the world's joint vectors."""
        return [self.world.joint_names.index(name) for name in names]


@per_robot
def shared_renderer() -> SnapshotRenderer:
    """One renderer a process; it takes every model."""
    return SnapshotRenderer(load_cameras())


class _ArmController:
    """Implements `openarm_motion.service.robot.ArmController`."""

    def __init__(self, robot: SimRobot, arm: str) -> None:
        self._robot, self._follower = robot, robot.simulated.controller.arms[arm]
        self.name = f"the {arm} arm's controller"

    @property
    def fastest(self) -> float:
        return self._follower.fastest

    def ready(self) -> bool:
        return True

    def start(self, motion: Motion, begin_ns: int, *, touches: bool) -> _Goal:
        robot, goal = self._robot, _Goal(self._follower, begin_ns or self._robot.t_ns)
        measured = robot.world.read_joints().position[robot.columns(motion.names)]
        near = {} if touches else dict.fromkeys(motion.names, robot.suite.motion.execution.goal_tolerance)
        points = FollowedTrajectory(motion.names, motion.t, motion.q, motion.v, motion.a, begin_ns, goal_tolerance=near)
        try:
            self._follower.start(self._follower.check(points), robot.t_ns, measured, goal.end)
        except TrajectoryError as error:
            goal.outcome = GoalOutcome(False, f"{error.result.name}: {error.message}")
        return goal


class _Goal:
    """Implements `openarm_motion.service.robot.TrajectoryGoal`."""

    accepted = True

    def __init__(self, follower: TrajectoryFollower, since_ns: int) -> None:
        self._follower, self.since_ns = follower, since_ns
        self.outcome: GoalOutcome | None = None

    def end(self, outcome: TrajectoryOutcome) -> None:
        self.outcome = GoalOutcome(outcome.end is End.SUCCEEDED, f"{outcome.result.name}: {outcome.text}")

    def cancel(self) -> None:
        if self.outcome is None:
            self._follower.cancel()


def arms_behind(
    sets: tuple[str, ...],
    table: Table,
    cameras: tuple[CameraConfig, ...] | None = None,
    hands: tuple[tuple[str, HandReach], ...] = (),
) -> Mapping[str, Arm]:
    """Return the arms of the motion service behind a table, with cameras at their mounts and hands as learned.

    Made once a process.
    """
    motion = suite_config(sets).motion.model_copy(update={"faults": FaultsConfig()})
    return _arms(motion.model_dump_json(), table.model_dump_json(), cameras, hands)


@per_robot
def _arms(
    config: str, table: str, cameras: tuple[CameraConfig, ...] | None, hands: tuple[tuple[str, HandReach], ...]
) -> Mapping[str, Arm]:
    fixed = (table_box(Table.model_validate_json(table)),)
    by_name = None if cameras is None else {camera.name: camera for camera in cameras}
    return make_arms(
        MotionConfig.model_validate_json(config), RobotDescription.load().with_hands(dict(hands)), fixed, by_name
    )


@per_robot
def _finder(sets: tuple[str, ...], camera: str, cameras: tuple[CameraConfig, ...]) -> RobotFinder:
    finder = RobotFinder(RobotDescription.load(), suite_config(sets).detectors[camera].self_filter)
    finder.mount({one.name: one for one in cameras})
    return finder


@per_robot
def _pipeline(sets: tuple[str, ...], name: str, table_z: float) -> Pipeline:
    config, camera = suite_config(sets).detectors[name], load_cameras()[name]
    path = Path(config.colors) if config.colors else config_dir() / "params" / "detector.yaml"
    colors = ColorDetector(load_config(path, ColorDetectorConfig))
    localizer = Localizer(config.localizer, DepthLimits(near=camera.near, far=camera.far), table_z)
    made = make_pipeline(
        config.detector, colors, config.network, localizer, config.policy, config.label, tags=config.tag
    )
    made.faults = config.faults
    return made
