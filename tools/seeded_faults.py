# SPDX-License-Identifier: Apache-2.0
"""Put faults into a copy of the checkout, one at a time, and list which of them the tests of their package miss.

    .venv/bin/python tools/seeded_faults.py [--root DIR] [--packages a,b] [--faults id,…] [--all] [--workers 2]
                                            [--out DIR] [--json FILE]

The faults are those of `seeded_faults.yaml` next to this file, also for another tree. A fault is `caught` when a test
fails (pytest ends with 1) or pytest takes longer than 15 minutes, `missed` when all pass, and `broken` when pytest
ends otherwise; where its text does not occur exactly once it `does not apply`. A test that fails without the fault,
too, is left out. `--all` also runs the tests that are marked `long`. The exit code is 0 when every fault was run, 1
when some did not apply or broke, and 2 when the call or the list is wrong.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Literal

import yaml

ROOT = Path(__file__).resolve().parents[1]
LIST = Path(__file__).with_suffix(".yaml")
#: Of the tree, at its top: what a copy does without.
LEFT_OUT = frozenset({".venv", ".build-env", ".git", "runs"})
#: Least numbers of faults: of each package, and of all.
LEAST_EACH, LEAST_IN_ALL = 5, 60
#: Longest run of the tests of a package, s.
TIMEOUT_S = 900.0

_KEYS = frozenset({"id", "file", "old", "new"})
_ID = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
_COMPILED = re.compile(r"\bnjit\b|@kernel\b")
_FAILED = re.compile(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", re.MULTILINE)

Outcome = Literal["caught", "missed", "broken", "does not apply"]


class ListError(Exception):
    """The list of faults is wrong; the message says where and what to do."""


@dataclass(frozen=True)
class Fault:
    """A change of one line of a package.

    Attributes:
        package: That it is of.
        id: Short words, unique in the list.
        file: Relative to the root.
        old: Text that the file has exactly once.
        new: What takes its place.
    """

    package: str
    id: str
    file: str
    old: str
    new: str


@dataclass(frozen=True)
class Package:
    """The tests and the faults of a package; tests are files and folders relative to the root."""

    tests: tuple[str, ...]
    faults: tuple[Fault, ...]


@dataclass(frozen=True)
class Row:
    """What became of a fault; `test` is the first that failed, or why it was not run."""

    package: str
    id: str
    verdict: Outcome
    test: str
    seconds: float


def load(path: Path = LIST) -> dict[str, Package]:
    """Read a list of faults.

    Raises:
        ListError: When it can't be read, or an entry lacks a key.
    """
    try:
        data: Any = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError) as error:
        raise ListError(f"can't read {path}: {error}") from error
    if not isinstance(data, dict):
        raise ListError(f"{path} is no mapping; expected packages, each with `tests` and `faults`")
    found: dict[str, Package] = {}
    for name, entry in data.items():
        if not isinstance(entry, dict) or not all(isinstance(entry.get(key), list) for key in ("tests", "faults")):
            raise ListError(f"{path}: {name} needs two lists, `tests` and `faults`")
        for number, fault in enumerate(entry["faults"], 1):
            if (
                not isinstance(fault, dict)
                or fault.keys() != _KEYS
                or not all(isinstance(v, str) for v in fault.values())
            ):
                raise ListError(
                    f"{path}: fault {number} of {name} needs the texts {', '.join(sorted(_KEYS))}, and no more"
                )
        faults = tuple(Fault(package=name, **fault) for fault in entry["faults"])
        found[name] = Package(tuple(map(str, entry["tests"])), faults)
    return found


def check(packages: Mapping[str, Package], root: Path = ROOT) -> list[str]:
    """Return what is wrong with a list, each with what to do.

    Args:
        packages: By name.
        root: Checkout that the list is of.
    """
    wrong: list[str] = []
    every = [fault for package in packages.values() for fault in package.faults]
    for name, count in Counter(fault.id for fault in every).items():
        if count > 1:
            wrong.append(f"id {name!r} is there {count} times; give each fault its own")
    for name, package in packages.items():
        if len(package.faults) < LEAST_EACH:
            wrong.append(f"{name} has {len(package.faults)} faults, expected at least {LEAST_EACH}; add some")
        for test in package.tests:
            if not (root / test).exists():
                wrong.append(f"{name}: there is no {test}; correct or remove it under `tests`")
    for fault in every:
        if not _ID.fullmatch(fault.id):
            wrong.append(f"id {fault.id!r} of {fault.package}: expected lower-case words with hyphens between them")
        if not (root / fault.file).is_file():
            wrong.append(f"{fault.id}: there is no file {fault.file}; correct `file`, or replace the fault")
        elif not fault.file.startswith(f"{fault.package}/"):
            wrong.append(
                f"{fault.id}: {fault.file} is not of {fault.package}; move the fault to the package of its file"
            )
        if "\n" in fault.old + fault.new or not fault.old or fault.old == fault.new:
            wrong.append(f"{fault.id}: expected two different texts of one line as `old` and `new`")
    if len(every) < LEAST_IN_ALL:
        wrong.append(f"there are {len(every)} faults, expected at least {LEAST_IN_ALL}; add some")
    return wrong


def why_not(fault: Fault, root: Path) -> str:
    """Return why a fault can't be put into a tree; nothing: it can."""
    path = root / fault.file
    if not path.is_file():
        return f"there is no file {fault.file}"
    count = path.read_text(encoding="utf-8").count(fault.old)
    return "" if count == 1 else f"{fault.file} has its text {count} times, expected once"


def apply(fault: Fault, root: Path) -> None:
    """Put a fault into a tree."""
    path = root / fault.file
    path.write_text(path.read_text(encoding="utf-8").replace(fault.old, fault.new), encoding="utf-8")


def is_compiled(path: Path) -> bool:
    """Whether numba compiles functions of a file."""
    return _COMPILED.search(path.read_text(encoding="utf-8")) is not None


def importers(root: Path, file: str) -> set[Path]:
    """Return the modules of a tree that import one at run time, directly or through others, and the module itself.

    Args:
        root: Of the tree.
        file: Of the module, relative to the root.
    """
    modules = {_name(path.relative_to(root)): path for path in root.glob("openarm_*/**/*.py")}
    users: defaultdict[str, set[str]] = defaultdict(set)
    for name, path in modules.items():
        for other in _imports(ast.parse(path.read_text(encoding="utf-8"))):
            users[other].add(name)
    found, left = set[str](), [_name(Path(file))]
    while left:
        name = left.pop()
        if name not in found:
            found.add(name)
            left += users[name]
    return {modules[name] for name in found if name in modules}


def _name(path: Path) -> str:
    """Return the name of the module of a file, relative to the root."""
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imports(node: ast.AST) -> Iterator[str]:
    """Yield what a module imports, or may: of `from a import b`, `a` and `a.b`. Imports for type checkers are none."""
    if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
        return
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module:
        yield node.module
        yield from (f"{node.module}.{alias.name}" for alias in node.names)
    for child in ast.iter_child_nodes(node):
        yield from _imports(child)


def forget_compiled(root: Path, file: str) -> None:
    """Delete the compiled functions that may contain some of a module: numba looks for changes in one file only.

    Args:
        root: Of the tree.
        file: Of the module, relative to the root.
    """
    for path in importers(root, file):
        for pattern in (f"{path.stem}.*.nbi", f"{path.stem}.*.nbc"):
            for cached in (path.parent / "__pycache__").glob(pattern):
                cached.unlink(missing_ok=True)


def copy_tree(source: Path, target: Path, left_out: Collection[str] = ()) -> None:
    """Copy a tree with the times of its files, by which Python and numba know that their caches hold.

    Args:
        source: Its root.
        target: Root of the copy, which is made.
        left_out: Names at its top that are not copied.
    """

    def ignore(folder: str, names: list[str]) -> set[str]:
        return set(names) & set(left_out) if Path(folder) == source else set()

    shutil.copytree(source, target, symlinks=True, ignore=ignore, copy_function=_copy_file)


def _copy_file(source: str, target: str, *, follow_symlinks: bool = True) -> str:
    with contextlib.suppress(FileNotFoundError):  # a cache that is written at the moment
        shutil.copy2(source, target, follow_symlinks=follow_symlinks)
    return target


def restore(copy: Path, original: Path) -> None:
    """Make a copy of a tree equal to it again, but for caches, which know by themselves whether they hold."""
    there = _files(original)
    now = _files(copy)
    for name in now.keys() - there.keys():
        (copy / name).unlink()
    for name, state in there.items():
        if now.get(name) != state:
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            (copy / name).unlink(missing_ok=True)
            shutil.copy2(original / name, copy / name, follow_symlinks=False)


def _files(root: Path) -> dict[Path, tuple[int, int]]:
    """Return size and time of each file of a tree that is in no cache, by its path in the tree."""
    found: dict[Path, tuple[int, int]] = {}
    for folder, folders, names in os.walk(root):
        folders[:] = [name for name in folders if name != "__pycache__"]
        for path in (Path(folder) / name for name in names):
            state = path.lstat()
            found[path.relative_to(root)] = (state.st_size, state.st_mtime_ns)
    return found


def environment(tree: Path) -> dict[str, str]:
    """Return the environment in which Python imports the packages of a tree, whatever is installed."""
    before = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}  # a cache of each tree
    return {**before, "PYTHONPATH": os.pathsep.join(filter(None, (str(tree), before.get("PYTHONPATH", ""))))}


def require_own_packages(tree: Path, packages: Collection[str]) -> None:
    """Make sure that tests in a tree are tests of its packages.

    Raises:
        RuntimeError: When a package is imported from elsewhere.
    """
    code = "import importlib, sys; [print(importlib.import_module(name).__file__) for name in sys.argv[1:]]"
    command = [sys.executable, "-c", code, *packages]
    done = subprocess.run(command, cwd=tree, env=environment(tree), capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"the packages of {tree} can't be imported: {done.stderr.strip()}")
    for file in done.stdout.split():
        if not Path(file).resolve().is_relative_to(tree.resolve()):
            raise RuntimeError(f"{file} is imported instead of the copy in {tree}; is PYTHONPATH ignored?")


def verdict_of(code: int | None, output: str) -> tuple[Outcome, str]:
    """Return what a run of pytest says of a fault, and the first test that failed.

    Args:
        code: That pytest ended with; None: it took too long.
        output: What it printed.
    """
    if code is None:
        return "caught", "timeout"
    if code == 0:
        return "missed", ""
    if code != 1:
        return "broken", f"pytest ended with {code}"
    failed = _FAILED.search(output)
    return "caught", failed[1] if failed else "a test that pytest does not name"


@dataclass
class Bench:
    """Copies of a tree in which faults are tried, one for each worker.

    Attributes:
        folder: Of the copies; the one that stays as it is is called `original`.
        out: Folder of the logs.
        long: Whether `long` tests are run, too.
        timeout_s: Longest run of the tests of a package.
    """

    folder: Path
    out: Path
    long: bool = False
    timeout_s: float = TIMEOUT_S
    _free: SimpleQueue[Path] = field(default_factory=SimpleQueue[Path])
    _running: set[int] = field(default_factory=set[int])
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _ended: bool = False

    @property
    def original(self) -> Path:
        """The copy that no fault is put into."""
        return self.folder / "original"

    def prepare(self, root: Path, workers: int) -> None:
        """Copy a tree.

        Args:
            root: Its root; it may change from now on.
            workers: Faults that are tried at the same time.
        """
        copy_tree(root, self.original, LEFT_OUT)
        for number in range(workers):
            self._free.put(self.folder / f"copy_{number}")

    def try_fault(self, fault: Fault, tests: Sequence[str]) -> Row:
        """Run tests with a fault, in a copy that is free.

        Args:
            fault: Is put into the copy.
            tests: Files and folders relative to the root.
        """
        if why := why_not(fault, self.original):
            return Row(fault.package, fault.id, "does not apply", why, 0.0)
        tests = [test for test in tests if (self.original / test).exists()]  # of an older tree
        if not tests:
            return Row(fault.package, fault.id, "broken", "the tree has none of the tests of its package", 0.0)
        copy, unsure = self._free.get(), list[str]()
        try:
            if copy.exists():
                restore(copy, self.original)
            else:
                copy_tree(self.original, copy)
            compiled = is_compiled(copy / fault.file)
            if compiled:
                forget_compiled(copy, fault.file)
            apply(fault, copy)
            began = time.monotonic()
            while True:
                code, output = self._pytest(copy, [*tests, *unsure], self.out / f"{fault.id}.log")
                outcome, test = verdict_of(code, output)
                named = "::" in test
                if (
                    outcome != "caught"
                    or not named
                    or self._pytest(self.original, [test], self.out / f"{fault.id}.check.log")[0] == 0
                ):
                    break
                unsure.append(f"--deselect={test}")  # it fails without the fault, too
            seconds = time.monotonic() - began
            if compiled:  # what was compiled meanwhile contains the fault
                shutil.rmtree(copy, ignore_errors=True)
        finally:
            self._free.put(copy)
        return Row(fault.package, fault.id, outcome, test, round(seconds, 1))

    def _pytest(self, copy: Path, tests: Sequence[str], log: Path) -> tuple[int | None, str]:
        """Run pytest in a copy; return its exit code, None when it took too long, and what it printed."""
        command = [sys.executable, "-m", "pytest", "-q", "-x", "--no-header", "-p", "no:cacheprovider"]
        command += [*(["--all"] if self.long else []), *tests]
        with log.open("w", encoding="utf-8") as output:
            with self._lock:
                if self._ended:
                    raise KeyboardInterrupt
                process = subprocess.Popen(
                    command, cwd=copy, env=environment(copy), stdin=subprocess.DEVNULL, stdout=output,
                    stderr=subprocess.STDOUT, start_new_session=True,
                )  # fmt: skip
                self._running.add(process.pid)
            try:
                code: int | None = process.wait(self.timeout_s)
            except subprocess.TimeoutExpired:
                _kill(process.pid)
                process.wait()
                code = None
            finally:
                with self._lock:
                    self._running.discard(process.pid)
        return code, log.read_text(encoding="utf-8", errors="replace")

    def end(self) -> None:
        """Kill what runs; nothing is begun any more."""
        with self._lock:
            self._ended = True
            for group in self._running:
                _kill(group)


def _kill(group: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)


def run(bench: Bench, packages: Mapping[str, Package], faults: Sequence[Fault], workers: int) -> list[Row]:
    """Try faults and print a line about each as it ends.

    Args:
        bench: Prepared.
        packages: Whose tests are run, by name.
        faults: To try.
        workers: How many at the same time.

    Returns:
        A row for each, in their order.
    """
    rows: dict[str, Row] = {}
    pool = ThreadPoolExecutor(workers)
    try:
        futures = [pool.submit(bench.try_fault, fault, packages[fault.package].tests) for fault in faults]
        for done in as_completed(futures):
            row = done.result()
            rows[row.id] = row
            said = f": {row.test}" if row.test else ""
            print(f"{row.package} {row.id}: {row.verdict} in {row.seconds:.0f} s{said}", flush=True)
    finally:
        bench.end()
        pool.shutdown(wait=True, cancel_futures=True)
    return [rows[fault.id] for fault in faults]


def report(rows: Sequence[Row]) -> str:
    """Return a table of what was caught of what pytest judged, by package, and the list of what was not caught."""
    names = list(dict.fromkeys(row.package for row in rows))
    width = max(map(len, (*names, "package")))
    lines = [f"{'package':<{width}}  caught"]
    for name in (*names, "all"):
        mine = [row for row in rows if name in (row.package, "all") and row.verdict in ("caught", "missed")]
        caught = sum(row.verdict == "caught" for row in mine)
        lines.append(f"{name:<{width}}  {caught:>2} of {len(mine)}")
    for verdict in ("missed", "broken", "does not apply"):
        if mine := [row for row in rows if row.verdict == verdict]:
            lines += ["", verdict]
            lines += [f"  {row.package} {row.id}{f': {row.test}' if row.test else ''}" for row in mine]
    return "\n".join(lines)


def chosen(packages: Mapping[str, Package], names: str, ids: str) -> list[Fault]:
    """Return the faults that are asked for, in the order of the list.

    Args:
        packages: The list, by name.
        names: Of packages, comma-separated; empty: all.
        ids: Of faults, comma-separated; empty: all of these packages.

    Raises:
        ListError: When there is no such package, or no such fault in them.
    """
    wanted = names.split(",") if names else list(packages)
    if unknown := [name for name in wanted if name not in packages]:
        raise ListError(f"no package {', '.join(unknown)}; packages: {', '.join(packages)}")
    faults = [fault for name, package in packages.items() if name in wanted for fault in package.faults]
    known = [fault.id for fault in faults]
    if unknown := [one for one in ids.split(",") if ids and one not in known]:
        raise ListError(f"no fault {', '.join(unknown)}; faults: {', '.join(known)}")
    return [fault for fault in faults if not ids or fault.id in ids.split(",")]


def main(arguments: Sequence[str] | None = None) -> int:
    """Try the faults and print what the tests missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--root", type=Path, default=ROOT, help="tree with the code and the tests; by default this one")
    parser.add_argument("--packages", default="", help="comma-separated; by default all")
    parser.add_argument("--faults", default="", help="ids, comma-separated; by default all of the packages")
    parser.add_argument("--all", action="store_true", help="run the tests that are marked `long`, too")
    parser.add_argument("--workers", type=int, default=2, help="faults that are tried at the same time")
    parser.add_argument("--out", type=Path, help="folder of the logs; a temporary one by default")
    parser.add_argument("--json", type=Path, help="file for the rows")
    options = parser.parse_args(arguments)
    root: Path = options.root.resolve()
    if options.workers < 1:
        parser.error(f"--workers is {options.workers}, expected at least 1")
    if not (root / "tests").is_dir() or not (root / "openarm_common").is_dir():
        parser.error(f"--root {root} is no checkout: expected the folders tests and openarm_common in it")
    if options.json is not None and not options.json.resolve().parent.is_dir():
        parser.error(f"--json {options.json}: its folder is not there; make it first")
    try:
        packages = load()
        faults = chosen(packages, options.packages, options.faults)
    except ListError as error:
        parser.error(str(error))
    if wrong := check(packages):
        parser.error("\n".join([f"{LIST} is wrong", *wrong]))
    out: Path = (options.out or Path(tempfile.mkdtemp(prefix="openarm_faults_logs_"))).resolve()
    out.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(prefix="openarm_faults_", ignore_cleanup_errors=True) as folder:
            bench = Bench(Path(folder), out, options.all)
            bench.prepare(root, options.workers)
            require_own_packages(bench.original, sorted({fault.package for fault in faults}))
            rows = run(bench, packages, faults, options.workers)
    except KeyboardInterrupt:
        print(f"interrupted; the copies are removed (logs: {out})", file=sys.stderr)
        return 130
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 1
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n", encoding="utf-8")
    print(report(rows), f"(logs: {out})", sep="\n")
    return 0 if all(row.verdict in ("caught", "missed") for row in rows) else 1


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # also where a script has begun it in the background
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(main())
