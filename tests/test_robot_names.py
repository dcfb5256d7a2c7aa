# SPDX-License-Identifier: Apache-2.0
"""No name of a robot's arms, links, joints, frames or cameras is in code or on a page outside its folder."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from openarm_common.camera.cameras import load_cameras
from openarm_common.robot import description
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import ROBOT, robot_names

ROOT = Path(__file__).parents[1]
#: Texts that are words of a language or of another library as well, by file.
WORDS = {
    "openarm_common/wanted.py": {"left", "right"},  # of a request
    "openarm_bringup/commands/pick.py": {"left", "right"},  # what remains; justification of a column
    "openarm_bringup/workplace.py": {"overhead", "wrist", "spectator"},  # cameras that a draft is given
    "openarm_control/trajectory.py": {"right"},  # numpy.searchsorted
    "openarm_evaluation/campaign/trial.py": {"left"},  # what remains
    "openarm_motion/timing/trajectory.py": {"right"},
    "openarm_perception/ros/stereo_node.py": {"left", "right"},  # cameras of a pair
    "openarm_perception/stereo/pairs.py": {"left", "right"},
    "openarm_perception/stereo/rectification.py": {"left", "right"},
    "openarm_sim_bridge/openarm_ros2.py": {"right"},
    "openarm_sim_bridge/world/scenery.py": {"left", "right"},  # legs of a table
}
#: Parts of a name that is put together: `openarm_{side}_joint1`, `{arm}_link7`.
MADE = re.compile(r"openarm_\{\}_|\{\}_(link|joint)\d|\{\}_finger_joint")


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """Line and text of each string that is no docstring; what is filled in is {}."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    with_docstring = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    skipped = {
        id(n.body[0].value)
        for n in ast.walk(tree)
        if isinstance(n, with_docstring) and n.body and isinstance(n.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [p.value if isinstance(p, ast.Constant) else "{}" for p in node.values]
            yield node.lineno, "".join(map(str, parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in skipped:
            yield node.lineno, node.value


def test_the_search_finds_names(tmp_path):
    path = tmp_path / "code.py"
    path.write_text('"""Of openarm_left_link1."""\nx = f"openarm_{side}_joint1"\ny = "openarm_left_link1"\n')
    found = [text for _, text in texts(path)]
    assert found[:2] != []
    assert "openarm_left_link1" in found
    assert any(MADE.search(text) for text in found)
    assert not any("Of " in text for text in found)


@pytest.fixture(scope="module")
def names() -> set[str]:
    """Names of links, joints, arms and cameras of all robots."""
    found = set[str]()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(description, "take_meshes", lambda *_: {})
        for name in robot_names():
            patch.setenv(ROBOT, name)
            robot = RobotDescription.from_folder(name)
            found |= {*robot.links, *robot.joints, *robot.arms, *load_cameras()} - {robot.root}
    return found


@pytest.mark.long
@pytest.mark.requirement("R-07", "B-13")
def test_no_name_of_a_robot_is_in_the_page_or_a_report(names):
    """Texts and attributes in quotes, of what a browser shows; comments apart."""
    hits = list[str]()
    pages = [
        path for kind in ("js", "html") for path in ROOT.glob(f"openarm_*/**/*.{kind}") if "vendor" not in path.parts
    ]
    assert len(pages) > 5
    for path in pages:
        text = re.sub(
            r"/\*.*?\*/|^\s*//.*?$|<!--.*?-->", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
        )
        hits += [f"{path.relative_to(ROOT)}: {q}" for q in re.findall(r"""["'`]([\w/]+)["'`]""", text) if q in names]
    assert hits == []


@pytest.mark.requirement("R-07", "B-13")
def test_no_name_of_a_robot_is_in_code(names):
    hits = []
    long = {name for name in names if "_" in name}
    short = "|".join(names - long)
    suspect = re.compile(rf"[\"']({short})[\"']|openarm_\{{|\}}_(link|joint)\d|\}}_finger_joint")
    for path in sorted(ROOT.glob("openarm_*/**/*.py")):
        text = path.read_text(encoding="utf-8")
        if not (suspect.search(text) or any(name in text for name in long)):
            continue
        where = path.relative_to(ROOT).as_posix()
        allowed = WORDS.get(where, set())
        hits += [
            f"{where}:{line}: {text[:60]!r}"
            for line, text in texts(path)
            if MADE.search(text) or text in names - allowed or any(name in text for name in long)
        ]
    assert hits == []
