# SPDX-License-Identifier: Apache-2.0
"""A lifeline ends with its process."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
import uuid

import pytest

from openarm_common.lifeline import Lifeline, watch
from tests.conftest import DEADLINE_S

CHILD = "import sys; from openarm_common.lifeline import Lifeline; l = Lifeline(sys.argv[1]); print(); sys.stdin.read()"


@pytest.mark.requirement("R-21")
def test_it_ends_when_the_process_is_killed() -> None:
    name, ended = uuid.uuid4().hex, threading.Event()
    with subprocess.Popen([sys.executable, "-c", CHILD, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        child.stdout.readline()
        assert watch(name, ended.set)
        assert not ended.wait(0.1)
        child.kill()
        assert ended.wait(20.0)


def test_it_ends_when_it_is_closed_and_is_known_only_meanwhile() -> None:
    name, ended = uuid.uuid4().hex, threading.Event()
    assert not watch(name, ended.set)
    line = Lifeline(name)
    assert watch(name, ended.set)
    line.close()
    assert ended.wait(20.0)
    assert not watch(name, ended.set)


def test_a_watch_that_has_ended_says_nothing_and_leaves_no_thread() -> None:
    name, ended = uuid.uuid4().hex, threading.Event()
    line, before = Lifeline(name), set(threading.enumerate())
    watched = watch(name, ended.set)
    assert watched is not None
    (thread,) = set(threading.enumerate()) - before
    watched.close()
    thread.join(20.0)
    assert not thread.is_alive()
    line.close()
    watched.close()
    assert not ended.is_set()
    assert not watched.ended


def test_a_process_that_beats_is_not_silent_whoever_listens_and_one_that_does_not_is() -> None:
    name = uuid.uuid4().hex
    line = Lifeline(name)
    gone, watched = watch(name), watch(name)
    assert gone is not None
    assert watched is not None
    gone.close()
    deadline = time.monotonic() + DEADLINE_S
    while watched.silence < 0.05:
        assert time.monotonic() < deadline
    silent_since = time.monotonic() - watched.silence
    for _ in range(3):  # to one that has left, too
        line.beat()
    while time.monotonic() - watched.silence <= silent_since + 0.01:
        assert time.monotonic() < deadline
    line.close()
    while not watched.ended:
        assert time.monotonic() < deadline


def test_a_name_is_that_of_one_lifeline() -> None:
    line = Lifeline(name := uuid.uuid4().hex)
    with pytest.raises(OSError, match="in use"):
        Lifeline(name)
    line.close()
    Lifeline(name).close()
