# SPDX-License-Identifier: Apache-2.0
"""Domains of one's own."""

from __future__ import annotations

import socket
import subprocess
import sys

import pytest

from openarm_common import domain as domains
from openarm_common.domain import release_domain, reserve_domain
from openarm_common.errors import OpenArmError


@pytest.fixture
def three(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Only three domains exist, none of those that others are given."""
    monkeypatch.setattr(domains, "DOMAINS", [220, 221, 222])
    return [220, 221, 222]


def test_no_domain_is_given_twice_until_it_is_given_back(three: list[int]) -> None:
    got = [reserve_domain() for _ in three]
    try:
        assert sorted(got) == three
        with pytest.raises(OpenArmError, match="in use"):
            reserve_domain()
        release_domain(got[1])
        assert reserve_domain() == got[1]
    finally:
        for domain in got:
            release_domain(domain)


def test_another_process_gets_another_domain_until_this_one_ends(three: list[int]) -> None:
    script = (
        "from openarm_common import domain as d; d.DOMAINS = [220, 221, 222]\n"
        "print(d.reserve_domain(), flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        theirs = int(other.stdout.readline())
        ours = [reserve_domain(), reserve_domain()]
        assert sorted([*ours, theirs]) == three
        other.communicate("\n", timeout=10.0)
    ours.append(reserve_domain())
    assert sorted(ours) == three
    for domain in ours:
        release_domain(domain)


@pytest.mark.parametrize("port", [0, 10, 16], ids=["of_all", "of_the_first", "of_the_fourth"])
def test_a_domain_in_which_a_discovery_port_is_held_is_not_given(three: list[int], port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
        held.bind(("0.0.0.0", 7400 + 250 * 221 + port))
        ours = [reserve_domain(), reserve_domain()]
        assert sorted(ours) == [220, 222]
    for domain in ours:
        release_domain(domain)
