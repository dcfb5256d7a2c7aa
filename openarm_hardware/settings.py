# SPDX-License-Identifier: Apache-2.0
"""How motors are commanded and watched."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """How motors are commanded and watched. The process of the servo reads it as JSON, so it has plain fields alone.

    Attributes:
        period_s: Period of the commands.
        priority: Priority of the process under SCHED_FIFO, where the system allows it; 0: ordinary.
        flexible: Whether frames are sent as CAN FD.
        command_period_s: Period of the client's commands, between which positions are joined by lines.
        stale_s: Age of the client's command from which on the arms hold.
        silent: A motor that leaves so many replies out in a row is lost.
        jump: Largest step of a joint's commands from one to the next, rad.
        tracking: Largest distance of a joint from its command, rad.
        stuck: A joint whose reading stays the very same while its command moves by this, and by what 3 N m
            stand for, has a dead encoder, rad.
        slack: Distance that a joint may be beyond its limits at the start, rad.
        posture: A joint that is this much elsewhere than when it was last seen has a wrong zero, rad.
        hot: Temperature of MOSFET or rotor at which the arm holds, °C.
        ramp_s: Time in which the gains rise at the start.
        timeout_s: The motors switch themselves off when no command came for so long.
        orphan_s: Time for which the arms are held without a client; then they sink, damped.
        release_s: Longest time for which arms sink before their motors are switched off.
    """

    period_s: float = 0.004
    priority: int = 60
    flexible: bool = True
    command_period_s: float = 0.01
    stale_s: float = 0.1
    silent: int = 3
    jump: float = 0.15
    tracking: float = 0.4
    stuck: float = 0.1
    slack: float = 0.1
    posture: float = 0.35
    hot: int = 80
    ramp_s: float = 0.5
    timeout_s: float = 0.2
    orphan_s: float = 10.0
    release_s: float = 5.0
