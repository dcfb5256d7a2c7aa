# SPDX-License-Identifier: Apache-2.0
"""Golden numbers: the verified results of a bag, each with its tolerance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from openarm_bringup.supervision import runs
from openarm_common.config import load_json
from openarm_common.errors import Code, OpenArmError, said

#: How far a number may be off when it is computed again, by the unit its name ends in; others have to be equal.
TOLERANCES = {"_mm": 0.5, "_deg": 0.3, "_px": 0.05}
#: Share of cells that may differ between machines, by rounding of the last bit.
CELLS = 0.002


@dataclass(frozen=True)
class Difference:
    """A number that is not what it was; None where one side has none."""

    name: str
    expected: float | None
    got: float | None
    tolerance: float

    def __str__(self) -> str:
        if self.got is None:
            return f"{self.name}: {self.expected:g} expected, not there"
        if self.expected is None:
            return f"{self.name}: {self.got:g}, which no golden number expects"
        return f"{self.name}: {self.got:g}, expected {self.expected:g} within {self.tolerance:g}"


def tolerance_of(name: str, value: float) -> float:
    """Return the default tolerance of a number, by the unit in its name."""
    if name.startswith("map/"):
        return math.ceil(CELLS * abs(value))
    return next((limit for unit, limit in TOLERANCES.items() if name.endswith(unit)), 0.0)


def compare(golden: Mapping[str, Mapping[str, float]], numbers: Mapping[str, float]) -> list[Difference]:
    """Return what differs, by name."""
    differences: list[Difference] = []
    for name in sorted(golden.keys() | numbers.keys()):
        got = numbers.get(name)
        if name not in golden:
            differences.append(Difference(name, None, got, 0.0))
            continue
        value, tolerance = golden[name]["value"], golden[name]["tolerance"]
        if got is None or not abs(got - value) <= tolerance:
            differences.append(Difference(name, value, got, tolerance))
    return differences


def read(path: Path) -> dict[str, dict[str, float]]:
    """Read golden numbers.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the file is missing or something else.
    """
    if not path.exists():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"there are no golden numbers at {path}; --update writes them")
    data: Any = load_json(path)
    try:
        return {
            str(name): {key: float(entry[key]) for key in ("value", "tolerance")}
            for name, entry in data["numbers"].items()
        }
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        text = f"{path} holds no golden numbers: {type(error).__name__}: {said(error)}"
        raise OpenArmError(Code.INVALID_ARGUMENT, text) from error


def write(path: Path, numbers: Mapping[str, float], before: Mapping[str, Mapping[str, float]]) -> None:
    """Write the numbers; existing tolerances are kept."""
    entries = {
        name: {"value": value, "tolerance": before.get(name, {}).get("tolerance", tolerance_of(name, value))}
        for name, value in sorted(numbers.items())
    }
    runs.write_json(path, {"numbers": entries})
