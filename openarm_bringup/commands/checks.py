# SPDX-License-Identifier: Apache-2.0
"""`openarm test`, `lint` and `completion`: for developers, and for the shell."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError

#: Folders of tests that mostly wait, for messages and processes: they run while those of the others compute.
WAITING = ("graph", "nodes")

#: Number of processes that share the tests, file by file, on two processors or more: one of three mostly waits. Tests
#: marked `alone` run by themselves.
WORKERS = 3
#: What pytest can't do, or shows less of, when tests run in other processes.
NEEDS_ONE_PROCESS = ("-s", "--capture=no", "--pdb", "--trace", "--collect-only", "--co", "no:xdist")

#: What a run ends with: the slowest tests, and each that was skipped with its reason.
REPORT = ("--durations=25", "-rs")

Rest = Annotated[str, Parameter(allow_leading_hyphen=True)]


def test(*args: Rest, every: Annotated[bool, Parameter(name="--all", negative="")] = False) -> Outcome:  # noqa: PT028
    """Run the tests of cores and nodes, and of a graph that grasps; print the slowest and what was skipped.

    Args:
        args: Passed to pytest; without a path, all files run, in three processes (-n 0: in one).
        every: Run the long tests, too: faults, campaigns, other robots, replays, two hosts, whatever measures time.
    """
    root = _checkout()
    given_paths = [arg for arg in args if not arg.startswith("-") and (root / arg.partition("::")[0]).exists()]
    paths = [] if given_paths else _in_order(root / "tests")
    began = time.monotonic()
    shared = [] if given_paths or set(NEEDS_ONE_PROCESS) & set(args) else _shared_out()
    command = [sys.executable, "-m", "pytest", "-q", *REPORT, *(["--all"] if every else []), *shared, *paths, *args]
    # Byte code is kept, whatever the environment says: the tests start a hundred processes.
    env = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    if shared:  # each process would compile the same kernels
        subprocess.run([sys.executable, "-m", "openarm_bringup.warm"], cwd=root, env=env, check=False)
    code = subprocess.run(command, cwd=root, env=env, check=False).returncode
    seconds = time.monotonic() - began
    data = {"exit_code": code, "seconds": round(seconds, 1)}
    if code == 0:
        return Outcome(True, f"tests passed in {seconds:.0f} s", data=data)
    if code == 4:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"pytest refused the call: {' '.join(args)}")
    return Outcome(False, f"tests failed (pytest ended with {code}) after {seconds:.0f} s", Code.INTERNAL, data)


def lint() -> Outcome:
    """Check style and types: ruff and basedpyright (installed at the first call)."""
    root = _checkout()
    python = Path(sys.executable)
    if importlib.util.find_spec("basedpyright") is None:
        lock = root / "requirements-dev.lock"
        uv = python.parent / "uv"
        install = [str(uv) if uv.exists() else "uv", "pip", "install", "--python", str(python), "--require-hashes"]
        if subprocess.run([*install, "-r", str(lock)], cwd=root, check=False).returncode != 0:
            raise OpenArmError(Code.ENVIRONMENT, f"could not install {lock.name}; see the lines above")
    results: dict[str, int] = {}
    for name, command in {
        "ruff check": ["ruff", "check"],
        "ruff format": ["ruff", "format", "--check"],
        "basedpyright": ["basedpyright"],
    }.items():
        results[name] = subprocess.run([sys.executable, "-m", *command], cwd=root, check=False).returncode
    failed = [name for name, code in results.items() if code != 0]
    if failed:
        return Outcome(
            False, f"{', '.join(failed)} found faults; see the lines above", Code.INTERNAL, {"checks": results}
        )
    return Outcome(True, "style and types are sound", data={"checks": results})


def completion(shell: Literal["bash", "zsh", "fish"] = "bash", *, install: bool = False) -> Outcome:
    """Print what makes a shell complete this command line, as in: eval "$(openarm completion bash)".

    Args:
        shell: Shell.
        install: Write it where the shell finds it, for every new shell, instead of printing it.
    """
    from openarm_bringup.cli import build_app

    if install:
        path = build_app().install_completion(shell=shell)
        return Outcome(True, f"written to {path}; new shells complete `openarm`", data={"path": str(path)})
    script = build_app().generate_completion(shell=shell)
    return Outcome(True, data={"shell": shell, "script": script}, text=script)


def _in_order(tests: Path) -> list[str]:
    """Return the test files: those that wait evenly among those that compute, of each kind the longest first.

    A long one that came last would keep one process busy and the others waiting. What has most text counts as longest.
    """
    files = sorted(tests.rglob("test_*.py"), key=lambda path: (-path.stat().st_size, path))
    kinds = [path.relative_to(tests).parts[0] in WAITING for path in files]
    ranks = [kinds[:k].count(kind) / kinds.count(kind) for k, kind in enumerate(kinds)]
    return [str(path.relative_to(tests.parent)) for _, path in sorted(zip(ranks, files, strict=True))]


def _shared_out() -> list[str]:
    """Return options that run tests in several processes, where there are processors for them.

    A process that crashes ends the run: xdist would start another one and then wait for ever for some of its tests.
    """
    if len(os.sched_getaffinity(0)) == 1:
        return []
    return ["-n", str(WORKERS), "--dist=loadfile", "--no-loadscope-reorder", "--max-worker-restart=0"]


def _checkout() -> Path:
    root = Path(__file__).resolve().parents[2]
    if not (root / "tests").is_dir():
        raise OpenArmError(
            Code.ENVIRONMENT, f"there is no tests/ next to {root / 'openarm_bringup'}; run this in a checkout"
        )
    return root
