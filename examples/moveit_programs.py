# SPDX-License-Identifier: Apache-2.0
"""Each call that the documentation of pymoveit2 shows, one program after the other, before whatever robot runs.

    ./openarm up motion --robot panda --moveit
    python examples/moveit_programs.py                     # names from the node move_group
    python examples/moveit_programs.py --preset panda      # names from pymoveit2.robots.panda

It prints a line for each program, and ends with 0 when all did what they should. Needs the extra `moveit`
(docs/moveit.md). The arm moves.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from collections.abc import Callable
from threading import Thread
from typing import Any

import rclpy
import trimesh
from pymoveit2 import GripperInterface, MoveIt2, MoveIt2Gripper, MoveIt2Servo, MoveIt2State, RobotDescription
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from shape_msgs.msg import SolidPrimitive

#: A motion has so long, s.
_LIMIT = 60.0
_LEVEL = (0.0, 0.0, 0.0, 1.0)
_MISS = "not what was asked"


class Programs:
    """The programs; each returns what it saw, or raises."""

    def __init__(self, node: Node, names: dict[str, Any], gripper: dict[str, Any], home: list[float]) -> None:
        self.node, self.names, self.home = node, names, home
        self.group = ReentrantCallbackGroup()
        self.arm = MoveIt2(node=node, callback_group=self.group, **names)
        self.by_action = MoveIt2(node=node, callback_group=self.group, use_move_group_action=True, **names)
        self.gripper = GripperInterface(node=node, callback_group=self.group, interface=MoveIt2Gripper, **gripper)
        tip = names["end_effector_name"]
        self.servo = MoveIt2Servo(node, tip, linear_speed=0.3, callback_group=self.group, enable_at_init=False)
        for arm in (self.arm, self.by_action):
            arm.max_velocity = arm.max_acceleration = 0.5

    def ran(self, started: object, arm: MoveIt2 | None = None) -> None:
        """Wait for the end of a motion that was started."""
        arm = arm or self.arm
        if started is False or not arm.wait_until_executed(timeout_sec=_LIMIT):
            raise RuntimeError(arm.last_failure() or "no answer in time")

    def wait(self, done: Callable[[], object]) -> None:
        """Wait until a condition holds."""
        end = time.monotonic() + 10.0
        while not done():
            if time.monotonic() > end:
                raise RuntimeError("not within 10 s")
            time.sleep(0.02)

    def here(self) -> tuple[list[float], list[float]]:
        """Position and orientation of the tool."""
        pose = self.arm.compute_fk(timeout_sec=10.0).pose
        p, q = pose.position, pose.orientation
        return [p.x, p.y, p.z], [q.x, q.y, q.z, q.w]

    def arrived(self, position: list[float]) -> str:
        """How far the tool is from where it should be."""
        p, _ = self.here()
        away = max(abs(a - b) for a, b in zip(p, position, strict=True))
        if away > 0.01:
            raise RuntimeError(f"{away * 1e3:.1f} mm from the goal")
        return f"{away * 1e3:.1f} mm from the goal"

    def objects(self) -> tuple[list[str], list[str]]:
        """Ids of bodies, and of what is attached."""
        if not self.arm.update_planning_scene(timeout_sec=10.0):
            raise RuntimeError("no planning scene")
        scene = self.arm.planning_scene
        attached = scene.robot_state.attached_collision_objects
        return [body.id for body in scene.world.collision_objects], [body.object.id for body in attached]

    def close(self) -> None:
        """Release what the library holds; rclpy 7.1 stops spinning when another thread destroys what it waits for."""
        for owner in (self.servo, self.gripper, self.by_action, self.arm):
            owner.destroy()

    # --- the programs
    def joint_goal(self) -> str:
        """Go to the posture."""
        self.ran(self.arm.move_to_configuration(self.home, timeout_sec=_LIMIT))
        self.wait(lambda: self.arm.joint_state is not None)
        state = self.arm.joint_state
        at = dict(zip(state.name, state.position, strict=True))
        away = max(abs(at[n] - q) for n, q in zip(self.names["joint_names"], self.home, strict=True))
        if away > 0.02:
            raise RuntimeError(f"{away:.3f} rad from the goal")
        return f"{away:.4f} rad from the goal"

    def fk(self) -> str:
        """Ask where the tool is."""
        poses = self.arm.compute_fk(fk_link_names=[self.names["end_effector_name"]], timeout_sec=10.0)
        return f"{len(poses)} pose in {poses[0].header.frame_id}"

    def ik(self) -> str:
        """Solve a pose in reach, and one out of it."""
        p, q = self.here()
        found = self.arm.compute_ik([p[0] + 0.02, p[1] + 0.03, p[2]], q, timeout_sec=10.0)
        if found is None or self.arm.compute_ik([5.0, 0.0, 0.0], q, timeout_sec=10.0) is not None:
            raise RuntimeError(_MISS)
        return f"{len(found.name)} joints; none for a pose out of reach"

    def pose_goal(self) -> str:
        """Go to a pose."""
        p, q = self.here()
        goal = [p[0] + 0.03, p[1] + 0.05, p[2] - 0.03]
        self.ran(self.arm.move_to_pose(position=goal, quat_xyzw=q, timeout_sec=_LIMIT))
        return self.arrived(goal)

    def cartesian(self) -> str:
        """Go along a straight line."""
        p, q = self.here()
        goal = [p[0], p[1] - 0.05, p[2] + 0.02]
        self.ran(
            self.arm.move_to_pose(
                position=goal, quat_xyzw=q, cartesian=True, cartesian_fraction_threshold=0.99, timeout_sec=_LIMIT
            )
        )
        return self.arrived(goal)

    def orientation_path_constraint(self) -> str:
        """Go to a pose, upright on the way."""
        p, q = self.here()
        goal = [p[0] + 0.02, p[1] + 0.06, p[2]]
        self.arm.set_path_orientation_constraint(q, tolerance=(0.1, 0.1, 3.14))
        self.ran(self.arm.move_to_pose(position=goal, quat_xyzw=q, timeout_sec=_LIMIT))
        self.arm.clear_path_constraints()
        return self.arrived(goal)

    def move_group_action(self) -> str:
        """Let /move_action plan and execute."""
        self.wait(lambda: self.by_action.joint_state is not None)
        self.ran(self.by_action.move_to_configuration(self.home), self.by_action)
        p, q = self.here()
        goal = [p[0], p[1] + 0.04, p[2]]
        self.ran(self.by_action.move_to_pose(position=goal, quat_xyzw=q), self.by_action)
        return self.arrived(goal)

    def asynchronous(self) -> str:
        """Plan without waiting, then execute."""
        future = self.arm.plan_async(joint_positions=self.home)
        self.wait(future.done)
        self.ran(self.arm.execute(self.arm.get_trajectory(future)))
        return "planned and executed"

    def cancelled(self) -> str:
        """Cancel a slow motion."""
        turned = [*self.home[:-1], self.home[-1] - (0.4 if self.home[-1] > 0.0 else -0.4)]
        self.arm.max_velocity = self.arm.max_acceleration = 0.03
        try:
            self.arm.move_to_configuration(turned, timeout_sec=_LIMIT)
            self.wait(lambda: self.arm.query_state() == MoveIt2State.EXECUTING)
            self.arm.cancel_execution()
            if self.arm.wait_until_executed(timeout_sec=_LIMIT):
                raise RuntimeError("it went on")
            if "PREEMPTED" not in str(self.arm.last_failure()):
                raise RuntimeError(self.arm.last_failure())
        finally:
            self.arm.max_velocity = self.arm.max_acceleration = 0.5
        return "PREEMPTED; the arm holds"

    def collision_primitive(self) -> str:
        """Put one body of each shape, and remove one."""
        p, _ = self.here()
        away = (p[0], p[1], p[2] + 0.35)
        self.arm.add_collision_primitive("cone", SolidPrimitive.CONE, (0.05, 0.02), position=away, quat_xyzw=_LEVEL)
        self.arm.add_collision_sphere("sphere", 0.02, position=(p[0], p[1] + 0.1, p[2] + 0.35))
        self.arm.add_collision_cylinder(
            "cylinder", 0.05, 0.02, position=(p[0], p[1] - 0.1, p[2] + 0.35), quat_xyzw=_LEVEL
        )
        self.arm.add_collision_box(
            "box", (0.03, 0.03, 0.03), position=(p[0], p[1] + 0.2, p[2] + 0.35), quat_xyzw=_LEVEL
        )
        self.wait(lambda: {"cone", "sphere", "cylinder", "box"} <= set(self.objects()[0]))
        self.arm.remove_collision_object("cone")
        self.wait(lambda: "cone" not in self.objects()[0])
        return "cone, sphere, cylinder, box; the cone removed"

    def collision_mesh(self) -> str:
        """Put a mesh, move and remove it."""
        p, _ = self.here()
        mesh = trimesh.creation.icosphere(radius=0.02)
        self.arm.add_collision_mesh(
            filepath=None, id="mesh", position=(p[0] + 0.1, p[1], p[2] + 0.35), quat_xyzw=_LEVEL, mesh=mesh
        )
        self.wait(lambda: "mesh" in self.objects()[0])
        self.arm.move_collision("mesh", (p[0], p[1] + 0.3, p[2] + 0.35), _LEVEL)
        self.arm.remove_collision_object("mesh")
        self.wait(lambda: "mesh" not in self.objects()[0])
        return "added, moved, removed"

    def allow_collisions(self) -> str:
        """Let a body be touched, and no longer."""
        p, q = self.here()
        self.arm.add_collision_box("blocker", (0.1, 0.1, 0.1), position=tuple(p), quat_xyzw=_LEVEL)
        self.wait(lambda: "blocker" in self.objects()[0])
        if self.arm.plan(position=p, quat_xyzw=q, timeout_sec=_LIMIT) is not None:
            raise RuntimeError("a goal in the box was planned")
        self.change(self.arm.allow_collisions("blocker", True), self.arm.process_allow_collision_future)
        if self.arm.plan(position=p, quat_xyzw=q, timeout_sec=_LIMIT) is None:
            raise RuntimeError(self.arm.last_failure())
        self.change(self.arm.allow_collisions("blocker", False), self.arm.process_allow_collision_future)
        if self.arm.plan(position=p, quat_xyzw=q, timeout_sec=_LIMIT) is not None:
            raise RuntimeError("a goal in the box was planned")
        return "refused, allowed, refused again"

    def change(self, future: Any, took: Callable[[Any], bool]) -> None:
        """Wait for a change of the scene."""
        if future is None:
            raise RuntimeError("the change was not sent")
        self.wait(future.done)
        if not took(future):
            raise RuntimeError("the change was refused")

    def attach(self) -> str:
        """Let the hand hold a body, and let it go."""
        self.arm.attach_collision_object("box", self.names["end_effector_name"])
        self.wait(lambda: "box" in self.objects()[1])
        self.arm.detach_collision_object("box")
        self.wait(lambda: "box" in self.objects()[0] and "box" not in self.objects()[1])
        return "attached and detached"

    def clear_planning_scene(self) -> str:
        """Remove all bodies."""
        took = self.arm.process_clear_all_collision_objects_future
        self.change(self.arm.clear_all_collision_objects(), took)
        if self.objects() != ([], []):
            raise RuntimeError(_MISS)
        return "empty"

    def gripper_group(self) -> str:
        """Close and open the hand."""
        self.gripper.close()
        self.gripper.wait_until_executed(_LIMIT)
        self.wait(lambda: self.gripper.is_closed)
        self.gripper.open()
        self.gripper.wait_until_executed(_LIMIT)
        self.wait(lambda: self.gripper.is_open)
        return "closed and opened"

    def servo_twist(self) -> str:
        """Draw the tool back by a twist in its own frame."""
        return self.servoed(lambda servo: servo.servo(linear=(0.0, 0.0, -1.0)))

    def servo_jog(self) -> str:
        """Turn the last joint away from its nearest limit."""
        self.wait(lambda: self.arm.joint_state is not None)
        state: Any = self.arm.joint_state
        last = self.names["joint_names"][-1]
        speed = -0.5 if state.position[list(state.name).index(last)] > 0.0 else 0.5
        return self.servoed(lambda servo: servo.servo_jog((last,), (speed,)))

    def servoed(self, send: Callable[[MoveIt2Servo], bool]) -> str:
        """Servo for half a second, and rest."""
        before = self.here()
        servo = self.servo
        if not servo.enable(sync=True):
            raise RuntimeError("servoing was not started")
        self.wait(lambda: send(servo))
        for _ in range(50):
            send(servo)
            time.sleep(0.01)
        if not servo.disable(sync=True):
            raise RuntimeError("servoing was not stopped")
        time.sleep(0.5)
        after = self.here()
        moved = max(abs(a - b) for x, y in zip(before, after, strict=True) for a, b in zip(x, y, strict=True))
        if moved < 0.01:
            raise RuntimeError(_MISS)
        return f"moved by {moved:.3f}"


PROGRAMS = (
    *("joint_goal", "fk", "ik", "pose_goal", "cartesian", "orientation_path_constraint", "move_group_action"),
    *("asynchronous", "cancelled", "collision_primitive", "collision_mesh", "allow_collisions", "attach"),
    *("clear_planning_scene", "gripper_group", "servo_twist", "servo_jog"),
)


def from_preset(name: str) -> dict[str, Any]:
    """Names of a robot of pymoveit2, but for its hand: /joint_states has the finger that is driven, and no other."""
    preset = importlib.import_module(f"pymoveit2.robots.{name}")
    return {
        "joint_names": preset.joint_names(),
        "base_link_name": preset.base_link_name(),
        "end_effector_name": preset.end_effector_name(),
        "group_name": preset.MOVE_GROUP_ARM,
    }


def main() -> int:
    """Run the programs; 0 when all did what they should."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", help="robot of pymoveit2 whose names are used")
    parser.add_argument("--group", help="group of the SRDF, where there are several arms")
    parser.add_argument("--gripper", help="group of its hand")
    parser.add_argument("--posture", help="posture of the SRDF to begin from")
    parser.add_argument("--json", action="store_true", help="a JSON object a line")
    options = parser.parse_args()

    rclpy.init()
    node = Node("moveit_programs")
    executor = MultiThreadedExecutor(2)
    executor.add_node(node)
    spinning = Thread(target=executor.spin, daemon=True)
    spinning.start()
    description = RobotDescription.from_node(node)
    arm, gripper = description.moveit2_kwargs(options.group), description.moveit2_gripper_kwargs(options.gripper)
    home = list(description.joint_positions(options.posture, str(arm["group_name"])))
    if options.preset:
        arm = from_preset(options.preset)
    programs = Programs(node, arm, gripper, home)
    failures = 0
    for name in PROGRAMS:
        began = time.monotonic()
        try:
            ok, text = True, getattr(programs, name)()
        except (RuntimeError, ValueError) as error:
            ok, text = False, str(error)
            failures += 1
        seconds = time.monotonic() - began
        row = {"program": name, "ok": ok, "seconds": round(seconds, 2), "said": text}
        print(
            json.dumps(row) if options.json else f"{name:30} {'ok' if ok else 'FAILED':7} {seconds:6.2f} s  {text}",
            flush=True,
        )
    executor.shutdown()
    spinning.join()
    programs.close()
    node.destroy_node()
    rclpy.try_shutdown()
    return min(failures, 1)


if __name__ == "__main__":
    sys.exit(main())
