# SPDX-License-Identifier: Apache-2.0
"""Doctor: each fault of a machine is found and has an advice."""

from __future__ import annotations

import json
import threading
from functools import partial
from pathlib import Path

import pytest

from openarm_bringup import cli
from openarm_bringup.commands import doctor
from openarm_bringup.doctor import checks
from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.shm import check_shm, shm_need_mib
from openarm_common.errors import Code, OpenArmError

GOOD = {
    "mujoco": "4.0.0",
    "opencv-python-headless": "4.14.0.94",
    "numpy": "2.4.6",
    "scipy": "1.17.1",
    "numba": "0.68.1",
    "pin": "4.1.0",
    "ompl": "2.0.1",
    "ruckig": "0.19.4",
    "pydantic": "2.14.3",
}
PREFIX = "/home/me/suite/.venv"
WHEEL = f"{PREFIX}/lib/python3.11/site-packages/rclpy/__init__.py"
NATIVE = "/opt/ros/jazzy/lib/python3.12/site-packages/rclpy/__init__.py"


@pytest.mark.requirement("A-08")
def test_the_simulators_version_is_the_first_check() -> None:
    first = checks.check_versions(GOOD)[0]
    assert (first.name, first.level) == ("mujoco", "ok")
    assert "4.0.0" in first.observed


@pytest.mark.parametrize(
    ("name", "version"), [("mujoco", "3.9.1"), ("opencv-python-headless", "5.0.1"), ("ompl", "1.7.0")]
)
@pytest.mark.requirement("B-08")
def test_wrong_versions_are_errors_with_the_wanted_range(name: str, version: str) -> None:
    findings = {f.name: f for f in checks.check_versions({**GOOD, name: version})}
    assert findings[name].level == "error"
    assert "needs >=" in findings[name].advice
    assert all(f.level == "ok" for key, f in findings.items() if key != name)


def test_missing_package_is_an_error() -> None:
    findings = checks.check_versions({k: v for k, v in GOOD.items() if k != "pin"})
    assert [f.name for f in findings if f.level == "error"] == ["pin"]


DEBIAN = {"ID": "debian", "VERSION_ID": "12", "PRETTY_NAME": "Debian GNU/Linux 12 (bookworm)"}
UBUNTU = {"ID": "ubuntu", "VERSION_ID": "24.04", "PRETTY_NAME": "Ubuntu 24.04.3 LTS", "ID_LIKE": "debian"}
MINT = {"ID": "linuxmint", "VERSION_ID": "22", "PRETTY_NAME": "Linux Mint 22", "ID_LIKE": "ubuntu debian"}


@pytest.mark.parametrize(
    ("os_release", "libc", "level", "words"),
    [
        (DEBIAN, ("glibc", "2.36"), "ok", "Debian GNU/Linux 12 (bookworm), glibc 2.36: supported"),
        (UBUNTU, ("glibc", "2.39"), "ok", "Ubuntu 24.04.3 LTS, glibc 2.39: supported"),
        (DEBIAN | {"VERSION_ID": "13"}, ("glibc", "2.41"), "note", "not among the tested ones"),
        (DEBIAN | {"VERSION_ID": "24.04"}, ("glibc", "2.41"), "note", "not among the tested ones"),
        (MINT, ("glibc", "2.39"), "note", "Linux Mint 22, glibc 2.39: not among the tested ones"),
        ({"ID": "arch"}, ("glibc", "2.42"), "note", "arch, glibc 2.42: not among the tested ones"),
        ({}, ("glibc", "2.40"), "note", "unknown, glibc 2.40: not among the tested ones"),
        ({"ID": "centos", "VERSION_ID": "7"}, ("glibc", "2.17"), "error", "centos, glibc 2.17"),
        ({"ID": "alpine", "VERSION_ID": "3.20"}, ("", ""), "error", "alpine, unknown C library"),
    ],
)
@pytest.mark.requirement("B-08")
def test_the_operating_system_is_supported_untested_or_unusable(
    os_release: dict[str, str], libc: tuple[str, str], level: str, words: str
) -> None:
    finding = checks.check_system(os_release, libc)
    assert (finding.name, finding.level) == ("system", level)
    assert words in finding.observed
    assert bool(finding.advice) == (level != "ok")


@pytest.mark.parametrize(
    ("environ", "file", "words"),
    [
        (
            {"AMENT_PREFIX_PATH": "/opt/ros/humble:/opt/ros/jazzy"},
            NATIVE,
            "several ROS distributions are sourced: humble, jazzy",
        ),
        ({"ROS_DISTRO": "humble", "PYTHONPATH": "/opt/ros/humble/lib"}, WHEEL, "ROS humble is sourced"),
        ({"ROS_DISTRO": "jazzy", "AMENT_PREFIX_PATH": "/opt/ros/jazzy"}, WHEEL, "but rclpy comes from the wheels"),
    ],
)
@pytest.mark.requirement("B-09")
def test_more_than_one_ros_is_an_error(environ: dict[str, str], file: str, words: str) -> None:
    (finding,) = checks.check_ros(environ, file, "7.1.6", PREFIX)
    assert finding.level == "error"
    assert words in finding.observed
    assert finding.advice


def test_wheels_alone_and_native_jazzy_alone_are_both_fine() -> None:
    assert checks.check_ros({}, WHEEL, "7.1.6", PREFIX)[0].level == "ok"
    native = {"ROS_DISTRO": "jazzy", "AMENT_PREFIX_PATH": "/opt/ros/jazzy"}
    assert checks.check_ros(native, NATIVE, "7.1.2", "/usr")[0].level == "ok"


def test_rclpy_of_another_distribution_and_none_at_all_are_errors() -> None:
    assert checks.check_ros({}, WHEEL, "3.3.13", PREFIX)[0].level == "error"
    assert "cannot be imported" in checks.check_ros({}, None, "", PREFIX)[0].observed


@pytest.mark.requirement("B-11")
def test_opencv_with_a_window_system_is_an_error() -> None:
    both = checks.check_opencv({**GOOD, "opencv-python": "4.14.0"}, links_gl=False)
    assert both.level == "error"
    assert "uninstall opencv-python," in both.advice
    assert checks.check_opencv(GOOD, links_gl=True).level == "error"
    assert checks.check_opencv(GOOD, links_gl=False).level == "ok"


def test_64_mb_of_shared_memory_are_enough_for_the_whole_graph() -> None:
    """A container's default; the figure comes from the graph, not from a constant."""
    need = shm_need_mib(load_graph("sim"), extra_participants=4)
    assert 30 < need < 62
    assert checks.check_shm(64.0, 63.0, need, "sim").level == "ok"


def test_too_little_shared_memory_is_an_error_with_what_to_do() -> None:
    need = shm_need_mib(load_graph("sim"), extra_participants=4)
    full = checks.check_shm(64.0, 20.0, need, "sim")
    assert full.level == "error"
    assert "fastdds shm clean" in full.advice
    assert "--shm-size" in checks.check_shm(16.0, 16.0, need, "sim").advice
    with pytest.raises(OpenArmError) as caught:
        check_shm(load_graph("sim"), free_mib=20.0)
    assert caught.value.code == Code.ENVIRONMENT
    assert "20 MiB are free" in caught.value.message


@pytest.mark.requirement("R-26")
def test_checks_that_wait_do_so_at_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    together = threading.Barrier(4)

    def meet(result: object, *_: object) -> object:
        together.wait(60.0)  # broken, when one of them waits for another
        return result

    for name, result in (("_opencv_links_gl", False), ("_render_time", 12.0), ("_graph_findings", [])):
        monkeypatch.setattr(doctor, name, partial(meet, result))
    assert doctor.gather("sim")[0].name.startswith("mujoco")
    assert not together.broken


@pytest.mark.requirement("A-10")
def test_no_display_is_fine_and_a_failing_renderer_names_one_that_works() -> None:
    assert checks.check_machine(2, 8.0, 0.3, display=False, wsl=True).level == "ok"
    assert checks.check_gl({"egl": 12.0, "osmesa": "failed"}, "egl").level == "ok"
    other = checks.check_gl({"egl": "failed", "osmesa": 30.0}, "egl")
    assert (other.level, other.advice) == ("error", "set MUJOCO_GL=osmesa")
    assert "apt-get install libegl1" in checks.check_gl({"egl": "failed", "osmesa": "failed"}, "egl").advice


@pytest.mark.parametrize(
    ("text", "level"), [("0", "ok"), ("101", "ok"), ("102", "note"), ("250", "error"), ("x", "error")]
)
def test_domain(text: str, level: str) -> None:
    assert checks.check_domain(text, 32768).level == level


@pytest.mark.parametrize(
    ("version", "system", "machine", "level"),
    [
        ((3, 11), "Linux", "x86_64", "ok"),
        ((3, 13), "Linux", "x86_64", "ok"),
        ((3, 14), "Linux", "x86_64", "error"),
        ((3, 12), "Linux", "aarch64", "error"),
        ((3, 12), "Darwin", "arm64", "error"),
    ],
)
@pytest.mark.requirement("N-17")
def test_python_and_machine(version: tuple[int, int], system: str, machine: str, level: str) -> None:
    assert checks.check_python(version, system, machine).level == level


def test_environment_that_changes_discovery_is_noted() -> None:
    notes = checks.check_rmw({"ROS_LOCALHOST_ONLY": "1", "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"})
    assert [finding.level for finding in notes] == ["note", "note"]
    assert [finding.level for finding in checks.check_rmw({})] == ["ok", "ok"]


def test_sros_2_is_refused_for_the_wheels_which_are_built_without_it() -> None:
    asked = {"ROS_SECURITY_ENABLE": "true"}
    (found,) = checks.check_security(asked, from_wheels=True)
    assert (found.level, found.observed) == ("error", "ROS_SECURITY_ENABLE=true")
    assert "docs/two_machines.md" in found.advice
    assert [finding.level for finding in checks.check_security(asked, from_wheels=False)] == ["note"]
    assert checks.check_security({"ROS_SECURITY_ENABLE": "false"}, from_wheels=True) == []


def test_a_graph_that_the_network_can_command_is_noted() -> None:
    (found,) = checks.check_reach(["localhost", "subnet", "subnet"])
    assert (found.level, found.observed) == ("note", "discovery subnet")
    assert "move the arms, without a password" in found.advice


@pytest.mark.long
@pytest.mark.requirement("B-10")
def test_doctor_of_this_machine_checks_ros_simulator_and_planner(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # graphs that others run here are no fault of the machine
    code = cli.run(["doctor", "--json"])
    answer = json.loads(capsys.readouterr().out)
    names = [finding["name"] for finding in answer["findings"]]
    assert names[0] == "mujoco"
    of_software = {"system", "ros", "simulator", "planner", "messages", "rendering"}
    assert of_software | {"/dev/shm", "domain", "ports"} <= set(names)
    errors = [finding for finding in answer["findings"] if finding["level"] == "error"]
    assert code == (1 if errors else 0)
    assert errors == []
