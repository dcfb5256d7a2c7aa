# SPDX-License-Identifier: Apache-2.0
"""What the repository ships, and what its parts depend on."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import os
import re
import subprocess
import sys
import textwrap
import tomllib
from pathlib import Path

import pytest
import yaml

from openarm_bringup.cli import build_app
from openarm_common.errors import Code
from openarm_sim_bridge.faults.faults import FAULTS

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = sorted(path.name for path in ROOT.glob("openarm_*") if (path / "__init__.py").exists())
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(ROOT.glob("docs/*.md"))]
FROM_INTERFACES = {path.parent.name for path in (ROOT / "interfaces").glob("*/package.xml")}


@pytest.mark.requirement("A-02")
def test_sources_parameters_descriptions_messages_and_graphs_are_all_here() -> None:
    assert len(PACKAGES) >= 7
    for package in PACKAGES:
        assert (ROOT / package / "package.xml").is_file(), package
    assert {
        "openarm_interfaces",
        "tf2_msgs",
        "control_msgs",
        "vision_msgs",
        "octomap_msgs",
        "moveit_msgs",
    } <= FROM_INTERFACES
    for pattern in ("models/robots/*/*.xacro", "models/scenes/*.yaml", "config/params/*.yaml", "config/graphs/*.yaml"):
        assert list(ROOT.glob(pattern)), pattern


@pytest.mark.requirement("A-03")
def test_ros_2_jazzy_on_the_pythons_it_has_wheels_for() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["requires-python"] == ">=3.11,<3.14"
    assert {"ros-jazzy-rclpy", "ros-jazzy-common-interfaces", "ros-jazzy-rmw-fastrtps-cpp"} <= set(
        project["dependencies"]
    )
    assert (3, 11) <= sys.version_info[:2] <= (3, 13)
    rclpy = importlib.metadata.version("ros-jazzy-rclpy")
    assert rclpy.split(".")[0] == "7", f"rclpy {rclpy} is not Jazzy's"


def _view_world(*args: str, **environ: str) -> subprocess.CompletedProcess[str]:
    """Run the viewer example without a display, or with one that environment variables name."""
    env = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
    command = [sys.executable, str(ROOT / "examples" / "view_world.py"), *args]
    return subprocess.run(command, env=env | environ, capture_output=True, text=True, timeout=60.0, check=False)


@pytest.mark.long
@pytest.mark.requirement("A-14")
def test_the_viewer_example_steps_a_thousand_times_without_a_display() -> None:
    done = _view_world("empty", "--headless")
    assert done.returncode == 0, done.stderr
    match = re.fullmatch(r"1000 steps, 2\.00 s simulated in .* s \((\d+) times real time\)\n", done.stdout)
    assert match, done.stdout
    assert int(match[1]) >= 2


@pytest.mark.parametrize("environ", [{}, {"DISPLAY": ":941"}], ids=["none", "dead"])
@pytest.mark.requirement("A-14")
def test_the_viewer_example_says_what_to_do_without_a_display(environ: dict[str, str]) -> None:
    done = _view_world("empty", **environ)
    assert (done.returncode, done.stdout) == (1, "")
    (sentence,) = done.stderr.splitlines()
    assert "there is no display" in sentence
    assert "--headless" in sentence
    assert "./openarm view" in sentence


@pytest.mark.requirement("B-02")
def test_the_interfaces_of_all_parts_are_documented() -> None:
    """tests/graph/test_graph.py holds these tables against the running graph."""
    text = (ROOT / "docs" / "interfaces.md").read_text(encoding="utf-8")
    for part in ("/overhead/color/image_raw", "/detections_3d", "/tf_static", "/motion/execute", "gripper_cmd"):
        assert part in text, part


def test_the_table_of_codes_and_that_of_faults_are_complete() -> None:
    text = (ROOT / "docs" / "interfaces.md").read_text(encoding="utf-8")
    codes = text[text.index("## Result codes") : text.index("## Fault injection")]
    faults = text[text.index("## Fault injection") : text.index("## Frames")]
    assert re.findall(r"^\| `([A-Z_]+)` \|", codes, re.MULTILINE) == list(Code)
    rows = re.findall(r"^\| `([a-z_]+)` \| ([a-z_, ]+) \|", faults, re.MULTILINE)
    assert {name: fields.split(", ") for name, fields in rows} == {
        name: list(model.model_fields) for name, model in FAULTS.items()
    }


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\((?!https?://)([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    assert [link for link in links if not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_files_and_commands_that_a_page_names_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    folders = "|".join((*PACKAGES, "interfaces", "config", "models", "tests", "benchmarks", "tools", "examples"))
    named = re.findall(rf"`((?:{folders})/[\w./-]*)`( \(new\))?", text)
    assert [path for path, new in named if not new and not (ROOT / path).exists()] == []
    app = build_app()
    for command, part in re.findall(r"\./openarm ([a-z]+)(?: ([a-z-]+))?", text):
        assert command in app, command
        parts = [name for name in app[command] if not name.startswith("-")]
        assert not parts or not part or part in parts, f"{command} {part}"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_what_examples_of_a_page_import_exists(page: Path) -> None:
    for block in re.findall(r"^ *```python\n(.*?)^ *```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        for node in ast.walk(ast.parse(textwrap.dedent(block))):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("openarm_"):
                module = importlib.import_module(node.module)
                for alias in node.names:
                    if not hasattr(module, alias.name):
                        importlib.import_module(f"{node.module}.{alias.name}")


def test_the_readme_is_short_and_links_every_guide() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 200
    guides = {f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")}
    assert guides <= set(re.findall(r"\]\(([^)#]+)", text))


@pytest.mark.requirement("P-32")
def test_the_workflow_runs_the_commands_of_contributing_without_gpu_or_display() -> None:
    (job,) = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))["jobs"].values()
    contributing = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    loop = contributing[contributing.index("```sh") : contributing.index("```\n\n")]
    assert job["runs-on"] == "ubuntu-24.04"
    assert 0 < job["timeout-minutes"] <= 60
    app = build_app()
    for command in job["strategy"]["matrix"]["command"]:
        program, *words = command.split()
        assert f"\n{command} " in loop, "it is named to who contributes"
        assert os.access(ROOT / program, os.X_OK)
        assert all(word in app for word in words), command
    assert len(job["strategy"]["matrix"]["command"]) == 2
    assert [step["run"] for step in job["steps"] if "run" in step] == ["${{ matrix.command }}"]


@pytest.mark.requirement("P-32")
def test_the_workflow_keeps_wheels_until_a_lock_or_an_interface_changes() -> None:
    (job,) = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))["jobs"].values()
    (cache,) = [step["with"] for step in job["steps"] if step.get("uses", "").startswith("actions/cache@")]
    inputs = {pattern: {*ROOT.glob(pattern)} for pattern in re.findall(r"'([^']+)'", cache["key"])}
    assert all(inputs.values()), inputs
    assert {*ROOT.glob("*.lock"), *ROOT.glob("interfaces/*/*/*.msg")} <= set().union(*inputs.values())


@pytest.mark.requirement("R-32")
def test_ci_runs_the_tests_once_and_repeats_nothing() -> None:
    lines = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    tests = [line for line in lines if '" test' in line]
    assert tests == [lines[-1]] == ['exec "$root/openarm" test "$@"']
    extras = re.search(r"^for extra in (.*); do$", "\n".join(lines), re.M)
    assert extras is not None
    locks = {path.stem.removeprefix("requirements-") for path in ROOT.glob("requirements-*.lock")}
    assert set(extras[1].split()) == locks - {"build", "dev"}, "each lock of an extra is installed, its tests are run"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert not [
        name for name in project["project"]["optional-dependencies"]["test"] if "rerun" in name or "flaky" in name
    ]
    assert "reruns" not in project["tool"]["pytest"]["ini_options"]["addopts"]


def test_pre_commit_hooks_use_the_tools_of_the_environment() -> None:
    (local,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))["repos"]
    assert local["repo"] == "local"
    for hook in local["hooks"]:
        program = ROOT / hook["entry"].split()[0]
        assert program.is_file(), hook["id"]


@pytest.mark.parametrize(
    "form", sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")), ids=lambda path: path.stem
)
def test_an_issue_form_is_what_github_reads(form: Path) -> None:
    data = yaml.safe_load(form.read_text(encoding="utf-8"))
    assert {"name", "description", "body"} <= data.keys()
    for field in data["body"]:
        assert {"type", "id", "attributes"} <= field.keys()
        assert field["attributes"]["label"]


def test_the_changelog_has_the_version_of_the_project() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    releases = re.findall(r"^## \[(.+?)\]", text, re.MULTILINE)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] in releases[:2]
