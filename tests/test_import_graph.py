# SPDX-License-Identifier: Apache-2.0
"""The three rings: cores know no ROS, packages know no sibling, bring-up knows all."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = sorted(path.name for path in ROOT.glob("openarm_*") if (path / "__init__.py").is_file())
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py") if path.name != "setup.py")

#: These orchestrate processes and measure the whole: they may import any package.
OUTER = ("openarm_bringup", "openarm_evaluation")
ROS = ("rclpy", "rosidl", "ament", "tf2_ros", "rpyutils")


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
    """Return whether a module may speak ROS: it stands in a folder `ros`."""
    return "ros" in path.parts[:-1]


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
        if top in PACKAGES and top not in (package, "openarm_common") and package not in OUTER:
            faults.append(f"{path.name}:{line} imports the sibling {name}; packages meet over DDS")
        if package == "openarm_bringup" and top == "openarm_evaluation":
            faults.append(f"{path.name}:{line} imports {name}, which imports openarm_bringup")
        if top in PACKAGES and not is_shell(path) and package not in OUTER and "ros" in name.split(".")[:-1]:
            faults.append(f"{path.name}:{line} is core and imports the shell {name}")
    assert not faults, "; ".join(faults)


def test_a_reversed_arrow_would_be_seen() -> None:
    assert is_ros("sensor_msgs.msg.Image")
    assert is_ros("rclpy.node.Node")
    assert is_ros("openarm_interfaces.msg.GraspStatus")
    assert not is_ros("openarm_common.ros.convert.image_to_array")
    assert is_shell(Path("openarm_grasp/ros/node.py"))
    assert not is_shell(Path("openarm_grasp/strategy/direct.py"))
