# SPDX-License-Identifier: Apache-2.0
"""Which processes meet: ROS domain, reach of discovery and Fast DDS profile, as variables of the environment."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from openarm_common.resources import config_dir

Discovery = Literal["localhost", "subnet", "off", "system_default"]
#: Reaches of discovery that go beyond this machine.
ACROSS_MACHINES = ("subnet", "system_default")
#: Largest ROS_DOMAIN_ID; there are no UDP ports above.
LAST_DOMAIN = 232
#: The variable that names the Fast DDS profile of a process.
PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"


def variables(domain: int, discovery: str) -> dict[str, str]:
    """Return the variables that decide which other processes a process meets."""
    found = {"ROS_DOMAIN_ID": str(domain)}
    if discovery != "system_default":
        found["ROS_AUTOMATIC_DISCOVERY_RANGE"] = discovery.upper()
    return found


def exposure(discovery: str) -> str:
    """Return a warning that the network can command the robot; empty where discovery stays on this machine."""
    if discovery not in ACROSS_MACHINES:
        return ""
    return (
        f"discovery {discovery}: whoever is on this network can see the cameras and move the arms, without a password; "
        "docs/two_machines.md says how to keep others out"
    )


def network_profile() -> Path:
    """Return the Fast DDS profile of processes that receive images from another machine."""
    return config_dir() / "fastdds_network.xml"
