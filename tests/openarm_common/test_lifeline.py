# SPDX-License-Identifier: Apache-2.0
"""A lifeline ends with its process."""

from __future__ import annotations

import subprocess
import sys
import threading
import uuid

import pytest

from openarm_common.lifeline import Lifeline, lives, watch

CHILD = "import sys; from openarm_common.lifeline import Lifeline; l = Lifeline(sys.argv[1]); print(); sys.stdin.read()"


@pytest.mark.requirement("R-21")
def test_it_ends_when_the_process_is_killed() -> None:
    name, ended = uuid.uuid4().hex, threading.Event()
    with subprocess.Popen([sys.executable, "-c", CHILD, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        assert watch(name, ended.set)
        assert not ended.wait(0.1)
        child.kill()
        assert ended.wait(20.0)


def test_it_ends_when_it_is_closed_and_is_known_only_meanwhile() -> None:
    name, ended = uuid.uuid4().hex, threading.Event()
    assert not watch(name, ended.set)
    assert not lives(name)
    line = Lifeline(name)
    assert lives(name)
    assert watch(name, ended.set)
    line.close()
    assert ended.wait(20.0)
    assert not watch(name, ended.set)


def test_a_watch_that_has_ended_says_nothing_and_leaves_no_thread() -> None:
    name, ended = uuid.uuid4().hex, threading.Event()
    line, before = Lifeline(name), set(threading.enumerate())
    end = watch(name, ended.set)
    assert end is not None
    (thread,) = set(threading.enumerate()) - before
    end()
    thread.join(20.0)
    assert not thread.is_alive()
    line.close()
    end()
    assert not ended.is_set()
