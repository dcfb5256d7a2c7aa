# SPDX-License-Identifier: Apache-2.0
"""Put faults into copies of the checkout, one at a time, and list which of them the tests of their package miss.

    .venv/bin/python tools/seeded_faults.py [--root DIR] [--faults id,…] [--all] [--workers 2] [--json FILE]

The faults are those of `seeded_faults.yaml` next to this file, also for another tree. A fault is `caught` when a test
fails that passes without it, `missed` when all tests pass, and `not run` when its text is not there exactly once or
pytest itself fails. `--all` also runs the tests that are marked `long`. The exit code is 0 when every fault was run.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
LIST = Path(__file__).with_suffix(".yaml")
#: At the top of a tree: what a copy does without.
LEFT_OUT = (".venv", ".build-env", ".git", "runs")
#: Longest run of the tests of a package, s; a test that hangs has noticed the fault.
TIMEOUT_S = 1800.0


@dataclass(frozen=True)
class Fault:
    """A change of one line of a package.

    Attributes:
        package: That it is of.
        id: Short words, unique in the list.
        file: Relative to the root.
        old: Text that the file has exactly once.
        new: What takes its place.
        tests: What pytest gets for it: files and folders relative to the root.
    """

    package: str
    id: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def applies(self, root: Path) -> bool:
        """Whether a tree has the text of the fault, once."""
        path = root / self.file
        return path.is_file() and path.read_text(encoding="utf-8").count(self.old) == 1

    def nearest_first(self, root: Path) -> list[str]:
        """Return the test files of a tree, those that import the module first; an older tree may have fewer."""
        paths = [path for test in self.tests for path in sorted({root / test, *root.glob(f"{test}/**/test_*.py")})]
        module = self.file.removesuffix(".py").replace("/", ".")
        files = dict.fromkeys(str(path.relative_to(root)) for path in paths if path.is_file())
        return sorted(files, key=lambda file: module not in (root / file).read_text(encoding="utf-8"))

    def apply(self, root: Path) -> None:
        """Change a tree; numba, which looks for changes in one file only, forgets what it compiled."""
        path = root / self.file
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace(self.old, self.new), encoding="utf-8")
        if re.search(r"\bnjit\b|kernel\b", text):
            for cached in root.glob("openarm_*/**/__pycache__/*.nb?"):
                cached.unlink()


@dataclass(frozen=True)
class Row:
    """What became of a fault; `test` is the first that failed."""

    package: str
    id: str
    verdict: str
    test: str = ""


def load(path: Path = LIST) -> list[Fault]:
    """Read a list of faults."""
    data: Mapping[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return [
        Fault(package=package, tests=tuple(entry["tests"]), **fault)
        for package, entry in data.items()
        for fault in entry["faults"]
    ]


def try_fault(fault: Fault, original: Path, *, long: bool) -> Row:
    """Run the tests of a fault's package in a copy of a tree with the fault.

    Args:
        fault: To try.
        original: Root of the tree, which stays as it is.
        long: Whether tests that are marked `long` are run, too.
    """
    tests = fault.nearest_first(original)
    if not fault.applies(original) or not tests:
        return Row(fault.package, fault.id, "not run")
    with tempfile.TemporaryDirectory(prefix="openarm_fault_", ignore_cleanup_errors=True) as folder:
        copy = Path(folder, "tree")
        shutil.copytree(original, copy, symlinks=True)  # with times, by which Python knows that its caches hold
        fault.apply(copy)
        while True:
            code, failed = run_pytest(copy, tests, long=long)
            if code != 1:
                return Row(fault.package, fault.id, {0: "missed", None: "caught"}.get(code, "not run"))
            if run_pytest(original, [failed], long=long)[0] == 0:
                return Row(fault.package, fault.id, "caught", failed)
            tests.append(f"--deselect={failed}")


def run_pytest(tree: Path, tests: Sequence[str], *, long: bool) -> tuple[int | None, str]:
    """Return the exit code of pytest in a tree, None when it took too long, and the first test that failed.

    Args:
        tree: Whose packages are imported, whatever is installed.
        tests: Arguments.
        long: Whether tests that are marked `long` are run, too.
    """
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        "-p",
        "no:cacheprovider",
        *(["--all"] if long else []),
        *tests,
    ]
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}  # a cache each
    process = subprocess.Popen(
        command, cwd=tree, env=environment | {"PYTHONPATH": str(tree)}, stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        output, _ = process.communicate(timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return None, ""
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    failed = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", output, re.MULTILINE)
    return process.returncode, failed[1] if failed else ""


def report(rows: Sequence[Row]) -> str:
    """Return how many were caught by package, and which were not."""
    verdicts = Counter((name, row.verdict) for row in rows for name in (row.package, "all"))
    lines = [
        f"{name:<20} {verdicts[name, 'caught']:>3} of {sum(n for (of, _), n in verdicts.items() if of == name)} caught"
        for name in dict.fromkeys([row.package for row in rows] + ["all"])
    ]
    return "\n".join([*lines, *(f"{row.verdict}: {row.package} {row.id}" for row in rows if row.verdict != "caught")])


def main() -> int:
    """Try the faults and print what the tests missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--root", type=Path, default=ROOT, help="tree with the code and the tests; by default this one")
    parser.add_argument("--faults", default="", help="ids or packages, comma-separated; by default all")
    parser.add_argument("--all", action="store_true", help="run the tests that are marked `long`, too")
    parser.add_argument("--workers", type=int, default=2, help="faults that are tried at the same time")
    parser.add_argument("--json", type=Path, help="file for the rows")
    options = parser.parse_args()
    faults, wanted = load(), set(options.faults.split(",")) - {""}
    if unknown := wanted - {word for fault in faults for word in (fault.id, fault.package)}:
        parser.error(f"no fault or package {', '.join(unknown)}; faults: {', '.join(fault.id for fault in faults)}")
    faults = [fault for fault in faults if not wanted or wanted & {fault.id, fault.package}]
    with tempfile.TemporaryDirectory(prefix="openarm_faults_") as folder:
        original = Path(folder, "original")  # the tree may change meanwhile
        shutil.copytree(options.root, original, symlinks=True, ignore=lambda _, names: set(names) & set(LEFT_OUT))
        rows: list[Row] = []
        with ThreadPoolExecutor(options.workers) as pool:
            for row in pool.map(lambda fault: try_fault(fault, original, long=options.all), faults):
                print(f"{row.package} {row.id}: {row.verdict} {row.test}", flush=True)
                rows.append(row)
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n", encoding="utf-8")
    print(report(rows))
    return 1 if any(row.verdict == "not run" for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
