# SPDX-License-Identifier: Apache-2.0
"""Write openarm.srdf: groups, postures, and the collisions that need no check.

    python models/robots/openarm_v1/generate_srdf.py [--samples 60000] [--out FILE]

A pair of links is not checked for one of three reasons. *Adjacent*: joined by a joint. *Default*: the primitives touch
where the parts do not, or by design (the fingers when closed). *Never*: not nearer than `MARGIN` in any of the random
postures, and neither is the mirror image of the pair. `always_checked` stays checked, whatever the samples say.
Deterministic: same description, same file.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import numpy as np
import pinocchio as pin

from openarm_common.robot.description import RobotDescription

BASE_LINK = RobotDescription.load().base
SIDES = RobotDescription.load().arm_names
mirror = RobotDescription.load().mirrored

MARGIN = 0.01  # m
SEED = 1
OUTER = ("link4", "link5", "link6", "link7", "hand", "left_finger", "right_finger")
FINGERS = ("left_finger", "right_finger")
#: Of one arm; "body" is the pedestal.
DEFAULT = (
    [
        ("body", "link1"),
        ("body", "link2"),
        ("link0", "link2"),
        ("link1", "link3"),
        ("link3", "link5"),
        ("link5", "link7"),
    ]
    + [("link7", finger) for finger in FINGERS]
    + [FINGERS]
)

#: Postures of the right arm, rad; the left arm has their mirror image.
POSTURES = {
    "home": (-0.2, 2.2, 0.0, 1.2, 0.0, 0.0, 0.4),  # elbow over the shoulder, out of the overhead camera's view
    "official_home": (0.0, 0.0, 0.0, 1.570796, 0.0, 0.0, 0.0),  # forearm forward
    "hands_up": (0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0),
    "zero": (0.0,) * 7,  # hanging
}
WRIST_LOOK = (0.14, 2.46, -1.17, 1.79, -0.3, -0.4, 0.91)  # the right wrist camera sees the right half of the table
GRIPPER = {"open": 0.044, "half_closed": 0.022, "closed": 0.0}

Pair = frozenset[str]


def full_name(side: str, link: str) -> str:
    """Name of a link of one arm in the description."""
    return BASE_LINK if link == "body" else f"openarm_{side}_{link}"


def mirrored(link: str) -> str:
    """Name of the link in the mirror image: the other arm's, and of its fingers the other one."""
    swap = {"left": "right", "right": "left"}
    if link == BASE_LINK:
        return link
    _, side, part = link.split("_", 2)
    if part in FINGERS:
        part = f"{swap[part.split('_')[0]]}_finger"
    return f"openarm_{swap[side]}_{part}"


def mirrored_pair(pair: Pair) -> Pair:
    """Return the pair of the mirror image."""
    return frozenset(mirrored(link) for link in pair)


def adjacent_pairs(description: RobotDescription) -> set[Pair]:
    """Links with shapes that a joint connects, directly or over links without shapes."""
    pairs: set[Pair] = set()
    for name, link in description.links.items():
        if link.collision:
            parents = [j.parent for j in description.chain(name) if description.links[j.parent].collision]
            if parents:
                pairs.add(frozenset((parents[-1], name)))
    return pairs


def default_pairs() -> set[Pair]:
    """Pairs of `DEFAULT`, for both arms."""
    return {frozenset((full_name(side, a), full_name(side, b))) for side in SIDES for a, b in DEFAULT}


def always_checked() -> set[Pair]:
    """Arm against arm from link4 outwards, these against the pedestal, and the hand against its own shoulder."""
    outer = {side: [full_name(side, link) for link in OUTER] for side in SIDES}
    pairs = {frozenset(pair) for pair in itertools.product(outer["left"], outer["right"])}
    for side in SIDES:
        pairs |= {frozenset((BASE_LINK, link)) for link in outer[side]}
        for part in ("hand", *FINGERS):
            pairs |= {frozenset((full_name(side, part), full_name(side, link))) for link in ("link0", "link1")}
    return pairs


def touching_pairs(description: RobotDescription, samples: int) -> set[Pair]:
    """Pairs of links that come nearer than `MARGIN` in random postures."""
    model = pin.buildModelFromXML(description.urdf)
    geometry = pin.buildGeomFromUrdfString(model, description.urdf, pin.GeometryType.COLLISION)
    geometry.addAllCollisionPairs()
    owner = [model.frames[shape.parentFrame].name for shape in geometry.geometryObjects]
    pairs = [frozenset((owner[p.first], owner[p.second])) for p in geometry.collisionPairs]
    data, geometry_data = model.createData(), geometry.createData()
    for request in geometry_data.collisionRequests:
        request.security_margin = MARGIN
    rng = np.random.default_rng(SEED)
    follower = {
        model.joints[model.getJointId(j.name)].idx_q: model.joints[model.getJointId(j.mimic)].idx_q
        for j in description.joints.values()
        if j.mimic is not None
    }
    active = {pair: [k for k, other in enumerate(pairs) if other == pair] for pair in set(pairs)}
    found: set[Pair] = set()
    for _ in range(samples):
        q = rng.uniform(model.lowerPositionLimit, model.upperPositionLimit)
        for mimic, leader in follower.items():
            q[mimic] = q[leader]
        if not pin.computeCollisions(model, data, geometry, geometry_data, q, False):
            continue
        for pair in [p for p, ks in active.items() if any(geometry_data.collisionResults[k].isCollision() for k in ks)]:
            found.add(pair)
            for k in active.pop(pair):
                geometry_data.deactivateCollisionPair(k)
    return found


def classify(description: RobotDescription, samples: int) -> dict[Pair, str]:
    """Reason of every pair of links whose collision is not checked."""
    shaped = [name for name, link in description.links.items() if link.collision]
    touching = touching_pairs(description, samples)
    checked = always_checked()
    adjacent, default = adjacent_pairs(description), default_pairs()
    reasons: dict[Pair, str] = {}
    for pair in map(frozenset, itertools.combinations(shaped, 2)):
        if pair in adjacent:
            reasons[pair] = "Adjacent"
        elif pair in default:
            reasons[pair] = "Default"
        elif pair not in checked and pair not in touching and mirrored_pair(pair) not in touching:
            reasons[pair] = "Never"
    return reasons


def group_lines() -> list[str]:
    """Groups, end effectors, passive joints."""
    lines: list[str] = []
    for side in SIDES:
        lines += [
            f'  <group name="{side}_arm">',
            f'    <chain base_link="openarm_{side}_link0" tip_link="openarm_{side}_hand_tcp"/>',
            "  </group>",
        ]
    for side in SIDES:
        joints = [f'    <joint name="openarm_{side}_finger_joint{i}"/>' for i in (1, 2)]
        lines += [f'  <group name="{side}_gripper">', *joints, "  </group>"]
    lines += [
        '  <group name="both_arms">',
        '    <group name="left_arm"/>',
        '    <group name="right_arm"/>',
        "  </group>",
    ]
    for side, label in zip(SIDES, ("left_ee", "right_ee"), strict=True):
        lines.append(
            f'  <end_effector name="{label}" parent_link="openarm_{side}_hand" group="{side}_gripper"'
            f' parent_group="{side}_arm"/>'
        )
    lines += [f'  <passive_joint name="openarm_{side}_finger_joint2"/>' for side in SIDES]
    return lines


def state_lines() -> list[str]:
    """Named postures of each group."""

    def state(group: str, name: str, values: dict[str, float]) -> list[str]:
        joints = [f'    <joint name="{joint}" value="{value:.9g}"/>' for joint, value in values.items()]
        return [f'  <group_state name="{name}" group="{group}">', *joints, "  </group_state>"]

    def arm(side: str, q: tuple[float, ...]) -> dict[str, float]:
        own = q if side == "right" else tuple(float(v) + 0.0 for v in mirror(q))
        return dict(zip(RobotDescription.load().arm_joints(side), own, strict=True))

    lines: list[str] = []
    for name, q in POSTURES.items():
        for side in SIDES:
            lines += state(f"{side}_arm", name, arm(side, q))
        lines += state("both_arms", name, arm("left", q) | arm("right", q))
    lines += state("right_arm", "wrist_look", arm("right", WRIST_LOOK))
    for side in SIDES:
        for name, opening in GRIPPER.items():
            lines += state(f"{side}_gripper", name, {RobotDescription.load().finger_joint(side): opening})
    return lines


def srdf_text(description: RobotDescription, samples: int) -> str:
    """Return the whole file."""
    order = {name: index for index, name in enumerate(description.links)}
    rows = [(sorted(pair, key=order.__getitem__), reason) for pair, reason in classify(description, samples).items()]
    rows.sort(key=lambda row: [order[link] for link in row[0]])
    disabled = [f'  <disable_collisions link1="{a}" link2="{b}" reason="{reason}"/>' for (a, b), reason in rows]
    head = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        "<!-- SPDX-License-Identifier: Apache-2.0 -->",
        "<!-- Written by generate_srdf.py: change that, not this. -->",
        '<robot name="openarm">',
    ]
    return "\n".join([*head, *group_lines(), *state_lines(), *disabled, "</robot>", ""])


def main() -> None:
    """Command line."""
    here = Path(__file__).resolve().parent
    parser = argparse.ArgumentParser(description="Write openarm.srdf from the description and random postures.")
    parser.add_argument("--samples", type=int, default=60_000, help="random postures (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=here / "openarm.srdf", help="file to write (default: %(default)s)")
    arguments = parser.parse_args()
    description = RobotDescription.from_urdf(RobotDescription.load().urdf)
    arguments.out.write_text(srdf_text(description, arguments.samples), encoding="utf-8")


if __name__ == "__main__":
    main()
