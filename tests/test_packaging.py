# SPDX-License-Identifier: Apache-2.0
"""What a wheel holds, what colcon reads, and what the locks hold."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import pytest
import setuptools

from openarm_bringup import warm

_ROOT = Path(__file__).parents[1]
_PACKAGES = sorted(path.parent.name for path in _ROOT.glob("openarm_*/__init__.py"))
_INTERFACES = sorted(path.parent.name for path in _ROOT.glob("interfaces/*/package.xml"))
_LOCKS = sorted(path.name for path in _ROOT.glob("*.lock"))


def test_the_wheel_holds_packages_models_and_parameters_and_nothing_of_colcon(tmp_path: Path) -> None:
    build = ["build", "--wheel", "--offline", "--no-build-isolation", "--python", sys.executable, "-o", tmp_path, _ROOT]
    subprocess.run([Path(sys.executable).parent / "uv", *build], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    shared = f"{wheel.name.split('-py3')[0]}.data/data/share/openarm"
    for folder in ("models", "config"):
        files = [path for path in (_ROOT / folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
        missing = [str(path) for path in files if f"{shared}/{path.relative_to(_ROOT)}" not in names]
        assert not missing
    assert {f"{package}/__init__.py" for package in _PACKAGES} <= names
    pages = [path for path in (_ROOT / "openarm_bringup" / "view" / "page").rglob("*") if path.is_file()]
    pages += [path for package in _PACKAGES for path in (_ROOT / package).rglob("*.html")]
    assert len(pages) > 10
    assert {str(path.relative_to(_ROOT)) for path in pages} <= names
    colcon = re.compile(r"(^|/)(setup\.py|setup\.cfg|package\.xml|resource/.*)$")
    assert not [name for name in names if colcon.search(name)]


@pytest.mark.parametrize("package", _PACKAGES)
def test_a_package_is_complete_for_colcon_too(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = _ROOT / package
    manifest = ElementTree.parse(folder / "package.xml").getroot()
    assert manifest.findtext("name") == package
    assert manifest.findtext("export/build_type") == "ament_python"
    assert (folder / "resource" / package).is_file()
    assert f"install_scripts=$base/lib/{package}" in (folder / "setup.cfg").read_text()

    given: dict[str, object] = {}
    monkeypatch.setattr(setuptools, "setup", lambda **arguments: given.update(arguments))
    monkeypatch.chdir(folder)
    runpy.run_path("setup.py", run_name="__main__")
    inside = [".".join([package, *path.parent.relative_to(folder).parts]) for path in folder.rglob("__init__.py")]
    assert sorted(given["packages"]) == sorted(inside)  # setup.py lists sub-packages by hand
    patterns = given["package_data"][package]
    brought = {path for pattern in patterns for path in folder.glob(pattern) if path.is_file()}
    assert {path for path in folder.rglob("*") if path.suffix in (".html", ".js", ".css", ".svg", ".typed")} <= brought
    assert given["version"] == manifest.findtext("version") == _project()["version"]
    for script in given.get("entry_points", {"console_scripts": []})["console_scripts"]:
        module = script.split(" = ")[1].removesuffix(":main").split(".")
        assert Path(_ROOT, *module).with_suffix(".py").is_file(), script


def _project() -> dict[str, object]:
    return tomllib.loads((_ROOT / "pyproject.toml").read_text())["project"]


def test_every_package_is_in_the_wheel_s_list() -> None:
    build = tomllib.loads((_ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert sorted(build["packages"]) == _PACKAGES


def test_set_up_compiles_kernels_of_every_package_that_has_some() -> None:
    made = {
        path.relative_to(_ROOT).parts[0]
        for path in _ROOT.glob("openarm_*/**/*.py")
        if "openarm_common.kernels" in path.read_text()
    }
    assert made - {"openarm_common"} <= {part.__module__.partition(".")[0] for part in (*warm.OF_NODES, *warm.REST)}


def test_every_interface_package_is_built_by_the_launcher() -> None:
    lines = re.findall(r'^(?:interfaces|of_moveit)="(.*)"$', (_ROOT / "openarm").read_text(), re.MULTILINE)
    assert sorted(" ".join(lines).split()) == _INTERFACES


@pytest.mark.parametrize("package", _INTERFACES)
def test_an_interface_package_has_one_version_and_one_name(package: str) -> None:
    manifest = ElementTree.parse(_ROOT / "interfaces" / package / "package.xml").getroot()
    project = tomllib.loads((_ROOT / "interfaces" / package / "pyproject.toml").read_text())["project"]
    assert (manifest.findtext("name"), manifest.findtext("version")) == (package, project["version"])
    assert project["name"] == package.replace("_", "-")
    assert f"project({package})" in (_ROOT / "interfaces" / package / "CMakeLists.txt").read_text()


@pytest.mark.parametrize("lock", _LOCKS)
def test_a_lock_pins_with_hashes_and_names_no_address(lock: str) -> None:
    text = (_ROOT / lock).read_text()
    pins = re.split(r"\n(?=\S)", text.strip())
    assert all(re.match(r"[a-z0-9-]+==", pin) and "--hash=sha256:" in pin for pin in pins)
    assert not re.search(r"://|^--", text, re.MULTILINE)
