# SPDX-License-Identifier: Apache-2.0
"""`openarm pick`: what a dry run prints of the candidates, and the refusal without a grasp node."""

from __future__ import annotations

import io
import json
import threading
from concurrent import futures
from pathlib import Path
from typing import Any

import pytest
from openarm_interfaces.msg import GraspStatus

from openarm_bringup.commands import connect, pick
from openarm_bringup.supervision import runs
from openarm_common.errors import Code, OpenArmError
from openarm_grasp.planning.options import Option
from openarm_grasp.requests.request import GraspRequest
from openarm_grasp.ros.client import GraspResult
from tests.openarm_bringup.commands import record_of

OPTIONS = (
    Option("red/x+/tilt0", "left", 0.05, {"tilt": -0.0, "width": 0.05}, 0.5, Code.OK, "chosen"),
    Option(
        "red/x-/tilt0", "left", 0.05, {"tilt": 0.0, "width": 0.05}, code="IN_COLLISION", message="[hand] meets blue"
    ),
    Option("red/y", "left", code=Code.TOO_WIDE, message="90 mm wide"),
)


def test_each_candidate_has_a_line_with_parts_margin_and_reason() -> None:
    head, chosen, refused, wide, _ = pick._options_table(OPTIONS).splitlines()
    assert head.split() == ["candidate", "arm", "score", "tilt", "width", "margin"]
    assert chosen.split() == ["red/x+/tilt0", "left", "+0.05", "+0.00", "+0.05", "29°", "chosen"]
    assert refused.endswith("IN_COLLISION: [hand] meets blue")
    assert wide.split() == ["red/y", "left", "TOO_WIDE:", "90", "mm", "wide"]
    assert pick._options_table(()) == ""


def test_a_graph_without_grasping_is_named_with_one_that_has_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")

    def run(*nodes: str) -> None:
        runs.write_record(record_of("motion", 7, {node: runs.NodeRecord(state="ready") for node in nodes}))

    def ask() -> str:
        with pytest.raises(OpenArmError) as refused, connect.requires_node("grasp", "sim"):
            raise OpenArmError(Code.NOT_READY, "no action")
        assert refused.value.code == Code.NOT_READY
        return refused.value.message

    assert ask() == "no action"  # nothing runs here; elsewhere, who knows
    run("motion", "grasp")
    assert ask() == "no action"
    run("motion")
    assert ask().startswith("what runs here in domain 7 (motion) has no node `grasp`")
    assert "`openarm up sim`" in ask()


def test_json_has_no_number_for_a_margin_that_is_not_known() -> None:
    chosen, refused, _ = json.loads(json.dumps([pick._option_row(option) for option in OPTIONS], allow_nan=False))
    assert (chosen["limit_margin"], chosen["code"]) == (0.5, "OK")
    assert (refused["limit_margin"], refused["parts"]) == (None, {"tilt": 0.0, "width": 0.05})


class Client:
    """Stands in for the client of the grasp node: one plan waits, and is answered."""

    def __init__(self) -> None:
        self.asked: dict[str, Any] = {}
        self.accepted: bool | None = None

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def carry_out(self, request: GraspRequest, **asked: Any) -> GraspResult:
        self.asked = {"request": request, **asked}
        plan = GraspStatus(
            state="PLAN", plan_id="4adc", reason="grasp red; 12.0 s of motion; plan '4adc' waits for /grasp/confirm"
        )
        if asked["confirm"]:
            asked["on_feedback"](plan)
        self.accepted = callable(asked["confirm"]) and asked["confirm"](plan)
        return GraspResult(True, Code.OK, "done", "SUCCESS", "red", "right", 1, (0.0, 0.0, 0.4), 1.0)


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> Client:
    """What commands ask in place of the grasp node."""
    made = Client()
    monkeypatch.setattr("openarm_grasp.ros.client.GraspClient", lambda: made)
    monkeypatch.setattr(pick, "join_graph", lambda domain: None)
    return made


class Stdin(io.StringIO):
    def __init__(self, text: str, *, terminal: bool) -> None:
        super().__init__(text)
        self.isatty = lambda: terminal  # type: ignore[method-assign]


@pytest.mark.requirement("P-20", "R-25")
@pytest.mark.parametrize(
    ("typed", "accepted"), [("y\n", True), ("YES\n", True), ("\n", False), ("n\n", False), ("", False)]
)
def test_a_plan_is_shown_on_the_terminal_and_confirmed_by_yes_alone(
    client: Client, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], typed: str, accepted: bool
) -> None:
    monkeypatch.setattr("sys.stdin", Stdin(typed, terminal=True))
    assert pick.pick("red", confirm=True).success
    assert client.accepted is accepted
    lines = [line.strip() for line in capsys.readouterr().err.splitlines()]
    assert lines[-4:] == ["plan 4adc:", "grasp red", "12.0 s of motion", "run this plan? [y/N]"]


@pytest.mark.requirement("P-20", "R-25")
def test_without_a_terminal_a_plan_waits_for_the_service(
    client: Client, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", Stdin("y\n", terminal=False))
    pick.pick("red", confirm=True)
    assert client.asked["confirm"] is True
    assert 'openarm service call /grasp/confirm "{plan_id: 4adc, accept: true}"' in capsys.readouterr().err
    pick.pick("red")
    assert client.asked["confirm"] is False
    with pytest.raises(OpenArmError, match="of one object"):
        pick.pick("red", "blue", confirm=True)


@pytest.mark.requirement("R-17", "P-02", "P-03")
def test_an_order_lists_what_is_left_with_place_and_reason(
    client: Client, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked, cups, lock = list[GraspRequest](), ["cup"], threading.Lock()

    def answer(request: GraspRequest, **_: Any) -> GraspResult:
        nowhere, wide = (0.0, 0.0, 0.0), (0.2, 0.1)
        with lock:
            asked.append(request)
            if request.phase == "all" and cups:
                return GraspResult(True, Code.OK, "placed", "SUCCESS", cups.pop(), "left", 1, (0.2, 0.3, 0.4), 9.0,
                                   (0.3, 0.0, 0.42))  # fmt: skip
        if request.phase == "all" and wide not in request.exclude_near:
            return GraspResult(False, Code.TOO_WIDE, "190 mm", "REFUSED", "", "", 0, nowhere, 1.0, (*wide, 0.45))
        return GraspResult(False, Code.UNKNOWN_OBJECT, "no more", "REFUSED", "", "", 0, nowhere, 1.0)

    monkeypatch.setattr(client, "carry_out", answer)
    bins = tmp_path / "bins.yaml"
    bins.write_text("bins: {tray: {x: [0.15, 0.25], y: [0.2, 0.44]}}\nrest: tray\n")
    outcome = pick.order("anything", bins=bins)
    assert (outcome.success, outcome.code) == (False, Code.PLACE_FAILED)
    assert outcome.message == "PARTIAL: 1 placed, 1 left"
    assert outcome.text == "left: anything at (0.200, 0.100) m: TOO_WIDE: 190 mm\n"
    data = json.loads(json.dumps(outcome.data, allow_nan=False))
    assert data["left"][0]["where"] == [0.2, 0.1]
    assert [row["place"] for row in data["results"] if row["place"]] == [[0.2, 0.3, 0.4]]
    first = {one.arm: one.place_choices for one in asked if not one.exclude_near}
    assert first == {"left": ((0.2, 0.26), (0.2, 0.38)), "right": ((0.2, 0.38), (0.2, 0.26))}
    # which arm hears of both first is up to the threads
    assert any({(0.2, 0.3), (0.2, 0.1)} <= {*one.exclude_near} for one in asked)
    assert (asked[-1].object_at, asked[-1].phase, asked[-1].arm) == ((0.2, 0.1), "aside", "auto")


@pytest.mark.requirement("P-21")
def test_ctrl_c_cancels_all_that_an_order_has_asked_for_and_waits_for_its_end(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop, ended = threading.Event(), list[str]()

    def answer(request: GraspRequest, **_: Any) -> GraspResult:
        assert stop.wait(10.0)
        ended.append(request.arm)
        return GraspResult(False, Code.CANCELLED, "cancelled", "CANCELLED", "", request.arm, 0, (0.0, 0.0, 0.0), 1.0)

    waits = [KeyboardInterrupt()]

    def wait(*args: Any, **kwargs: Any) -> Any:
        if waits:
            raise waits.pop()
        return futures.wait(*args, **kwargs)

    monkeypatch.setattr(client, "carry_out", answer)
    monkeypatch.setattr(client, "cancel", stop.set, raising=False)
    monkeypatch.setattr(pick, "wait", wait)
    outcome = pick.order("anything")
    assert (outcome.success, outcome.code) == (False, Code.CANCELLED)
    assert sorted(ended) == ["left", "right"]


def test_an_order_whose_grasp_node_is_gone_ends_with_the_reason(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = threading.Event()

    def answer(request: GraspRequest, **_: Any) -> GraspResult:
        assert request.arm == "left" or stop.wait(10.0)
        raise OpenArmError(Code.NOT_READY, f"the server of the {request.arm} arm is gone")

    monkeypatch.setattr(client, "carry_out", answer)
    monkeypatch.setattr(client, "cancel", stop.set, raising=False)
    with pytest.raises(OpenArmError, match="left arm is gone"):
        pick.order("anything")
    assert stop.is_set()
