# SPDX-License-Identifier: Apache-2.0
"""Node `mujoco_bridge`: a simulated robot behind the topics and actions of the real one.

Threads: physics (steps the world at 100 Hz, publishes its state) and the executor (services, actions, commands). They
share data only through `Simulation.call`. The cameras are drawn and published by a process of their own, the node
`mujoco_cameras`, which receives the states to draw (`CameraFeed`).
"""

from __future__ import annotations

import gc
import os
import sys
import traceback
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from openarm_common.camera.cameras import CameraConfig, load_cameras
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.resources import config_dir
from openarm_common.ros.holds import HoldListener
from openarm_common.ros.node import QOS_COMMAND, BaseNode, reliable, run
from openarm_common.scene.scene import load_scene
from openarm_sim_bridge.cameras.camera_feed import CameraFeed
from openarm_sim_bridge.cameras.handover import CameraSetup
from openarm_sim_bridge.config import BridgeConfig
from openarm_sim_bridge.faults.faults import Fault
from openarm_sim_bridge.priority import use_fifo
from openarm_sim_bridge.robot import SimulatedRobot
from openarm_sim_bridge.ros.camera_publisher import topic_names
from openarm_sim_bridge.ros.fault_server import FaultServer
from openarm_sim_bridge.ros.gripper_server import GripperServer
from openarm_sim_bridge.ros.sensor_publisher import SensorPublisher
from openarm_sim_bridge.ros.simulation_server import SimulationServer
from openarm_sim_bridge.ros.state_publisher import StatePublisher, until_shutdown
from openarm_sim_bridge.ros.trajectory_server import TrajectoryServer
from openarm_sim_bridge.simulation import Simulation
from openarm_sim_bridge.world.stage import Stage
from openarm_sim_bridge.world.world import JointReadout, Snapshot

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
#: So many unknown joints of commands are named in the log.
_NAMED = 20
#: Joint states that are further apart than this (p99, ms) are reported as a fault.
_LATE_MS = 15.0


class MujocoBridge(BaseNode[BridgeConfig]):
    """The simulation with its topics, services and actions.

    Raises:
        OpenArmError: CONFIG_INVALID or SCENE_INVALID, when the world can't be made.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("mujoco_bridge", BridgeConfig, **kwargs)
        config = self.config
        cameras = load_cameras(Path(config.cameras) if config.cameras else None)
        scene = load_scene(config.scene, config.seed)
        stage = Stage(self.description, cameras, config.mount_seed if config.mount_seed >= 0 else None, config.physics)
        robot = SimulatedRobot.on(stage, scene, config.trajectory, config.gripper)
        world, controller = robot.world, robot.controller
        self._controller = controller
        self._simulation = Simulation(robot, self._observe, speed=config.speed, crashed=self._on_crash)
        self._simulation.set_paused(config.paused)

        self._states = StatePublisher(
            self, self.description, world.joint_names, config.tf_rate, config.ground_truth_rate
        )
        self._sensors = SensorPublisher(self)
        self._images = self._camera_feed(cameras, world.snapshot()) if config.images else None
        self._real_time_factor = self.create_publisher(Float64, "/sim/real_time_factor", reliable(5))

        self.create_subscription(JointState, "/joint_commands", self._on_command, QOS_COMMAND)
        self._holds = HoldListener(self)
        self._arms = [
            TrajectoryServer(self, side, arm, self._simulation, partial(self._holds.check, side))
            for side, arm in controller.arms.items()
        ]
        self._grippers = [
            GripperServer(
                self, side, gripper, self._simulation, partial(self._holds.check, side), config.gripper_action
            )
            for side, gripper in controller.grippers.items()
        ]
        self.create_service(Trigger, "/stop", self._on_stop)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self._sim_services = SimulationServer(self, stage, scene, self._simulation)

        self._faults = FaultServer(
            self, self._simulation, cameras if self._images is not None else (), self._set_camera_faults
        )

        self._scheduling = ""
        self._warned: set[str] = set()
        self._commands = 0
        self._drawn = dict.fromkeys(cameras, 0)
        self.create_timer(REPORT_PERIOD_S, self._report, clock=self.steady_clock)

        if self._images is not None:
            self.create_timer(WATCH_PERIOD_S, self._images.poll, clock=self.steady_clock)
            if not self._images.wait_ready(WARM_UP_S):
                self.get_logger().warning(f"no image yet after {WARM_UP_S:.0f} s; the simulation begins without")
        self._states.publish_static(self.description)
        self._simulation.start()
        self.get_logger().info(f"scene {scene.name!r} with {len(scene.objects)} objects; simulation is running")

    def use_real_time_priority(self) -> None:
        """Request real-time scheduling of this process, where the simulation waits for the wall clock."""
        # As fast as it can, it would take a core from everything else.
        if 0.0 < self.config.speed <= 1.0:
            self._scheduling = use_fifo(self.config.thread_priority)
            self.get_logger().info(f"scheduled as {self._scheduling}")

    def close(self) -> None:
        """Stop physics and drawing, then the node."""
        self._simulation.stop()
        if self._images is not None:
            self._images.close()
        for server in (*self._arms, *self._grippers):
            server.destroy()
        super().close()

    def _observe(self, state: JointReadout) -> None:
        """End of a tick, in the thread of the simulation."""
        with until_shutdown(self.context):
            joints = self._simulation.faults.publishes_joints(state.t_ns)
            self._states.publish(state, self._simulation.world, joints=joints)
            self._sensors.publish(self._simulation.world)
            if self._images is not None:
                self._images.tick(self._simulation.world)

    def _on_command(self, message: JointState) -> None:
        """Follow position targets of some or all joints."""
        self._commands += 1
        logger = self.get_logger()
        try:
            self._simulation.check_able()
            command = self._controller.check_command(message.name, message.position)
            for side in self._controller.sides(command):
                self._holds.check(side)
        except OpenArmError as error:
            logger.error(f"/joint_commands refused: {error}", throttle_duration_sec=1.0)
            return
        for name in sorted(set(command.unknown) - self._warned)[: _NAMED - len(self._warned)]:
            self._warned.add(name)
            known = ", ".join(self._simulation.world.joint_names)
            logger.warning(f"/joint_commands: unknown joint {brief(name)} is ignored; joints: {known}")
        busy = self._controller.busy(command)
        if busy:
            names = ", ".join(busy)
            logger.warning(f"/joint_commands: {names} follow a goal; ignored until it ends", throttle_duration_sec=1.0)
        self._simulation.call(lambda: self._controller.command(command))

    async def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Emergency stop; the answer says that the joints hold."""
        await self.awaitable(self._simulation.call(self._simulation.stop_motion))
        response.success, response.message = True, "arms and hands hold; release them with /mujoco_bridge/reset"
        self.get_logger().error(f"emergency stop: {response.message}")
        return response

    async def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Release the emergency stop."""
        stopped = self._simulation.stopped
        self._simulation.stopped = False
        response.success, response.message = True, "the emergency stop is released" if stopped else "it was not latched"
        self.get_logger().warning(response.message)
        return response

    def _camera_feed(self, cameras: Mapping[str, CameraConfig], first: Snapshot) -> CameraFeed:
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
        return CameraFeed(setup, environ, first, self._on_no_images, self.config.speed)

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

    def _on_crash(self, error: Exception) -> None:
        """End the process after an unexpected error of the physics, so that it is restarted."""
        self.get_logger().fatal(f"the physics thread ended: {error!r}\n{''.join(traceback.format_exception(error))}")
        self.context.try_shutdown()

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
        commands, self._commands = self._commands, 0
        if not fault and not simulation.paused and period.n > 100 and period.p99_ms > _LATE_MS:
            fault = (
                f"late: one of a hundred joint states is {period.p99_ms:.0f} ms or more behind the one before, expected"
                f" {_LATE_MS:.0f} at most; is the machine busy, or are {commands} commands a second too many?"
            )
        self.diagnose(
            not fault,
            fault or ("paused" if simulation.paused else "running"),
            real_time_factor=f"{factor:.3f}",
            joint_state_period_p50_ms=f"{period.p50_ms:.2f}",
            joint_state_period_p99_ms=f"{period.p99_ms:.2f}",
            joint_state_period_max_ms=f"{period.max_ms:.2f}",
            scheduling=self._scheduling,
            commands_per_s=commands,
            refused_of_held_arms=self._holds.refused,
            wall_time_skipped_s=f"{simulation.skipped_s:.2f}",
            faults_active=" ".join(self._faults.active),
            frames_dropped=images.dropped if images is not None else 0,
            draw_ms=f"{images.report.draw_ms:.1f}" if images is not None else "",
            watched=" ".join(sorted(images.report.watched)) if images is not None else "",
            **{f"frames_{name}": count - before[name] for name, count in drawn.items()},
        )


def make() -> MujocoBridge:
    """Make the node for a process of its own."""
    # The physics thread must not wait 5 ms (the default) for another thread to let go of the interpreter.
    sys.setswitchinterval(0.0005)
    if PROFILE in os.environ:
        os.environ[LARGE_PROFILE] = os.environ[PROFILE]
        os.environ[PROFILE] = str(config_dir() / "fastdds_small.xml")
    node = MujocoBridge()
    mujoco.set_mju_user_warning(lambda text: node.get_logger().warning(f"MuJoCo: {text}"))  # not into a file
    node.use_real_time_priority()
    gc.collect()
    gc.freeze()  # what is there now stays; later collections are short
    return node


def main() -> None:
    """Run the node."""
    run(make)


if __name__ == "__main__":
    main()
