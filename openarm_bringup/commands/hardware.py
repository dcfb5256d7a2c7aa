# SPDX-License-Identifier: Apache-2.0
"""`openarm hardware`: motors of a real arm on their buses, without a graph."""

from __future__ import annotations

from typing import Annotated

from cyclopts import App, Parameter

from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code

hardware = App(name="hardware", help="Motors of a real arm on their buses, without a graph.")


@hardware.command
def scan(bus: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = ()) -> Outcome:
    """List the motors that answer on buses: state, ranges, control mode, timeout, firmware. Nothing is switched on.

    Args:
        bus: `socketcan:can0`, or as hardware.yaml says; those of the robot's folder when left out.
    """
    from openarm_common.motors.wiring import load_wiring
    from openarm_hardware.scan import scanned

    wiring = load_wiring()
    buses = bus or tuple(dict.fromkeys(arm.bus for arm in wiring.arms.values()))
    found = scanned(buses, wiring)
    lines = [f"{'bus':<20}{'id':>4}  {'status':<22}{'rad':>8}{'°C':>5}  mode       timeout  firmware  ranges"]
    for m in found:
        celsius = f"{m.celsius}" if m.celsius is not None else ""
        q = f"{m.q:.3f}" if m.q is not None else ""
        ranges = "/".join(f"{x:g}" for x in m.ranges)
        state = f"{m.bus:<20}{m.id:>4}  {m.status:<22}{q:>8}{celsius:>5}"
        lines.append(f"{state}  {m.mode:<9}  {m.timeout_s:<7g}  {m.firmware:<8}  {ranges}")
    data = {"motors": [vars(motor) for motor in found]}
    if not found:
        text = f"no motor answers on {', '.join(buses)}; is the arm's power on, its bus up and at the right bitrate?"
        return Outcome(False, text, Code.NOT_READY, data)
    return Outcome(True, f"{len(found)} motors answer", data=data, text="\n".join(lines))
