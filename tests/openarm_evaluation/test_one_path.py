# SPDX-License-Identifier: Apache-2.0
"""A campaign runs what the nodes run: their motion service, their parameters, and a map of the same images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from openarm_bringup.cli import run
from openarm_bringup.supervision.environment import node_arguments
from openarm_bringup.supervision.graph import load_graph
from openarm_common.errors import Code
from openarm_common.scene.scene import load_scene
from openarm_evaluation.campaign.parameters import suite_config
from openarm_evaluation.campaign.robot import SimRobot, SimulatedSenses
from openarm_grasp.perception.detections import Frame
from openarm_motion.config import MotionConfig
from openarm_motion.service.motion_service import MotionService
from openarm_perception.detection.pipeline import SUPPORT
from tests.refusals import refused


@pytest.mark.requirement("R-27")
def test_the_robot_in_process_has_the_motion_service_and_a_map_that_shows_the_objects() -> None:
    scene = load_scene("demo")
    robot = SimRobot(scene, SimulatedSenses(depth_noise=False))
    assert type(robot.motion) is MotionService
    assert refused(None, robot.map.latest).code is Code.NOT_READY
    robot.pass_time(2.0)
    field = robot.map.latest()
    tops = [(*item.position[:2], scene.table.top_z + item.size[2] - 0.01) for item in scene.objects]
    assert np.asarray(field.at(tops)).max() < 0.03
    assert field.at([(0.3, 0.0, scene.table.top_z + 0.25)])[0] > 0.05  # nothing is in the air
    field.require_fresh(robot.t_ns, 2.0)
    seen = robot.motion.scene_state().map
    assert seen.occupied is not None, seen.why  # it plans with that map


def test_the_robot_in_process_follows_objects_as_the_detector_does() -> None:
    scene = load_scene("demo")
    robot = SimRobot(scene, SimulatedSenses())
    ids = list[dict[str, str]]()
    for _ in range(3):
        robot.pass_time(0.1)
        frame = robot.detect("overhead")
        assert frame is not None
        ids.append({one.label: one.id for one in frame.detections})
    assert ids[0] == ids[1] == ids[2]
    assert set(ids[0].values()) == {str(i + 1) for i in range(len(scene.objects))}


@pytest.mark.long
def test_things_that_are_picked_and_placed_keep_their_ids(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = list[dict[str, str]]()
    detect = SimRobot.detect

    def noted(self: SimRobot, name: str) -> Frame | None:
        frame = detect(self, name)
        if frame is not None and name == "overhead":
            seen.append({one.label: one.id for one in frame.detections})
        return frame

    monkeypatch.setattr(SimRobot, "detect", noted)
    assert run(["campaign", "--seeds", "1", "--noise", "--profile", "ideal", "--out", str(tmp_path)]) == 0
    every = {(label, name) for ids in seen for label, name in ids.items()}
    assert len(every) == len(seen[0]) == 2


@pytest.mark.long
@pytest.mark.requirement("B-63", "R-15")
def test_a_table_15_mm_higher_than_believed_is_refused_and_right_when_it_was_measured() -> None:
    demo = load_scene("demo")
    scene = demo.model_copy(update={"table": demo.table.at(demo.table.top_z + 0.015)})
    believed, measured = (SimRobot(scene, SimulatedSenses(), table=table) for table in (demo.table, scene.table))
    for robot, code in ((believed, Code.TABLE_MISMATCH), (measured, None)):
        robot.pass_time(0.1)
        frames = [robot.detect("overhead") for _ in range(3)]
        assert frames[-1] is not None
        labels = {d.label for d in frames[-1].detections} - {SUPPORT}  # a table that is believed lower is one
        assert labels == {item.label for item in scene.objects}
        assert {None if d.measured else d.code for d in frames[-1].detections} == {code}
        assert robot.motion.scene.fixed[0].T[2, 3] == pytest.approx(robot.table.top_z - robot.table.thickness / 2.0)
    heights = {item.label: item.size[2] for item in scene.objects}
    for seen in frames[-1].detections:
        assert seen.size[2] == pytest.approx(heights[seen.label], abs=0.003)


@pytest.mark.requirement("R-27")
def test_parameters_are_those_that_the_supervisor_gives_the_nodes_and_set_changes_both(tmp_path: Path) -> None:
    sets = ("motion.planning.seed=7", "motion.map.use=required")
    node_arguments(load_graph("sim", sets=sets), "motion", tmp_path)
    written = yaml.safe_load((tmp_path / "params" / "motion.yaml").read_text())["motion"]["ros__parameters"]
    motion = suite_config(sets).motion
    for name, value in written.items():
        here: object = motion
        for part in name.split("."):
            here = getattr(here, part)
        assert here == value, name
    assert (motion.planning.seed, motion.map.use) == (7, "required")
    assert suite_config().motion != motion
    assert suite_config().motion == load_graph("sim").config("motion", MotionConfig)
    refused("no node 'motoin'", suite_config, ("motoin.planning.seed=7",))
