# SPDX-License-Identifier: Apache-2.0
"""Which robot a command works with: that of `--robot`, or of the graph that runs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from openarm_bringup import cli
from openarm_bringup.bags.about import about, require_robot
from openarm_bringup.bags.bag import BagWriter, open_bag
from openarm_bringup.commands import connect, doctor
from openarm_bringup.supervision import runs
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import ROBOT, per_robot, robot_name
from tests.openarm_bringup.commands import answer_of, record_of

DOMAIN = 61


@pytest.fixture(autouse=True)
def environment(monkeypatch, tmp_path):
    """What commands change in the environment ends with the test."""
    for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.setenv(name, os.environ[name])
    monkeypatch.setenv(ROBOT, "openarm_v1")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "runtime"))
    monkeypatch.setenv("OPENARM_RUNS", str(tmp_path / "runs"))
    (tmp_path / "runtime").mkdir(mode=0o700)


@pytest.fixture
def running(nearer) -> Iterator[runs.RunRecord]:
    """The record of a graph of another robot than this process's."""
    record = record_of("sim", DOMAIN, robot=nearer)
    runs.write_record(record)
    os.environ[ROBOT] = "openarm_v1"
    yield record
    runs.remove_record(record.pid)


@pytest.mark.parametrize("command", [["up"], ["campaign"], ["demo"], ["chaos"], ["model", "urdf"]])
def test_a_robot_that_is_not_there_is_refused_with_those_that_are(command, capsys):
    assert cli.run([*command, "--robot", "nobody"]) == 2
    assert "no robot 'nobody'; robots: openarm_v1" in capsys.readouterr().err
    assert robot_name() == "openarm_v1"


def test_a_command_works_with_the_robot_that_is_named(nearer, monkeypatch, capsys):
    monkeypatch.setenv(ROBOT, "openarm_v1")
    code, answer = answer_of(capsys, "model", "srdf", "--robot", nearer)
    assert (code, answer["robot"]) == (0, nearer)
    assert os.environ[ROBOT] == nearer  # and so do the processes that it starts


def test_a_command_to_a_running_graph_works_with_the_robot_of_the_graph(running):
    connect.join_graph(DOMAIN)
    assert robot_name() == running.robot


def test_a_graph_is_not_started_in_the_domain_of_another_robot(running):
    other = running.model_copy(update={"pid": os.getppid(), "pid_created": psutil.Process(os.getppid()).create_time()})
    runs.write_record(other)
    try:
        with pytest.raises(OpenArmError, match=f"domain {DOMAIN} with robot 'nearer', this graph is of 'openarm_v1'"):
            runs.refuse_twins(DOMAIN, ["anything"])
        runs.refuse_twins(DOMAIN + 1, ["anything"])
        os.environ[ROBOT] = running.robot
        runs.refuse_twins(DOMAIN, ["anything"])
    finally:
        runs.remove_record(other.pid)


def test_ps_doctor_and_bags_say_the_robot_of_the_graph(running, capsys):
    assert cli.run(["ps", "--seconds", "0.01"]) == 0
    assert f"sim: ready, robot nearer, domain {DOMAIN}" in capsys.readouterr().out.replace("not ready", "ready")
    assert about(running)["robot"] == "nearer"
    assert about(None)["robot"] == "openarm_v1"
    connect.join_graph(DOMAIN)
    assert doctor._robot().observed == "nearer: arms left, right; cameras overhead, wrist, spectator"


def test_doctor_says_what_is_wrong_with_a_robot(monkeypatch):
    monkeypatch.setenv(ROBOT, "nobody")
    found = doctor._robot()
    assert found.level == "error"
    assert "no robot 'nobody'" in found.observed


@pytest.mark.parametrize("command", [["pick", "red"], ["grasp", "release"], ["demo"]])
def test_an_arm_that_the_robot_lacks_is_refused(command, capsys):
    assert cli.run([*command, "--arm", "third"]) == 2
    assert "valid: auto, left, right" in capsys.readouterr().err


def test_arms_of_the_suites_choice_are_not_refused():
    connect.check_arms("auto", "", "left")
    with pytest.raises(OpenArmError, match="third"):
        connect.check_arms("left", "third")


def test_what_is_cached_for_a_robot_is_not_that_of_another(nearer, monkeypatch):
    made: list[str] = []

    @per_robot
    def name(suffix: str = "") -> str:
        made.append(suffix)
        return robot_name() + suffix

    assert (name("!"), name("!"), name()) == ("nearer!", "nearer!", "nearer")
    monkeypatch.setenv(ROBOT, "openarm_v1")
    assert name("!") == "openarm_v1!"
    assert made == ["!", "", "!"]


@pytest.mark.parametrize(
    ("custom", "of_v1"),
    [({"robot": "openarm_v1"}, True), ({"openarm-vision": "0.1.0"}, True), ({}, False), ({"robot": "nearer"}, False)],
)
def test_a_bag_of_another_robot_is_refused(custom, of_v1, nearer, monkeypatch, tmp_path):
    """Those that the suite made before it knew of robots are of OpenArm v1; other programs do not say it."""
    with BagWriter(tmp_path / "bag", custom):
        pass
    with open_bag(tmp_path / "bag") as bag:
        monkeypatch.setenv(ROBOT, nearer)
        if of_v1:
            with pytest.raises(OpenArmError, match=r"bag is of robot 'openarm_v1', expected 'nearer'") as caught:
                require_robot(bag)
            assert caught.value.code == Code.CONFIG_INVALID
        else:
            require_robot(bag)
        monkeypatch.setenv(ROBOT, "openarm_v1")
        if of_v1 or not custom:
            require_robot(bag)


def test_commands_refuse_a_bag_of_another_robot(nearer, capsys):
    bag = str(Path(__file__).parents[1] / "data" / "demo_pick")
    assert cli.run(["check", bag]) == 1
    assert "demo_pick is of robot 'openarm_v1', expected 'nearer'" in capsys.readouterr().err
    assert cli.run(["calibrate", "solve", bag, "--camera", "overhead"]) == 1
    assert "demo_pick is of robot 'openarm_v1', expected 'nearer'" in capsys.readouterr().err
