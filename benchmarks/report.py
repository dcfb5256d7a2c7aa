# SPDX-License-Identifier: Apache-2.0
"""What every benchmark writes: machine, versions, rows of metrics, each with its target and peer."""

from __future__ import annotations

import json
import os
import platform
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGES = ("numpy", "scipy", "numba", "opencv-python-headless", "mujoco")


@dataclass(frozen=True)
class Row:
    """One metric; the id is stable, `better` is lower, higher or a range."""

    metric: str
    value: float
    unit: str
    better: str
    target: float | None
    peer: str = ""
    peer_value: float | None = None
    n: int = 0

    def as_json(self) -> dict[str, object]:
        """With the ratio of the peer's value to ours."""
        ratio = self.peer_value / self.value if self.peer_value is not None and self.value else None
        return {**asdict(self), "ratio": ratio}


def machine() -> dict[str, object]:
    """What the figures were measured on."""
    model = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = names[0].partition(":")[2].strip() if names else model
    return {"cpu": model, "cores": os.cpu_count(), "system": platform.platform(), "load": os.getloadavg()[0]}


def versions() -> dict[str, str]:
    """Of Python and of the libraries that matter."""
    out = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            continue
    return out


def write_report(rows: list[Row], path: Path | None) -> None:
    """Print the metrics, and write them as JSON where a path is given."""
    for row in rows:
        ratio = row.as_json()["ratio"]
        times = f", ratio {ratio:.3g}" if ratio is not None else ""
        peer = f"  ({row.peer}: {row.peer_value:.4g}{times})" if row.peer_value is not None else ""
        target = f"  target {row.target:g}" if row.target is not None else ""
        print(f"{row.metric:32s} {row.value:10.4g} {row.unit:4s}{target}{peer}  n={row.n}")
    if path is not None:
        report = {"machine": machine(), "versions": versions(), "rows": [row.as_json() for row in rows]}
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
