# SPDX-License-Identifier: Apache-2.0
"""The three rings: cores know no ROS, packages know no sibling, bring-up knows all."""

from __future__ import annotations

import ast
import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = sorted(path.name for path in ROOT.glob("openarm_*") if (path / "__init__.py").is_file())
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py") if path.name != "setup.py")

#: Modules that may speak ROS; everything else is core.
SHELL = ("*node.py", "*publisher.py", "*client.py", "*executor.py", "convert.py", "tf.py")
ROS = ("rclpy", "rosidl", "ament", "tf2_ros", "rpyutils")
MAX_LINES = 360  # "about 350"


def imports(path: Path) -> dict[str, int]:
    """Return the absolute names that a module imports at any place, with the line; type-checking blocks left out."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for_types = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    found: dict[str, int] = {}
    for node in ast.walk(tree):
        if id(node) in for_types:
            continue
        if isinstance(node, ast.Import):
            found.update({alias.name: node.lineno for alias in node.names})
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import; write the package's name"
            found.update({f"{node.module}.{alias.name}": node.lineno for alias in node.names})
    return found


def is_ros(name: str) -> bool:
    top = name.partition(".")[0]
    messages = top.endswith(("_msgs", "_interfaces")) or top in ("rosgraph_msgs", "std_srvs")
    return messages or top.startswith(ROS)


def is_shell(path: Path) -> bool:
    return any(fnmatch.fnmatch(path.name, pattern) for pattern in SHELL)


def test_packages_are_found() -> None:
    assert {"openarm_common", "openarm_bringup"} <= set(PACKAGES)
    assert len(MODULES) > 30


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_arrows_point_inwards(path: Path) -> None:
    package = path.relative_to(ROOT).parts[0]
    faults: list[str] = []
    for name, line in imports(path).items():
        top = name.partition(".")[0]
        if is_ros(name) and not is_shell(path):
            faults.append(f"{path.name}:{line} is core and imports {name}")
        if top in PACKAGES and top not in (package, "openarm_common") and package != "openarm_bringup":
            faults.append(f"{path.name}:{line} imports the sibling {name}; packages meet over DDS")
        if top == package and not is_shell(path) and package != "openarm_bringup":
            module = ROOT / Path(*name.split(".")).with_suffix(".py")
            inner = module if module.is_file() else module.parent.with_suffix(".py")
            if inner.is_file() and is_shell(inner):
                faults.append(f"{path.name}:{line} is core and imports the shell {inner.name}")
    assert not faults, "; ".join(faults)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_stay_small(path: Path) -> None:
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= MAX_LINES, f"{path.name} has {lines} lines; above {MAX_LINES} it holds two things"


def test_a_reversed_arrow_would_be_seen() -> None:
    assert is_ros("sensor_msgs.msg.Image")
    assert is_ros("rclpy.node.Node")
    assert is_ros("openarm_interfaces.msg.GraspStatus")
    assert not is_ros("openarm_common.convert.image_to_array")
    assert is_shell(Path("grasp/detect_node.py"))
    assert not is_shell(Path("grasp/machine.py"))
