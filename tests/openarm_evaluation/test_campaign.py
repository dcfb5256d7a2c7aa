# SPDX-License-Identifier: Apache-2.0
"""Campaigns: tasks by seed, rows, resume, reports, and grasps that really run in this process."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_common.octree.codec import read_file
from openarm_evaluation.campaign import campaign, in_process_robot, report, trial
from openarm_evaluation.campaign.campaign import run_campaign
from openarm_evaluation.campaign.options import CampaignOptions
from openarm_evaluation.campaign.progress import pace
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks.faults import KINDS
from openarm_evaluation.campaign.tasks.suites import SUITES, make_task
from openarm_evaluation.campaign.tasks.task import FaultPlan
from openarm_grasp.config import GraspConfig
from openarm_grasp.robot import skills
from openarm_grasp.strategies import pick_and_place
from openarm_octomap.config import GridConfig
from openarm_octomap.grid import OccupancyGrid


def row(seed: int, *, placed: bool = True, attempts: int = 1, false: bool = False, expected=("placed",), code="OK"):
    """A row as `campaign_trial.row_of` makes it, of one object."""
    grasp = {"placed": placed, "arm": "left", "place_error_mm": 2.0 if placed else None, "sim_s": 10.0,
             "states": [{"state": "LIFT", "seconds": 1.5}]}  # fmt: skip
    right = not false and (placed if "placed" in expected else code in expected)
    return {
        "set": "nominal", "seed": seed, "kind": "nominal", "scene_hash": "abc", "objects": 1, "targets": 1,
        "outcome": "placed" if placed else "failed", "as_expected": right, "expected": list(expected), "placed": placed,
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
    data = campaign.write_reports(done)
    assert data["scenes_per_hour"] == 1000
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
    with pytest.raises(OpenArmError, match="noise was False"):
        run_campaign(CampaignOptions(seeds=(4,), noise=True), tmp_path)


def test_the_pace_counts_new_rows_alone() -> None:
    assert pace(0, 60, 10.0) == ""
    assert pace(10, 50, 36.0) == "1000 scenes an hour, 0:03:00 left"


def test_clutter_is_five_to_eight_objects_each_asked_for() -> None:
    tasks = [make_task("clutter", seed) for seed in range(10000, 10020)]
    assert {len(task.labels) for task in tasks} == {5, 6, 7, 8}
    for task in tasks:
        assert sorted(task.labels) == sorted(item.label for item in task.scene.objects)
        assert len({item.name for item in task.scene.objects}) == len(task.labels)


def test_tasks_come_from_set_and_seed_alone() -> None:
    for name in SUITES:
        assert make_task(name, 7) == make_task(name, 7)
    with pytest.raises(OpenArmError, match="nominal"):
        make_task("nothing", 0)


@pytest.mark.requirement("N-03")
def test_every_kind_of_fault_can_be_made_and_says_how_it_may_end() -> None:
    for i, kind in enumerate(KINDS):
        task = make_task("faults", len(KINDS) + i)
        assert task.kind == kind
        assert task.codes


def trials(task, tmp_path, **kwargs) -> trial.Trials:
    return trial.Trials(task, SimulatedSenses(depth_noise=False), GraspConfig(), folder=tmp_path, **kwargs)


@pytest.mark.requirement("B-01", "B-70")
def test_two_objects_are_placed_one_after_the_other_without_a_reset(tmp_path) -> None:
    run = trials(make_task("nominal", 10001), tmp_path / "f")
    found = run.run()
    assert found["placed"], found["message"]
    assert found["targets"] == 2
    assert found["place_error_mm"] < 20.0
    assert not (tmp_path / "f").exists()  # nothing is kept of what went as expected
    names = [step.state for step in run.steps]
    assert names.count("PLACE") >= 2
    assert names[-1] == "IDLE"


@pytest.mark.requirement("N-03", "N-05")
def test_a_nudged_object_is_looked_for_again_and_placed(tmp_path) -> None:
    task = replace(make_task("nominal", 10000), labels=("yellow",))
    name = task.scene.objects[0].name
    nudge = FaultPlan("object_nudged", {"object": name, "mm": 45.0}, when="MOVE_TO_PREGRASP")
    found = trials(replace(task, fault=nudge), tmp_path).run()
    assert found["placed"], found["message"]
    assert found["attempts"] == 2


@pytest.mark.requirement("N-03")
def test_a_gap_of_joint_states_while_the_hand_is_read_is_waited_out(tmp_path) -> None:
    tasks = (make_task("faults", seed) for seed in range(10000, 10100))
    task = next(task for task in tasks if task.kind == "joint_states_gap")
    found = trials(task, tmp_path).run()
    assert found["placed"], found["message"]


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

    for module in (skills, pick_and_place, in_process_robot):
        text = Path(module.__file__ or "").read_text()
        for word in ("tracks", ".objects()", "body_pose", "qpos"):
            assert word not in text, f"{module.__name__} reads {word}"
