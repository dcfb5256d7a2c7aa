# SPDX-License-Identifier: Apache-2.0
"""The command line: exit codes, JSON, one clear sentence for every error and never a traceback."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from openarm_bringup import cli
from openarm_bringup.commands import graph
from openarm_bringup.commands.checks import _in_order
from openarm_bringup.outcome import Outcome
from openarm_bringup.supervision import runs, session
from openarm_common.errors import Code, OpenArmError
from openarm_evaluation.campaign.options import parse_seeds
from tests.openarm_bringup.commands import answer_of, record_of
from tests.refusals import refused

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def own_folders(own_state: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENARM_RUNS", str(tmp_path / "runs"))
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def record(process: psutil.Process, graph: str, domain: int, nodes: dict[str, runs.NodeRecord], **more) -> Path:
    """Write the record of a supervisor."""
    about = {"pid": process.pid, "pid_created": process.create_time(), "ready": True}
    return runs.write_record(
        record_of(graph, domain, nodes, started=f"2026-01-01T00:00:0{domain % 10}", **(about | more))
    )


@pytest.mark.parametrize(
    ("argv", "path", "rest"),
    [
        (["ps"], None, ["ps"]),
        (["ps", "--json"], "-", ["ps"]),
        (["--json", "pick", "red"], "-", ["pick", "red"]),
        (["pick", "--json", "red"], "-", ["pick", "red"]),
        (["ps", "--json", "a/b.json"], "a/b.json", ["ps"]),
        (["ps", "--json=out.txt"], "out.txt", ["ps"]),
        (["test", "--", "--json"], None, ["test", "--", "--json"]),
    ],
)
def test_json_may_stand_anywhere_and_its_path_is_optional(argv: list[str], path: str | None, rest: list[str]) -> None:
    assert cli.take_json(argv) == (rest, path)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["frobnicate"], "Unknown command"),
        (["up", "no_such_graph"], "no graph 'no_such_graph'; give a file, or one of"),
        (["up", "--set", "grasp"], "expected node.param=value"),
        (["up", "--set", "nobody.x=1"], "has no node 'nobody'; its nodes are"),
        (["up", "--domain", "many"], "--domain"),
        (["pick", "red", "--arm", "third"], "third"),
        (["pick", "red", "--place", "1", "2"], "--place"),
        (["demo", "--seeds", "9-3"], "expected numbers such as 0-19"),
        (["logs", "grasp", "--run", "nope"], "there is no run 'nope'"),
        (["model", "step"], "step"),
    ],
)
def test_wrong_call_ends_with_2_and_one_sentence(
    argv: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    runs.new_run_dir()
    assert cli.run(argv) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("openarm: INVALID_ARGUMENT: ")
    assert words in err
    assert "Traceback" not in err


def test_refused_call_is_json_too(capsys: pytest.CaptureFixture[str]) -> None:
    code, answer = answer_of(capsys, "up", "no_such_graph")
    assert (code, answer["success"], answer["code"]) == (2, False, "INVALID_ARGUMENT")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("nodes: {a: {module: x, needs: [b]}}", "CONFIG_INVALID"),
        ("nodes: {a: {module: no_such_package.node}}", "there is no module no_such_package.node"),
    ],
)
def test_failure_ends_with_1_and_its_code(tmp_path: Path, capsys, text: str, words: str) -> None:
    bad = tmp_path / "bad.yaml"
    bad.write_text(text)
    assert cli.run(["graph", "check", str(bad)]) == 1
    assert words in capsys.readouterr().err


def test_graph_check_lists_what_it_runs_and_names_what_is_none_of_the_suite(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    foreign = {
        "extra": {"command": ["sh", "-c", "true\n\x1b[2J"]},
        "other": {"module": "json.tool"},
        "octomap": {"env": {"LD_PRELOAD": "/tmp/x.so"}},
    }
    path = tmp_path / "mine.yaml"
    path.write_text(json.dumps({"extends": "map", "nodes": foreign}))
    assert cli.run(["graph", "check", str(path)]) == 0
    out = capsys.readouterr().out
    assert "not of the suite: octomap, extra, other. Start it only if you trust" in out
    assert "LD_PRELOAD=/tmp/x.so python -m openarm_octomap.ros.node" in out
    (line,) = [line for line in out.splitlines() if line.startswith("extra ")]
    assert line.split(maxsplit=1)[1] == r"sh -c 'true\n\x1b[2J'"


def test_every_graph_of_the_suite_is_sound() -> None:
    """B-66: each step of the bring-up is a graph of its own."""
    listed = graph.list_().data["graphs"]
    assert set(listed) >= {"sim", "sim_only", "perception", "motion"}
    for name in listed:
        checked = graph.check(name)
        assert checked.success, name
        assert not checked.data["foreign"], name


def test_a_report_that_the_disk_does_not_take_is_a_failure_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "full.json").symlink_to("/dev/full")
    assert cli.run(["graph", "list", "--json", str(tmp_path / "full.json")]) == 1
    (sentence,) = capsys.readouterr().err.splitlines()
    assert sentence == f"openarm: ENVIRONMENT: can't write {tmp_path}/full.json: No space left on device"


def test_draw_writes_json_to_a_file_and_text_to_stdout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sink = tmp_path / "deep" / "graph.json"
    assert cli.run(["graph", "draw", "sim", "--form", "mermaid", "--json", str(sink)]) == 0
    assert capsys.readouterr().out.startswith("flowchart LR")
    answer = json.loads(sink.read_text())
    assert answer["success"] is True
    assert ["detector", "grasp", ["/detections_3d"]] in answer["edges"]


@pytest.mark.parametrize("discovery", ["subnet", "system_default", "localhost"])
def test_up_warns_that_the_network_can_move_the_arms_before_it_starts_anything(
    discovery: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    said: list[str] = []

    def start(*_: object, **__: object) -> None:
        said.append(capsys.readouterr().err)
        raise OpenArmError(Code.CANCELLED, "nothing is started in this test")

    monkeypatch.setattr(session, "running_graph", start)
    assert cli.run(["up", "sim_only", "--discovery", discovery]) == 1
    (text,) = said
    warned = f"warning: discovery {discovery}: whoever is on this network can see the cameras and move the arms" in text
    assert warned == (discovery != "localhost"), text


def test_ps_and_logs_find_a_running_graph(capsys: pytest.CaptureFixture[str]) -> None:
    code, answer = answer_of(capsys, "ps")
    assert (code, answer["graphs"]) == (0, [])
    me = psutil.Process()
    folder = runs.new_run_dir()
    (folder / "logs" / "arm.log").write_text("one\ntwo\nthree\n")
    node = runs.NodeRecord(state="ready", pid=me.pid, restarts=1, log=str(folder / "logs" / "arm.log"))
    record(me, "toy", 5, {"arm": node}, run_dir=str(folder))
    assert cli.run(["ps", "--seconds", "0.05"]) == 0
    text = capsys.readouterr().out
    assert "toy: ready, robot openarm_v1, domain 5" in text
    assert str(me.pid) in text
    assert cli.run(["logs", "arm", "-n", "2"]) == 0
    assert capsys.readouterr().out == "two\nthree\n"
    assert cli.run(["logs", "leg"]) == 2
    assert "it has arm" in capsys.readouterr().err
    assert runs.the_running().domain == 5
    refused(r"no graph is running in domain 6; running: toy in domain 5", runs.the_running, 6)


def test_several_graphs_are_distinguished_by_domain_and_one_that_lost_a_node_is_degraded(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Two supervisors in one domain make one graph; ones in different domains have to be chosen from."""
    others = [subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(60)"]) for _ in range(2)]
    try:
        for process, domain, state in zip(others, (5, 7), ("failed", "ready"), strict=True):
            nodes = {f"eye_{domain}": runs.NodeRecord(state=state), "arm": runs.NodeRecord(state="ready")}
            folder = tmp_path / str(domain)
            supervisor = psutil.Process(process.pid)
            record(supervisor, f"part_{domain}", domain, nodes, run_dir=str(folder), ready=state == "ready")
            (folder / "logs").mkdir(parents=True)
            (folder / "logs" / f"eye_{domain}.log").write_text(f"I am eye {domain}\n")
        assert cli.run(["ps", "--seconds", "0.05"]) == 0
        text = capsys.readouterr().out
        assert "part_5: degraded, without eye_5, robot openarm_v1, domain 5" in text
        assert "part_7: ready, robot openarm_v1, domain 7" in text
        refused(r"several graphs are running: part_5 in domain 5 .* choose one", runs.the_running)
        assert runs.the_running(5).graph == "part_5"
        first = runs.the_running(5)
        runs.write_record(first.model_copy(update={"pid": os.getpid(), "pid_created": psutil.Process().create_time()}))
        assert runs.the_running(5).domain == 5
        assert cli.run(["logs", "eye_5"]) == 0
        assert capsys.readouterr().out == "I am eye 5\n"
    finally:
        for process in others:
            process.kill()
            process.wait()
        runs.remove_record(os.getpid())


def test_a_graph_is_not_started_next_to_another_that_has_its_nodes(capsys: pytest.CaptureFixture[str]) -> None:
    other = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(60)"])
    ready = runs.NodeRecord(state="ready")
    record(psutil.Process(other.pid), "arms", 67, {"motion": ready, "eye": ready})
    try:
        code, answer = answer_of(capsys, "up", "motion", "--domain", "67")
        assert (code, answer["code"]) == (1, Code.BUSY)
        assert f"arms (supervisor {other.pid}) runs in domain 67 and has motion already" in answer["message"]
        runs.refuse_twins(67, ["hand"])  # as with eyes and hands under supervisors of their own
        runs.refuse_twins(68, ["motion"])
    finally:
        other.kill()
        other.wait()


def test_record_of_another_process_with_the_same_number_is_not_alive() -> None:
    path = record(psutil.Process(), "toy", 0, {}, pid_created=1.0)
    assert runs.running() == []
    assert not path.exists()


def test_run_folders_never_collide(tmp_path: Path) -> None:
    folders = [runs.new_run_dir(tmp_path) for _ in range(3)]
    assert len(set(folders)) == 3
    assert (tmp_path / "latest").resolve() == folders[-1]


@pytest.mark.parametrize(
    ("text", "seeds"), [("0-3", (0, 1, 2, 3)), ("7", (7,)), ("1,4,7-9", (1, 4, 7, 8, 9)), ("5-5", (5,))]
)
def test_seeds(text: str, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "-3", "3-", "a", "3-1", "1,,2", "1.5"])
def test_wrong_seeds_are_refused(text: str) -> None:
    assert refused(None, parse_seeds, text).code is Code.INVALID_ARGUMENT


def test_files_of_tests_that_wait_are_spread_among_those_that_compute() -> None:
    paths = _in_order(ROOT / "tests")
    assert sorted(paths) == sorted(str(path.relative_to(ROOT)) for path in (ROOT / "tests").rglob("test_*.py"))
    waiting = [path.startswith(("tests/nodes", "tests/graph")) for path in paths]
    third = len(paths) // 3
    counts = [sum(waiting[k : k + third]) for k in (0, third, 2 * third)]
    assert max(counts) - min(counts) <= 2


def test_the_largest_files_come_first(tmp_path: Path) -> None:
    tests = tmp_path / "tests"
    tests.mkdir()
    for name, text in {"a_small": "", "large": "#" * 90}.items():
        (tests / f"test_{name}.py").write_text(text)
    assert _in_order(tests) == ["tests/test_large.py", "tests/test_a_small.py"]


def test_outcome_exit_codes() -> None:
    assert Outcome(True).exit_code == 0
    assert Outcome(False, "no", Code.NO_PLAN).exit_code == 1
    told = {"success": False, "code": "NO_PLAN", "message": "no", "a": 1}
    assert Outcome(False, "no", Code.NO_PLAN, {"a": 1}).as_json() == told


@pytest.mark.long
def test_help_is_quick() -> None:
    command = [sys.executable, "-c", "from openarm_bringup import cli; cli.run(['--help'])"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    # CPU time, not the clock: tests run next to other work. It takes 0.4 s.
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 1.0


def test_the_shell_completes_commands_and_choices(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["completion", "bash"]) == 0
    script = tmp_path / "openarm.bash"
    script.write_text(capsys.readouterr().out)
    ask = f"source {script}; spec=$(complete -p openarm); f=${{spec#*-F }}; f=${{f%% *}}; "
    for words, expected in (("openarm topic", "topic"), ("openarm topic ec", "echo"), ("openarm param du", "dump")):
        last = len(words.split()) - 1
        line = f"COMP_WORDS=({words}); COMP_CWORD={last}; COMP_LINE='{words}'; COMP_POINT={len(words)}; $f; "
        done = subprocess.run(
            ["bash", "-c", ask + line + 'echo "${COMPREPLY[@]}"'], capture_output=True, text=True, check=True
        )
        assert expected in done.stdout.split(), (words, done.stdout, done.stderr)
