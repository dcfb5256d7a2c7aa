# SPDX-License-Identifier: Apache-2.0
"""`openarm test`: what is asked of pytest."""

from __future__ import annotations

import os
import subprocess

import pytest

from openarm_bringup.commands import checks


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The command lines that would have run, on two processors."""
    commands: list[list[str]] = []

    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(checks.subprocess, "run", run)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    return commands


@pytest.mark.parametrize("args", [(), ("-x",), ("-k", "machine"), ("-n", "0")])
def test_all_tests_are_shared_out_a_file_each_and_what_is_said_last_holds(
    asked: list[list[str]], args: tuple[str, ...]
) -> None:
    assert checks.test(*args).success
    compile_kernels, command = asked
    assert compile_kernels[-1] == "openarm_bringup.warm"
    assert command[command.index("-n") + 1] == "3"
    assert {"--dist=loadfile", "--max-worker-restart=0"} < set(command)
    assert command[len(command) - len(args) :] == list(args)
    assert {"tests/graph/test_graph.py", "tests/nodes/test_tf.py", "tests/test_import_graph.py"} < set(command)


@pytest.mark.parametrize(
    "args", [("tests/test_import_graph.py", "-x"), ("tests/nodes/test_tf.py::test_of_time",), ("--pdb",), ("-s",)]
)
def test_chosen_files_and_debuggers_have_one_process(asked: list[list[str]], args: tuple[str, ...]) -> None:
    checks.test(*args)
    assert "-n" not in asked[0]
    assert asked[0][-len(args) :] == list(args)


def test_one_processor_has_one_process(asked: list[list[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    checks.test()
    assert "-n" not in asked[0]


def test_byte_code_of_what_the_tests_import_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[dict[str, str]] = []

    def run(command: list[str], *, env: dict[str, str], **_: object) -> subprocess.CompletedProcess[str]:
        given.append(env)
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(checks.subprocess, "run", run)
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    checks.test()
    assert given[0] == {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
