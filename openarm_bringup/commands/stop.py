# SPDX-License-Identifier: Apache-2.0
"""`openarm stop`: the emergency stop."""

from __future__ import annotations

from openarm_bringup.commands.connect import Domain, join_graph
from openarm_bringup.outcome import Outcome


def stop(*, reset: bool = False, domain: Domain = None) -> Outcome:
    """Emergency stop: arms hold at once, hands keep what they hold, running goals end with STOPPED.

    Nothing moves until it is released with `--reset`.

    Args:
        reset: Release it.
    """
    join_graph(domain)
    from openarm_bringup.ros.stop_client import emergency_stop

    return Outcome(*emergency_stop(reset=reset))
