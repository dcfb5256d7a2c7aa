# SPDX-License-Identifier: Apache-2.0
"""Parameters of nodes: ROS parameter files, dotted names, variables."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from openarm_common.config import load_yaml
from openarm_common.errors import Code, OpenArmError


def read_params(path: Path, node: str) -> dict[str, Any]:
    """Read the parameters of one node from a ROS parameter file (`/**` first, then the node's own), flat.

    Raises:
        OpenArmError: CONFIG_INVALID, for a file of another form.
    """
    params: dict[str, Any] = {}
    data = load_yaml(path)
    for key in ("/**", node, f"/{node}"):
        if key not in data:
            continue
        section: Any = data[key]
        if not isinstance(section, dict) or not isinstance(section.get("ros__parameters"), dict):  # pyright: ignore[reportUnknownMemberType]
            raise OpenArmError(Code.CONFIG_INVALID, f"{path}:{key}: expected a mapping `ros__parameters`")
        params.update(flatten(section["ros__parameters"]))  # pyright: ignore[reportUnknownArgumentType]
    return params


def flatten(params: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Join nested keys with dots, as ROS names parameters."""
    flat: dict[str, Any] = {}
    for key, value in params.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f"{prefix}{key}."))  # pyright: ignore[reportUnknownArgumentType]
        else:
            flat[f"{prefix}{key}"] = value
    return flat


_VARIABLE = re.compile(r"\$\{([^}]*)\}")


def substitute(value: Any, variables: Mapping[str, Any], where: str) -> Any:
    """Fill `${name}` in; a value that is nothing else keeps the variable's type.

    Raises:
        OpenArmError: CONFIG_INVALID, listing the variables.
    """
    if isinstance(value, list):
        return [substitute(item, variables, where) for item in value]  # pyright: ignore[reportUnknownVariableType]
    if not isinstance(value, str):
        return value
    unknown = [name for name in _VARIABLE.findall(value) if name not in variables]
    if unknown:
        choices = ", ".join(f"${{{name}}}" for name in variables)
        raise OpenArmError(Code.CONFIG_INVALID, f"{where}: unknown variable ${{{unknown[0]}}}; there are {choices}")
    whole = _VARIABLE.fullmatch(value)
    if whole:  # keeps its type
        return variables[whole.group(1)]
    return _VARIABLE.sub(lambda match: str(variables[match.group(1)]), value)
