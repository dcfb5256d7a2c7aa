# SPDX-License-Identifier: Apache-2.0
"""Campaigns: tasks by seed, rows, resume, reports, and grasps that really run in this process."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import openarm_grasp
from openarm_bringup import cli
from openarm_common import se3
from openarm_common.errors import Code
from openarm_common.octree.codec import read_file
from openarm_evaluation.campaign import campaign, in_process_robot, report, trial
from openarm_evaluation.campaign.campaign import run_campaign
from openarm_evaluation.campaign.options import CampaignOptions
from openarm_evaluation.campaign.progress import pace
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks.suites import SUITES, make_task
from openarm_evaluation.campaign.tasks.task import FaultPlan
from openarm_evaluation.campaign.tasks.things import THINGS
from openarm_grasp.config import GraspConfig
from openarm_grasp.requests.request import GraspOutcome, GraspRequest
from openarm_grasp.strategies.registry import carry_out
from openarm_octomap.config import GridConfig
from openarm_octomap.grid import OccupancyGrid
from tests.refusals import refused
from tests.tag_paint import paint


def row(
    seed: int, *, placed: bool = True, attempts: int = 1, false: bool = False, expected=("placed",), code="OK",
    detector: str = "color",
):  # fmt: skip
    """A row as `campaign_trial.row_of` makes it, of one object."""
    grasp = {"label": "red", "attempts": attempts, "arm": "left", "placed": placed,
             "place_error_mm": 2.0 if placed else None, "sim_s": 10.0,
             "states": [{"state": "LIFT", "seconds": 1.5}]}  # fmt: skip
    right = not false and (placed if "placed" in expected else code in expected)
    return {
        "set": "nominal", "seed": seed, "detector": detector, "kind": "nominal", "scene_hash": "abc",
        "objects": 1, "targets": 1, "outcome": "placed" if placed else "failed", "as_expected": right,
        "expected": list(expected), "placed": placed,
        "false_success": false, "code": code, "message": "a < b", "reasons": [], "arm": "left", "attempts": attempts,
        "place_error_mm": grasp["place_error_mm"], "sim_s": 10.0, "wall_s": 1.0, "grasps": [grasp], "again": "cmd",
    }  # fmt: skip


@pytest.mark.requirement("N-01", "N-04", "N-19")
def test_rates_carry_wilson_intervals_and_attempts() -> None:
    rows = [row(0), row(1, attempts=2), row(2, placed=False, code="GRASP_LOST"), row(3, false=True, placed=False)]
    s = report.summarise(rows)
    assert (s["success"], s["possible"], s["first_attempt"], s["false_success"]) == (2, 4, 1, 1)
    # Wilson's interval of 2 of 4 at 95 %: 0.150 to 0.850
    assert s["success_rate"]["low"] == pytest.approx(0.150, abs=1e-3)
    assert s["success_rate"]["high"] == pytest.approx(0.850, abs=1e-3)
    assert s["attempts"] == {1: 1, 2: 1}
    assert s["causes"] == {"GRASP_LOST": 1, "false success": 1}
    assert s["state_s"] == {"LIFT": 1.5}


def test_impossible_rows_count_apart() -> None:
    rows = [row(0), row(1, placed=False, expected=("TOO_WIDE",), code="TOO_WIDE"),
            row(2, placed=False, expected=("TOO_WIDE",), code="NO_PLAN")]  # fmt: skip
    s = report.summarise(rows)
    assert s["possible"] == 1
    assert (s["refused_right"]["count"], s["refused_right"]["n"]) == (1, 2)


@pytest.mark.requirement("P-13", "P-14")
def test_reports_are_written_in_three_forms(tmp_path) -> None:
    rows = [row(0), row(1, placed=False, code="GRASP_LOST")]
    done = campaign.Campaign(tmp_path, CampaignOptions(seeds=(0, 1)), rows, wall_s=7.2)
    assert campaign.write_reports(done)["scenes_per_hour"] == 1000
    assert json.loads((tmp_path / "campaign.json").read_text())["summary"]["n"] == 2
    with (tmp_path / "campaign.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [(line["seed"], line["code"], line["again"]) for line in lines] == [
        ("0", "OK", "cmd"),
        ("1", "GRASP_LOST", "cmd"),
    ]
    page = (tmp_path / "campaign.html").read_text()
    assert "a &lt; b" in page
    assert 'href="failures/1"' in page


def test_resume_runs_only_what_is_missing_and_drops_a_torn_line(tmp_path, monkeypatch) -> None:
    ran: list[int] = []

    def fake(options: CampaignOptions, seed: int, folder) -> dict:
        ran.append(seed)
        return row(seed)

    monkeypatch.setattr(campaign, "run_one", fake)
    run_campaign(CampaignOptions(seeds=(0, 1)), tmp_path)
    with (tmp_path / campaign.ROWS).open("a") as file:
        file.write('{"seed": 2, "torn')
    done = run_campaign(CampaignOptions(seeds=(0, 1, 2, 3)), tmp_path)
    assert ran == [0, 1, 2, 3]
    assert sorted(r["seed"] for r in done.rows) == [0, 1, 2, 3]
    refused("noise was False", run_campaign, CampaignOptions(seeds=(4,), noise=True), tmp_path)


@pytest.mark.requirement("N-01")
def test_a_campaign_with_several_detectors_reports_the_rate_of_each(tmp_path, monkeypatch, capsys) -> None:
    """The network fails on seeds 1 and 2; folders of each can be gone on with, and the page leads to them."""
    ran: list[tuple[str, int]] = []

    def fake(options: CampaignOptions, seed: int, folder: Path) -> dict:
        ran.append((folder.name, seed))
        good = options.detector == "color" or seed in (0, 3)
        return row(seed, placed=good, code="OK" if good else "GRASP_MISSED")

    monkeypatch.setattr(campaign, "run_one", fake)
    command = ["campaign", "--seeds", "0-3", "--detectors", "network,color", "--out", str(tmp_path), "--json"]
    for _ in range(2):
        assert cli.run(command) != 0
        capsys.readouterr()
    assert ran == [(kind, seed) for kind in ("color", "network") for seed in range(4)]
    data = json.loads((tmp_path / "campaign.json").read_text())
    rates = data["summary"]["detectors"]
    assert {kind: (rate["count"], rate["n"]) for kind, rate in rates.items()} == {"color": (4, 4), "network": (2, 4)}
    # Wilson's interval of 2 of 4 at 95 %
    assert (rates["network"]["low"], rates["network"]["high"]) == pytest.approx((0.150, 0.850), abs=1e-3)
    assert dict(report.figures(data))["placed with detector network"].startswith(
        "2 of 4 = 50.0 % (95 %: 15.0 to 85.0 %)"
    )
    page = (tmp_path / "campaign.html").read_text()
    assert "2 of 4 = 50.0 % (95 %: 15.0 to 85.0 %)" in page
    assert 'href="network/failures/1"' in page
    assert cli.run([*command[:3], "--detectors", "color,smell", "--json"]) != 0
    assert "'smell' do not exist; there are color, network, both, tag, anything" in capsys.readouterr().out


def test_the_pace_counts_new_rows_alone() -> None:
    assert pace(0, 60, 10.0) == ""
    assert pace(10, 50, 36.0) == "1000 scenes an hour, 0:03:00 left"


def test_clutter_is_five_to_eight_objects_each_asked_for() -> None:
    tasks = [make_task("clutter", seed) for seed in range(10000, 10020)]
    assert {len(task.labels) for task in tasks} == {5, 6, 7, 8}
    for task in tasks:
        assert sorted(task.labels) == sorted(item.label for item in task.scene.objects)
        assert len({item.name for item in task.scene.objects}) == len(task.labels)


@pytest.mark.long
def test_tasks_come_from_set_and_seed_alone() -> None:
    for name in set(SUITES) - set(THINGS):  # for those see test_things.py
        assert make_task(name, 7) == make_task(name, 7)
    refused("nominal", make_task, "nothing", 0)


def trials(task, tmp_path, **kwargs) -> trial.Trials:
    return trial.Trials(task, SimulatedSenses(depth_noise=False), GraspConfig(), folder=tmp_path, **kwargs)


@pytest.mark.long
@pytest.mark.requirement("P-14")
def test_a_refusal_keeps_its_reason_when_nothing_else_is_in_view(tmp_path, monkeypatch) -> None:
    """The order asks for another object of the label, and there is none, then for that one by its place."""
    run = trials(replace(make_task("nominal", 10001), labels=("anything",)), tmp_path)
    wide = GraspOutcome(Code.TOO_WIDE, "90 mm, expected at most 80", "anything", object_position=(0.3, 0.1, 0.4))
    none = GraspOutcome(Code.UNKNOWN_OBJECT, "nothing is in view besides 1 that must stay", "anything")
    answers = iter((wide, none, wide, none))

    def grasp(ask: GraspRequest) -> trial.Trial:
        answer = next(answers)
        run._ends = (answer.place_position, answer.object_position)
        return run._trial(ask.label, answer, (), 0.0)

    monkeypatch.setattr(run, "_grasp", grasp)
    row = run.run()
    assert (row["code"], row["message"]) == ("TOO_WIDE", "90 mm, expected at most 80")


def test_of_several_that_were_lifted_the_one_at_the_place_is_judged(tmp_path) -> None:
    """One may have been dropped at an earlier attempt, from higher up."""
    run = trials(replace(make_task("nominal", 10001), labels=("anything",)), tmp_path)
    run.robot.pass_time(0.2)
    rises = (0.20, 0.10)
    for (name, track), rise in zip(sorted(run.robot.tracks.items()), rises, strict=True):
        track.append(replace(track[-1], p_world=track[-1].p_world + np.array([0.0, 0.0, rise])))
        placed = name
    x, y, z = (float(v) for v in run.robot.tracks[placed][0].p_world)
    answer = GraspOutcome(Code.PLACE_FAILED, "", "anything", attempts=2, place_position=(x, y, z))
    assert run.link.run(run._trial("anything", answer, (), 0.0)).target == placed
    nowhere = replace(answer, place_position=(0.0, 0.0, 0.0))
    assert run.link.run(run._trial("anything", nowhere, (), 0.0)).target != placed


@pytest.mark.long
@pytest.mark.requirement("R-01")
def test_heavy_soft_late_arms_with_wrong_zeros_are_identified_and_place_an_object(tmp_path) -> None:
    options = CampaignOptions(seeds=(0,), noise=True, profile="openarm", dynamics_seeds=(41,))
    (row,) = run_campaign(options, tmp_path).rows
    assert (row["outcome"], row["attempts"]) == ("placed", 1)
    assert row["place_error_mm"] < 6.0
    assert sorted(path.name for path in (tmp_path / "servos" / "41" / "servos").glob("*.yaml")) == [
        "left.yaml",
        "right.yaml",
    ]
    assert "--dynamics-seeds 41" in row["again"]


@pytest.mark.long
@pytest.mark.requirement("B-01", "B-70", "R-18")
def test_two_objects_are_placed_one_after_the_other_without_a_reset(tmp_path) -> None:
    """Asked for by shape, and by colour and shape; each is judged as the object that the words mean."""
    task = make_task("nominal", 10001)
    assert [(item.color, item.shape) for item in task.scene.objects] == [("red", "box"), ("green", "cylinder")]
    run = trials(replace(task, labels=("cube", "green cylinder")), tmp_path / "f")
    found = run.run()
    assert found["placed"], found["message"]
    assert found["targets"] == 2
    assert found["place_error_mm"] < 20.0
    assert not (tmp_path / "f").exists()  # nothing is kept of what went as expected
    names = [step.state for step in run.steps]
    assert names.count("PLACE") >= 2
    assert names[-1] == "IDLE"


@pytest.mark.requirement("P-17")
def test_an_object_is_picked_by_the_tag_on_it(tmp_path) -> None:
    """Painted into the images of both cameras where its top is seen; neither colour nor shape is asked for."""
    task = replace(make_task("nominal", 10001), labels=("tag_7",))
    run = trial.Trials(task, SimulatedSenses(depth_noise=False, detector="tag"), GraspConfig(), folder=tmp_path)
    robot, item = run.robot, task.scene.objects[0]
    draw = robot.draw

    def truth() -> np.ndarray:
        return robot.world.object(item.name).T_world_object

    def draw_tagged(name: str):
        rgb, depth = draw(name)
        if rgb is not painted.get(name):
            T_camera_base = se3.inverse(robot.camera_pose(robot.cameras[name], robot.states.latest()[0]))
            T = T_camera_base @ truth() @ se3.make(p=(0.0, 0.0, item.size[2] / 2.0))
            paint(rgb, depth * 1e-3, robot.cameras[name].intrinsics, T, 7, 0.045)
            painted[name] = rgb
        return rgb, depth

    painted: dict[str, np.ndarray] = {}
    robot.draw = draw_tagged
    start = truth()[:3, 3]
    outcome = run.link.run(carry_out(run.grasp_task(GraspRequest("tag_7"))))
    assert (outcome.code, outcome.label) == (Code.OK, "tag_7"), outcome.message
    there = truth()[:3, 3]
    assert np.linalg.norm(there[:2] - outcome.place_position[:2]) < 0.02
    assert np.linalg.norm(there - start) > 0.05


@pytest.mark.long
@pytest.mark.requirement("N-02", "N-24")
def test_what_cannot_be_held_is_refused_and_everything_of_it_kept(tmp_path) -> None:
    task = replace(make_task("nominal", 10000), labels=("yellow",), codes=(Code.GRASP_MISSED, Code.GRASP_LOST))
    task = replace(task, fault=FaultPlan("friction_lowered", {"scale": 0.02}))
    run = trials(replace(task, codes=(Code.OK,)), tmp_path, again="openarm campaign --seeds 10000")
    found = run.run()
    assert not found["placed"]
    assert not found["false_success"]
    assert found["code"] in (Code.GRASP_MISSED, Code.GRASP_LOST, Code.HAND_COLLISION)
    assert found["attempts"] == 3
    kept = {path.name for path in tmp_path.iterdir()}
    assert {
        "row.json",
        "reason.txt",
        "joints.npz",
        "cloud.npz",
        "map.bt",
        "end_spectator.png",
        "end_overhead.png",
    } <= kept
    assert any(name.startswith("failed_0") for name in kept)
    occupied = read_file(tmp_path / "map.bt").on(OccupancyGrid(GridConfig()).lattice)[0] > 0.0
    assert 1000 < int(occupied.sum()) < 20000  # a table and what stands on it
    assert "openarm campaign --seeds 10000" in (tmp_path / "reason.txt").read_text()


@pytest.mark.requirement("P-16")
def test_nothing_that_decides_reads_ground_truth() -> None:
    """In the source; `tests/graph/test_graph.py` has the same of the topics of a running graph."""
    deciding = sorted(Path(openarm_grasp.__file__).parent.rglob("*.py"))
    assert len(deciding) > 30
    for path in (*deciding, Path(in_process_robot.__file__)):
        text = path.read_text(encoding="utf-8")
        for word in ("tracks", ".objects()", "body_pose", "qpos", "ground_truth"):
            assert word not in text, f"{path} reads {word}"
