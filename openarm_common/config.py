# SPDX-License-Identifier: Apache-2.0
"""Configuration as frozen models, read from YAML with errors that name the file and the key."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError

from openarm_common.errors import Code, OpenArmError


class Config(BaseModel):
    """Base of every configuration model: frozen, unknown keys refused, defaults checked too."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)


ConfigT = TypeVar("ConfigT", bound=BaseModel)


def load_yaml(
    path: Path, code: Code = Code.CONFIG_INVALID, *, loader: type[yaml.SafeLoader] = yaml.SafeLoader
) -> dict[str, Any]:
    """Read a YAML mapping.

    Args:
        path: File to read.
        code: Of the error.
        loader: Which YAML is accepted.

    Raises:
        OpenArmError: With `code`, when the file is missing, is not YAML, or is not a mapping.
    """
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), Loader=loader)
    except FileNotFoundError as error:
        raise OpenArmError(code, f"{path} does not exist") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise OpenArmError(code, f"{path} is not valid YAML: {error}") from error
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise OpenArmError(code, f"{path} holds a {type(data).__name__}, expected a mapping of keys")
    return data  # pyright: ignore[reportUnknownVariableType]


def metres_by_name(items: Sequence[str], field: str, example: str, low: float, high: float) -> dict[str, float]:
    """Parse items of `name=metres`, since ROS parameters know no mappings.

    Args:
        items: The field.
        field: Its name.
        example: An item as it should be.
        low: Least value, m.
        high: Largest value, m.

    Raises:
        ValueError: With what is wrong, for a validator of the model.
    """
    found: dict[str, float] = {}
    for item in items:
        name, _, text = item.partition("=")
        try:
            metres = float(text)
        except ValueError:
            raise ValueError(f"{field} {item!r}: expected `name=metres`, such as {example}") from None
        if not low <= metres <= high:
            raise ValueError(f"{field} {item!r}: expected {low:g} .. {high:g} m")
        found[name.strip()] = metres
    return found


#: `json_schema_extra` of a field that may change while a node runs, and `Field` with it.
AT_RUN_TIME: dict[str, JsonValue] = {"at_run_time": True}
RunTimeField = partial(Field, json_schema_extra=AT_RUN_TIME)


def validate(model: type[ConfigT], data: dict[str, Any], where: str, code: Code = Code.CONFIG_INVALID) -> ConfigT:
    """Validate a mapping; every wrong key is named at once.

    Args:
        model: Model of the data.
        data: The mapping.
        where: Begins each fault, such as the path of a file.
        code: Of the error.

    Raises:
        OpenArmError: With `code`, and `where`:key for each fault.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise OpenArmError(code, describe_faults(error, where, model)) from error


def describe_faults(error: ValidationError, where: str, model: type[BaseModel]) -> str:
    """Turn a pydantic error into `where:key: fault` sentences, with the valid keys for an unknown one.

    Args:
        error: What pydantic found.
        where: Begins each fault.
        model: Model of the data.
    """
    faults: list[str] = []
    for item in error.errors():
        key = ".".join(str(part) for part in item["loc"]) or "(top level)"
        text = item["msg"].removeprefix("Value error, ")
        if item["type"] == "extra_forbidden":
            text = "unknown key" + (f"; valid keys: {', '.join(model.model_fields)}" if len(item["loc"]) == 1 else "")
        elif item["type"] != "missing":
            text += f", got {item['input']!r}"
        faults.append(f"{where}:{key}: {text}")
    return "; ".join(faults)


def load_config(path: Path, model: type[ConfigT]) -> ConfigT:
    """Read and validate a YAML file.

    Raises:
        OpenArmError: CONFIG_INVALID, naming file and key.
    """
    return validate(model, load_yaml(path), str(path))
