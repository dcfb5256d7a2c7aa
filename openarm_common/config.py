# SPDX-License-Identifier: Apache-2.0
"""Configuration as frozen models, read from YAML with errors that name the file and the key.

Files come from others, too: their size and depth are bounded, aliases and keys that are given twice are refused, and
no error repeats more than a few words of them.
"""

from __future__ import annotations

import json
from collections.abc import Hashable, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue, ValidationError

from openarm_common.errors import Code, OpenArmError, said
from openarm_common.printable import brief, brief_text


class Config(BaseModel):
    """Base of every configuration model: frozen, unknown keys refused, defaults checked too."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)


ConfigT = TypeVar("ConfigT", bound=BaseModel)


def _ascending(ends: tuple[float, float]) -> tuple[float, float]:
    if not ends[0] < ends[1]:
        raise ValueError(f"{list(ends)} must ascend: expected [low, high] with low < high")
    return ends


#: Two ends, the lower first.
Interval = Annotated[tuple[float, float], AfterValidator(_ascending)]


#: Longest file or text, bytes, and deepest nesting.
MAX_YAML_BYTES, MAX_YAML_DEPTH = 4 * 2**20, 32

#: Most faults that an error names.
_FAULTS = 12


class _Loader(yaml.SafeLoader):
    """Refuses aliases, deep nesting, and a key given twice, which YAML would let the last one win."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event = self.peek_event()  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
        if isinstance(event, yaml.AliasEvent):
            raise yaml.MarkedYAMLError(None, None, "aliases are not accepted: write the value out", event.start_mark)
        if self.depth == MAX_YAML_DEPTH:
            raise yaml.MarkedYAMLError(
                None,
                None,
                f"nested deeper than {MAX_YAML_DEPTH} levels",
                event.start_mark,  # pyright: ignore
            )
        self.depth += 1
        node: Any = super().compose_node(parent, index)  # pyright: ignore[reportUnknownMemberType]
        self.depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[Hashable] = set()
        for key_node, _ in node.value:
            key: Any = self.construct_object(key_node, deep=True)  # pyright: ignore[reportUnknownMemberType]
            if not isinstance(key, Hashable) or key in seen:
                what = f"{brief(key)} is given twice" if isinstance(key, Hashable) else f"{brief(key)} is no key"
                raise yaml.MarkedYAMLError(None, None, what, key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


def parse_yaml(text: str, where: str, code: Code = Code.CONFIG_INVALID) -> Any:
    """Parse YAML without aliases.

    Args:
        text: Text of at most 4 MiB.
        where: Begins the error, such as the path of a file.
        code: Code of the error.

    Raises:
        OpenArmError: `code`, when it is not YAML, too long, or nested too deeply.
    """
    if len(text) > MAX_YAML_BYTES:
        raise OpenArmError(code, f"{where} is longer than {MAX_YAML_BYTES // 2**20} MiB")
    try:
        return yaml.load(text, Loader=_Loader)
    # a date or a number that is none ends in errors of datetime and int
    except (yaml.YAMLError, ValueError, TypeError, OverflowError) as error:
        raise OpenArmError(code, f"{where} is not valid YAML: {_fault(error)}") from error


def _fault(error: Exception) -> str:
    """What is wrong with a document, and where."""
    mark = error.problem_mark if isinstance(error, yaml.MarkedYAMLError) else None
    if mark is None or not isinstance(error, yaml.MarkedYAMLError):
        return said(error)
    context = f"{error.context}: " if error.context else ""
    return f"{brief_text(context + str(error.problem))}, line {mark.line + 1}, column {mark.column + 1}"


def read_text(path: Path, code: Code = Code.CONFIG_INVALID, most: int = MAX_YAML_BYTES) -> str:
    """Read a text file.

    Args:
        path: File to read.
        code: Code of the error.
        most: Longest file, bytes.

    Raises:
        OpenArmError: `code`, when the file is missing, longer, or not UTF-8.
    """
    try:
        with path.open("rb") as file:
            content = file.read(most + 1)
    except FileNotFoundError as error:
        raise OpenArmError(code, f"{path} does not exist") from error
    except (OSError, ValueError) as error:
        raise OpenArmError(code, f"can't read {brief_text(str(path))}: {said(error)}") from error
    if len(content) > most:
        raise OpenArmError(code, f"{path} is longer than {most // 2**20} MiB")
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        at = f"byte {error.start} is 0x{content[error.start]:02x}"
        raise OpenArmError(code, f"{path} is no text in UTF-8: {at}") from error


def load_json(path: Path, code: Code = Code.INVALID_ARGUMENT) -> Any:
    """Read JSON.

    Raises:
        OpenArmError: `code`, same as `read_text`, and when it is not JSON, or nested too deeply.
    """
    return parse_json(read_text(path, code), str(path), code)


def parse_json(text: str, where: str, code: Code = Code.INVALID_ARGUMENT) -> Any:
    """Parse JSON; as `parse_yaml`."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise OpenArmError(code, f"{where} is not valid JSON: {said(error)}") from error


def load_yaml(path: Path, code: Code = Code.CONFIG_INVALID) -> dict[str, Any]:
    """Read a YAML mapping.

    Args:
        path: File to read.
        code: Code of the error.

    Raises:
        OpenArmError: `code`, when the file is missing, is not YAML, or is not a mapping; see `parse_yaml`.
    """
    return _mapping(read_text(path, code), str(path), code)


def _mapping(text: str, where: str, code: Code) -> dict[str, Any]:
    data = parse_yaml(text, where, code)
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise OpenArmError(code, f"{where} holds a {type(data).__name__}, expected a mapping of keys")
    if unnamed := [key for key in data if not isinstance(key, str)]:  # pyright: ignore[reportUnknownVariableType]
        raise OpenArmError(code, f"{where} has the key {brief(unnamed[0])}, expected names")  # pyright: ignore
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
        ValueError: The fault, for a validator of the model.
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
        code: Code of the error.

    Raises:
        OpenArmError: `code`, and `where`:key for each fault.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise OpenArmError(code, describe_faults(error, where, model)) from error


def describe_faults(error: ValidationError, where: str, model: type[BaseModel]) -> str:
    """Turn a pydantic error into `where:key: fault` sentences, with the valid keys for an unknown one.

    Args:
        error: Error of pydantic.
        where: Begins each fault.
        model: Model of the data.
    """
    faults: list[str] = []
    for item in error.errors():
        key = ".".join(str(part) for part in item["loc"]) or "(top level)"
        key = key if key.isprintable() and len(key) < 160 else brief(key)
        text = item["msg"].removeprefix("Value error, ")
        if item["type"] == "extra_forbidden":
            text = "unknown key" + (f"; valid keys: {', '.join(model.model_fields)}" if len(item["loc"]) == 1 else "")
        elif item["type"] != "missing":
            text += f", got {brief(item['input'])}"
        faults.append(f"{where}:{key}: {text}")
    more = [f"and {len(faults) - _FAULTS} more"] if len(faults) > _FAULTS else []
    return "; ".join(faults[:_FAULTS] + more)


def load_config(path: Path, model: type[ConfigT]) -> ConfigT:
    """Read and validate a YAML file; a text that has been read before is not parsed again.

    Raises:
        OpenArmError: CONFIG_INVALID, naming file and key.
    """
    return cast(ConfigT, _parsed(model, read_text(path), str(path)))


@lru_cache(maxsize=64)
def _parsed(model: type[BaseModel], text: str, where: str) -> BaseModel:
    return validate(model, _mapping(text, where, Code.CONFIG_INVALID), where)
