# SPDX-License-Identifier: Apache-2.0
"""The peer of graph_realtime: a bridge as it is often written, one timer that steps, draws and publishes in turn.

The same world, cameras and topics as `mujoco_bridge`. One executor, one 100 Hz timer on the wall clock; every third
tick or so it draws each camera with `mujoco.Renderer`, colour and depth in two passes, and publishes whole messages.
"""

from __future__ import annotations

import mujoco
import numpy as np
import rclpy
from openarm_interfaces.srv import ResetWorld
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState

from openarm_common.camera.cameras import load_cameras
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import info_from_intrinsics, ns_to_stamp
from openarm_common.ros.node import QOS_CLOCK, QOS_COMMAND, QOS_SENSOR
from openarm_common.scene.scene import load_scene
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.stage import Stage


class NaiveBridge(Node):
    """Everything in one callback."""

    def __init__(self) -> None:
        super().__init__("mujoco_bridge")
        cameras = load_cameras()
        stage = Stage(RobotDescription.load(), cameras, None, PhysicsConfig())
        self.world = stage.world(load_scene("demo", 0))
        self.cameras = [camera for camera in cameras.values() if camera.depth]
        self.renderer = mujoco.Renderer(self.world.model, 480, 640)
        self.joints = self.create_publisher(JointState, "/joint_states", QOS_COMMAND)
        self.clock_publisher = self.create_publisher(Clock, "/clock", QOS_CLOCK)
        self.images = {
            (camera.name, kind): (
                self.create_publisher(Image, f"/{camera.name}/{kind}/image_raw", QOS_SENSOR),
                self.create_publisher(CameraInfo, f"/{camera.name}/{kind}/camera_info", QOS_SENSOR),
            )
            for camera in self.cameras
            for kind in ("color", "depth")
        }
        self.create_service(ResetWorld, "/sim/reset_world", lambda _request, response: response)
        self.frame = 0
        self.create_timer(0.01, self.tick)

    def tick(self) -> None:
        """Step, publish, draw."""
        self.world.step(self.world.steps_per_tick)
        state = self.world.read_joints()
        stamp = ns_to_stamp(state.t_ns)
        message = JointState(name=list(self.world.joint_names))
        message.header.stamp = stamp
        message.position, message.velocity = state.position.tolist(), state.velocity.tolist()
        message.effort = state.effort.tolist()
        self.clock_publisher.publish(Clock(clock=stamp))
        self.joints.publish(message)
        frame = int(state.t_ns * 30 // 1_000_000_000)
        if frame != self.frame:
            self.frame = frame
            self.draw(state.t_ns)

    def draw(self, t_ns: int) -> None:
        """Draw and publish all cameras."""
        for camera in self.cameras:
            self.renderer.update_scene(self.world.data, camera.name)
            self.publish(camera, "color", "rgb8", self.renderer.render(), t_ns)
            self.renderer.enable_depth_rendering()
            self.renderer.update_scene(self.world.data, camera.name)
            depth = self.renderer.render()
            self.renderer.disable_depth_rendering()
            self.publish(camera, "depth", "16UC1", (depth * 1000.0).astype(np.uint16), t_ns)

    def publish(self, camera, kind: str, encoding: str, pixels: np.ndarray, t_ns: int) -> None:
        """Publish one image with its info."""
        message = Image(height=pixels.shape[0], width=pixels.shape[1], encoding=encoding)
        message.header.frame_id = camera.optical_frame
        message.header.stamp = ns_to_stamp(t_ns)
        message.step = pixels.strides[0]
        message.data = pixels.tobytes()
        image, info = self.images[camera.name, kind]
        image.publish(message)
        info.publish(info_from_intrinsics(camera.intrinsics, camera.optical_frame, t_ns))


def main() -> None:
    """Run it until a signal."""
    rclpy.init()
    node = NaiveBridge()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
