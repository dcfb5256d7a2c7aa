# SPDX-License-Identifier: Apache-2.0
"""No answer says success without two kinds of evidence, and one place can say it."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import pytest

import openarm_grasp
from openarm_common.errors import Code, OpenArmError
from openarm_grasp.evidence.verdicts import CameraVerdict, HandVerdict
from openarm_grasp.requests.request import Feasible, GraspOutcome, Proof

HELD = HandVerdict(Code.OK, "held")
AT_PLACE = CameraVerdict(Code.OK, "2 mm from its target")


@pytest.mark.parametrize("grip", [Code.OK, Code.GRASP_MISSED, Code.HAND_COLLISION, Code.GRASP_LOST])
@pytest.mark.parametrize("sight", [Code.OK, Code.GRASP_MISSED, Code.STALE_DATA])
@pytest.mark.requirement("P-08")
def test_a_lift_is_proven_by_a_hand_that_holds_and_a_camera_that_sees_the_object_gone(grip, sight):
    if grip is Code.OK and sight is Code.OK:
        Proof(HandVerdict(grip, "a"), CameraVerdict(sight, "b"))
        return
    with pytest.raises(OpenArmError, match="success without evidence") as error:
        Proof(HandVerdict(grip, "a"), CameraVerdict(sight, "b"))
    assert error.value.code is Code.INTERNAL


@pytest.mark.requirement("P-08", "P-09")
def test_an_answer_cannot_say_ok_without_its_proof():
    with pytest.raises(OpenArmError, match="OK without evidence"):
        GraspOutcome(Code.OK, "placed", "red", attempts=1)
    refused = GraspOutcome(Code.UNREACHABLE, "too far", "red")
    with pytest.raises(OpenArmError, match="OK without evidence"):
        replace(refused, code=Code.OK)
    assert GraspOutcome(Code.OK, "placed", "red", attempts=1, proof=Proof(HELD, AT_PLACE)).success


def test_a_plan_alone_is_no_proof_once_an_arm_has_moved():
    assert GraspOutcome(Code.OK, "can be done", "red", proof=Feasible("a plan")).success
    with pytest.raises(OpenArmError, match="OK without evidence"):
        GraspOutcome(Code.OK, "can be done", "red", attempts=1, proof=Feasible("a plan"))


@pytest.mark.requirement("P-08", "P-09")
def test_one_function_builds_the_proof_of_a_success_and_it_cannot_be_called_without_either_evidence():
    found: list[str] = []
    for path in Path(openarm_grasp.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                calls = [n.func.id for n in ast.walk(node) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
                found += [node.name] * calls.count("Proof")
                if node.name == "succeeded":
                    assert [arg.arg for arg in node.args.kwonlyargs] == ["hand", "camera"]
                    assert node.args.kw_defaults == [None, None]
    assert found == ["succeeded"]


@pytest.mark.requirement("P-08")
def test_the_answers_of_a_pick_and_of_a_place_carry_their_proof(world):
    picked = world.grasp(phase="pick")
    assert isinstance(picked.proof, Proof)
    assert picked.proof.camera.reason == "it has gone from its place"
    placed = world.grasp("", phase="place")
    assert isinstance(placed.proof, Proof)
    assert placed.proof.camera.reason == "its middle is seen 1 mm from its target"
    assert placed.proof.hand.ok
