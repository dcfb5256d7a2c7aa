# SPDX-License-Identifier: Apache-2.0
"""The three rings: cores know no ROS, packages know no sibling, bring-up knows all; no circles and no long chains."""

from __future__ import annotations

import ast
import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
import structure

ROOT = Path(__file__).parents[1]
PACKAGES = sorted(path.name for path in ROOT.glob("openarm_*") if (path / "__init__.py").is_file())
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py") if path.name != "setup.py")

#: These orchestrate processes and measure the whole: they may import any package.
OUTER = ("openarm_bringup", "openarm_evaluation")
#: These are libraries: the others may import them, and each of them those before it.
INNER = ("openarm_common", "openarm_world", "openarm_control")
#: Modules of the longest import chain that a package may have.
LONGEST = 10
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
#: Message packages that a wheel of ROS 2 brings, and those that `interfaces/` brings.
FROM_WHEELS = {
    "shape_msgs",
    "action_msgs",
    "builtin_interfaces",
    "diagnostic_msgs",
    "geometry_msgs",
    "nav_msgs",
    "rcl_interfaces",
    "rosgraph_msgs",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
    "trajectory_msgs",
    "unique_identifier_msgs",
    "visualization_msgs",
}
#: A class that may be a node.
NODE = re.compile(r"^ *class \w+\(.*Node\b", re.M)
ROS = ("rclpy", "rosidl", "ament", "tf2_ros", "rpyutils")


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


@pytest.mark.parametrize("package", PACKAGES)
def test_arrows_point_inwards(package: str) -> None:
    faults: list[str] = []
    for path in (path for path in MODULES if path.is_relative_to(ROOT / package)):
        for name, line in structure.imported_names(path).items():
            top = name.partition(".")[0]
            if is_ros(name) and not is_shell(path):
                faults.append(f"{path}:{line} is core and imports {name}")
            inner = INNER[: INNER.index(package)] if package in INNER else INNER
            if top in PACKAGES and top not in (package, *inner) and package not in OUTER:
                faults.append(f"{path}:{line} imports the sibling {name}; packages meet over DDS")
            if package == "openarm_bringup" and top == "openarm_evaluation":
                faults.append(f"{path}:{line} imports {name}, which imports openarm_bringup")
            if top in PACKAGES and not is_shell(path) and package not in OUTER and "ros" in name.split(".")[:-1]:
                faults.append(f"{path}:{line} is core and imports the shell {name}")
    assert not faults, "; ".join(faults)


@pytest.mark.parametrize("package", PACKAGES)
def test_package_xml_declares_what_is_imported(package: str) -> None:
    """So that rosdep and colcon know of it; docs/native.md says what neither ROS nor Ubuntu has."""
    text = (ROOT / package / "package.xml").read_text(encoding="utf-8")
    page = (ROOT / "docs" / "native.md").read_text(encoding="utf-8")
    declared = set(re.findall(r"<(?:exec_)?depend>([^<]+)</", text))
    known = {*sys.stdlib_module_names, package, *re.findall(r"^\| `([a-z0-9_]+)` \|", page, re.MULTILINE)}
    files = (ROOT / package).rglob("*.py")
    imported = {name.partition(".")[0]: path.name for path in files for name, _, _ in structure.imports(path)}
    missing = {
        name: file
        for name, file in imported.items()
        if name not in known and KEYS.get(name, name) and KEYS.get(name, name) not in declared
    }
    assert missing == {}, f"{package}/package.xml lacks an exec_depend, or docs/native.md a row: {missing}"


@pytest.mark.requirement("A-09")
def test_messages_come_from_wheels_or_from_interfaces() -> None:
    interfaces = {path.parent.name for path in (ROOT / "interfaces").glob("*/package.xml")}
    parts = [(path, name.split(".")) for path in MODULES for name, _, _ in structure.imports(path)]
    unknown = {
        (path, top)
        for path, (top, *kind) in parts
        if kind[:1] in (["msg"], ["srv"], ["action"]) and top not in {"rclpy", *FROM_WHEELS, *interfaces}
    }
    assert unknown == set(), "these need an apt ROS"


def test_a_reversed_arrow_would_be_seen() -> None:
    assert is_ros("sensor_msgs.msg.Image")
    assert is_ros("rclpy.node.Node")
    assert is_ros("openarm_interfaces.msg.GraspStatus")
    assert not is_ros("openarm_common.ros.convert.image_to_array")
    assert is_shell(Path("openarm_grasp/ros/node.py"))
    assert not is_shell(Path("openarm_grasp/strategies/direct.py"))


@pytest.mark.parametrize("package", PACKAGES)
def test_import_chains_of_a_package_are_short_and_have_no_circle(package: str) -> None:
    graph = structure.module_imports(ROOT, package)
    assert structure.circles(graph) == []
    chain = structure.longest_chain(graph)
    assert len(chain) <= LONGEST, f"{len(chain)} modules, at most {LONGEST}: {' → '.join(chain)}"


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_lists_at_most_a_dozen_public_names_and_shows_a_use(package: str) -> None:
    folder = ROOT / package
    assert 1 <= structure.exported(folder) <= 12
    docstring = ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8")))
    assert f">>> from {package} import " in (docstring or "")


def test_importing_a_package_is_light() -> None:
    heavy = "{'numpy', 'numba', 'mujoco', 'rclpy', 'pinocchio', 'cv2', 'scipy', 'pydantic'}"
    script = f"""
import importlib, sys
for package in {PACKAGES}:
    before = set(sys.modules)
    importlib.import_module(package)
    print(package, (set(sys.modules) - before) & {heavy})
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [f"{package} set()" for package in PACKAGES]


def _attributes_set(code: ast.AST) -> set[str]:
    """Names that `self.NAME = ...` gives a value to."""
    stores = (node for node in ast.walk(code) if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store))
    return {node.attr for node in stores if isinstance(node.value, ast.Name) and node.value.id == "self"}


def test_no_node_overwrites_what_rclpy_keeps() -> None:
    """A node with `self._timers` of its own loses the timers of its base class without an error."""
    spec = importlib.util.find_spec("rclpy")
    assert spec is not None
    assert spec.origin is not None
    folder = Path(spec.origin).parent
    kept = _attributes_set(ast.parse((folder / "node.py").read_text()))
    assert {"_timers", "_publishers"} <= kept
    found = set[Path]()
    for path in (*MODULES, *(ROOT / "tests").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        for code in ast.walk(ast.parse(text)) if NODE.search(text) else ():
            bases = [ast.unparse(base).partition("[")[0] for base in getattr(code, "bases", ())]
            if {"Node", "BaseNode", "ManagedNode", "RosNode"} & set(bases):
                found.add(path)
                assert not _attributes_set(code) & kept, f"{path}: {ast.unparse(code)[:60]}"
    assert len(found) > 15


def test_packages_import_each_other_in_no_circle() -> None:
    assert structure.circles(structure.package_imports(ROOT)) == []


def test_a_circle_and_the_longest_chain_are_found() -> None:
    graph = {"a": {"b", "c"}, "b": {"c"}, "c": {"d"}, "d": set(), "e": {"f"}, "f": {"e"}}
    assert structure.longest_chain(graph) == ("a", "b", "c", "d")
    assert structure.circles(graph) == [["e", "f"]]


def test_code_lines_leave_out_comments_docstrings_and_blank_lines() -> None:
    assert structure.python_lines('"""Doc."""\n\n# comment\nx = """\ntext\n"""  # comment\n') == 3
    assert structure.web_lines("// a\nconst a = 1; /* b\nc */\n\nconst u = 'http://b'; // c\n<!-- d -->\n") == 2
    assert structure.shell_lines("#!/bin/sh\n# a\n\nset -eu\n") == 1
