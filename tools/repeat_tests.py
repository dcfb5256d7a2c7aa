# SPDX-License-Identifier: Apache-2.0
"""Run the tests several times in parts, and list which tests failed how often with their first error line.

    .venv/bin/python tools/repeat_tests.py [--times 3] [--parts core,nodes,graph,other] [--load] [--out DIR] [PYTEST…]

`core` are the tests of packages and repository, `nodes` those of nodes in process, `graph` those of whole graphs,
`other` the rest. `--load` keeps one core busy meanwhile. Each run leaves its output and a JUnit file in DIR. The exit
code is 0 when every run of every part passed, 1 when a test failed or a run ended otherwise, 2 when the call is wrong.
"""

from __future__ import annotations

import argparse
import contextlib
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PARTS = ("core", "nodes", "graph", "other")
#: How `openarm test` shares tests out: files in three processes; tests marked `alone` have the machine for themselves.
SHARED = ("-n", "3", "--dist", "loadfile", "--no-loadscope-reorder")


@dataclass
class Failure:
    """A test, or a whole run, that failed.

    Attributes:
        runs: Numbers of the repetitions in which it failed, from 1.
        lines: The first line of each error, without repetitions.
    """

    runs: list[int] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)

    def note(self, run: int, line: str) -> None:
        """Add a failure."""
        self.runs.append(run)
        if line not in self.lines:
            self.lines.append(line)


def paths_of(tests: Path) -> dict[str, list[str]]:
    """Return the test files and folders of each part, relative to the parent of `tests`."""
    found: dict[str, list[str]] = {part: [] for part in PARTS}
    for path in sorted(tests.iterdir()):
        is_file = path.name.startswith("test_") and path.suffix == ".py"
        if not is_file and not (path.is_dir() and any(path.rglob("test_*.py"))):
            continue
        part = path.name if path.name in PARTS else "core" if is_file or path.name.startswith("openarm_") else "other"
        found[part].append(str(path.relative_to(tests.parent)))
    return found


def failures_in(junit: Path) -> Iterator[tuple[str, str]]:
    """Yield each failed test of a JUnit file and the first line of its error."""
    for case in ElementTree.parse(junit).getroot().iter("testcase"):
        for kind in ("failure", "error"):
            for fault in case.iter(kind):
                first = (fault.get("message") or fault.text or kind).strip().partition("\n")[0]
                yield f"{case.get('classname')}::{case.get('name')}", first


@contextlib.contextmanager
def load(wanted: bool) -> Iterator[None]:
    """Keep one core busy inside the context, if that is wanted."""
    if not wanted:
        yield
        return
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as busy:
        try:
            yield
        finally:
            busy.kill()


def run(
    part: str, paths: Sequence[str], number: int, out: Path, extra: Sequence[str], failed: dict[str, Failure]
) -> str:
    """Run one part once.

    Args:
        part: Its name.
        paths: What pytest gets.
        number: Of the repetition, from 1.
        out: Folder of the output and the JUnit file.
        extra: More arguments of pytest.
        failed: Failures so far, by test; those of this run are added.

    Returns:
        One line about the run.
    """
    junit, log = out / f"{part}_{number}.xml", out / f"{part}_{number}.log"
    junit.unlink(missing_ok=True)
    command = [sys.executable, "-m", "pytest", "-q", *SHARED, f"--junitxml={junit}", *paths, *extra]
    began = time.monotonic()
    with log.open("w") as output:
        code = subprocess.run(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT, check=False).returncode
    seconds = time.monotonic() - began
    found = list(failures_in(junit)) if junit.is_file() else []
    for test, line in found:
        failed.setdefault(test, Failure()).note(number, line)
    if code != 0 and not found:  # no test ran, pytest crashed or was interrupted
        failed.setdefault(f"{part} as a whole", Failure()).note(number, f"pytest ended with {code}; see {log}")
    verdict = "passed" if code == 0 else f"{len(found)} failed" if found else f"pytest ended with {code}"
    return f"{part} {number}: {verdict} in {seconds:.0f} s"


def report(failed: Mapping[str, Failure], times: int) -> str:
    """Return the failures as text, the most frequent first."""
    rows: list[str] = []
    for test, failure in sorted(failed.items(), key=lambda item: (-len(item[1].runs), item[0])):
        rows.append(f"{len(failure.runs)} of {times}  {test}  (runs {', '.join(map(str, failure.runs))})")
        rows += [f"        {line}" for line in failure.lines]
    return "\n".join(rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the parts and print what failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--times", type=int, default=3, help="repetitions")
    parser.add_argument("--parts", default=",".join(PARTS), help=f"comma-separated, of {', '.join(PARTS)}")
    parser.add_argument("--load", action="store_true", help="keep one core busy meanwhile")
    parser.add_argument("--out", type=Path, help="folder of the logs; a temporary one by default")
    options, extra = parser.parse_known_args(arguments)
    parts = options.parts.split(",")
    if unknown := [part for part in parts if part not in PARTS]:
        parser.error(f"no part {', '.join(unknown)}; parts: {', '.join(PARTS)}")
    if options.times < 1:
        parser.error(f"--times is {options.times}, expected at least 1")
    out = (options.out or Path(tempfile.mkdtemp(prefix="openarm_tests_"))).resolve()
    out.mkdir(parents=True, exist_ok=True)
    paths, failed = paths_of(ROOT / "tests"), dict[str, Failure]()
    with load(options.load):
        for number in range(1, options.times + 1):
            for part in parts:
                print(run(part, paths[part], number, out, extra, failed), flush=True)
    print(report(failed, options.times) or f"nothing failed in {options.times} runs", f"(logs: {out})", sep="\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
