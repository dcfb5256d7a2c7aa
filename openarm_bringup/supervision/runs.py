# SPDX-License-Identifier: Apache-2.0
"""Run folders, and the list of graphs that run now.

A run folder is `runs/<stamp>/` below the working directory (or $OPENARM_RUNS); `runs/latest` points at the newest.
What runs now is one small JSON file a supervisor in $XDG_RUNTIME_DIR/openarm (or the temporary folder), so that
`openarm ps`, `logs` and `pick` find it from any terminal.
"""

from __future__ import annotations

import errno
import json
import os
import re
from collections.abc import Iterable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import psutil
from pydantic import ValidationError

from openarm_bringup.supervision.state import foreign, state_dir
from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import DEFAULT, robot_name

#: Folder of a run with its flight recordings, and the name of one.
RECORDINGS, RECORDING = "recordings", re.compile(r"\d+_\w+")


class NodeRecord(Config):
    """State of one node, as its supervisor records it."""

    state: str
    pid: int | None = None
    restarts: int = 0
    log: str = ""
    #: What it says on /diagnostics, if that is a warning or an error.
    trouble: str = ""


class RunRecord(Config):
    """One running graph."""

    graph: str
    robot: str = DEFAULT
    pid: int
    pid_created: float
    domain: int
    discovery: str
    run_dir: str
    started: str
    ready: bool = False
    nodes: dict[str, NodeRecord]

    @property
    def ready_nodes(self) -> list[str]:
        """Names of the nodes that are ready now."""
        return [name for name, node in self.nodes.items() if node.state == "ready"]

    @property
    def health(self) -> str:
        """In a word or two: ready, not ready, or without which nodes it goes on."""
        failed = [name for name, node in self.nodes.items() if node.state == "failed"]
        if failed:
            return f"degraded, without {', '.join(failed)}"
        return "ready" if self.ready else "not ready"

    @property
    def alive(self) -> bool:
        """Whether its supervisor still runs (and not another process with its number)."""
        try:
            return abs(psutil.Process(self.pid).create_time() - self.pid_created) < 1.0
        except psutil.NoSuchProcess:
            return False


def runs_root(environ: Mapping[str, str] = os.environ) -> Path:
    """Return the folder of all runs."""
    return Path(environ.get("OPENARM_RUNS") or "runs").resolve()


def new_run_dir(root: Path | None = None) -> Path:
    """Make a run folder named by the time of day, with `logs/` and `params/`, and point `latest` at it.

    Raises:
        OpenArmError: ENVIRONMENT, when it can't be made.
    """
    root = runs_root() if root is None else root
    try:
        return _make_run_dir(root)
    except OSError as error:
        raise OpenArmError(
            Code.ENVIRONMENT,
            f"no folder for this run in {root}: {error.strerror}; make room, or choose another by OPENARM_RUNS",
        ) from error


def _make_run_dir(root: Path) -> Path:
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    number, folder = 1, root / stamp
    while True:
        try:
            folder.mkdir(parents=True)
            break
        except FileExistsError:
            number, folder = number + 1, root / f"{stamp}-{number + 1}"
    (folder / "logs").mkdir()
    (folder / "params").mkdir()
    link = root / f".latest-{os.getpid()}"
    link.unlink(missing_ok=True)
    link.symlink_to(folder.name)
    link.replace(root / "latest")
    return folder


def write_record(record: RunRecord) -> Path:
    """Write the record of this supervisor, atomically.

    Raises:
        OSError: It can't be written, or the folder is not this user's.
    """
    folder = state_dir()
    if why := foreign(folder):
        raise PermissionError(errno.EPERM, why, str(folder))
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    path = folder / f"{record.pid}.json"
    draft = path.with_suffix(".tmp")
    try:
        draft.write_text(record.model_dump_json(indent=1), encoding="utf-8")
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
    return path


def remove_record(pid: int) -> None:
    """Remove the record of a supervisor that ends."""
    (state_dir() / f"{pid}.json").unlink(missing_ok=True)


def running() -> list[RunRecord]:
    """Return the graphs that run now, oldest first; records of dead supervisors are removed.

    Raises:
        OpenArmError: ENVIRONMENT, when the folder of the records is not this user's.
    """
    records: list[RunRecord] = []
    folder = state_dir()
    if why := foreign(folder):
        text = f"{folder}, where graphs leave their records: {why}, so none of them is believed"
        raise OpenArmError(Code.ENVIRONMENT, f"{text}; remove it, or set XDG_RUNTIME_DIR to a folder of your own")
    for path in sorted(folder.glob("*.json")) if folder.is_dir() else []:
        try:
            record = RunRecord.model_validate_json(path.read_text(encoding="utf-8"))
        except (ValidationError, FileNotFoundError):
            continue  # of another version, or just ended
        if record.alive:
            records.append(record)
        else:
            path.unlink(missing_ok=True)
    return sorted(records, key=lambda record: record.started)


def the_running(domain: int | None = None) -> RunRecord:
    """Return the graph that runs now.

    Args:
        domain: Selects one of several running graphs; None = ROS_DOMAIN_ID if it is set, else the only one.

    Raises:
        OpenArmError: NOT_READY, when none runs; INVALID_ARGUMENT, when several do, in different domains.
    """
    if domain is None and os.environ.get("ROS_DOMAIN_ID", "").isdecimal():
        domain = int(os.environ["ROS_DOMAIN_ID"])
    records = running()
    matching = [record for record in records if domain is None or record.domain == domain]
    if len({record.domain for record in matching}) == 1:
        return matching[-1]  # several graphs of one domain are one graph to their clients
    listed = "; ".join(f"{r.graph} in domain {r.domain} (pid {r.pid})" for r in records)
    if not matching:
        hint = f"; running: {listed}" if listed else ""
        where = "" if domain is None else f" in domain {domain}"
        raise OpenArmError(Code.NOT_READY, f"no graph is running{where}{hint}; start one with `openarm up`")
    raise OpenArmError(Code.INVALID_ARGUMENT, f"several graphs are running: {listed}; choose one with --domain")


def own() -> RunRecord | None:
    """Return the graph whose supervisor has started this process; None when another program has."""
    return next((run for run in running() if run.pid == os.getppid()), None)


def refuse_twins(domain: int, nodes: Iterable[str]) -> None:
    """Refuse nodes that run in a domain already, where commands would reach both of a name, and another robot there.

    Raises:
        OpenArmError: BUSY, naming the graph that has them.
    """
    for run in running():
        if run.domain != domain or run.pid == os.getpid():
            continue
        if run.robot != robot_name():
            text = f"{run.graph} (supervisor {run.pid}) runs in domain {domain} with robot {run.robot!r}"
            raise OpenArmError(Code.BUSY, f"{text}, this graph is of {robot_name()!r}: start it in another (--domain)")
        if twins := [name for name in nodes if name in run.nodes]:
            raise OpenArmError(
                Code.BUSY,
                f"{run.graph} (supervisor {run.pid}) runs in domain {domain} and has {', '.join(twins)} already: end "
                "it with Ctrl-C where it was started, or start this one in a domain of its own (--domain)",
            )


def recordings(folder: Path) -> list[Path]:
    """Return the flight recordings in a folder, `NN_CODE`, the oldest first; none when there is no such folder."""
    found = [path for path in folder.iterdir() if RECORDING.fullmatch(path.name)] if folder.is_dir() else []
    return sorted(found, key=recording_number)


def recording_number(path: Path) -> int:
    """Return the number of a flight recording, which is in its name."""
    return int(path.name.partition("_")[0])


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write a JSON report.

    Raises:
        OpenArmError: ENVIRONMENT, when it can't be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(data, indent=2, default=str) + "\n", encoding="utf-8")
    except OSError as error:
        raise OpenArmError(Code.ENVIRONMENT, f"can't write {path}: {error.strerror}") from error
