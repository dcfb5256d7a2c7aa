# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate zeros`: from sessions of both arms to the description that every part reads, and back."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from openarm_bringup.supervision.environment import client_environment
from openarm_bringup.supervision.graph import load_graph
from openarm_calibration.handeye import zero_sets
from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.zeros import ZEROS, zeros_label
from tests.openarm_bringup.commands import answer_of
from tests.openarm_calibration.known_session import make_session

#: Degrees by joint of each arm.
OFF = (0.0, 1.2, -0.8, 1.6, -1.1, 0.9, 0.0)


def zeros_of_both() -> dict[str, float]:
    robot = RobotDescription.load()
    return {
        name: math.radians(off * sign)
        for arm, sign in (("right", 1.0), ("left", -1.0))
        for name, off in zip(robot.arm_joints(arm), OFF, strict=True)
    }


def sessions(folder: Path, count: int) -> list[str]:
    """The camera over the table with a board in each hand, that on the right hand with one on the table."""
    out, zeros = list[str](), zeros_of_both()
    for setup, arm in (("to_hand", "right"), ("to_hand", "left"), ("in_hand", "right")):
        known = make_session(setup, count, arm=arm, zeros=zeros, spread=0.5, seed=len(out))
        path = folder / f"{setup}_{arm}.npz"
        known.samples.head = known.samples.head.model_copy(update={"mount_seed": None})
        known.samples.save(path)
        out.append(str(path))
    return out


@pytest.fixture(autouse=True)
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("OPENARM_CALIBRATIONS", str(tmp_path / "store"))
    return tmp_path / "store"


@pytest.mark.long
@pytest.mark.parametrize(("count", "folds"), [(8, 2), (14, 5)])
@pytest.mark.requirement("R-11")
def test_zeros_are_found_stored_read_by_graphs_and_later_commands_and_rolled_back(
    capsys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int, folds: int
) -> None:
    monkeypatch.setattr(zero_sets, "_FOLDS", folds)
    page, taken = tmp_path / "zeros.html", sessions(tmp_path, count)
    code, answer = answer_of(capsys, "calibrate", "zeros", *taken, "--save", "--page", str(page))
    assert code == 0, answer["message"]
    text = page.read_text()
    data, truth = answer, zeros_of_both()
    assert text.count("the prior decides") == 4
    assert all(name in text for name in (*truth, "overhead_1/s001", f"wrist_3/s{count:03d}"))
    zeros = data["zeros"]
    assert set(zeros["by_prior"]) == {f"openarm_{arm}_joint{k}" for arm in ("right", "left") for k in (1, 7)}
    for name, value in zeros["offsets"].items():
        assert name in zeros["by_prior"] or math.degrees(abs(value - truth[name])) < 0.05, name
    assert data["left_out"]["after"]["metres"] < 0.3 * data["left_out"]["before"]["metres"]
    assert set(data["mounts"]) == {"overhead", "wrist"}
    assert all(mount["zeros"] == zeros_label(zeros["offsets"]) for mount in data["mounts"].values())

    # a later solve of one session, at the stored zeros, passes; nothing but the command line says so
    code, solved = answer_of(capsys, "calibrate", "solve", taken[-1])
    assert solved["figures"]["robot_rotation"] < math.radians(0.02)

    # a graph of the real robot gives all its nodes the zeros; a simulated robot has its own, which nobody stored
    environment = client_environment(load_graph("real"), tmp_path / "run")
    with monkeypatch.context() as patch:
        patch.setenv(ZEROS, environment[ZEROS])
        robot = RobotDescription.load()
        q = dict.fromkeys(robot.joints, 0.3)
        true = q | {name: q[name] + truth[name] for name in truth}
        for arm in robot.arm_names:
            ends = robot.arm(arm).base, robot.tcp_link(arm)
            found, wanted = (
                se3.inverse(one.link_pose(ends[0], at)) @ one.link_pose(ends[1], at)
                for one, at in ((robot, q), (robot.described, true))
            )
            described = se3.inverse(robot.described.link_pose(ends[0], q)) @ robot.described.link_pose(ends[1], q)
            # turned back by what the mounts take up: distance from the shoulder is free of it
            reach = [float(np.linalg.norm(T[:3, 3])) for T in (found, wanted, described)]
            assert abs(reach[0] - reach[1]) < 0.2e-3 < 0.001 < abs(reach[2] - reach[1])
    simulated = client_environment(load_graph("sim"), tmp_path / "other")[ZEROS]
    assert Path(simulated).stem == "simulated_openarm"

    code, listed = answer_of(capsys, "calibrate", "list")
    assert set(listed["zeros"]) == {"zeros"}
    # a run that has begun keeps its zeros
    assert answer_of(capsys, "calibrate", "rollback", "zeros")[0] == 0
    assert client_environment(load_graph("real"), tmp_path / "run")[ZEROS] == environment[ZEROS]
    assert answer_of(capsys, "calibrate", "list")[1]["zeros"]["zeros"]["offsets"] == {}
    code, answer = answer_of(capsys, "calibrate", "rollback", "zeros")
    assert code == 1
    assert "going back needs" in answer["message"]


@pytest.mark.long
@pytest.mark.requirement("R-11")
def test_zeros_that_are_right_are_left_alone_and_nothing_is_stored(
    capsys, tmp_path: Path, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zero_sets, "_FOLDS", 2)
    path = tmp_path / "exact.npz"
    make_session("to_hand", 10, spread=0.5).samples.save(path)
    code, answer = answer_of(capsys, "calibrate", "zeros", str(path), "--save")
    assert code == 1
    assert "nothing was stored" in answer["message"]
    assert not store.exists()


@pytest.mark.requirement("R-11")
@pytest.mark.parametrize(
    ("argv", "part"),
    [
        (["--prior", "openarm_right_joint3"], "expected joint=degrees"),
        (["--prior", "openarm_right_joint3=much"], "expected joint=degrees"),
        (["--prior", "elbow=1"], "joints: openarm_right_joint1"),
        (["--sigma", "-1"], "--sigma, --prior and --level"),
    ],
)
def test_wrong_priors_are_refused_with_what_is_valid(capsys, tmp_path: Path, argv: list[str], part: str) -> None:
    make_session(count=3).samples.save(tmp_path / "three.npz")
    code, answer = answer_of(capsys, "calibrate", "zeros", str(tmp_path / "three.npz"), *argv)
    assert code != 0
    assert part in answer["message"]
