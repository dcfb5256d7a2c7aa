# SPDX-License-Identifier: Apache-2.0
"""The three rings: cores know no ROS, packages know no sibling, bring-up knows all; no circles and no long chains."""

from __future__ import annotations

import ast
import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]


def _structure() -> ModuleType:
    """tools/structure.py as a module; tools/ is no package."""
    spec = importlib.util.spec_from_file_location("openarm_structure", ROOT / "tools" / "structure.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


structure = _structure()
PACKAGES = sorted(path.name for path in ROOT.glob("openarm_*") if (path / "__init__.py").is_file())
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py") if path.name != "setup.py")

#: These orchestrate processes and measure the whole: they may import any package.
OUTER = ("openarm_bringup", "openarm_evaluation")
#: These are libraries: the others may import them, and each of them those before it.
INNER = ("openarm_common", "openarm_control")
#: Modules of the longest import chain that a package may have.
LONGEST = 10
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


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_arrows_point_inwards(path: Path) -> None:
    package = path.relative_to(ROOT).parts[0]
    faults: list[str] = []
    for name, line in structure.imported_names(path).items():
        top = name.partition(".")[0]
        if is_ros(name) and not is_shell(path):
            faults.append(f"{path.name}:{line} is core and imports {name}")
        inner = INNER[: INNER.index(package)] if package in INNER else INNER
        if top in PACKAGES and top not in (package, *inner) and package not in OUTER:
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


@pytest.mark.parametrize("package", PACKAGES)
def test_importing_a_package_is_light(package: str) -> None:
    heavy = "{'numpy', 'numba', 'mujoco', 'rclpy', 'pinocchio', 'cv2', 'scipy', 'pydantic'}"
    script = f"import sys; before = set(sys.modules); import {package}; print((set(sys.modules) - before) & {heavy})"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


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
    for path in (*MODULES, *(ROOT / "tests").rglob("*.py")):
        for code in ast.walk(ast.parse(path.read_text())):
            bases = [ast.unparse(base).partition("[")[0] for base in getattr(code, "bases", ())]
            if {"Node", "BaseNode", "ManagedNode", "RosNode"} & set(bases):
                assert not _attributes_set(code) & kept, f"{path}: {ast.unparse(code)[:60]}"


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
