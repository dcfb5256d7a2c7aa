# SPDX-License-Identifier: Apache-2.0
"""`openarm view` as a user runs it."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from openarm_bringup import cli
from openarm_bringup.commands.view import redirect

ROOT = Path(__file__).parents[2]


def test_a_browser_gets_a_private_page_that_leads_to_the_address(tmp_path: Path) -> None:
    page = redirect(tmp_path, "http://127.0.0.1:1/#secret")
    assert page.stat().st_mode & 0o777 == 0o600
    assert 'content="0;url=http://127.0.0.1:1/#secret"' in page.read_text()
    assert "secret" not in page.as_uri()


def test_a_port_that_is_taken_is_named(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # a graph that runs on this machine is not found
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert cli.run(["view", "--port", port]) == 1
    said = capsys.readouterr().err
    assert f"can't listen on 127.0.0.1:{port}" in said
    assert "--port" in said


@pytest.mark.long
def test_it_prints_an_address_that_opens_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "openarm_bringup.cli", "view", "--port", "0"]
    env = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
    first = subprocess.Popen(command, env=env, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    try:
        printed = re.search(r"the page is at (http://127\.0\.0\.1:\d+/)#([\w-]{32})$", first.stderr.readline())
        assert printed is not None
        with urllib.request.urlopen(printed[1], timeout=60.0) as page:
            shown = page.read().decode()
        assert "<title>OpenArm</title>" in shown
        assert printed[2] not in shown
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(urllib.request.Request(f"{printed[1]}stop", method="POST"), timeout=60.0)
    finally:
        first.send_signal(signal.SIGINT)
        assert first.wait(timeout=60.0) == 0
