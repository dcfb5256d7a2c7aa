# SPDX-License-Identifier: Apache-2.0
"""Node `mujoco_bridge`: a simulated robot behind the topics and actions of the real one.

Threads: physics (steps the world at 100 Hz, publishes its state) and the executor (services, actions, commands). They
share data only through `Simulation.call`. The cameras are drawn and published by a process of their own, the node
`mujoco_cameras`, which receives the states to draw (`RenderedFeed`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
from std_msgs.msg import Float64

from openarm_common.camera.cameras import CameraConfig, load_cameras
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import config_dir
from openarm_common.ros.node import reliable, run, until_shutdown
from openarm_common.scene.scene import load_scene
from openarm_control.joints import JointReadout
from openarm_control.ros.process import ControlNode, timely
from openarm_sim_bridge.cameras.camera_feed import RenderedFeed, SpareProcess
from openarm_sim_bridge.cameras.handover import CameraSetup
from openarm_sim_bridge.config import BridgeConfig
from openarm_sim_bridge.faults.faults import Fault
from openarm_sim_bridge.robot import SimulatedRobot
from openarm_sim_bridge.ros.camera_node import serve
from openarm_sim_bridge.ros.camera_publisher import topic_names
from openarm_sim_bridge.ros.faces import Face, MotorFace, OpenArmRos2Face, SuiteFace
from openarm_sim_bridge.ros.fault_server import FaultServer
from openarm_sim_bridge.ros.simulation_server import SimulationServer
from openarm_sim_bridge.ros.state_publisher import StatePublisher
from openarm_sim_bridge.simulation import Simulation
from openarm_sim_bridge.world.stage import Stage
from openarm_sim_bridge.world.world import Snapshot, World

WATCH_PERIOD_S = 0.2
#: The simulation begins after this long at the latest, images or not, s.
WARM_UP_S = 20.0
#: Variable with the file of Fast DDS settings.
PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"
#: Where `make` keeps the settings for large messages, which only the process of the cameras needs.
LARGE_PROFILE = "OPENARM_LARGE_MESSAGES_PROFILE"
REPORT_PERIOD_S = 1.0
#: Slower than this share of the requested speed is reported as a fault.
_SLOW = 0.9
#: Joint states that are further apart than this (p99, ms of simulated time) are reported as a fault.
_LATE_MS = 15.0


class MujocoBridge(ControlNode[BridgeConfig]):
    """The simulation with its topics, services and actions.

    Args:
        spare: A process for its cameras.
        kwargs: Arguments of `BaseNode`.

    Raises:
        OpenArmError: CONFIG_INVALID or SCENE_INVALID, when the world can't be made.
    """

    def __init__(self, spare: SpareProcess | None = None, **kwargs: Any) -> None:
        super().__init__("mujoco_bridge", BridgeConfig, **kwargs)
        config = self.config
        cameras = load_cameras(Path(config.cameras) if config.cameras else None)
        scene = load_scene(config.scene, config.seed)
        mount_seed = config.mount_seed if config.mount_seed >= 0 else None
        self._stage = stage = Stage(self.description, cameras, mount_seed, config.physics, config.hardware)
        world = stage.world(scene, each_step=config.controllers != "suite")
        self._face = self._made_face(world)
        self._simulation = Simulation(
            SimulatedRobot(self.description, world, self._face.controller),
            self._observe,
            speed=config.speed,
            wall_stamps=self._face.wall_stamps,
            crashed=self.on_crash,
        )
        self._simulation.set_paused(config.paused)

        self._states = StatePublisher(
            self,
            self.description,
            world.joint_names,
            config.tf_rate,
            config.ground_truth_rate,
            clock=not self._face.wall_stamps,
            robot=self._face.speaks,
        )
        self._images = self._camera_feed(cameras, world.snapshot(), spare) if config.images else None
        if self._images is None and spare is not None:
            spare.release()
        self._real_time_factor = self.create_publisher(Float64, "/sim/real_time_factor", reliable(5))

        self._face.serve(self._simulation)
        self._sim_services = SimulationServer(self, stage, scene, self._simulation, stays=not self._face.speaks)

        self._faults = FaultServer(
            self, self._simulation, cameras if self._images is not None else (), self._set_camera_faults
        )

        self._drawn = dict.fromkeys(cameras, 0)
        self.create_timer(REPORT_PERIOD_S, self._report, clock=self.steady_clock)

        if self._images is not None:
            self.create_timer(WATCH_PERIOD_S, self._images.poll, clock=self.steady_clock)
            if not self._images.wait_ready(WARM_UP_S):
                self.get_logger().warning(f"no image yet after {WARM_UP_S:.0f} s; the simulation begins without")
        self._states.publish_static(self.description)
        self._simulation.start()
        self.get_logger().info(f"scene {scene.name!r} with {len(scene.objects)} objects; simulation is running")

    def close(self) -> None:
        """Stop physics and drawing, then the node."""
        self._simulation.stop()
        if self._images is not None:
            self._images.close()
        self._face.close()
        super().close()

    def _made_face(self, world: World) -> Face:
        if self.config.controllers == "openarm_ros2":
            return OpenArmRos2Face(self, self._stage, world)
        if self.config.controllers == "motors":
            return MotorFace(self, self.config, self._stage, world)
        return SuiteFace(self, self.config, self._stage, world)

    def _observe(self, state: JointReadout) -> None:
        """End of a tick, in the thread of the simulation."""
        with until_shutdown(self.context):
            joints = self._simulation.faults.publishes_joints(state.t_ns)
            published = self._face.publish(state, self._simulation.world)
            self._states.publish(published, self._simulation.world, joints=joints)
            if self._images is not None:
                self._images.tick(self._simulation.world)

    def _camera_feed(
        self, cameras: Mapping[str, CameraConfig], first: Snapshot, spare: SpareProcess | None
    ) -> RenderedFeed:
        topics = [name for camera in cameras.values() for name in topic_names(camera)]
        setup = CameraSetup(
            cameras=tuple(cameras.values()),
            depth_encoding=self.config.depth_encoding,
            depth_noise=self.config.depth_noise,
            colour_noise=self.config.colour_noise,
            noise_seed=self.config.seed,
            topics={name: self.resolve_topic_name(name) for name in topics},
        )
        environ = {**os.environ, "ROS_DOMAIN_ID": str(self.context.get_domain_id())}
        if LARGE_PROFILE in environ:
            environ[PROFILE] = environ[LARGE_PROFILE]
        return RenderedFeed(setup, environ, first, self._on_no_images, self.config.speed, spare)

    def _on_no_images(self, fault: str) -> None:
        if fault:
            self.get_logger().error(f"no images: {fault}")
        else:
            self.get_logger().info("images again")

    def _set_camera_faults(self, faults: tuple[Fault, ...]) -> None:
        if self._images is not None:
            self._images.set_faults(faults)
        elif faults:
            raise OpenArmError(Code.NOT_READY, "there are no cameras: the parameter images is false")

    def _report(self) -> None:
        """Report once per second how well the simulation keeps time."""
        simulation, config = self._simulation, self.config
        factor, period = simulation.real_time_factor.value, simulation.periods.figures()
        self._real_time_factor.publish(Float64(data=0.0 if simulation.paused else factor))
        images = self._images
        drawn, before = images.rendered if images is not None else {}, self._drawn
        self._drawn = drawn
        stopped = "the emergency stop is latched" if simulation.stopped else ""
        fault = simulation.fault or stopped or (images.fault if images is not None else "")
        slow = not simulation.paused and config.speed > 0.0 and period.n > 100 and factor < _SLOW * config.speed
        if not fault and slow:
            fault = f"slower than requested: {factor:.2f} simulated seconds per second, expected {config.speed:g}"
        late_ms = _LATE_MS / min(1.0, config.speed or 1.0)
        values = self._face.values()
        if not fault and not simulation.paused and period.n > 100 and period.p99_ms > late_ms:
            commands = values.get("commands_per_s", 0)
            fault = (
                f"late: one of a hundred joint states is {period.p99_ms:.0f} ms or more behind the one before, expected"
                f" {late_ms:.0f} at most; is the machine busy, or are {commands} commands a second too many?"
            )
        limited = images.limited if images is not None else ""
        report = self.diagnose_warning if limited and not fault else partial(self.diagnose, not fault)
        report(
            "; ".join(filter(None, (fault, limited))) or ("paused" if simulation.paused else "running"),
            real_time_factor=f"{factor:.3f}",
            joint_state_period_p50_ms=f"{period.p50_ms:.2f}",
            joint_state_period_p99_ms=f"{period.p99_ms:.2f}",
            joint_state_period_max_ms=f"{period.max_ms:.2f}",
            scheduling=self.scheduling,
            profile=config.profile,
            **values,
            wall_time_skipped_s=f"{simulation.skipped_s:.2f}",
            faults_active=" ".join(self._faults.active),
            frames_dropped=images.dropped if images is not None else 0,
            draw_ms=f"{images.report.draw_ms:.1f}" if images is not None else "",
            **{f"frames_{name}": count - before[name] for name, count in drawn.items()},
            **{f"rate_{name}": f"{rate:.0f}" for name, rate in (images.rates if images is not None else {}).items()},
        )


def _priority(node: MujocoBridge) -> int:
    """Of the process; a simulation as fast as it can would take a core from everything else."""
    return node.config.thread_priority if 0.0 < node.config.speed <= 1.0 else 0


def make(spare: SpareProcess | None = None) -> MujocoBridge:
    """Make the node for a process of its own."""
    if PROFILE in os.environ:
        os.environ[LARGE_PROFILE] = os.environ[PROFILE]
        os.environ[PROFILE] = str(config_dir() / "fastdds_small.xml")
    node = timely(partial(MujocoBridge, spare), _priority)
    mujoco.set_mju_user_warning(lambda text: node.get_logger().warning(f"MuJoCo: {text}"))  # not into a file
    return node


def main() -> None:
    """Run the node."""
    run(partial(make, SpareProcess(serve)))


if __name__ == "__main__":
    main()
