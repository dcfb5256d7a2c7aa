# SPDX-License-Identifier: Apache-2.0
"""Checks of CAN interfaces, priorities and cameras, of what /sys and `ip` say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from openarm_bringup.commands.doctor import gather
from openarm_bringup.doctor.hardware import check_cameras, check_can, check_priority, check_python_can

pytestmark = pytest.mark.requirement("R-08", "R-09")


def interface(sys: Path, *, up: bool = True, queue: int = 128) -> None:
    folder = sys / "class" / "net" / "can0"
    (folder / "device").mkdir(parents=True)
    driver = sys / "bus" / "usb" / "drivers" / "gs_usb"
    driver.mkdir(parents=True)
    (folder / "device" / "driver").symlink_to(driver)
    (folder / "flags").write_text("0x40081\n" if up else "0x40080\n")
    (folder / "tx_queue_len").write_text(f"{queue}\n")


def link(state: str = "ERROR-ACTIVE", rate: int = 1_000_000, data_rate: int = 5_000_000) -> dict[str, Any]:
    """As iproute2 6 prints it."""
    data = {
        "state": state,
        "berr_counter": {"tx": 0, "rx": 3},
        "bittiming": {"bitrate": rate},
        "data_bittiming": {"bitrate": data_rate},
    }
    return {"ifname": "can0", "linkinfo": {"info_kind": "can", "info_data": data}}


@pytest.mark.parametrize(
    ("up", "queue", "said", "level", "text", "advice"),
    [
        (True, 128, link(), "ok", "gs_usb adapter, up, 1000000 bit/s, 5000000 for data, ERROR-ACTIVE", ""),
        (False, 128, link(), "error", "gs_usb adapter, down", "type can bitrate 1000000 dbitrate 5000000 fd on"),
        (True, 10, link(), "note", "its queue holds 10 frames", "txqueuelen 128"),
        (True, 128, link("BUS-OFF"), "error", "BUS-OFF: 0 and 3 errors", "termination"),
        (True, 128, link(rate=500_000), "error", "500000 bit/s", "bitrate 1000000"),
        (True, 128, link(data_rate=0), "error", "none for data", "dbitrate 5000000"),
        (True, 128, None, "note", "no `ip`", "iproute2"),
    ],
)
def test_a_can_interface_is_said_with_what_to_type(
    tmp_path: Path, up: bool, queue: int, said: Any, level: str, text: str, advice: str
) -> None:
    interface(tmp_path, up=up, queue=queue)
    finding = check_can("socketcan:can0", tmp_path, said, flexible=True)[0]
    assert finding.level == level
    assert text in finding.observed
    assert advice in finding.advice


def test_an_interface_that_is_not_there_is_said_with_those_that_are(tmp_path: Path) -> None:
    interface(tmp_path)
    (finding,) = check_can("socketcan:can7", tmp_path, None, flexible=True)
    assert finding.level == "error"
    assert "no interface can7; CAN interfaces: can0" in finding.observed
    assert check_python_can("python-can:pcan:X", installed=False).advice == "pip install python-can"
    assert check_python_can("python-can:pcan:X", installed=True).level == "ok"


@pytest.mark.parametrize(
    ("limit", "locked", "root", "level"),
    [(0, 65536, False, "note"), (0, 65536, True, "ok"), (80, -1, False, "ok"), (80, 65536, False, "note")],
)
def test_priorities_that_are_missing_are_said(limit: int, locked: int, root: bool, level: str) -> None:
    finding = check_priority(limit, locked, root=root)
    assert finding.level == level
    assert ("limits.d" in finding.advice) == (level == "note")


def test_a_realsense_on_usb_2_is_said(tmp_path: Path) -> None:
    for name, speed, vendor in (("1-1", "480", "8086"), ("2-1", "5000", "8086"), ("3-1", "480", "1234")):
        device = tmp_path / "bus" / "usb" / "devices" / name
        device.mkdir(parents=True)
        for key, text in (
            ("idVendor", vendor),
            ("product", "Intel(R) RealSense(TM) 435i"),
            ("speed", speed),
            ("serial", name),
        ):
            (device / key).write_text(text + "\n")
    dev = tmp_path / "dev"
    dev.mkdir()
    (dev / "video0").touch()
    found = check_cameras(tmp_path, dev, ["video0"], library=True)
    assert [(f.level, f.name.split()[-1]) for f in found] == [("error", "1-1"), ("ok", "2-1")]
    assert "480 Mbit/s" in found[0].observed
    closed = check_cameras(tmp_path, dev, [], library=False)
    assert [f.level for f in closed] == ["error", "ok", "error", "error"]
    assert "requirements-realsense.lock" in closed[2].advice
    assert "group" in closed[3].advice or "usermod" in closed[3].advice


@pytest.mark.long
def test_doctor_of_the_graph_real_checks_the_hardware() -> None:
    names = {finding.name for finding in gather("real")}
    assert "real-time priority" in names
    assert any(name.startswith("CAN ") for name in names)
    assert any(name.startswith("camera") for name in names)
