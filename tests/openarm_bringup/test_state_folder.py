# SPDX-License-Identifier: Apache-2.0
"""Records of running graphs are believed and written in a folder of this user alone."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from openarm_bringup.supervision import runs
from openarm_bringup.supervision.state import state_dir
from openarm_common.errors import Code, OpenArmError
from tests.openarm_bringup.commands import record_of


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return state_dir()


def test_a_folder_of_this_user_is_made_and_used(folder: Path) -> None:
    assert runs.running() == []
    runs.write_record(record_of("sim", 7))
    assert folder.stat().st_mode & 0o777 == 0o700
    runs.remove_record(os.getpid())


@pytest.mark.requirement("R-23")
@pytest.mark.parametrize("fault", ["other_owner", "writable", "link"])
def test_a_folder_that_another_user_may_have_made_is_refused_by_name(
    folder: Path, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if fault == "link":
        (folder.parent / "elsewhere").mkdir()
        folder.symlink_to(folder.parent / "elsewhere")
    else:
        folder.mkdir(mode=0o700)
        (folder / "1.json").write_text(record_of("sim", 7).model_dump_json())
    if fault == "writable":
        folder.chmod(0o777)
    elif fault == "other_owner":
        mine = os.geteuid()
        monkeypatch.setattr(os, "geteuid", lambda: mine + 1)
    with pytest.raises(OpenArmError, match=f"{folder}, where graphs leave their records: .*XDG_RUNTIME_DIR") as caught:
        runs.running()
    assert caught.value.code is Code.ENVIRONMENT
    with pytest.raises(PermissionError):
        runs.write_record(record_of("sim", 7))
