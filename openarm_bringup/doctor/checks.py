# SPDX-License-Identifier: Apache-2.0
"""Checks of the machine and the installation, as functions of what was measured; each returns findings with advice."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from openarm_bringup.supervision.discovery import ACROSS_MACHINES, LAST_DOMAIN, exposure

Level = Literal["ok", "note", "error"]

#: The one ROS distribution that the suite is built for, and the major version of its rclpy.
DISTRO = "jazzy"
RCLPY_MAJOR = 7
#: UDP ports that fifty participants of a domain take from its first one on.
PORTS = 110
PYTHONS = ((3, 11), (3, 12), (3, 13))
#: ID → VERSION_ID of /etc/os-release that the suite is tested on, and the least glibc that the wheels are built for.
SYSTEMS = (("debian", "12"), ("ubuntu", "24.04"))
GLIBC = (2, 28)

#: Distribution → (lowest version, first unsupported one, purpose); mujoco is checked first.
WANTED: Mapping[str, tuple[tuple[int, ...], tuple[int, ...] | None, str]] = {
    "mujoco": ((4, 0), None, "simulator"),
    "opencv-python-headless": ((4, 13), (5,), "images; 5.0 has no calibrateHandEye"),
    "numpy": ((2, 0), None, "arrays"),
    "scipy": ((1, 11), None, "geometry"),
    "numba": ((0, 60), None, "kernels"),
    "pin": ((3, 0), None, "kinematics"),
    "ompl": ((2, 0), None, "planner"),
    "ruckig": ((0, 14), None, "trajectories"),
    "pydantic": ((2, 0), None, "configuration"),
}


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Args:
        name: Name of the check.
        level: ok, note (works, with a limitation) or error (will not work).
        observed: Observation, in words.
        advice: Advice; empty when there is nothing to do.
    """

    name: str
    level: Level
    observed: str
    advice: str = ""


def ok(name: str, observed: str) -> Finding:
    """Return the finding of a check that passed."""
    return Finding(name, "ok", observed)


def note(name: str, observed: str, advice: str) -> Finding:
    """Return the finding of a limitation."""
    return Finding(name, "note", observed, advice)


def error(name: str, observed: str, advice: str) -> Finding:
    """Return the finding of a fault."""
    return Finding(name, "error", observed, advice)


def version_tuple(text: str) -> tuple[int, ...]:
    """Return the leading numbers of a version."""
    return tuple(int(part) for part in re.findall(r"\d+", text.split("+")[0])[:3])


def check_system(os_release: Mapping[str, str], libc: tuple[str, str]) -> Finding:
    """Check the operating system: one that is tested, one that is not, or one where the wheels can't be loaded.

    Args:
        os_release: Fields of /etc/os-release; empty where there is none.
        libc: Name and version of the C library, such as ("glibc", "2.36"); empty when they are unknown.
    """
    name, (library, version) = os_release.get("PRETTY_NAME") or os_release.get("ID") or "unknown", libc
    observed = f"{name}, {library or 'unknown C library'} {version}".rstrip()
    if library != "glibc" or version_tuple(version) < GLIBC:
        advice = f"the wheels need glibc {'.'.join(map(str, GLIBC))} or later, as Debian 12 and Ubuntu 24.04 have"
        return error("system", observed, advice)
    if (os_release.get("ID", ""), os_release.get("VERSION_ID", "")) in SYSTEMS:
        return ok("system", f"{observed}: supported")
    advice = "tested are Debian 12 and Ubuntu 24.04; what fails here may work there, or in a container of one of them"
    return note("system", f"{observed}: not among the tested ones", advice)


def check_python(version: tuple[int, int], system: str, machine: str) -> Finding:
    """Check interpreter and machine: the ROS wheels exist for CPython 3.11 to 3.13 on Linux x86-64."""
    observed = f"CPython {version[0]}.{version[1]} on {system} {machine}"
    if (system, machine) != ("Linux", "x86_64"):
        advice = "the ROS 2 wheels exist for Linux x86_64 only; elsewhere build the suite with colcon in a native Jazzy"
        return error("python", observed, advice)
    if version not in PYTHONS:
        return error("python", observed, "use CPython 3.11, 3.12 or 3.13 (OPENARM_PYTHON=/path ./openarm)")
    return ok("python", observed)


def check_versions(installed: Mapping[str, str]) -> list[Finding]:
    """Check the installed versions against what the suite was built with; the simulator comes first."""
    findings: list[Finding] = []
    for name, (lowest, first_bad, purpose) in WANTED.items():
        version = installed.get(name)
        wanted = f">= {'.'.join(map(str, lowest))}" + (f", < {'.'.join(map(str, first_bad))}" if first_bad else "")
        if version is None:
            findings.append(
                error(name, f"not installed ({purpose})", f"run ./openarm again, or install {name} {wanted}")
            )
        elif version_tuple(version) < lowest or (first_bad and version_tuple(version) >= first_bad):
            findings.append(error(name, f"{version} ({purpose})", f"needs {wanted}; remove .venv and run ./openarm"))
        else:
            findings.append(ok(name, f"{version} ({purpose})"))
    return findings


def check_opencv(installed: Mapping[str, str], links_gl: bool) -> Finding:
    """Check which OpenCV is there: only the headless build needs no libGL and fights with no other."""
    others = [name for name in installed if name.startswith("opencv-") and name != "opencv-python-headless"]
    if others:
        advice = f"they overwrite each other: uninstall {', '.join(others)}, then reinstall opencv-python-headless"
        return error("opencv build", f"{', '.join(others)} next to the headless one", advice)
    if links_gl:
        return error("opencv build", "linked against libGL", "install opencv-python-headless instead")
    return ok("opencv build", "headless, needs no libGL")


def check_ros(environ: Mapping[str, str], rclpy_file: str | None, rclpy_version: str, prefix: str) -> list[Finding]:
    """Check that there is one ROS, that it is Jazzy, and that wheels and a sourced ROS are not mixed."""
    if rclpy_file is None:
        return [error("ros", "rclpy cannot be imported", "run ./openarm, or source /opt/ros/jazzy/setup.sh")]
    sourced = sorted(
        {
            found
            for key in ("AMENT_PREFIX_PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "CMAKE_PREFIX_PATH")
            for found in re.findall(r"/opt/ros/([a-z]+)", environ.get(key, ""))
        }
        | ({environ["ROS_DISTRO"]} if environ.get("ROS_DISTRO") else set())
    )
    if len(sourced) > 1:
        advice = f"source one only: open a shell that does not source {' or '.join(d for d in sourced if d != DISTRO)}"
        return [error("ros", f"several ROS distributions are sourced: {', '.join(sourced)}", advice)]
    if sourced and sourced != [DISTRO]:
        return [error("ros", f"ROS {sourced[0]} is sourced", f"the suite is for {DISTRO}; open a shell without it")]
    from_wheels = rclpy_file.startswith(prefix)
    if sourced and from_wheels:
        advice = "use one of them: ./openarm leaves a sourced ROS aside; a colcon workspace needs no .venv"
        return [error("ros", f"ROS {DISTRO} is sourced, but rclpy comes from the wheels in {prefix}", advice)]
    major = version_tuple(rclpy_version)[:1]
    if major and major != (RCLPY_MAJOR,):
        return [error("ros", f"rclpy {rclpy_version}", f"{DISTRO} has rclpy {RCLPY_MAJOR}; another ROS shadows it")]
    origin = f"wheels in {prefix}" if from_wheels else f"a native ROS {DISTRO}"
    return [ok("ros", f"rclpy {rclpy_version} from {origin}, no other ROS is sourced")]


def check_rmw(environ: Mapping[str, str]) -> list[Finding]:
    """Check the variables that decide how processes find each other."""
    findings: list[Finding] = []
    rmw = environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    if rmw == "rmw_fastrtps_cpp":
        findings.append(ok("rmw", rmw))
    else:
        advice = "large images rely on the Fast DDS profile of the suite; unset RMW_IMPLEMENTATION"
        findings.append(note("rmw", rmw, advice))
    if environ.get("ROS_LOCALHOST_ONLY", "0") == "1":
        advice = "it is deprecated and overrides ROS_AUTOMATIC_DISCOVERY_RANGE; unset it"
        findings.append(note("discovery", "ROS_LOCALHOST_ONLY is set", advice))
    else:
        reach = environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "localhost (set by the graph)")
        findings.append(ok("discovery", reach))
    if environ.get("FASTRTPS_DEFAULT_PROFILES_FILE"):
        advice = (
            "every process takes it, and with a large segment each takes that much of /dev/shm; unset it unless wanted"
        )
        findings.append(note("fast dds profile", environ["FASTRTPS_DEFAULT_PROFILES_FILE"], advice))
    return findings


def check_security(environ: Mapping[str, str], from_wheels: bool) -> list[Finding]:
    """Check whether SROS 2 is asked of Fast DDS wheels, which were built without it; nothing where it is not asked.

    Args:
        environ: The environment.
        from_wheels: Whether ROS comes from the wheels, not from a native installation.
    """
    if environ.get("ROS_SECURITY_ENABLE", "").lower() != "true":
        return []
    if from_wheels:
        advice = (
            "the wheels are built without DDS security: nodes either refuse to start or talk unprotected; unset it, "
            "and keep others out as docs/two_machines.md says, or use a native ROS 2 (docs/native.md)"
        )
        return [error("security", "ROS_SECURITY_ENABLE=true", advice)]
    advice = "the suite brings no keystore and is not tested with SROS 2"
    return [note("security", "ROS_SECURITY_ENABLE=true", advice)]


def check_reach(reaches: Sequence[str]) -> list[Finding]:
    """Check whether graphs that run are open to the network, by their reaches of discovery."""
    return [note("network", f"discovery {reach}", exposure(reach)) for reach in sorted({*reaches} & {*ACROSS_MACHINES})]


def check_domain(text: str, first_ephemeral_port: int) -> Finding:
    """Check ROS_DOMAIN_ID: a number, and its ports below those that the system gives to other programs."""
    if not text.isdecimal() or int(text) > LAST_DOMAIN:
        return error("domain", f"ROS_DOMAIN_ID={text!r}", "set a number from 0 to 101")
    last_port = 7400 + 250 * int(text) + PORTS
    if last_port >= first_ephemeral_port:
        advice = f"its UDP ports (up to {last_port}) can be taken by other programs; choose one from 0 to 101"
        return note("domain", f"ROS_DOMAIN_ID={text}", advice)
    return ok("domain", f"ROS_DOMAIN_ID={text}, UDP ports {last_port - PORTS} to {last_port}")


def check_port(port: int, free: bool) -> Finding:
    """Check that the domain's discovery port can be used on this machine."""
    if not free:
        advice = "another program holds it without sharing; choose another ROS_DOMAIN_ID"
        return error("ports", f"UDP {port}, for discovery, cannot be opened", advice)
    return ok("ports", f"UDP {port}, for discovery, can be opened")


def check_shm(total_mib: float, free_mib: float, need_mib: float, graph: str) -> Finding:
    """Check /dev/shm against what the graph takes of it."""
    observed = f"{free_mib:.0f} of {total_mib:.0f} MiB free, graph {graph} needs {need_mib:.0f}"
    if free_mib >= need_mib:
        return ok("/dev/shm", observed)
    if total_mib >= need_mib:
        return error("/dev/shm", observed, "stop other graphs, or remove what dead ones left: `fastdds shm clean`")
    advice = (
        "images would be lost; give the container more (`docker run --shm-size=256m`), or "
        "`mount -o remount,size=256m /dev/shm`"
    )
    return error("/dev/shm", observed, advice)


def check_gl(milliseconds: Mapping[str, float | str], chosen: str) -> Finding:
    """Check the off-screen renderers, each with its time for one image or why it failed."""
    observed = ", ".join(
        f"{name} {value:.0f} ms" if isinstance(value, float) else f"{name} {value}"
        for name, value in milliseconds.items()
    )
    if isinstance(milliseconds.get(chosen), float):
        return ok("rendering", f"MUJOCO_GL={chosen}: {observed}; no display is needed")
    working = [name for name, value in milliseconds.items() if isinstance(value, float)]
    if working:
        return error("rendering", observed, f"set MUJOCO_GL={working[0]}")
    return error("rendering", observed, "install a software renderer: apt-get install libegl1 libgl1 libegl-mesa0")


def check_imports(failed: Mapping[str, str], purpose: str, names: Sequence[str]) -> Finding:
    """Check that all packages of one purpose can be imported."""
    if not failed:
        return ok(purpose, f"{', '.join(names)} can be imported")
    name, why = next(iter(failed.items()))
    return error(purpose, f"{name} cannot be imported: {why}", "run ./openarm again; it repairs the installation")


def check_machine(cores: int, memory_gib: float, load: float, display: bool, wsl: bool) -> Finding:
    """Check the machine; a display is never needed."""
    observed = f"{cores} cores, {memory_gib:.0f} GiB, load {load:.1f}, {'WSL, ' if wsl else ''}"
    observed += f"{'a' if display else 'no'} display (none is needed)"
    if cores < 2:
        return note("machine", observed, "images and control share one core: slower than real time")
    if load > cores:
        return note("machine", observed, "other programs are busy; images may come late")
    return ok("machine", observed)
