# SPDX-License-Identifier: Apache-2.0
"""`openarm hardware`: motors of a real arm on their buses, without a graph; and hands, by the running one."""

from __future__ import annotations

import json
import math
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from openarm_bringup.commands.connect import Domain, check_arms, join_graph, requires_node
from openarm_bringup.outcome import Outcome, console
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import write_whole

if TYPE_CHECKING:
    from openarm_common.motors.axis import Axis
    from openarm_common.robot.description import RobotDescription

Emulated = Annotated[bool, Parameter(negative=())]

hardware = App(name="hardware", help="Motors of a real arm on their buses, without a graph; hands, with one.")


@hardware.command
def scan(bus: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = ()) -> Outcome:
    """List the motors that answer on buses: state, ranges, control mode, timeout, firmware. Nothing is switched on.

    Args:
        bus: `socketcan:can0`, or as hardware.yaml says; those of the robot's folder when left out.
    """
    from openarm_common.motors.wiring import load_wiring
    from openarm_hardware.scan import scanned, silence, unset

    wiring = load_wiring()
    buses = bus or tuple(dict.fromkeys(arm.bus for arm in wiring.arms.values()))
    found = scanned(buses, wiring)
    lines = [
        f"{'bus':<20}{'id':>4}{'reply':>7}  {'status':<22}{'rad':>8}{'°C':>5}  mode       timeout s  firmware  ranges"
    ]
    for m in found:
        celsius = f"{m.celsius}" if m.celsius is not None else ""
        q = f"{m.q:.3f}" if m.q is not None else ""
        ranges = "/".join(f"{x:g}" for x in m.ranges)
        state = f"{m.bus:<20}{m.id:>4}{m.reply_id:>#7x}  {m.status:<22}{q:>8}{celsius:>5}"
        lines.append(f"{state}  {m.mode:<9}  {m.timeout_s:<9g}  {m.firmware:<8}  {ranges}")
    data = {"motors": [vars(motor) for motor in found]}
    heard = {motor.bus for motor in found}
    wrong = [*(silence(address, wiring) for address in buses if address not in heard), *unset(found, wiring)]
    text = "\n".join(lines if found else ())
    if wrong:
        return Outcome(False, "; ".join(wrong), Code.NOT_READY, data, text)
    return Outcome(True, f"{len(found)} motors answer", data=data, text=text)


@hardware.command
def set_id(bus: str, motor: int, *, to: int = 0) -> Outcome:
    """Set the ids of a motor, and read them back; it keeps them without power. Connect new motors one by one.

    Args:
        bus: Same as for `scan`.
        motor: Its present id.
        to: Its new one; 0: it keeps it, and only its replies get the id that hardware.yaml expects.
    """
    from openarm_common.motors.wiring import load_wiring
    from openarm_hardware import upkeep

    wiring = load_wiring()
    new, offset = to or motor, wiring.joints.reply_offset
    upkeep.set_id(bus, motor, new, offset, flexible=wiring.flexible)
    return Outcome(True, f"motor {motor} of {bus} has id {new:#x} now, and answers with {new + offset:#x}")


@hardware.command
def zero(*joints: str, yes: Annotated[bool, Parameter(negative=())] = False, emulated: Emulated = False) -> Outcome:
    """Put the zeros of motors where their joints are now. Says what that changes, and asks before it does it.

    Motors keep their zero without power; offsets of hardware.yaml, calibrations and stored postures are of the old one.

    Args:
        joints: Names; all of an arm: its name.
        yes: Do not ask.
        emulated: Motors of a simulation alone (docs/hardware.md), by ROS_DOMAIN_ID.
    """
    from openarm_common.motors.wiring import load_wiring
    from openarm_hardware.upkeep import zeros

    flexible = load_wiring().flexible
    _, axes = _axes(emulated=emulated)
    chosen = [axis for axis in axes if axis.joint in joints or axis.arm in joints]
    known = {axis.joint for axis in axes} | {axis.arm for axis in axes}
    if not joints or not set(joints) <= known:
        wrong = next((joint for joint in joints if joint not in known), "")
        text = f"no joint or arm {wrong!r}" if wrong else "name the joints, or an arm"
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{text}; there are: {', '.join(sorted(known))}")
    would = zeros(chosen, flexible=flexible, write=False)
    at = {axis.joint: 0.0 - axis.offset / axis.ratio for axis in chosen}
    lines = [f"{z.joint:<28} is at {z.before:8.4f} {z.unit}, will be {at[z.joint]:8.4f} {z.unit} there" for z in would]
    shown = console()
    shown.print("\n".join(lines), markup=False, highlight=False)
    if not yes:
        shown.print("Motors keep this without power. Postures, calibrations and plans of before are wrong after it.")
        if not sys.stdin.isatty() or input("type zero to do it: ").strip() != "zero":
            return Outcome(False, "nothing was changed; `--yes` does it without asking", Code.CANCELLED)
    done = zeros(chosen, flexible=flexible, write=True)
    text = "\n".join(f"{z.joint:<28} was at {z.before:8.4f} {z.unit}, is at {z.after:8.4f} {z.unit}" for z in done)
    forgotten = _forget_posture(emulated=emulated)
    return Outcome(
        True, f"zeros of {len(done)} motors were set{forgotten}", data={"zeros": list(map(vars, done))}, text=text
    )


@hardware.command
def jog(joint: str, degrees: float, *, emulated: Emulated = False) -> Outcome:
    """Move one joint there and back at 0.2 rad/s, its arm carried; then the arm sinks, and its motors are switched off.

    Args:
        joint: Its name.
        degrees: Angle, up to 30 either way.
        emulated: Same as for `zero`.
    """
    from openarm_common.collision.self_collision import SelfCollision
    from openarm_common.motors.wiring import load_wiring
    from openarm_control.joints import arm_loads
    from openarm_hardware.jog import Jog
    from openarm_hardware.settings import Settings
    from openarm_hardware.touch import TouchGuard

    robot, axes = _axes(emulated=emulated)
    arm = next((axis.arm for axis in axes if axis.joint == joint and not axis.grips), None)
    if arm is None:
        names = ", ".join(axis.joint for axis in axes if not axis.grips)
        raise OpenArmError(Code.INVALID_ARGUMENT, f"no joint {joint[:60]!r}; joints: {names}")
    mine = [axis for axis in axes if axis.arm == arm]
    guard = TouchGuard(SelfCollision(robot, [axis.joint for axis in mine]))
    settings = Settings(flexible=load_wiring().flexible, silent=100 if emulated else Settings().silent)
    found = Jog(mine, joint, arm_loads(robot)[arm], guard, settings).run(math.radians(degrees))
    there, back = (math.degrees(q - found.start) for q in (found.there, found.back))
    message = (
        f"{joint} went {there:.2f}° there and was {back:+.2f}° off its place back; other joints moved by up to"
        f" {math.degrees(found.others):.2f}°; {found.hottest} °C; {found.scheduling}"
    )
    return Outcome(True, message, data=vars(found), text="\n".join(found.turns))


@hardware.command
def learn_hand(
    *, arm: str = "", yes: Annotated[bool, Parameter(negative=())] = False, domain: Domain = None
) -> Outcome:
    """Learn where the fingers of this hand stop: in the running graph, they close, open and close where the arm is.

    Stored as calibrations are. Asks before it does it: nothing may be between the fingers, nor come there.

    Args:
        arm: Arm of the hand; those of all arms when not given.
        yes: Do not ask.
    """
    join_graph(domain)
    check_arms(arm)
    from openarm_common.robot.description import RobotDescription
    from openarm_grasp.ros.client import GraspClient

    robot = RobotDescription.load()
    arms = robot.arm_names if arm in ("", "auto") else (arm,)
    for name in arms:
        robot.hand(name)  # raises, when it has none
    if not yes:
        shown = (
            f"The fingers close, open and close, of: {', '.join(arms)}. Nothing may be between them, nor come there."
        )
        console().print(shown, markup=False, highlight=False)
        if not sys.stdin.isatty() or input("type learn to do it: ").strip() != "learn":
            return Outcome(False, "nothing was moved; `--yes` does it without asking", Code.CANCELLED)
    said: list[str] = []
    with requires_node("grasp", "sim"), GraspClient() as client:
        for name in arms:
            answer = client.learn_hand(name)
            said.append(answer.message)
            if not answer.success:
                return Outcome(False, "; ".join(said), answer.code)
    return Outcome(True, f"{'; '.join(said)}. Grasps use it now; motion does from the next start of the graph on")


@hardware.command
def record_gains(out: Path, *, against: Path | None = None, emulated: Emulated = False) -> Outcome:
    """Write down what is set in the motors: gains of their own loops, ranges, protections, firmware. Only asks.

    Args:
        out: JSON file.
        against: An earlier record; what differs is listed, as after an exchange of a motor or its firmware.
        emulated: Same as for `zero`.
    """
    from openarm_common.motors.wiring import load_wiring
    from openarm_common.robot.folder import robot_name
    from openarm_hardware.upkeep import changed, gains, read_gains

    before = read_gains(against) if against is not None else None
    _, axes = _axes(emulated=emulated)
    found = gains(axes, flexible=load_wiring().flexible)
    write_whole(out, json.dumps({"robot": robot_name(), "motors": found}, indent=1).encode())
    differs = changed(before, found) if before is not None else []
    message = f"registers of {len(found)} motors are in {out}"
    if differs:
        return Outcome(
            False, f"{message}; {len(differs)} differ from {against}", Code.CONFIG_INVALID, text="\n".join(differs)
        )
    return Outcome(True, message, data={"motors": found})


def _axes(*, emulated: bool) -> tuple[RobotDescription, tuple[Axis, ...]]:
    """Return the robot and its motors, those of a simulation by the ROS domain."""
    from openarm_common.motors.bus import emulated_buses
    from openarm_common.motors.wiring import axes_of, load_wiring
    from openarm_common.robot.description import RobotDescription

    robot = RobotDescription.load()
    buses = emulated_buses(int(os.environ.get("ROS_DOMAIN_ID") or 0), robot.arm_names) if emulated else None
    return robot, axes_of(load_wiring(), robot, buses)


def _forget_posture(*, emulated: bool) -> str:
    """Forget where the joints were last seen; return what to say of it."""
    from openarm_hardware.posture import LastPosture

    path = LastPosture("", "_emulated" if emulated else "").path
    if not path.is_file():
        return ""
    path.unlink()
    return f"; where the joints were last seen ({path}) was forgotten"
