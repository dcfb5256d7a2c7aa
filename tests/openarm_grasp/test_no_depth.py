# SPDX-License-Identifier: Apache-2.0
"""Picks by the graph `no_depth`, whose cameras have no depth: its parameters on the robot of a campaign."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_bringup.supervision.graph import load_graph
from openarm_common.scene.scene import load_scene
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig

GRAPH = load_graph("no_depth")


@pytest.mark.requirement("B-31")
@pytest.mark.parametrize("label", ["red", pytest.param("green", marks=pytest.mark.long)])
def test_an_object_of_known_height_is_picked_without_depth(label: str) -> None:
    """The second look of the wrist camera is by silhouette too; what each camera locates is within 5 mm."""
    assert GRAPH.nodes.keys() >= {"detector", "wrist_detector", "grasp"}
    assert "octomap" not in GRAPH.nodes
    detectors = ("detector", "wrist_detector")
    sets = [f"{n}.{k}={v!r}" for n in detectors for k, v in GRAPH.parameters(n).items() if k != "scene"]
    senses = SimulatedSenses(sets=("motion.map.use=off", *sets))
    scene = load_scene("demo")
    trials = Trials(Task("nominal", 1, scene, (label,)), senses, GraspConfig())
    errors: dict[str, list[float]] = {"overhead": [], "wrist": []}
    detect, home = trials.robot.detect, trials.robot.world.read_joints().position.copy()

    def judged(camera: str):
        """Without depth it is not known which pixels are the robot: an arm in front of an object is not noticed."""
        frame = detect(camera)
        away = np.abs(trials.robot.world.read_joints().position - home).max() > 0.01
        for seen in frame.detections if frame is not None and (camera == "wrist" or not away) else ():
            objects = zip(scene.objects, trials.robot.world.objects(), strict=True)
            true = {item.color: now.T_world_object[:3, 3] for item, now in objects}
            errors[camera].append(float(np.linalg.norm(seen.p_base - true[seen.label])))
        return frame

    trials.robot.detect = judged
    row = trials.run()
    assert row["placed"], row["message"]
    assert len(errors["overhead"]) > 5
    assert len(errors["wrist"]) >= 2
    assert max(errors["overhead"] + errors["wrist"]) <= 0.005
