# SPDX-License-Identifier: Apache-2.0
"""Pick an object and place it elsewhere, as a state machine of MoveIt's client pymoveit2.

    ./openarm up --moveit
    .venv/bin/python examples/moveit_client.py red --place 0.36 -0.20

Detections come from the suite, everything else is asked of MoveIt's names: the object becomes a body of the planning
scene that the hand may touch, the hand goes over it on a free path, down on a straight line, closes, carries it. What
fails begins again, three times at most. Needs the extra `moveit` (docs/moveit.md).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from threading import Thread
from typing import Any

import numpy as np
import rclpy
from pymoveit2 import GripperInterface, MoveIt2, MoveIt2Gripper, RobotDescription
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from vision_msgs.msg import Detection3DArray

#: Pre-grasp over the grasp, m; a motion or an answer has so long, s.
_ABOVE, _LIMIT = 0.08, 60.0
_ATTEMPTS = 3


class FailedError(Exception):
    """A state could not do what it should."""


@dataclass(eq=False)
class Found:
    """An object: its middle (3,), turn about the vertical, rad, and edges (3,), in a frame."""

    frame: str
    middle: np.ndarray
    yaw: float
    size: np.ndarray


def above(position: np.ndarray, height: float = _ABOVE) -> np.ndarray:
    """A position (3,) by so much higher, m."""
    return position + np.array([0.0, 0.0, height])


class Machine:
    """States by name; each does its work and names the next one."""

    def __init__(self, node: Node, names: dict[str, Any], gripper: dict[str, Any], home: list[float]) -> None:
        group = ReentrantCallbackGroup()
        self.arm = MoveIt2(node=node, callback_group=group, **names)
        self.arm.max_velocity = self.arm.max_acceleration = 0.5
        self.arm.allowed_planning_time = 5.0
        self.gripper = GripperInterface(node=node, callback_group=group, interface=MoveIt2Gripper, **gripper)
        self.posture, self.tool = home, names["end_effector_name"]
        self.label, self.place_at = "", (0.0, 0.0)
        self.latest: dict[str, Found] = {}
        self.target: Found | None = None
        node.create_subscription(Detection3DArray, "/detections_3d", self.on_detections, 5, callback_group=group)

    def run(self, label: str, place_at: tuple[float, float]) -> bool:
        """Run from HOME to DONE; begin again after a failure."""
        self.label, self.place_at = label, place_at
        for attempt in range(1, _ATTEMPTS + 1):
            state = "HOME"
            try:
                while state != "DONE":
                    print(f"{attempt}: {state}", flush=True)
                    state = getattr(self, f"on_{state.lower()}")()
                return True
            except FailedError as error:
                print(f"{attempt}: {state} failed: {error}", flush=True)
                self.release()
        return False

    # --- states
    def on_home(self) -> str:
        """Open the hand, and leave the view of the camera."""
        self.move_hand(self.gripper.open)
        self.ran(self.arm.move_to_configuration(self.posture, timeout_sec=_LIMIT))
        return "DETECT"

    def on_detect(self) -> str:
        """Wait for the object, and tell the planning scene of it, before anything is planned."""
        self.latest.clear()
        self.wait(lambda: self.label in self.latest, f"no {self.label!r} among the detections")
        found = self.target = self.latest[self.label]
        turn = Rotation.from_euler("z", found.yaw).as_quat().tolist()
        size, middle = found.size.tolist(), found.middle.tolist()
        self.arm.add_collision_box(self.label, size, position=middle, quat_xyzw=turn, frame_id=found.frame)
        self.wait(lambda: self.label in self.bodies(), "the planning scene does not have the object")
        self.change(self.arm.allow_collisions(self.label, True, timeout_sec=_LIMIT))
        return "PRE_GRASP"

    def on_pre_grasp(self) -> str:
        """Go over the object, on a free path."""
        self.go(above(self.found().middle))
        return "GRASP"

    def on_grasp(self) -> str:
        """Go down on a straight line, and close."""
        self.go(self.found().middle, straight=True)
        self.move_hand(self.gripper.close)
        if self.gripper.is_closed:
            raise FailedError("the hand is empty")
        self.arm.attach_collision_object(self.label, self.tool)
        return "LIFT"

    def on_lift(self) -> str:
        """Go up on a straight line, or on the first part of it."""
        self.go(above(self.found().middle), straight=True, share=0.3)
        return "PRE_PLACE"

    def on_pre_place(self) -> str:
        """Go over the place, with the object."""
        self.go(above(self.there()))
        return "PLACE"

    def on_place(self) -> str:
        """Go down on a straight line, and let go."""
        self.go(above(self.there(), 0.003), straight=True)
        self.release()
        return "RETREAT"

    def on_retreat(self) -> str:
        """Go up on a straight line, or on the first part of it, and home."""
        self.go(above(self.there()), straight=True, share=0.3)
        self.ran(self.arm.move_to_configuration(self.posture, timeout_sec=_LIMIT))
        return "DONE"

    # --- what they do it with
    def found(self) -> Found:
        """The object as it was detected."""
        if self.target is None:
            raise FailedError("nothing was detected")
        return self.target

    def there(self) -> np.ndarray:
        """Where the middle of the object is to be placed."""
        return np.array([*self.place_at, self.found().middle[2]])

    def go(self, position: np.ndarray, *, straight: bool = False, share: float = 0.99) -> None:
        """Move the tool, which points down and closes along the short edge of the object, at least so far."""
        found = self.found()
        across = found.yaw + (0.5 * np.pi if found.size[0] > found.size[1] else 0.0)
        y = np.array([np.cos(across), np.sin(across), 0.0])  # the tool's y is where the fingers come from
        z = np.array([0.0, 0.0, -1.0])
        quat = Rotation.from_matrix(np.column_stack([np.cross(y, z), y, z])).as_quat().tolist()
        goal = {"position": position.tolist(), "quat_xyzw": quat, "frame_id": found.frame, "timeout_sec": _LIMIT}
        self.ran(self.arm.move_to_pose(**goal, cartesian=straight, cartesian_fraction_threshold=share))

    def ran(self, started: object) -> None:
        """Wait for the end of a motion that was started."""
        if started is False or not self.arm.wait_until_executed(timeout_sec=_LIMIT):
            raise FailedError(self.arm.last_failure() or "no answer in time")

    def move_hand(self, motion: Callable[[], Any]) -> None:
        """Open or close the hand, and wait for it."""
        motion()
        self.gripper.wait_until_executed(_LIMIT)

    def release(self) -> None:
        """Open the hand, and take the object out of it."""
        self.move_hand(self.gripper.open)
        self.arm.detach_collision_object(self.label)
        self.arm.remove_collision_object(self.label)

    def change(self, future: Any) -> None:
        """Wait until a change of the planning scene is in force."""
        self.wait(lambda: future is not None and future.done(), "the planning scene was not changed")
        if not self.arm.process_allow_collision_future(future):
            raise FailedError("the planning scene was not changed")

    def bodies(self) -> list[str]:
        """Ids of the bodies of the planning scene."""
        if not self.arm.update_planning_scene(timeout_sec=_LIMIT):
            return []
        return [body.id for body in self.arm.planning_scene.world.collision_objects]

    def wait(self, done: Callable[[], object], what: str) -> None:
        """Wait until a condition holds."""
        end = time.monotonic() + _LIMIT
        while not done():
            if time.monotonic() > end:
                raise FailedError(what)
            time.sleep(0.05)

    def on_detections(self, message: Detection3DArray) -> None:
        """Keep the newest place of each label."""
        for detection in message.detections:
            p, q, size = detection.bbox.center.position, detection.bbox.center.orientation, detection.bbox.size
            yaw = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_euler("zyx")[0]
            middle, edges = np.array([p.x, p.y, p.z]), np.array([size.x, size.y, size.z])
            for result in detection.results:
                self.latest[result.hypothesis.class_id] = Found(message.header.frame_id, middle, float(yaw), edges)


def main() -> int:
    """Ask for what to pick, and run; 0 when it stands at its place."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("label", nargs="?", default="red")
    parser.add_argument("--place", nargs=2, type=float, default=(0.36, -0.20), metavar=("X", "Y"))
    parser.add_argument("--group", default="right_arm", help="group of the SRDF")
    parser.add_argument("--gripper", default="right_gripper", help="group of its hand")
    options = parser.parse_args()

    rclpy.init()
    node = Node("moveit_client")
    executor = MultiThreadedExecutor(2)
    executor.add_node(node)
    spinning = Thread(target=executor.spin, daemon=True)
    spinning.start()
    robot = RobotDescription.from_node(node)
    names, gripper = robot.moveit2_kwargs(options.group), robot.moveit2_gripper_kwargs(options.gripper)
    machine = Machine(node, names, gripper, list(robot.joint_positions("home", options.group)))
    done = machine.run(options.label, tuple(options.place))
    print("placed" if done else "given up")
    executor.shutdown()
    spinning.join()
    machine.gripper.destroy()
    machine.arm.destroy()
    node.destroy_node()
    rclpy.try_shutdown()
    return 0 if done else 1


if __name__ == "__main__":
    sys.exit(main())
