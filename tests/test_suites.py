# SPDX-License-Identifier: Apache-2.0
"""The default suite: tests that start a graph or simulate a grasp are `long`, but for a named few."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).parent
#: What grasps in a simulated world, or runs many of those.
WORLDS = {"Trials", "run_campaign", "run_in_new_process"}
#: What starts a graph as processes.
GRAPHS = {"start_graph"}
#: One simulated grasp for each route and kind of evidence; and two in which nothing is grasped.
GRASPS = {
    "openarm_grasp/test_any_shape.py::test_what_is_no_prism_is_grasped_on_its_cloud_and_placed",
    "openarm_grasp/test_no_depth.py::test_an_object_of_known_height_is_picked_without_depth",
    "openarm_evaluation/test_campaign.py::test_an_object_is_picked_by_the_tag_on_it",
    "openarm_evaluation/test_campaign_two_arms.py::test_an_object_changes_hands_in_the_middle_and_stands_where_one_arm_alone_cannot_put_it",
    "openarm_evaluation/test_campaign_two_arms.py::test_an_object_that_no_arm_can_grasp_is_pushed_and_then_grasped",
    "openarm_evaluation/test_campaign_two_arms.py::test_two_objects_are_grasped_at_once_and_the_arms_keep_apart",
    "openarm_evaluation/test_campaign.py::test_resume_runs_only_what_is_missing_and_drops_a_torn_line",
    "openarm_evaluation/test_campaign.py::test_of_several_that_were_lifted_the_one_at_the_place_is_judged",
}  # fmt: skip
#: The modules that start a graph.
GRAPH = {"graph/test_graph.py"}


def named(node: ast.AST) -> set[str]:
    """Names that a piece of code mentions, its parameters and decorators included."""
    found = {child.id for child in ast.walk(node) if isinstance(child, ast.Name)}
    found |= {child.attr for child in ast.walk(node) if isinstance(child, ast.Attribute)} & WORLDS
    return found | {child.arg for child in ast.walk(node) if isinstance(child, ast.arg)}


def is_long(node: ast.AST) -> bool:
    return any(ast.unparse(mark) == "pytest.mark.long" for mark in ast.walk(node) if isinstance(mark, ast.Attribute))


def modules(*words: str) -> Iterator[tuple[str, ast.Module]]:
    """Yield name and code of each test module that has one of some words."""
    for path in sorted(TESTS.rglob("test_*.py")):
        text = path.read_text(encoding="utf-8")
        if any(word in text for word in words):
            yield str(path.relative_to(TESTS)), ast.parse(text)


def default_tests() -> Iterator[tuple[str, set[str]]]:
    """Yield tests of the default suite and all names that each reaches through functions of its module."""
    for module, tree in modules(*WORLDS, *GRAPHS):
        if any(isinstance(node, ast.Assign) and "pytestmark" in named(node) and is_long(node) for node in tree.body):
            continue
        parts = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        for name, test in parts.items():
            if not name.startswith("test_") or any(is_long(mark) for mark in _marks(test)):
                continue
            reached, left = set[str](), [name]
            while left:
                new = named(parts[left.pop()]) - reached
                reached |= new
                left += [one for one in new if one in parts]
            yield f"{module}::{name}", reached


def _marks(test: ast.FunctionDef | ast.ClassDef) -> Iterator[ast.AST]:
    """Decorators of a test that are marks of all its cases."""
    return (mark for mark in test.decorator_list if not isinstance(mark, ast.Call))


def test_only_the_named_tests_of_the_default_suite_grasp_in_simulation() -> None:
    assert {name for name, reached in default_tests() if reached & WORLDS} == GRASPS


def test_only_one_graph_is_started_by_the_default_suite() -> None:
    assert {name.partition("::")[0] for name, reached in default_tests() if reached & GRAPHS} <= GRAPH


def test_only_the_graph_has_the_machine_for_itself_in_the_default_suite() -> None:
    """Tests wait for conditions; what would need a quiet machine measures something, and is long."""
    alone = set[str]()
    for module, tree in modules("mark.alone"):
        for node in tree.body:
            marks = getattr(node, "decorator_list", None) or ([node] if "pytestmark" in named(node) else [])
            texts = " ".join(ast.unparse(mark) for mark in marks)
            if "mark.alone" in texts and "mark.long" not in texts:
                alone.add(module)
    assert alone == GRAPH
