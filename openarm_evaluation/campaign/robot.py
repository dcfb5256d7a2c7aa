# SPDX-License-Identifier: Apache-2.0
"""The simulated robot in this process: physics, controllers, cameras and detection, one control tick at a time.

The parts are those of the node graph (world, followers, renderer, pipeline, faults); what is missing is only what lies
between them: DDS, processes and the wall clock. World frame = base frame, m, rad; simulated time in ns.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from openarm_common import se3
from openarm_common.camera.cameras import CameraConfig, load_cameras
from openarm_common.camera.depth_view import DepthView
from openarm_common.config import Config, load_config
from openarm_common.errors import OpenArmError
from openarm_common.resources import config_dir
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.held import HeldBox
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.scene.scene import Scene
from openarm_common.types import Array
from openarm_evaluation.judging.judge import Sample
from openarm_grasp.evidence.observation import Detection, Frame
from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig, Mask
from openarm_perception.detection.kinds import DetectorKind
from openarm_perception.detection.localize import Localizer, LocalizerConfig
from openarm_perception.detection.looking import make_pipeline
from openarm_perception.detection.network import NetworkConfig
from openarm_perception.detection.pipeline import Pipeline
from openarm_perception.detection.robot import RobotConfig, RobotFinder
from openarm_perception.geometry.depth import DepthImage, DepthLimits
from openarm_sim_bridge.cameras.cameras import SimulatedCameras
from openarm_sim_bridge.cameras.noise import ColourNoiseConfig, DepthNoiseConfig
from openarm_sim_bridge.cameras.renderer import SnapshotRenderer
from openarm_sim_bridge.faults.faults import Fault
from openarm_sim_bridge.robot import SimulatedRobot
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.stage import Stage

_TRUTH_NS = 50_000_000
#: How long the joint trace reaches back, s.
_TRACE_S = 60.0


class SimulatedSenses(Config):
    """How well the simulated robot sees and how long that takes, s of simulated time."""

    depth_noise: bool = Field(default=True, description="depth as noisy as a D435's")
    detector: DetectorKind = Field(default="color", description="what finds objects")
    max_rate: float = Field(default=10.0, gt=0.0, description="most frames that are detected in, Hz")
    latency: float = Field(default=0.06, ge=0.0, le=1.0, description="from an image to its detections, s")


class SimRobot:
    """One world and all that moves and watches it. One thread.

    Args:
        scene: What is on the table.
        senses: How well it sees.
        mount_seed: Of the true camera mounts; None mounts them where the configuration says.
        mounts: T_parent_link by camera as the suite believes; those left out are nominal.
        seed: Of the noise.
        posture: Joints that start elsewhere than at home, rad by name.
    """

    def __init__(
        self,
        scene: Scene,
        senses: SimulatedSenses,
        *,
        mount_seed: int | None = None,
        mounts: Mapping[str, Array] | None = None,
        seed: int = 0,
        posture: Mapping[str, float] | None = None,
    ) -> None:
        self.scene = scene
        self.description = RobotDescription.load()
        self.cameras = load_cameras()
        self._senses = senses
        stage = Stage(self.description, self.cameras, mount_seed, PhysicsConfig())
        stage.home |= posture or {}
        self.simulated = SimulatedRobot.on(stage, scene)
        self.world = self.simulated.world
        self.controller = self.simulated.controller
        self.world_faults = self.simulated.faults
        rng = np.random.default_rng([seed, 77])
        noise = DepthNoiseConfig(enabled=senses.depth_noise)
        self._drawing = SimulatedCameras(shared_renderer, self.cameras, noise, ColourNoiseConfig(), rng)
        self.camera_faults = self._drawing.faults
        self.states = RobotStateBuffer(self.description)
        self.efforts: dict[str, float] = {}
        self.tracks: dict[str, list[Sample]] = {item.name: [] for item in scene.objects}
        self.trace: deque[tuple[int, Array, Array]] = deque(maxlen=int(_TRACE_S * 1e9) // self.world.period_ns)
        self.images: dict[str, tuple[int, NDArray[np.uint8], DepthImage]] = {}
        #: Share of the frames in which the detector misses an object, on purpose.
        self.missed = 0.0
        self._mounts = dict(mounts or {})
        self._rng = rng
        self._arriving: deque[tuple[int, Frame]] = deque()
        self.frames: deque[Frame] = deque(maxlen=64)
        #: What the hands hold, as the planner believes; the detector takes it for a part of the robot.
        self.held: tuple[HeldBox, ...] = ()
        self._looking = ""
        self._detected_ns = -(10**12)
        self._table_z = scene.table.top_z
        self._told_ns = 0
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
            self.states.add_joint_state(state.t_ns, self.world.joint_names, state.position.tolist())
            self.efforts = dict(zip(self.world.joint_names, state.effort.tolist(), strict=True))
            self._told_ns = state.t_ns
        if state.t_ns % _TRUTH_NS == 0:
            for readout in self.world.objects():
                q = se3.quat_xyzw_from_matrix(readout.T_world_object[:3, :3])
                sample = Sample(state.t_ns, readout.T_world_object[:3, 3].copy(), q, readout.linear, readout.angular)
                self.tracks[readout.object.name].append(sample)

    @property
    def silent_s(self) -> float:
        """How long no joint state has come, s."""
        return (self.t_ns - self._told_ns) * 1e-9

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

    # --- seeing
    def look(self, camera: str) -> None:
        """Begin to detect in the images of a camera, or stop with ""; what was seen before is forgotten."""
        if camera != self._looking:
            self._looking = camera
            self._arriving.clear()
        if not camera:
            self.frames.clear()

    def _see(self) -> None:
        while self._arriving and self._arriving[0][0] <= self.t_ns:
            self.frames.append(self._arriving.popleft()[1])
        if not self._looking or self.t_ns - self._detected_ns < 0.999e9 / self._senses.max_rate:
            return
        self._detected_ns = self.t_ns
        if self.camera_faults.drops(self._looking):
            return
        frame = self.detect(self._looking)
        if frame is not None:
            late = self._senses.latency + self.camera_faults.delay_s(self._looking)
            self._arriving.append((self.t_ns + round(late * 1e9), frame))

    def detect(self, name: str) -> Frame | None:
        """Detections of the image that a camera takes now; None when the pose of the camera is not known."""
        camera = self.cameras[name]
        stamp_ns = self.camera_faults.stamp_ns(name, self.t_ns)
        rgb, depth = self.draw(name)
        self.images[name] = (self.t_ns, rgb, depth)
        try:
            T_base_camera = self.camera_pose(camera, stamp_ns)
            optics = self._drawing.intrinsics(name)
            view = DepthView(depth, optics, T_base_camera, camera.near, camera.far)
            perceived = _pipeline(name, self._table_z, self._senses.detector).run(
                rgb, depth, optics, T_base_camera, self._robot_in(view, stamp_ns)
            )
        except OpenArmError:
            return None  # as the detector: the frame is skipped, the next may do
        seen = (d for d in perceived.boxes if not self.missed or self._rng.random() >= self.missed)
        found = (Detection(d.label, d.score, d.T_base_object, np.array(d.size), d.method == "circle") for d in seen)
        return Frame(stamp_ns, tuple(found))

    def _robot_in(self, view: DepthView, stamp_ns: int) -> Mask | None:
        """Pixels of the robot and what it holds; None in a gap of the joint states, as the detector has it."""
        newest_ns, _ = self.states.latest()
        try:
            # the detector waits for joint states of an image's stamp; here they have not come yet
            joints = self.states.joints_at(min(stamp_ns, newest_ns))
        except OpenArmError:
            return None
        return _finder().find(view, joints, self.held)[0]

    def draw(self, name: str) -> tuple[NDArray[np.uint8], DepthImage]:
        """Colour and depth (mm) that a camera sees now."""
        camera = self.cameras[name]
        if self.camera_faults.frozen(name) and name in self.images:
            return self.images[name][1:]
        self._drawing.load(self.world.snapshot())
        rgb = np.empty((camera.height, camera.width, 3), np.uint8)
        depth = np.empty((camera.height, camera.width), np.uint16)
        self._drawing.draw(name, rgb, depth if camera.depth else None)
        return rgb, depth

    def camera_pose(self, camera: CameraConfig, stamp_ns: int) -> Array:
        """T_base_optical (4, 4) of a camera at a stamp, as the suite believes.

        Raises:
            OpenArmError: STALE_DATA, when the camera rides on a joint of which the stamp knows nothing.
        """
        T_parent_link = self._mounts.get(camera.name, camera.T_parent_link)
        T_link_optical = se3.inverse(camera.T_parent_link) @ camera.T_parent_optical
        T_base_parent = self.states.lookup(self.description.root, camera.parent, stamp_ns)
        return T_base_parent @ T_parent_link @ T_link_optical

    def columns(self, names: Sequence[str]) -> list[int]:
        """Places of joints in the world's joint vectors."""
        return [self.world.joint_names.index(name) for name in names]


@cache
def shared_renderer() -> SnapshotRenderer:
    """One renderer a process; it takes every model."""
    return SnapshotRenderer(load_cameras())


@cache
def _finder() -> RobotFinder:
    return RobotFinder(RobotDescription.load(), RobotConfig())


@cache
def _pipeline(camera_name: str, table_z: float, kind: DetectorKind) -> Pipeline:
    camera = load_cameras()[camera_name]
    colors = load_config(config_dir() / "params" / "detector.yaml", ColorDetectorConfig)
    limits = DepthLimits(near=camera.near, far=camera.far)
    localizer = Localizer(LocalizerConfig(), limits, table_z)
    return make_pipeline(kind, ColorDetector(colors), NetworkConfig(), localizer)
