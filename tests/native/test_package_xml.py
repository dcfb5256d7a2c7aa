# SPDX-License-Identifier: Apache-2.0
"""What a package imports its package.xml declares, so that rosdep and colcon know of it."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = sorted(path.parent for path in ROOT.glob("openarm_*/package.xml"))
#: rosdep keys of what Ubuntu packages.
KEYS = {
    "aiohttp": "python3-aiohttp",
    "PIL": "python3-pil",
    "cv2": "python3-opencv",
    "jinja2": "python3-jinja2",
    "matplotlib": "python3-matplotlib",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "psutil": "python3-psutil",
    "pydantic": "python3-pydantic",
    "rich": "python3-rich",
    "scipy": "python3-scipy",
    "yaml": "python3-yaml",
    "launch": "launch",
    "xacro": "xacro",
    "setuptools": "",
}


def imported(package: Path) -> dict[str, str]:
    """Return what the modules of a package import from elsewhere, each with a file that does."""
    found: dict[str, str] = {}
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                names = [node.module]
            found |= {name.partition(".")[0]: path.name for name in names}
    return {name: file for name, file in found.items() if name not in {*sys.stdlib_module_names, package.name}}


def from_pip() -> set[str]:
    """Return the modules that docs/native.md says to install with pip, since neither ROS nor Ubuntu has them."""
    text = (ROOT / "docs" / "native.md").read_text(encoding="utf-8")
    return set(re.findall(r"^\| `([a-z0-9_]+)` \|", text, re.MULTILINE))


@pytest.mark.parametrize("package", PACKAGES, ids=lambda path: path.name)
def test_package_xml_declares_what_is_imported(package: Path) -> None:
    text = (package / "package.xml").read_text(encoding="utf-8")
    declared = set(re.findall(r"<(?:exec_)?depend>([^<]+)</", text))
    missing = {
        name: file
        for name, file in imported(package).items()
        if KEYS.get(name, name) and KEYS.get(name, name) not in declared and name not in from_pip()
    }
    assert missing == {}, f"{package.name}/package.xml lacks an exec_depend, or docs/native.md a row: {missing}"


def test_every_node_of_the_graphs_is_an_executable_of_its_package() -> None:
    """What `ros2 run` and a launch file start is what the graph starts."""
    from openarm_bringup.supervision.graph import graph_names, load_graph

    modules = {spec.module for name in graph_names() for spec in load_graph(name).nodes.values() if spec.module}
    for module in modules - {"openarm_bringup.ros.script_node"}:
        package = module.partition(".")[0]
        assert f"{module}:main" in (ROOT / package / "setup.py").read_text(encoding="utf-8"), module
