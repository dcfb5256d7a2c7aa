# SPDX-License-Identifier: Apache-2.0
"""Parameters, and what the package must not touch."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

import openarm_grasp
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import ROBOT
from openarm_grasp.config import GraspConfig


def fields(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from fields(field.annotation, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", field


@pytest.mark.parametrize(("name", "field"), list(fields(GraspConfig)), ids=lambda v: v if isinstance(v, str) else "")
@pytest.mark.requirement("B-62")
def test_every_parameter_is_described_and_numbers_have_a_range(name, field):
    assert field.description
    if field.annotation in (int, float):
        assert field.metadata, f"{name} has no range"


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("approach", "max_width", 0.078),  # B-17
        ("detect", "max_age", 0.5),  # P-33
        ("limits", "max_attempts", 3),
        ("held", "rise", 0.03),  # P-07
        ("place", "tolerance", 0.02),  # P-09
    ],
)
def test_defaults_are_those_of_the_requirements(section, key, value):
    assert getattr(getattr(GraspConfig(), section), key) == value


def test_regions_are_those_of_the_robot_of_the_process(nearer, monkeypatch):
    config = GraspConfig()
    assert (config.place.region_x, config.place.region_abs_y) == ((0.15, 0.35), (0.05, 0.45))
    monkeypatch.setenv(ROBOT, "openarm_v1")
    config = GraspConfig()
    assert (config.place.region_x, config.place.region_abs_y) == ((0.16, 0.36), (0.06, 0.42))
    assert (config.hand_over.x, config.hand_over.abs_y) == ((0.20, 0.32), 0.03)


@pytest.mark.parametrize(("pregrasp", "clear"), [(None, True), (0.06, False)])
@pytest.mark.requirement("B-45", "B-48")
def test_by_default_the_open_fingers_begin_farther_above_any_object_than_they_may_be_off_their_path(pregrasp, clear):
    """Of the 5 to 8 cm that are allowed; a tall object reaches deepest between the fingers, up to the palm."""
    config = GraspConfig.model_validate({"approach": {} if pregrasp is None else {"pregrasp_distance": pregrasp}})
    assert 0.05 <= config.approach.pregrasp_distance <= 0.08
    hand = RobotDescription.load().hand("right").parts
    above = config.approach.pregrasp_distance - hand.palm_depth - hand.tip_clearance
    assert (above > config.approach.path_tolerance) is clear


@pytest.mark.parametrize("tilts", [[], [-5.0], [0.0, 70.0]])
def test_impossible_tilts_are_refused(tilts):
    with pytest.raises(ValueError, match="tilts_deg"):
        GraspConfig.model_validate({"approach": {"tilts_deg": tilts}})


@pytest.mark.requirement("A-69", "P-16")
def test_no_source_reads_ground_truth_or_contacts_or_the_simulator():
    folder = Path(openarm_grasp.__file__).parent
    for path in folder.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for word in ("ground_truth", "/sim/", "mujoco", ".contact", "qpos"):
            assert word not in text, f"{path.name} mentions {word}"
