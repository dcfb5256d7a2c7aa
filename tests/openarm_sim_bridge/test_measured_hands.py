# SPDX-License-Identifier: Apache-2.0
"""Hands of drafts, measured: as the robots of the suite were by hand; frame, pads and a hand that never closes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import load_folder
from openarm_common.robot.hand import Hand, HandParts
from openarm_sim_bridge.drafting.check import folder_faults
from openarm_sim_bridge.drafting.draft import draft_folder
from openarm_sim_bridge.drafting.hand import measured
from tests.openarm_sim_bridge.test_drafts_of_urdf import ARM, joint, link, robot


@pytest.mark.parametrize("name", ["panda", "ur5e", "openarm_v2"])
def test_a_hand_is_measured_as_its_folder_has_it(name):
    parts = load_folder(name)[1]
    assert parts.hand is not None
    for arm in parts.arms.values():
        found = measured(RobotDescription.load(name), arm.model_dump())
        assert found is not None
        assert (found.sign, found.pads, found.T_tip_tcp) == (arm.finger_sign, {}, None)
        mine = Hand("", 1.0, HandParts.model_validate(found.parts))
        known = Hand("", 1.0, parts.hand)
        for finger in np.linspace(0.01, parts.hand.opening - 0.001, 8):
            assert mine.finger(known.position(finger)) == pytest.approx(finger, abs=0.0015)
        assert mine.parts.tip_clearance == pytest.approx(parts.hand.tip_clearance, abs=0.004)
        assert mine.parts.tip_clearance_tilted == pytest.approx(parts.hand.tip_clearance_tilted, abs=0.01)
        assert mine.parts.palm_depth == pytest.approx(parts.hand.palm_depth, abs=0.013)
        assert mine.parts.opening == pytest.approx(min(parts.hand.fingers[-1][1], 0.044), abs=2e-4)


def slides(axis: str = "0 1 0", span: str = 'lower="0.01" upper="0.05"') -> str:
    """Two fingers 60 mm long on a palm, 10 mm thick, that come as near to each other as 10 mm."""
    box = '<collision><origin xyz="0 0 {}"/><geometry><box size="{} 0.06"/></geometry></collision>'
    across = "0.02 0.01" if axis == "0 1 0" else "0.01 0.02"
    fingers = "".join(link(name, box.format(0.03, across)) for name in ("l", "r"))
    left = joint("slide", "prismatic", "upper", "l", span=span)
    right = joint("follows", "prismatic", "upper", "r", '<mimic joint="slide" multiplier="-1"/>', span)
    return fingers + (left + right).replace("0 1 0", axis)


PALM = '<collision><origin xyz="0 0 0.19"/><geometry><box size="0.1 0.1 0.02"/></geometry></collision>'


@pytest.mark.parametrize(("axis", "added"), [("0 1 0", False), ("1 0 0", True)])
def test_a_hand_that_is_drafted_has_pads_and_a_frame_between_them(tmp_path: Path, axis: str, added: bool):
    text = robot(PALM, slides(axis)).replace(
        '<child link="tip"/><origin xyz="0 0 0.2"/>', '<child link="tip"/><origin xyz="0 0 0.25"/>'
    )
    source = tmp_path / "r.urdf"
    source.write_text(text)
    folder = tmp_path / "mine"
    draft = draft_folder(folder, source, ARM, samples=10)
    assert folder_faults(folder) == []
    said = yaml.safe_load((folder / "robot.yaml").read_text())
    arm, hand = said["arms"]["arm"], HandParts.model_validate(said["hand"])
    assert (arm["tcp"] == "arm_tcp") is added
    assert any("'arm_tcp', which is, has been added" in remark for remark in draft.remarks) is added
    # pads are 0.5 mm in front of the fingers, which are half of 10 mm thick
    np.testing.assert_allclose(hand.fingers, [[0.01, 0.0045], [0.05, 0.0445]], atol=1e-9)
    assert hand.opening == 0.044
    mine = RobotDescription.from_files(folder / "mine.urdf")
    state = dict.fromkeys(mine.joints, 0.03) | {"shoulder": 0.0}
    T = mine.link_pose(arm["tcp"], state)
    pads = [shape for link in ("l", "r") for shape in mine.links[link].collision if "_pad_" in shape.name]
    assert len(pads) == 2
    turned = np.linalg.inv(T) @ mine.link_pose("l", state)
    assert abs((turned[:3, :3] @ np.fromstring(axis, sep=" "))[1]) == pytest.approx(1.0)
    if added:  # in the middle of the pads
        np.testing.assert_allclose(T[:2, 3], 0.0, atol=1e-9)
    # room of 4 mm below the tips: 10 mm before the given frame, and half of what may be a pad before the other one
    assert hand.tip_clearance == pytest.approx(0.0245 if added else 0.014, abs=0.002)


def test_a_hand_closes_as_far_as_its_joint_goes():
    parts = HandParts.model_validate(
        {
            "fingers": [[0.021, 0.007], [0.057, 0.043]],
            "opening": 0.043,
            "tip_clearance": 0.01,
            "tip_clearance_tilted": 0.0,
            "pad_centre": 0.0,
            "palm_depth": 0.03,
            "palm_depth_tilted": 0.03,
            "armature": 0.05,
        }
    )
    for sign in (1.0, -1.0):
        hand = Hand("slide", sign, parts)
        assert hand.closed == sign * 0.021
        assert abs(hand.lever) == pytest.approx(1.0)
        assert hand.finger(hand.opened) == pytest.approx(0.043)


def test_joints_that_nothing_drives_are_fixed_where_they_are_at_0(tmp_path: Path):
    wheel = link("wheel") + joint("spin", "revolute", "base", "wheel", span='lower="0.5" upper="1"')
    trailer = link("gear") + joint("gears", "revolute", "base", "gear", '<mimic joint="spin" multiplier="2"/>')
    source = tmp_path / "r.urdf"
    source.write_text(robot(more=wheel + trailer))
    draft = draft_folder(tmp_path / "mine", source, ARM, samples=10)
    assert "fixed at 0, since no arm and no hand drives them: spin, gears" in draft.remarks
    before = RobotDescription.from_files(source)
    after = RobotDescription.from_files(tmp_path / "mine" / "mine.urdf")
    moved = np.linalg.inv(after.link_pose("base", {})) @ after.link_pose("gear", {})
    np.testing.assert_allclose(moved, before.link_pose("gear", {"spin": 0.5}), atol=1e-9)
