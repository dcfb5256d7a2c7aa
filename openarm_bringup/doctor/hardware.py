# SPDX-License-Identifier: Apache-2.0
"""Checks of what a real arm needs of the machine: CAN interfaces, priorities, cameras; of what /sys and `ip` say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from openarm_bringup.doctor.checks import Finding, error, note, ok
from openarm_common.errors import OpenArmError
from openarm_common.motors.wiring import Wiring

#: Bits a second of arbitration and of data, as the maker sets them.
BITRATE, DATA_BITRATE = 1_000_000, 5_000_000
#: Frames that the queue of an interface must hold: eight motors, twice, with room for a stop.
QUEUE = 64
#: Real-time priority that the process of the motors asks for, and bytes that it locks.
PRIORITY, LOCKED = 60, 64 << 20
#: Vendor of RealSense cameras, and Mbit/s of USB 3.
_INTEL, _USB3 = "8086", 5000


def check_can(address: str, sys: Path, link: Mapping[str, Any] | None, *, flexible: bool) -> list[Finding]:
    """Check the interface of a bus `socketcan:NAME`.

    Args:
        address: Address of hardware.yaml.
        sys: /sys.
        link: Output of `ip -details -statistics -json link show NAME`; None without `ip`.
        flexible: Whether frames are sent as CAN FD.
    """
    name = address.partition(":")[2]
    what, folder = f"CAN {name}", sys / "class" / "net" / name
    if not folder.is_dir():
        there = ", ".join(sorted(path.name for path in (sys / "class" / "net").glob("*can*"))) or "none"
        advice = "plug the adapter in; an adapter without a driver in the kernel: bus `python-can:INTERFACE:CHANNEL`"
        return [error(what, f"there is no interface {name}; CAN interfaces: {there}", advice)]
    driver = folder / "device" / "driver"
    adapter = f"{driver.resolve().name} adapter" if driver.exists() else "no adapter (virtual)"
    rates = f"bitrate {BITRATE}" + (f" dbitrate {DATA_BITRATE} fd on" if flexible else "")
    set_up = f"sudo ip link set {name} down; sudo ip link set {name} type can {rates}; sudo ip link set {name} up"
    if not int((folder / "flags").read_text(), 16) & 1:
        return [error(what, f"{adapter}, down", set_up)]
    findings = list[Finding]()
    queue = int((folder / "tx_queue_len").read_text())
    if queue < QUEUE:
        advice = f"sudo ip link set {name} txqueuelen 128"
        findings.append(note(what, f"its queue holds {queue} frames, expected {QUEUE} or more", advice))
    if link is None:
        advice = "install iproute2 to have bitrate and errors checked"
        return [*findings, note(what, f"{adapter}, up; there is no `ip` to ask for its bitrate", advice)]
    data = link.get("linkinfo", {}).get("info_data", {})
    rate = data.get("bittiming", {}).get("bitrate", 0)
    data_rate = data.get("data_bittiming", {}).get("bitrate", 0)
    if rate != BITRATE or (flexible and data_rate != DATA_BITRATE):
        expected = f"{BITRATE}" + (f" and {DATA_BITRATE} for data" if flexible else "")
        observed = f"{adapter}, {rate} bit/s, {data_rate or 'none'} for data; expected {expected}"
        return [*findings, error(what, observed, set_up)]
    state = str(data.get("state", "unknown"))
    counters = data.get("berr_counter", {})
    errors = f"{counters.get('tx', 0)} and {counters.get('rx', 0)} errors counted in sending and receiving"
    if state != "ERROR-ACTIVE":
        advice = f"look at wiring, termination (60 Ω between the lines), the arm's power; then: {set_up}"
        findings.append(error(what, f"{adapter}, {state}: {errors}", advice))
    else:
        findings.append(ok(what, f"{adapter}, up, {rate} bit/s, {data_rate or 'none'} for data, {state}, {errors}"))
    return findings


def check_motors(address: str, wiring: Wiring) -> Finding:
    """Check that motors answer on a bus, with both kinds of frames when they do not with the one; only asks.

    Args:
        address: Address of the bus.
        wiring: Wiring of the robot.
    """
    from openarm_hardware.scan import scanned, silence, unset
    from openarm_hardware.servo import Ownership

    what = f"motors on {address}"
    try:
        owner = Ownership([address], takeover_s=0.0)
    except OpenArmError as busy:
        return note(what, busy.message, "they are asked when no process commands them")
    try:
        found = scanned([address], wiring)
        if not found:
            observed, _, advice = silence(address, wiring).partition("; ")
            return error(what, observed, advice)
    except OpenArmError as failure:
        return error(what, failure.message, "look at what is said of the bus above")
    finally:
        owner.close()
    if wrong := unset(found, wiring):
        return error(what, f"{len(found)} answer", "; ".join(wrong))
    return ok(what, f"{len(found)} answer")


def check_python_can(address: str, *, installed: bool) -> Finding:
    """Check that python-can is there for a bus that needs it."""
    if installed:
        return ok(f"CAN {address}", "by python-can, which does not say whether it is up; `openarm hardware scan` does")
    return error(f"CAN {address}", "python-can is not installed", "pip install python-can")


def check_priority(limit: int, locked: int, *, root: bool) -> Finding:
    """Check what this user may do to be in time.

    Args:
        limit: Largest real-time priority, `ulimit -r`.
        locked: Bytes of memory that may be locked, `ulimit -l`; -1: all.
        root: This user may do all.
    """
    if root or (limit >= PRIORITY and (locked < 0 or locked >= LOCKED)):
        return ok("real-time priority", "permitted" if root else f"up to {limit}")
    return note(
        "real-time priority",
        f"up to {limit}, expected {PRIORITY}; memory to lock: {'all' if locked < 0 else f'{locked >> 10} KiB'}",
        "commands of motors will be late on a busy machine; printf '%s - rtprio 80\\n%s - memlock unlimited\\n' $USER"
        " $USER | sudo tee /etc/security/limits.d/openarm.conf, and log in again; in a container: --cap-add=SYS_NICE"
        " --ulimit rtprio=80 --ulimit memlock=-1",
    )


def check_cameras(sys: Path, dev: Path, writable: Sequence[str], *, library: bool) -> list[Finding]:
    """Check cameras that are plugged in.

    Args:
        sys: /sys.
        dev: /dev.
        writable: Devices below `dev` that this user may open.
        library: pyrealsense2 can be imported.
    """
    findings = list[Finding]()
    for device in sorted((sys / "bus" / "usb" / "devices").glob("*")):
        vendor, product = _text(device / "idVendor"), _text(device / "product")
        if vendor != _INTEL or "RealSense" not in product:
            continue
        what, speed = f"camera {product} {_text(device / 'serial')}".strip(), int(float(_text(device / "speed") or 0))
        if speed < _USB3:
            advice = "plug it into a USB 3 socket (blue), with the cable that came with it; turn the plug over once"
            findings.append(error(what, f"USB at {speed} Mbit/s, expected {_USB3} or more", advice))
        else:
            findings.append(ok(what, f"USB at {speed} Mbit/s"))
    if findings and not library:
        advice = ".venv/bin/uv pip install --require-hashes -r requirements-realsense.lock"
        findings.append(error("pyrealsense2", "can't be imported", advice))
    videos = sorted(path.name for path in dev.glob("video*"))
    if closed := [name for name in videos if name not in writable]:
        advice = "sudo usermod -aG video $USER, then log in again; for RealSense also librealsense's udev rules"
        findings.append(error("cameras", f"this user may not open {', '.join(closed)}", advice))
    if not findings:
        observed = f"/dev has {', '.join(videos)}" if videos else "none is plugged in"
        advice = "" if videos else "plug it in; `lsusb` should list it"
        findings.append(Finding("cameras", "ok" if videos else "note", observed, advice))
    return findings


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace").strip() if path.is_file() else ""
