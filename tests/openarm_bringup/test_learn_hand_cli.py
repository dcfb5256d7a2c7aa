# SPDX-License-Identifier: Apache-2.0
"""`openarm hardware learn-hand`: it asks first, goes from hand to hand, and says what was learned."""

from __future__ import annotations

from typing import Self

import pytest

from openarm_bringup.commands import hardware
from openarm_common.errors import Answer, Code
from openarm_grasp.ros import client
from tests.refusals import refused


class Grasps:
    """A grasp node whose right hand is full."""

    asked: list[str]

    def __init__(self) -> None:
        Grasps.asked = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def learn_hand(self, arm: str) -> Answer:
        self.asked.append(arm)
        if arm == "right":
            return Answer(False, Code.NOT_READY, "the right hand closes to 30.0 mm")
        return Answer(True, Code.OK, "the left hand goes from 3.2 to 76.0 mm")


@pytest.fixture(autouse=True)
def grasps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "GraspClient", Grasps)
    monkeypatch.setattr(hardware, "join_graph", lambda domain: None)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)


@pytest.mark.parametrize(
    ("typed", "options", "code", "message", "asked"),
    [
        ("no", {}, Code.CANCELLED, "nothing was moved; `--yes`", []),
        ("learn", {"arm": "left"}, Code.OK, "goes from 3.2 to 76.0 mm. Grasps use it now", ["left"]),
        ("", {"yes": True}, Code.NOT_READY, "76.0 mm; the right hand closes to 30.0 mm", ["left", "right"]),
    ],
)
def test_a_person_is_asked_and_each_hand_is_learned_until_one_is_not(
    monkeypatch: pytest.MonkeyPatch, typed: str, options: dict[str, object], code: Code, message: str, asked: list[str]
) -> None:
    monkeypatch.setattr("builtins.input", lambda prompt: typed)
    Grasps.asked = []
    outcome = hardware.learn_hand(**options)  # type: ignore[arg-type]
    assert (outcome.code, Grasps.asked) == (code, asked)
    assert message in outcome.message


def test_an_arm_that_does_not_exist_is_refused() -> None:
    refused("arm 'middle' does not exist; valid: auto, left, right", hardware.learn_hand, arm="middle")
