# SPDX-License-Identifier: Apache-2.0
"""Unused ROS domains, for tests and for graphs that must not interact with others on this machine."""

from __future__ import annotations

import random
import socket

from openarm_common.errors import Code, OpenArmError

#: Domains whose ports lie below those that Linux gives to other programs.
DOMAINS = range(1, 102)

_held: dict[int, socket.socket] = {}


def reserve_domain() -> int:
    """Return a random ROS domain that is unused on this machine, reserved until this process ends.

    A domain is in use when any participant holds a discovery port of it, or when another process has reserved it. Each
    participant has a port of its own: one that remains of an earlier owner is found, too, whatever its number.

    Raises:
        OpenArmError: ENVIRONMENT, when every domain is in use.
    """
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        base = 7400 + 250 * domain
        if not all(_port_free(port) for port in (base, *range(base + 10, base + 250, 2))):
            continue
        # An abstract socket name belongs to one process and vanishes with it.
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            claim.bind(f"\0openarm-ros-domain-{domain}")
        except OSError:
            claim.close()
            continue
        _held[domain] = claim
        return domain
    raise OpenArmError(
        Code.ENVIRONMENT, f"all ROS domains from {DOMAINS[0]} to {DOMAINS[-1]} are in use on this machine"
    )


def release_domain(domain: int) -> None:
    """Give a reserved domain back before the process ends."""
    claim = _held.pop(domain, None)
    if claim is not None:
        claim.close()


def _port_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("0.0.0.0", port))
        except OSError:
            return False
    return True
