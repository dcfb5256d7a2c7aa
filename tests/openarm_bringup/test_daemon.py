# SPDX-License-Identifier: Apache-2.0
"""The command line asks the daemon of a graph, and does without it whenever it is not the right one."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from openarm_bringup import cli
from openarm_bringup.daemon import client
from openarm_bringup.daemon.protocol import LONGEST, build, is_answered
from openarm_bringup.supervision.state import is_private, socket_path, state_dir
from openarm_common.errors import Code
from tests.refusals import refused

pytestmark = pytest.mark.requirement("R-26")
ROOT = Path(__file__).parents[2]
ANSWER = (["out", "/clock\n"], ["err", "a hint\n"], ["exit", 3])


class Answers:
    """A daemon of its own process's number that gives every client the same lines."""

    def __init__(self, *lines: Any, domain: int = 5, of: str | None = None) -> None:
        self.asked: list[list[str]] = []
        self._greeting = {"build": build() if of is None else of, "domain": domain}
        self._lines = lines
        state_dir().mkdir(mode=0o700, exist_ok=True)
        record = {"pid": os.getpid(), "domain": domain, "started": "2026-01-01"}
        (state_dir() / f"{os.getpid()}.json").write_text(json.dumps(record))
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(socket_path(os.getpid())))
        socket_path(os.getpid()).chmod(0o600)
        self._listener.listen()
        threading.Thread(target=self._serve, daemon=True).start()

    def close(self) -> None:
        with suppress(OSError):  # closed by its test
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        socket_path(os.getpid()).unlink(missing_ok=True)

    def _serve(self) -> None:
        while self._listener.fileno() >= 0:
            with suppress(OSError), self._listener.accept()[0] as connection:
                connection.sendall(json.dumps(self._greeting).encode() + b"\n")
                if line := connection.makefile("rb").readline():
                    self.asked.append(json.loads(line))
                    for answer in self._lines:
                        connection.sendall(json.dumps(answer).encode() + b"\n")


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    monkeypatch.delenv(client.DIRECT, raising=False)


@pytest.fixture
def answers() -> Iterator[Callable[..., Answers]]:
    made: list[Answers] = []

    def make(*lines: Any, **fields: Any) -> Answers:
        made.append(Answers(*lines, **fields))
        return made[-1]

    yield make
    for one in made:
        one.close()


@pytest.mark.parametrize(
    ("line", "answered"),
    [
        ("topic list", True),
        ("topic list --json", True),
        ("--json topic list", True),
        ("ps", True),
        ("tf echo world base", True),
        ("topic", False),
        ("topic --help", False),
        ("topic list --json out.json", False),
        ("topic list --json=out", False),
        ("tf tree --out tree.png", False),
        ("up sim", False),
        ("record bag", False),
        ("", False),
    ],
)
def test_which_commands_a_daemon_runs(line: str, answered: bool) -> None:
    assert is_answered(line.split()) is answered


@pytest.fixture
def daemon(answers: Callable[..., Answers]) -> Answers:
    return answers(*ANSWER)


def test_an_answer_is_printed_and_its_code_returned(daemon: Answers, capsys: pytest.CaptureFixture[str]) -> None:
    assert client.ask(["topic", "list"]) == 3
    assert client.ask(["topic", "list", "--domain", "5"]) == 3
    assert capsys.readouterr() == ("/clock\n" * 2, "a hint\n" * 2)
    assert daemon.asked == [["topic", "list"], ["topic", "list", "--domain", "5"]]


@pytest.mark.parametrize("words", [("--domain", "6"), ("--domain=6",), ("--domain",), ("--domain", "x")])
def test_another_domain_is_not_asked(daemon: Answers, words: tuple[str, ...]) -> None:
    assert client.ask(["topic", "list", *words]) is None
    assert daemon.asked == []


def test_the_environment_chooses_the_domain_and_can_do_without(answers: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    answers(*ANSWER)
    monkeypatch.setenv("ROS_DOMAIN_ID", "6")
    assert client.ask(["topic", "list"]) is None
    monkeypatch.setenv("ROS_DOMAIN_ID", "5")
    assert client.ask(["topic", "list"]) == 3
    monkeypatch.setenv(client.DIRECT, "1")
    assert client.ask(["topic", "list"]) is None


def test_of_graphs_in_two_domains_none_is_asked(answers: Any) -> None:
    answers(*ANSWER)
    (state_dir() / "7.json").write_text(json.dumps({"pid": 7, "domain": 9, "started": "2026-02-01"}))
    assert client.ask(["topic", "list"]) is None
    assert client.ask(["topic", "list", "--domain", "5"]) == 3
    assert client.ask(["ps"]) == 3, "it is told of all of them"


def test_another_build_is_not_asked(answers: Any) -> None:
    daemon = answers(*ANSWER, of="/elsewhere 1.0")
    assert client.ask(["topic", "list"]) is None
    assert daemon.asked == []


@pytest.mark.parametrize("what", ["folder", "socket"])
def test_what_others_can_open_is_not_asked(daemon: Answers, what: str) -> None:
    (state_dir() if what == "folder" else socket_path(os.getpid())).chmod(0o770)
    assert client.ask(["topic", "list"]) is None
    assert daemon.asked == []


@pytest.mark.requirement("R-23")
def test_what_is_another_users_is_not_asked(daemon: Answers, monkeypatch: pytest.MonkeyPatch) -> None:
    assert is_private(socket_path(os.getpid()))
    other = os.geteuid() + 1
    with monkeypatch.context() as patch:
        patch.setattr(client, "peer_uid", lambda _: other)
        assert client.ask(["topic", "list"]) is None
    monkeypatch.setattr(os, "geteuid", lambda: other)
    assert not is_private(socket_path(os.getpid()))
    assert daemon.asked == []


def test_a_link_in_the_place_of_the_folder_is_not_followed(daemon: Answers, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    state_dir().rename(tmp_path / "elsewhere" / "openarm")
    state_dir().symlink_to(tmp_path / "elsewhere" / "openarm")
    assert client.ask(["topic", "list"]) is None
    state_dir().unlink()
    (tmp_path / "elsewhere" / "openarm").rename(state_dir())
    assert daemon.asked == []


@pytest.mark.parametrize("record", [b"", b"{", b"[]", b"3", b'{"pid": "x", "domain": 5, "started": ""}', b"\xff"])
def test_a_record_that_is_none_is_passed_over(record: bytes) -> None:
    state_dir().mkdir(mode=0o700)
    (state_dir() / "9.json").write_bytes(record)
    assert client.ask(["topic", "list"]) is None


def test_a_daemon_that_does_not_answer_is_not_waited_for(answers: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    answers(*ANSWER).close()
    silent = socket.socket(socket.AF_UNIX)
    silent.bind(str(socket_path(os.getpid())))
    socket_path(os.getpid()).chmod(0o600)
    assert client.ask(["topic", "list"]) is None, "nobody listens: the supervisor is dead"
    silent.listen()
    monkeypatch.setattr(client, "_GREETING_S", 0.1)
    assert client.ask(["topic", "list"]) is None, "nobody answers: the supervisor hangs"


def test_a_daemon_that_ends_during_a_command_is_an_error(
    answers: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answers(["out", "half"])
    assert refused("ended while it ran this", client.ask, ["service", "call", "/pause"]).code is Code.INTERNAL
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", ["openarm", "service", "call", "/pause", "--json"])
    with pytest.raises(SystemExit, match="1"):
        cli.main()
    assert json.loads(capsys.readouterr().out.removeprefix("half"))["code"] == "INTERNAL"


def test_a_request_that_is_too_long_is_not_sent(daemon: Answers) -> None:
    assert client.ask(["topic", "pub", "/talk", "x" * LONGEST]) is None
    assert daemon.asked == []


def test_asking_imports_nothing_heavy(answers: Any) -> None:
    answers(["out", "/clock\n"], ["exit", 0])
    code = (
        "import sys; from openarm_bringup import cli\n"
        "try: cli.main()\n"
        "finally: print([m for m in ('rclpy', 'numpy', 'pydantic', 'psutil', 'yaml', 'cyclopts', 'rich')"
        " if m in sys.modules])"
    )
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    for words, said in (("topic list", "/clock"), ("--help", "Usage: openarm COMMAND")):
        command = [sys.executable, "-c", code, *words.split()]
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
        assert done.stdout.startswith(said)
        assert done.stdout.endswith("[]\n")


def test_the_help_says_what_the_commands_say() -> None:
    listed = " ".join(cli._help().split())
    for commands in cli.COMMANDS.values():
        for command in commands:
            name, summary = cli._summary(command)
            assert f" {name} {summary}" in listed
            module, _, target = cli._path(command).partition(":")
            loaded = getattr(import_module(module), target)
            said = loaded.help if hasattr(loaded, "help") else loaded.__doc__
            assert summary == " ".join(said.partition("\n\n")[0].split())
