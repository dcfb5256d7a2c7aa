# SPDX-License-Identifier: Apache-2.0
"""The launcher ./openarm, run in a copy of the checkout with stubs for what it finds on the machine.

The stubs are the machine: uname, df, id, sudo, apt-get, uv, and what tools/probe.py answers. What the launcher decides,
says and leaves behind is its own.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

_ROOT = Path(__file__).parents[1]
_TOOLS = """awk cat chmod cp cut date df dirname env find flock getconf grep id ls mkdir mktemp mv readlink rm sed sh
    sha256sum sleep sort tail touch tr uname xargs"""

#: Answers `python` as a good interpreter and `packages` with the words of the file `missing`.
_PROBE = """
import pathlib, sys
if sys.argv[1] == "python":
    print("3.12.0", sys.executable)
else:
    missing = pathlib.Path(__file__).parents[1] / "missing"
    print(missing.read_text() if missing.exists() else "")
"""

#: The Python of the environment: compiles, and keeps a record of it, where a kernel has no code beside it.
_PYTHON = """#!/bin/sh
case "$*" in
*probe.py*) exec python3 "$@" ;;
*openarm_bringup.warm*)
    find "${0%/.venv/*}" -name kernels.py | while read -r source; do
        compiled=${source%/*}/__pycache__/kernels.search-1.nbc
        [ -e "$compiled" ] || { mkdir -p "${compiled%/*}"; cp "$source" "$compiled"; echo "compile" >>"$CALLS"; }
    done
    ;;
esac
"""

#: Keeps a record of its calls, and leaves behind what the real one would.
_UV = """
[ "$1" = --version ] && { echo "uv 0.9.0"; exit 0; }
echo "$*" >>"$CALLS"
case "$1 $2" in
"venv "*)
    shift $(($# - 1))
    mkdir -p "$1/bin"
    mkdir -p "$1/lib/python3.12"
    cp "$PYTHON" "$1/bin/python"
    printf '#!/bin/sh\\necho "args: $*"\\necho "PYTHONPATH: ${PYTHONPATH-unset}"\\n' >"$1/bin/openarm"
    chmod +x "$1/bin/python" "$1/bin/openarm"
    ;;
"build "*)
    while [ $# -gt 2 ]; do [ "$1" = -o ] && out=$2; shift; done
    mkdir -p "$out"
    touch "$out/made.whl"
    ;;
"pip sync") [ -z "${SLOW-}" ] || { touch "$SLOW"; until [ -e "$SLOW.end" ]; do sleep 0.05; done; } ;;
esac
"""


class Machine:
    """A fresh machine with a fresh clone."""

    def __init__(self, folder: Path) -> None:
        self.root, self.bin, self.calls = folder / "a clone", folder / "bin", folder / "calls"
        self.cache = folder / "cache"
        self.bin.mkdir()
        self.clone(self.root)
        for tool in _TOOLS.split():
            (self.bin / tool).symlink_to(shutil.which(tool) or pytest.fail(f"{tool} is not on this machine"))
        self.stub("uname", '[ "$1" = -s ] && echo Linux || echo x86_64')
        self.stub("df", "echo head; echo /dev/x 0 0 9000000 0% /")
        self.stub("g++", "")
        self.stub("uv", _UV)
        (self.bin / "python3").symlink_to(sys.executable)
        self.env = {"PATH": str(self.bin), "HOME": str(folder), "XDG_CACHE_HOME": str(self.cache)}
        (folder / "python").write_text(_PYTHON)
        self.env |= {"CALLS": str(self.calls), "PYTHON": str(folder / "python")}

    @staticmethod
    def clone(to: Path) -> None:
        """Copy what set-up reads, with the stub of the probe."""
        to.mkdir()
        for name in ("openarm", "pyproject.toml", "requirements.lock", "requirements-build.lock"):
            shutil.copy(_ROOT / name, to)
        shutil.copytree(_ROOT / "interfaces", to / "interfaces")
        (to / "tools").mkdir()
        (to / "tools" / "probe.py").write_text(_PROBE)

    def stub(self, name: str, script: str) -> None:
        """Replace a command."""
        path = self.bin / name
        path.unlink(missing_ok=True)
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(0o755)

    def run(self, *args: str, root: Path | None = None, **env: str) -> subprocess.CompletedProcess[str]:
        """Run ./openarm to its end, from another folder."""
        return subprocess.run(
            [(root or self.root) / "openarm", *args],
            env=self.env | env,
            text=True,
            capture_output=True,
            timeout=120,
            cwd="/",
        )

    def refused(self, **env: str) -> str:
        """Run ./openarm, which must fail without a stamp, and return its last words."""
        answer = self.run("doctor", **env)
        assert answer.returncode == 1, answer.stderr
        assert answer.stdout == ""
        assert not (self.root / ".venv" / ".openarm-setup").exists()
        return answer.stderr

    def uv_calls(self) -> list[str]:
        """Return the calls of uv since the last time."""
        calls = self.calls.read_text().splitlines() if self.calls.exists() else []
        self.calls.unlink(missing_ok=True)
        return calls


def _interruptible() -> None:
    """Take SIGINT, which a process in the background of a script ignores."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_set_up_hands_over_its_arguments_and_the_next_run_does_nothing(machine: Machine) -> None:
    first = machine.run("demo", "--seeds", "0-3")
    assert first.returncode == 0, first.stderr
    assert first.stdout == "args: demo --seeds 0-3\nPYTHONPATH: unset\n"
    assert "set up" in first.stderr
    calls = machine.uv_calls()
    assert sum(call.startswith("build --wheel --no-build-isolation") for call in calls) == 5
    assert any("pip sync" in call and "--require-hashes" in call for call in calls)
    assert list(machine.cache.glob("openarm/tmp.*")) == []

    second = machine.run("a b", "c")
    assert (second.stdout, second.stderr) == ("args: a b c\nPYTHONPATH: unset\n", "")
    assert machine.uv_calls() == []


@pytest.mark.parametrize("command", [("up", "motion", "--moveit"), ("test",)])
def test_messages_of_moveit_are_built_when_they_are_first_wanted(machine: Machine, command: tuple[str, ...]) -> None:
    machine.run("up")
    machine.uv_calls()
    answer = machine.run(*command)
    assert answer.stdout.startswith(f"args: {' '.join(command)}\n")
    built = [call.rsplit("/", 1)[1] for call in machine.uv_calls() if call.startswith("build")]
    assert sorted(built) == ["moveit_msgs", "object_recognition_msgs"]
    for again in (command, ("up",)):
        assert machine.run(*again).stderr == ""
    assert machine.uv_calls() == []


@pytest.mark.long
def test_a_changed_message_rebuilds_its_package_only_and_a_second_clone_builds_nothing(machine: Machine) -> None:
    machine.run()
    machine.uv_calls()
    with (machine.root / "interfaces" / "openarm_interfaces" / "msg" / "Refusal.msg").open("a") as file:
        file.write("bool more\n")
    assert machine.run().returncode == 0
    calls = machine.uv_calls()
    assert [call.rsplit("/", 1)[1] for call in calls if call.startswith("build")] == ["openarm_interfaces"]
    assert not any("requirements.lock" in call for call in calls)  # the environment stays

    other = machine.root.parent / "other"
    machine.clone(other)
    assert machine.run(root=other).returncode == 0
    assert not any(call.startswith("build") for call in machine.uv_calls())


def test_kernels_are_compiled_where_they_or_what_they_import_have_changed_and_kept_for_other_clones(
    machine: Machine,
) -> None:
    """Else every node would compile at its first use, and miss its time limits."""
    clones = [machine.root, machine.root.parent / "another clone"]
    machine.clone(clones[1])
    for text, limit in (("@kernel\n", "1"), ("@bare_kernel\n", "1"), ("@bare_kernel\n", "2")):
        for clone, compiles in zip(clones, (1, 0), strict=True):
            kernels = clone / "openarm_motion" / "planning" / "kernels.py"
            kernels.parent.mkdir(parents=True, exist_ok=True)
            kernels.write_text(f"from openarm_motion.limits import LIMIT\n{text}")
            (clone / "openarm_motion" / "limits.py").write_text(f"LIMIT = {limit}\n")
            answer = machine.run("x", root=clone)
            assert answer.stdout.startswith("args: x\n"), answer.stderr
            assert machine.uv_calls().count("compile") == compiles, (text, limit, clone)
            assert (kernels.parent / "__pycache__" / "kernels.search-1.nbc").read_text() == kernels.read_text()
    assert machine.run("x", root=clones[1]).stderr == ""


@pytest.mark.long
def test_an_interrupted_set_up_leaves_no_stamp_and_the_next_recreates_the_environment(machine: Machine) -> None:
    reached = machine.root.parent / "reached"
    command = [machine.root / "openarm", "x"]
    with subprocess.Popen(
        command, env=machine.env | {"SLOW": str(reached)}, start_new_session=True, preexec_fn=_interruptible
    ) as process:
        deadline = time.monotonic() + 60
        while not reached.exists():
            assert time.monotonic() < deadline, "set-up did not come to the packages"
            threading.Event().wait(0.02)
        os.killpg(process.pid, signal.SIGINT)
        reached.with_suffix(".end").touch()  # for what runs beside, which an interrupt may not reach
        assert process.wait(60) == 130
    assert not (machine.root / ".venv" / ".openarm-setup").exists()
    assert list(machine.cache.glob("openarm/tmp.*")) == []
    machine.uv_calls()
    assert machine.run("x").stdout.startswith("args: x\n")
    assert any(call.startswith("venv") for call in machine.uv_calls())


@pytest.mark.long
def test_an_interrupted_set_up_ends_the_build_that_runs_beside(machine: Machine) -> None:
    builds = machine.root.parent / "builds"
    builds.touch()
    machine.stub("uv", _UV.replace('"build "*)', '"build "*) echo $$ >>"$BUILDS"; exec sleep 60;;\n"x")'))
    command = [machine.root / "openarm", "x"]
    with subprocess.Popen(
        command, env=machine.env | {"BUILDS": str(builds)}, start_new_session=True, preexec_fn=_interruptible
    ) as process:
        deadline = time.monotonic() + 60
        while len(pids := builds.read_text().split()) < 5:
            assert time.monotonic() < deadline, "the build did not begin"
            threading.Event().wait(0.02)
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(60) == 130
    while any(Path(f"/proc/{pid}").exists() for pid in pids):
        assert time.monotonic() < deadline, "the build goes on"
        threading.Event().wait(0.02)


def test_two_runs_at_once_set_up_once(machine: Machine) -> None:
    command = [machine.root / "openarm", "x"]
    both = [subprocess.Popen(command, env=machine.env, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert [process.communicate(timeout=120)[0].splitlines()[0] for process in both] == ["args: x"] * 2
    assert sum("requirements.lock" in call for call in machine.uv_calls()) == 1


def test_the_wrong_architecture_is_named(machine: Machine) -> None:
    machine.stub("uname", '[ "$1" = -s ] && echo Linux || echo aarch64')
    words = machine.refused()
    assert "this machine is Linux aarch64; the ROS 2 wheels exist for Linux x86_64 only" in words
    assert "native ROS 2 Jazzy" in words


def test_wrong_pythons_are_named_each_with_its_reason(machine: Machine) -> None:
    machine.stub("python3.12", "exit 127")
    machine.stub("python3", 'echo "it is 3.9.2"; exit 1')
    words = machine.refused()
    assert "no CPython 3.11, 3.12 or 3.13 found" in words
    assert "python3.12: it does not run; python3.11: not found; python3.13: not found; python3: it is 3.9.2;" in words
    assert "OPENARM_PYTHON=/path/to/python3" in words
    assert "/nowhere/python: not found;" in machine.refused(OPENARM_PYTHON="/nowhere/python")


def test_the_probe_accepts_this_python_and_refuses_another() -> None:
    probe = _ROOT / "tools" / "probe.py"
    answer = subprocess.run([sys.executable, probe, "python"], text=True, capture_output=True, check=True).stdout
    version, executable = answer.split(maxsplit=1)
    assert version == ".".join(map(str, sys.version_info[:3]))
    assert Path(executable.strip()).exists()
    pretend = (
        "import runpy, sys; sys.version_info = (3, 14); del sys.argv[0]; runpy.run_path(sys.argv[0], None, '__main__')"
    )
    refusal = subprocess.run([sys.executable, "-c", pretend, probe, "python"], text=True, capture_output=True)
    assert (refusal.returncode, refusal.stdout.startswith("it is ")) == (1, True), refusal


def test_too_little_disk_is_reported_with_the_numbers(machine: Machine) -> None:
    machine.stub("df", "echo head; echo /dev/x 0 0 1048576 0% /")
    assert f"no disk space: {machine.root} has 1024 MB free, set-up needs 4000 MB" in machine.refused()


def test_a_full_disk_on_the_way_is_reported_as_such(machine: Machine) -> None:
    machine.stub("uv", _UV.replace('"pip sync")', '"pip sync") echo "error: No space left on device"; exit 2;;\n"x")'))
    assert "no disk space left while fetching the packages of requirements.lock" in machine.refused()


@pytest.mark.skipif(
    shutil.which("uv", path=str(Path(sys.executable).parent)) is None, reason="uv is not in this environment"
)
def test_no_network_is_reported_as_such_by_the_real_uv(machine: Machine) -> None:
    (machine.bin / "uv").unlink()
    (machine.bin / "uv").symlink_to(Path(sys.executable).parent / "uv")
    closed = "http://127.0.0.1:9/simple"
    words = machine.refused(UV_DEFAULT_INDEX=closed, UV_NO_CONFIG="1", UV_HTTP_RETRIES="0")
    assert "no network while fetching the packages of requirements.lock" in words
    assert "HTTPS_PROXY" in words
    assert "run ./openarm again" in words


@pytest.mark.long
def test_no_network_for_pip_where_uv_is_missing_is_reported_as_such(machine: Machine) -> None:
    (machine.bin / "uv").unlink()
    words = machine.refused(PIP_INDEX_URL="http://127.0.0.1:9/simple", PIP_RETRIES="1", PIP_CONFIG_FILE=os.devnull)
    assert "no network while fetching uv" in words


def test_a_build_that_fails_shows_its_end_and_its_log(machine: Machine) -> None:
    machine.stub("uv", _UV.replace('"build "*)', '"build "*) echo "ninja: cannot connect the pieces"; exit 1;;\n"x")'))
    words = machine.refused()
    assert "ninja: cannot connect the pieces" in words
    assert f"failed while building the packages of interfaces/. Log: {machine.root}/runs/setup-interfaces.log" in words


def test_missing_libraries_are_installed_by_apt_where_that_is_allowed(machine: Machine) -> None:
    calls = machine.root.parent / "apt"
    missing = machine.root / "missing"
    missing.write_text("libegl1\nlibgl1\n")
    machine.stub("id", "echo 0")
    # As on a fresh machine: nothing is found before the lists are fetched.
    lists = machine.root.parent / "lists"
    install = f'[ -e "{lists}" ] && rm "{missing}"'
    machine.stub("apt-get", f'echo "$*" >>"{calls}"; case "$*" in *update*) touch "{lists}";; *) {install};; esac')
    answer = machine.run("x")
    assert answer.returncode == 0, answer.stderr
    assert "system packages: libegl1 libgl1" in answer.stderr
    wanted = "-q -y install --no-install-recommends libegl1 libgl1"
    assert calls.read_text().splitlines() == [wanted, "-q -y update", wanted]


def test_missing_libraries_are_named_with_the_command_where_apt_is_not_allowed(machine: Machine) -> None:
    (machine.root / "missing").write_text("libegl1\n")
    (machine.bin / "g++").unlink()
    machine.stub("id", "echo 1000")
    machine.stub("sudo", "exit 1")
    machine.stub("apt-get", "exit 99")
    words = machine.refused()
    assert "missing system packages: libegl1 g++" in words
    assert "sudo apt-get update && sudo apt-get install --no-install-recommends libegl1 g++" in words


def test_missing_libraries_are_named_where_there_is_no_apt(machine: Machine) -> None:
    (machine.root / "missing").write_text("libegl1\n")
    assert "missing on this system (Debian's package names): libegl1." in machine.refused()


def test_a_sourced_native_ros_is_left_out_and_reported(machine: Machine) -> None:
    machine.run()
    answer = machine.run(
        "x", PYTHONPATH="/opt/ros/jazzy/lib/python3.12/site-packages", AMENT_PREFIX_PATH="/opt/ros/jazzy"
    )
    assert answer.stdout == "args: x\nPYTHONPATH: unset\n"
    assert "leaving the sourced native ROS 2 out" in answer.stderr
    assert machine.run("x", PYTHONPATH="/mine").stdout == "args: x\nPYTHONPATH: /mine\n"
