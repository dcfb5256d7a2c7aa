# SPDX-License-Identifier: Apache-2.0
"""`openarm doctor`: what in this machine and installation would keep the suite from working, and what to do."""

from __future__ import annotations

import errno
import importlib
import importlib.util
import json
import os
import platform
import socket
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from openarm_bringup.doctor import checks, graph
from openarm_bringup.doctor.checks import Finding
from openarm_bringup.outcome import Outcome, as_text
from openarm_common.errors import Code, OpenArmError

if TYPE_CHECKING:
    from openarm_bringup.supervision.runs import RunRecord

MARKS = {"ok": "[green]ok[/green]", "note": "[yellow]note[/yellow]", "error": "[bold red]error[/bold red]"}

#: Three groups of packages that must import (row by row, so that the first fault is named).
GROUPS: Mapping[str, tuple[str, ...]] = {
    "messages": ("openarm_interfaces.msg", "control_msgs.action", "vision_msgs.msg", "tf2_msgs.msg", "sensor_msgs.msg"),
    "simulator": ("mujoco",),
    "planner": ("ompl", "pinocchio", "ruckig", "numba"),
}

_RENDER = """
import time, mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><light/><geom size='1 1 1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 240, 320) as renderer:
    renderer.update_scene(data)
    renderer.render()
    began = time.perf_counter()
    renderer.update_scene(data)
    picture = renderer.render()
    print((time.perf_counter() - began) * 1000 if picture.any() else "black picture")
"""


def doctor(*, graph: str = "sim") -> Outcome:
    """Check versions, ROS, rendering, shared memory, ports and running graphs, with advice on each fault.

    Args:
        graph: Graph whose needs the machine is checked for; of real, also CAN interfaces, priorities and cameras.
    """
    findings = list(gather(graph))
    errors = [finding for finding in findings if finding.level == "error"]
    data = {"findings": [vars(finding) for finding in findings]}
    text = _table(findings)
    if errors:
        first = errors[0]
        message = f"{len(errors)} of {len(findings)} checks failed; {first.name}: {first.advice or first.observed}"
        return Outcome(False, message, Code.ENVIRONMENT, data, text)
    return Outcome(True, f"all {len(findings)} checks passed", data=data, text=text)


def gather(graph: str) -> list[Finding]:
    """Make all checks, the simulator's version first; those that wait, at the same time."""
    environ = dict(os.environ)  # as it is before a graph is joined
    with ThreadPoolExecutor() as threads:
        of_graph = threads.submit(_graph_findings, graph)
        opencv, render = threads.submit(_opencv_links_gl), threads.submit(_render_times)
        failed = {purpose: _failed_imports(names) for purpose, names in GROUPS.items()}
        installed = {
            dist.metadata["Name"].lower(): dist.version for dist in metadata.distributions() if dist.metadata["Name"]
        }
        version = (sys.version_info.major, sys.version_info.minor)
        findings = checks.check_versions(installed)
        findings.append(checks.check_system(_os_release(), platform.libc_ver()))
        findings.append(checks.check_python(version, platform.system(), platform.machine()))
        findings.append(checks.check_opencv(installed, opencv.result()))
        rclpy = importlib.util.find_spec("rclpy")
        rclpy_version = installed.get("ros-rclpy") or installed.get("rclpy") or "unknown"
        findings += checks.check_ros(environ, rclpy.origin if rclpy else None, rclpy_version, sys.prefix)
        findings += checks.check_rmw(environ)
        from_wheels = bool(rclpy and rclpy.origin and rclpy.origin.startswith(sys.prefix))
        findings += checks.check_security(environ, from_wheels)
        findings += [checks.check_imports(failed[purpose], purpose, names) for purpose, names in GROUPS.items()]
        findings.append(checks.check_gl(render.result(), environ.get("MUJOCO_GL", "egl")))
        findings += of_graph.result()
        findings.append(_robot())
        domain = environ.get("ROS_DOMAIN_ID", "") or "0"
        findings.append(checks.check_domain(domain, _first_ephemeral_port()))
        if findings[-1].level != "error":
            port = 7400 + 250 * int(domain)
            findings.append(checks.check_port(port, _can_share(port)))
        findings.append(_machine())
        if graph == "real":
            findings += _hardware()
    return findings


def _hardware() -> list[Finding]:
    """Check what the motors and cameras of a real robot need."""
    import resource

    from openarm_bringup.doctor import hardware
    from openarm_common.motors.wiring import load_wiring

    try:
        wiring = load_wiring()
    except OpenArmError as error:
        return [checks.error("motors", error.message, "write it as docs/hardware.md says")]
    sys_, dev, findings = Path("/sys"), Path("/dev"), list[Finding]()
    for address in dict.fromkeys(arm.bus for arm in wiring.arms.values()):
        if address.startswith("python-can:"):
            found = importlib.util.find_spec("can") is not None
            findings.append(hardware.check_python_can(address, installed=found))
        else:
            name = address.partition(":")[2]
            findings += hardware.check_can(address, sys_, _link(name), flexible=wiring.flexible)
        findings.append(hardware.check_motors(address, wiring))
    limits = [resource.getrlimit(kind)[1] for kind in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK)]
    findings.append(hardware.check_priority(limits[0], limits[1], root=os.geteuid() == 0))
    videos = [path for path in dev.glob("video*") if os.access(path, os.R_OK | os.W_OK)]
    library = not _failed_imports(("openarm_hardware.cameras.realsense",)) and _has_realsense()
    return [*findings, *hardware.check_cameras(sys_, dev, [path.name for path in videos], library=library)]


def _has_realsense() -> bool:
    from openarm_hardware.cameras.realsense import library

    try:
        library()
    except OpenArmError:
        return False
    return True


def _link(name: str) -> Mapping[str, Any] | None:
    """Return what `ip` says of an interface; None without it."""
    command = ["ip", "-details", "-statistics", "-json", "link", "show", name]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
        rows = json.loads(done.stdout or "[]")
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return None
    return rows[0] if rows else None


def _table(findings: list[Finding]) -> str:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, show_header=False)
    for wrap in (False, False, True):
        table.add_column(no_wrap=not wrap, overflow="fold")
    for finding in findings:
        advice = f"\n→ {finding.advice}" if finding.advice else ""
        table.add_row(MARKS[finding.level], finding.name, Text(finding.observed + advice))
    return as_text(table)


def _graph_findings(name: str) -> list[Finding]:
    import shutil

    from openarm_bringup.supervision import runs, shm
    from openarm_bringup.supervision.graph import load_graph

    usage = shutil.disk_usage(shm.SHM)
    need = shm.shm_need_mib(load_graph(name), extra_participants=4)
    findings = [checks.check_shm(usage.total / 2**20, usage.free / 2**20, need, name)]
    running = runs.running()
    observed = "; ".join(f"{run.graph} in domain {run.domain}: {run.health} (pid {run.pid})" for run in running)
    findings.append(Finding("graphs", "ok", observed or "none is running"))
    findings += checks.check_reach([run.discovery for run in running])
    latest = [] if running else [runs.runs_root() / "latest"]  # the last that has ended
    folders = [*(Path(run.run_dir) for run in running), *(path.resolve() for path in latest if path.exists())]
    findings += [graph.check_recordings(folder) for folder in folders]
    for run in running:
        findings += graph.check_nodes(run)
        if run.ready_nodes:
            findings += graph.check_status(run, _status(run))
    return findings


def _status(run: RunRecord) -> graph.GraphStatus:
    """Have the nodes of a graph asked, by a process of its own; nothing where none is discovered."""
    command = [sys.executable, "-m", "openarm_bringup.cli", "node", "health", "--domain", str(run.domain), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    data = json.loads(done.stdout)
    return graph.GraphStatus(data.get("rates", {}), data.get("diagnostics", {}), data.get("nodes", []))


def _failed_imports(names: tuple[str, ...]) -> dict[str, str]:
    failed: dict[str, str] = {}
    for name in names:
        try:
            importlib.import_module(name)
        except (ImportError, OSError, AttributeError) as error:
            failed[name] = str(error).partition("\n")[0]
    return failed


def _opencv_links_gl() -> bool:
    """Return whether cv2 loads libGL, by the memory maps of a process that imports it."""
    code = "import cv2; print('libGL.so' in open('/proc/self/maps').read())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    return (done.returncode != 0 and "libGL" in done.stderr) or done.stdout.strip() == "True"


def _render_times() -> dict[str, float | str]:
    backends = ("egl", "osmesa")
    with ThreadPoolExecutor() as threads:
        return dict(zip(backends, threads.map(_render_time, backends), strict=True))


def _render_time(backend: str) -> float | str:
    """Return the time of a picture, ms, or why there is none."""
    env = {**os.environ, "MUJOCO_GL": backend}
    env.pop("PYOPENGL_PLATFORM", None)
    command = [sys.executable, "-c", _RENDER]
    try:
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=60, check=False)
    except subprocess.TimeoutExpired:
        return "no picture within 60 s"
    words = (done.stdout.strip() or done.stderr.strip()).splitlines()
    try:
        return float(words[-1]) if words else "no answer"
    except ValueError:
        return f"failed ({words[-1][:80]})"


def _os_release() -> Mapping[str, str]:
    try:
        return platform.freedesktop_os_release()
    except OSError:  # there is none
        return {}


def _first_ephemeral_port() -> int:
    path = Path("/proc/sys/net/ipv4/ip_local_port_range")
    return int(path.read_text(encoding="ascii").split()[0]) if path.exists() else 32768


def _can_share(port: int) -> bool:
    """Return whether a UDP port can be opened as Fast DDS opens that of discovery: shared (SO_REUSEADDR)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            return False
    return True


def _robot() -> Finding:
    """What the robot of the graph that runs, or else of this process, is called, and whether its folder can be read."""
    from openarm_common.camera.cameras import load_cameras
    from openarm_common.robot.folder import load_folder, robot_name

    try:
        _, robot = load_folder(robot_name())
        cameras = ", ".join(load_cameras()) or "none"
    except OpenArmError as error:
        return checks.error(
            "robot", error.message, "mend its folder in models/robots, or name another by OPENARM_ROBOT"
        )
    return checks.ok("robot", f"{robot_name()}: arms {', '.join(robot.arms)}; cameras {cameras}")


def _machine() -> Finding:
    import psutil

    release = platform.release().lower()
    return checks.check_machine(
        cores=len(os.sched_getaffinity(0)),
        memory_gib=psutil.virtual_memory().total / 2**30,
        load=os.getloadavg()[0],
        display=bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")),
        wsl="microsoft" in release,
    )
