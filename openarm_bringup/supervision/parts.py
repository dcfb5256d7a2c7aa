# SPDX-License-Identifier: Apache-2.0
"""What a graph file says once and means for each part of the robot: arms, and cameras.

A line of a list with `${arm}` or `${camera}` is there once for each arm, or each camera with depth; a node whose name
has `${hand_camera}` once for each camera that a hand carries, and so are lines with it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from openarm_common.camera.cameras import depth_cameras, hand_cameras
from openarm_common.robot.folder import load_folder, robot_name


def for_each_part(document: Any) -> Any:
    """Return the content of a graph file for the robot of this process.

    Raises:
        OpenArmError: Same as `load_folder` and `load_cameras`, when the file speaks of parts.
    """
    if not any(mark in str(document) for mark in ("${arm}", "${camera}", "${hand_camera}")):
        return document
    arms = tuple(load_folder(robot_name())[1].arms)
    return _expanded(document, {"arm": arms, "camera": tuple(depth_cameras()), "hand_camera": hand_cameras()})


def _expanded(value: Any, parts: Mapping[str, Sequence[str]]) -> Any:
    if isinstance(value, dict):
        rows = (copy for key, item in value.items() for copy in _copies(str(key), (key, item), parts))  # pyright: ignore
        return {key: _expanded(item, parts) for key, item in rows}
    if isinstance(value, list):
        found = (copy for item in value for copy in _copies(str(item), item, parts))  # pyright: ignore
        return [_expanded(item, parts) for item in found]
    return value


def _copies(text: str, value: Any, parts: Mapping[str, Sequence[str]]) -> Iterator[Any]:
    """Yield a value once for each combination of the parts that a text names."""
    named = [name for name in parts if f"${{{name}}}" in text]
    for chosen in itertools.product(*(parts[name] for name in named)):
        yield _filled(value, {f"${{{name}}}": part for name, part in zip(named, chosen, strict=True)})


def _filled(value: Any, texts: Mapping[str, str]) -> Any:
    if isinstance(value, dict):
        return {_filled(key, texts): _filled(item, texts) for key, item in value.items()}  # pyright: ignore
    if isinstance(value, list | tuple):
        return type(value)(_filled(item, texts) for item in value)  # pyright: ignore
    if isinstance(value, str):
        for mark, part in texts.items():
            value = value.replace(mark, part)
    return value
