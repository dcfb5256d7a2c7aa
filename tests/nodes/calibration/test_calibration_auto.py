# SPDX-License-Identifier: Apache-2.0
"""Action /calibration/auto with a robot, a camera and a planner of the test."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from openarm_interfaces.action import AutoCalibrate, MoveArm
from openarm_interfaces.srv import TakeSample
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.task import Future

from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.ros.node import CalibrationNode
from openarm_calibration.sampling.samples import load_session
from openarm_calibration.store.store import CalibrationStore
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL
from openarm_common.ros.convert import pose_to_matrix
from openarm_common.scene.scene import load_scene
from tests.openarm_calibration.known_session import Known, make_session

QUICK = {
    "auto.search.draws": 250, "auto.search.candidates": 12, "auto.tries": 10, "auto.settle_timeout": 10.0,
    "image_timeout": 20.0, "state_timeout": 20.0,
}  # fmt: skip


class Planner:
    """Serves /motion/move: the robot is there at once, unless the test says otherwise."""

    def __init__(self, ros, robot) -> None:
        self.goals: list[MoveArm.Goal] = []
        self.refuse: Callable[[int], str] = lambda k: ""
        self.hang = False
        self.cancelled = False
        self._robot, self._ros = robot, ros
        self.waiting: Future | None = None
        self._server = ActionServer(ros.node, MoveArm, "/motion/move", self._move, cancel_callback=self._cancel)

    def _cancel(self, _):
        if self.waiting is not None:
            self.waiting.set_result(None)
        return CancelResponse.ACCEPT

    async def _move(self, handle):
        goal = handle.request
        self.goals.append(goal)
        code = self.refuse(len(self.goals) - 1)
        if self.hang:
            self.waiting = Future(executor=self._ros.executor)
            await self.waiting
            self.cancelled = True
            code = "CANCELLED"
        if code:
            handle.abort()
            return MoveArm.Result(code=code, message=f"{code} by the test")
        self._robot.stand(dict(zip(self._robot.joints, goal.joint_positions, strict=True)))
        handle.succeed()
        return MoveArm.Result(success=True, code="OK")


class Bench:
    """Node, robot and planner."""

    def __init__(self, ros, posed_robot, folder: Path, setup: str, *, given_pose: bool, **more) -> None:
        self.ros, self.store = ros, CalibrationStore(folder / "store")
        self.camera = "wrist" if setup == "in_hand" else "overhead"
        self.known: Known = make_session(setup, 3, px=1e-9)
        self.robot = posed_robot(self.camera, self.known)
        if setup == "in_hand":  # a board on the table: what the session has is behind the fingers
            self.robot.Z = load_scene("calibration_wrist").fixtures[0].T_link_fixture
        self.robot.pose(0)
        self.planner = Planner(ros, self.robot)
        given = {"camera": "wrist", "store": str(self.store.folder), "mount_seed": 1, **QUICK, **more}
        if given_pose:
            Z = self.robot.Z
            key = "auto.on_table." if setup == "in_hand" else "auto.on_hand."
            given |= {
                key + "position": [round(v, 2) for v in Z[:3, 3]], key + "z_axis": Z[:3, 2].tolist(),
                key + "y_axis": Z[:3, 1].tolist(),
            }  # fmt: skip
        ros.start(CalibrationNode, **given)
        self.client = ActionClient(ros.node, AutoCalibrate, "/calibration/auto")
        self.feedback: list[AutoCalibrate.Feedback] = []

    def start(self, **fields):
        goal = AutoCalibrate.Goal(camera=self.camera, **fields)
        return self.ros.send_goal(self.client, goal, feedback_callback=lambda m: self.feedback.append(m.feedback))

    def run(self, **fields) -> AutoCalibrate.Result:
        _, result = self.start(**fields)
        return self.ros.result(result, 60.0).result

    def error(self, result: AutoCalibrate.Result) -> tuple[float, float]:
        return mount_error(pose_to_matrix(result.mount), self.known.X @ se3.inverse(T_LINK_OPTICAL))


@pytest.mark.parametrize(
    ("setup", "given_pose"), [("in_hand", True), pytest.param("to_hand", False, marks=pytest.mark.long)]
)
@pytest.mark.requirement("A-33", "A-34", "A-40", "A-45")
def test_calibrates_by_itself_and_stores(ros, posed_robot, tmp_path: Path, setup: str, given_pose: bool) -> None:
    """From a board in view, or from where a ruler says it is; refused poses are passed over; the board is announced."""
    bench = Bench(ros, posed_robot, tmp_path, setup, given_pose=given_pose)
    bench.planner.refuse = lambda k: "IN_COLLISION" if k == 1 else ""
    result = bench.run(poses=7, sigma_translation=1e-9, save=True, session=str(tmp_path / "session.npz"))
    assert result.success, result.message
    assert (result.code, result.samples, list(result.missed)) == ("OK", 7, [])
    offset, angle = bench.error(result)
    assert offset < 0.3e-3
    assert angle < math.radians(0.03)
    assert bench.store.load(bench.camera).T_parent_link == pytest.approx(pose_to_matrix(result.mount), abs=1e-9)
    assert len(load_session(tmp_path / "session.npz", bench.known.description)[0]) == 7
    assert json.loads(result.report)["figures"]["samples"] == 7
    # as many motions as poses that were not had where the arm stood, and the one that was refused
    assert len(bench.planner.goals) == (8 if given_pose else 7)
    goal = bench.planner.goals[-1]
    boxes = goal.obstacles if setup == "in_hand" else goal.attached
    assert [box.id for box in boxes] == ["calibration board"]
    turned = rotations(bench)
    assert max(se3.angle_between(a, b) for a in turned for b in turned) > math.radians(30.0)
    assert {f.stage for f in bench.feedback} == {"looking", "moving", "sampling", "solving"}
    assert all(f.pose <= f.poses == 7 for f in bench.feedback)
    assert bench.feedback[-1].sigma_translation > 0.0


def rotations(bench: Bench) -> list[np.ndarray]:
    samples, names = bench.known.samples, bench.known.samples.joint_names
    return [
        samples.pose(dict(zip(names, g.joint_positions, strict=True)))[:3, :3] for g in bench.planner.goals
    ]  # fmt: skip


@pytest.mark.long
def test_ends_when_the_predicted_error_is_small_enough(ros, posed_robot, tmp_path: Path) -> None:
    bench = Bench(ros, posed_robot, tmp_path, "to_hand", given_pose=False, **{"auto.fewest": 4})
    result = bench.run(poses=12, sigma_translation=0.02, sigma_rotation=0.2)
    assert result.success, result.message
    assert result.samples == 4
    assert result.grade in ("warn", "pass")


def test_cancel_stops_the_motion_and_the_node_is_free_again(ros, posed_robot, tmp_path: Path) -> None:
    bench = Bench(ros, posed_robot, tmp_path, "to_hand", given_pose=False)
    bench.planner.hang = True
    handle, ended = bench.start(poses=6)
    ros.spin_until(lambda: bench.planner.waiting is not None, what="a motion")
    busy = ros.call(ros.node.create_client(TakeSample, "/calibration/take_sample"), TakeSample.Request())
    assert busy.code == "BUSY"
    assert "calibrating automatically" in busy.message
    ros.result(handle.cancel_goal_async())
    result = ros.result(ended).result
    assert result.code == "CANCELLED"
    assert bench.planner.cancelled
    assert "after 1 samples" in result.message
    assert ros.call(ros.node.create_client(TakeSample, "/calibration/take_sample"), TakeSample.Request()).success


def test_goes_on_when_images_stop_for_a_while(ros, posed_robot, tmp_path: Path) -> None:
    """As when a camera's driver is started again: some attempts end without an image before they come back."""
    quick = {"image_timeout": 0.05, "state_timeout": 0.05}
    bench = Bench(ros, posed_robot, tmp_path, "to_hand", given_pose=False, **quick)
    bench.robot.images = False
    _, ended = bench.start(poses=4)
    ros.spin_until(lambda: bool(bench.feedback), what="the first attempt")
    silent = bench.robot.time_ns
    ros.spin_until(lambda: bench.robot.time_ns > silent + 5e9, what="two seconds without an image")
    assert not ended.done()
    bench.robot.images = True
    assert ros.result(ended, 60.0).result.samples == 4


@pytest.mark.long
def test_says_why_it_can_not(ros, posed_robot, tmp_path: Path) -> None:
    """No board in view and no pose given; a camera that there is not; an arm that is lost; nothing but collisions."""
    bench = Bench(ros, posed_robot, tmp_path, "to_hand", given_pose=False)
    bench.robot.blank = True
    result = bench.run(poses=5)
    assert result.code == "NOTHING_DETECTED"
    assert "auto.on_hand.position" in result.message
    bench.robot.blank = False
    bench.camera = "sideways"
    assert "cameras: overhead, wrist" in bench.run().message
    bench.camera = "overhead"
    bench.planner.refuse = lambda k: "ROBOT_LOST"
    assert bench.run(poses=5).code == "ROBOT_LOST"
    bench.planner.refuse = lambda k: "IN_COLLISION"
    refused = bench.run(poses=5)
    assert refused.code == "NO_PLAN"
    assert "reaches none of" in refused.message
    assert "IN_COLLISION by the test" in refused.message
