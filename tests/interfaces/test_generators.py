# SPDX-License-Identifier: Apache-2.0
"""The short way of rosidl's generators (interfaces/cmake/run_generator.py) writes what they write by themselves."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

_INTERFACES = Path(__file__).parents[2] / "interfaces"
_SHORT = str(_INTERFACES / "cmake/run_generator.py")
_GENERATOR = f"{sys.prefix}/lib/rosidl_generator_py/rosidl_generator_py"


def _python(*arguments: str) -> None:
    # The order of a set decides about that of some includes.
    subprocess.run([sys.executable, *arguments], check=True, env=os.environ | {"PYTHONHASHSEED": "0"})


def _idl(folder: Path, *interfaces: str) -> list[str]:
    """Write interfaces as .idl; return where they are, as generators take them."""
    asked = folder / "adapter.json"
    wanted = [f"{_INTERFACES}/openarm_interfaces:{name}" for name in interfaces]
    asked.write_text(json.dumps({"non_idl_tuples": wanted}))
    into = ("--output-dir", f"{folder}/idl", "--output-file", f"{folder}/made")
    _python("-m", "rosidl_adapter", "--package-name", "openarm_interfaces", "--arguments-file", str(asked), *into)
    return (folder / "made").read_text().splitlines()


def _generated(folder: Path, idl: list[str], *way: str) -> dict[str, str]:
    """Generate the Python side of interfaces; return each file's text by its name."""
    folder.mkdir()
    arguments = {
        "package_name": "openarm_interfaces",
        "output_dir": str(folder),
        "template_dir": f"{sys.prefix}/share/rosidl_generator_py/resource",
        "idl_tuples": idl,
        "ros_interface_dependencies": [],
        "target_dependencies": [],
    }
    asked = folder.with_suffix(".json")
    asked.write_text(json.dumps(arguments))
    _python(*way, _GENERATOR, "--generator-arguments-file", str(asked), "--typesupport-impls", "rosidl_typesupport_c")
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*.*")}


def test_a_generator_that_takes_what_another_has_parsed_writes_the_same(tmp_path: Path) -> None:
    idl = _idl(tmp_path, "msg/GraspStatus.msg", "msg/PickResult.msg", "srv/Grasp.srv", "action/Pick.action")
    alone = _generated(tmp_path / "alone", idl)
    assert {"msg/_grasp_status.py", "srv/_grasp.py", "action/_pick.py", "action/_pick_s.c"} <= alone.keys()
    assert _generated(tmp_path / "first", idl, _SHORT) == alone
    assert len(list((tmp_path / "idl").rglob("*.parsed"))) == 4
    assert _generated(tmp_path / "second", idl, _SHORT) == alone


def test_an_interface_that_has_changed_is_parsed_again(tmp_path: Path) -> None:
    idl = _idl(tmp_path, "msg/StateTime.msg")
    before = _generated(tmp_path / "before", idl, _SHORT)["msg/_state_time.py"]
    path = Path(idl[0].replace(":", "/"))
    path.write_text(path.read_text().replace("StateTime", "OtherTime"))
    after = _generated(tmp_path / "after", idl, _SHORT)["msg/_state_time.py"]
    assert "class StateTime(" in before
    assert "class OtherTime(" in after
