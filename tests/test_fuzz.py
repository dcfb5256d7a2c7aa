# SPDX-License-Identifier: Apache-2.0
"""A small part of what `python -m benchmarks.fuzz` does at length."""

from __future__ import annotations

import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, MoveArms, PlanApproach
from openarm_interfaces.msg import CollisionObject
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState, PointCloud2
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectory
from vision_msgs.msg import Detection3DArray
from visualization_msgs.msg import MarkerArray

from benchmarks.fuzz import __main__ as fuzz
from benchmarks.fuzz.files import KINDS, read_altered
from benchmarks.fuzz.graph import Lot
from benchmarks.fuzz.hostile import hostile, plausible
from benchmarks.fuzz.judge import BOUND_MIB, Tally
from openarm_bringup.view.ros.layers import _show_robot, _text
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.ros import convert, images
from openarm_common.ros.detections import detections_from_msg
from openarm_motion.ros import convert as motion

ROOT = Path(__file__).parents[1]


@pytest.mark.requirement("R-22")
@pytest.mark.parametrize("kind", KINDS)
def test_altered_files_are_read_or_refused_in_a_sentence(kind: str) -> None:
    tally = read_altered(kind, 4 if kind == "contents" else 30, 11)
    assert not tally.raw, tally.raw
    assert not tally.hangs
    assert tally.worst_mib < BOUND_MIB
    assert tally.sound
    assert tally.accepted
    assert tally.refused > (0 if kind == "contents" else 10)


def _edges(message: TFMessage) -> None:
    for edge in message.transforms:
        convert.transform_to_matrix(edge.transform)


def _solid(message: CollisionObject) -> None:
    motion.solid_from_msg(message, lambda T, _: T)


#: Where messages become data of the cores.
_DOORS: list[tuple[type[Any], Callable[[Any], object]]] = [
    (JointState, convert.joints_from_msg),
    (TFMessage, _edges),
    (Image, images.rgb_image),
    (Image, images.depth_image),
    (CompressedImage, images.rgb_image),
    (CompressedImage, images.depth_image),
    (CameraInfo, images.lens_from_info),
    (CameraInfo, images.rotation_from_info),
    (CameraInfo, images.projection_from_info),
    (PointCloud2, convert.points_from_cloud),
    (JointTrajectory, convert.trajectory_from_msg),
    (MarkerArray, convert.held_from_msg),
    (Detection3DArray, detections_from_msg),
    (CollisionObject, _solid),
    (PlanApproach.Goal, motion.approach_request),
    (MoveArm.Goal, motion.move_request),
    (MoveArms.Goal, motion.move_arms_request),
    (ExecuteTrajectory.Goal, motion.execute_request),
]


@pytest.mark.requirement("R-22")
def test_hostile_messages_become_data_or_are_refused() -> None:
    rng, refused = random.Random(3), 0
    for kind, read in _DOORS:
        for _ in range(40):
            message = hostile(plausible(kind, rng), rng)
            try:
                read(message)
            except OpenArmError:
                refused += 1
    assert refused > 200


def test_the_page_takes_joint_states_of_another_length_and_refuses_what_is_no_json() -> None:
    show = _show_robot(RobotDescription.load())
    for names in (["a"], ["a", "b"], ["b"]):
        assert [key for key, _ in show([JointState(name=names, position=[0.1] * len(names))], [])] == ["robot"]
    with pytest.raises(OpenArmError, match="0 positions of 1 joints"):
        list(show([JointState(name=["a"])], []))
    with pytest.raises(OpenArmError, match="states: a value is not finite"):
        _text("states", speed=float("nan"))


def test_what_is_no_sentence_is_counted_as_a_raw_error() -> None:
    tally = Tally("test")

    def refuse(text: str) -> None:
        raise OpenArmError(Code.INVALID_ARGUMENT, text)

    for work in (lambda: None, lambda: refuse("no"), lambda: refuse("one\ntwo"), lambda: [][0]):
        tally.take(work)
    assert (tally.inputs, tally.accepted, tally.refused, tally.raw.total()) == (4, 1, 2, 2)


def test_the_memory_of_an_input_is_measured_and_too_much_of_it_ends_the_run_with_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # in a process of its own: another one's memory may shrink meanwhile
    take = "t = Tally('bags'); t.take(lambda: bytearray(b'x') * (256 << 20)); print(t.worst_mib)"
    code = f"from benchmarks.fuzz.judge import Tally; {take}"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    tally = Tally("bags", worst_mib=float(done.stdout))
    assert 200.0 < tally.worst_mib < 300.0
    assert tally.sound
    monkeypatch.setattr(fuzz, "in_a_process", lambda *_: [tally])
    monkeypatch.setattr("sys.argv", ["fuzz", "--only", "bags"])
    for worst, code in ((tally.worst_mib, 0), (BOUND_MIB + 1.0, 1)):
        tally.worst_mib = worst
        with pytest.raises(SystemExit) as ended:
            fuzz.main()
        assert ended.value.code == code
    assert f"{BOUND_MIB + 1.0:9.1f}" in capsys.readouterr().out


def test_each_name_is_drawn_before_any_comes_again() -> None:
    lot, names = Lot(random.Random(0)), list("abcdefgh")
    drawn = [lot.draw(names) for _ in names]
    assert sorted(drawn) == names
    assert drawn != names
    assert lot.rounds == 1
    drawn = [lot.draw(names) for _ in range(3)]
    drawn += [lot.draw([*names, "new"]) for _ in range(6)]
    assert sorted(drawn) == [*names, "new"]
    assert lot.rounds == 2
    assert lot.draw(["other"]) == "other"
