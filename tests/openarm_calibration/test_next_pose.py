# SPDX-License-Identifier: Apache-2.0
"""The next pose for an arm: what it shows, what it tells, what happens without any."""

from __future__ import annotations

import math
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest

from openarm_calibration.board.board import CircleGrid
from openarm_calibration.board.detect import BoardDetection
from openarm_calibration.handeye.observability import UNITS
from openarm_calibration.handeye.problem import project
from openarm_calibration.handeye.refine import information_at, mount_error
from openarm_calibration.handeye.unknowns import Noise, Priors
from openarm_calibration.sampling.next_pose import PoseSearch, SearchConfig, advice
from openarm_calibration.sampling.samples import Sample, SampleSet, SessionHead
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL, load_cameras, true_mount
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import Primitive, RobotDescription
from openarm_common.robot.folder import robot_work
from openarm_common.scene.scene import load_scene
from tests.refusals import refuses

BOARD = CircleGrid()
QUICK = SearchConfig(draws=1000, candidates=30)
HAND = "openarm_right_link7"


class Arm:
    """The right arm, a camera off its nominal mount, and a board 1 cm off where a ruler says it is."""

    def __init__(self, name: str) -> None:
        self.description, self.camera = RobotDescription.load(), load_cameras()[name]
        self.in_hand = self.camera.parent == HAND
        k = self.camera.intrinsics
        self.row, self.size = np.array([k.fx, k.fy, k.cx, k.cy]), (k.width, k.height)
        head = SessionHead(
            camera=name, setup="in_hand" if self.in_hand else "to_hand", parent=self.camera.parent, carrier=HAND,
            intrinsics=(k.width, k.height, k.fx, k.fy, k.cx, k.cy), board=BOARD.model_dump(),
        )  # fmt: skip
        self.samples = SampleSet(head, self.description)
        self.X = true_mount(self.camera, 1) @ T_LINK_OPTICAL
        self.Z = load_scene(f"calibration_{name}").fixtures[0].T_link_fixture
        self.state = dict.fromkeys(self.description.joints, 0.0)
        for side in ("left", "right"):
            self.state |= self.description.group_state(f"{side}_arm", "home")

    def search(self, zeros: float = 0.0) -> PoseSearch:
        given = self.Z @ se3.make(se3.rot_x(0.03), (0.008, -0.006, 0.0))
        return PoseSearch(
            self.description, self.camera.T_parent_optical, given, QUICK.model_copy(update={"zeros": zeros})
        )

    def look(self, q: np.ndarray, rng: np.random.Generator) -> bool:
        """Go there and take a sample; False when not all marks are in the image."""
        joints = dict(zip(self.samples.joint_names, q.tolist(), strict=True))
        A = self.samples.pose(joints)
        T = se3.inverse(self.X) @ (se3.inverse(A) if self.in_hand else A) @ self.Z
        pixels = project(BOARD.points, BOARD.radius, T, self.row) + rng.normal(0.0, 0.05, (len(BOARD.points), 2))
        if not ((pixels > 0.0) & (pixels < self.size)).all():
            return False
        self.state |= joints
        count = len(self.samples)
        detection = BoardDetection(np.arange(len(BOARD.points)), pixels, 0.05)
        self.samples.add(Sample(f"s{count:03d}", 10**9 * count, 10**9 * count, joints, 0.0, detection, T))
        return True

    def follow(self, search: PoseSearch, count: int, rng: np.random.Generator) -> None:
        """Take samples at what is proposed, up to a number of them."""
        while len(self.samples) < count:
            proposal = search.propose(self.samples, self.state)[0]
            if self.look(proposal, rng):
                search.learn(self.samples)
            else:
                search.refuse(proposal)


@pytest.mark.long
@pytest.mark.parametrize("name", ["wrist", "overhead"])
@pytest.mark.requirement("N-07")
def test_eight_proposed_poses_calibrate(name: str) -> None:
    """Nominal mount and a ruler are enough to begin; all proposals but the first few show the board; 0.3 mm, 0.03°."""
    arm, rng = Arm(name), np.random.default_rng(0)
    search = arm.search()
    while len(arm.samples) < 8:
        solved = search.belief.solved
        proposals = search.propose(arm.samples, arm.state)
        seen = arm.look(proposals[0], rng)
        assert seen or not solved
        if not seen:
            search.refuse(proposals[0])
            continue
        belief = search.learn(arm.samples)
    offset, angle = mount_error(belief.X, arm.X)
    assert offset < 0.3e-3
    assert angle < math.radians(0.03)
    assert offset < 4.0 * belief.sigma_translation
    lower, upper = arm.description.limits(arm.samples.joint_names)
    q = np.array([list(sample.joints.values()) for sample in arm.samples.samples])
    assert (q >= lower).all()
    assert (q <= upper).all()
    turns = [se3.angle_between(a, b) for a in rotations(arm) for b in rotations(arm)]
    assert max(turns) > math.radians(25.0)


def rotations(arm: Arm) -> list[np.ndarray]:
    return [arm.samples.pose(sample.joints)[:3, :3] for sample in arm.samples.samples]


def test_what_was_refused_is_not_proposed_again() -> None:
    arm = Arm("overhead")
    search = arm.search()
    first = search.propose(arm.samples, arm.state)
    for proposal in first:
        search.refuse(proposal)
    again = search.propose(arm.samples, arm.state)
    assert all(np.abs(a - b).max() > 0.05 for a in again for b in first)


def test_hulls_that_lie_in_one_box_without_touching_are_in_nobody_s_way() -> None:
    """Links of grippers with knuckles: of two hulls the boxes overlap in every posture."""
    arm = Arm("overhead")
    corners = np.array([[x, y, z] for x, y in ((-1.0, -1.0), (1.0, -1.0), (-1.0, 0.5)) for z in (-1.0, 1.0)]) * 0.03
    links = dict(arm.description.links)
    tool = arm.description.link_pose("openarm_left_hand_tcp", arm.state)
    for link, side in (("openarm_left_left_finger", 1.0), ("openarm_left_hand_tcp", -1.0)):
        beside = se3.inverse(arm.description.link_pose(link, arm.state)) @ tool @ se3.make(None, (0.0, 0.3, 0.0))
        hull = Primitive("hull", "box", (0.06, 0.06, 0.06), beside, corners=side * corners)
        links[link] = replace(links[link], collision=(*links[link].collision, hull))
    arm.description = replace(arm.description, links=MappingProxyType(links))
    assert arm.search().propose(arm.samples, arm.state)


def test_a_board_in_the_hand_is_not_sent_close_to_the_table() -> None:
    """Arms that give way to gravity would lay it on the table, where no motion begins."""
    arm, table = Arm("overhead"), robot_work().table
    corners = np.array([[x, y, 0.0] for x in (-0.09, 0.09) for y in (-0.12, 0.12)])
    for proposal in arm.search().propose(arm.samples, arm.state, 50):
        joints = arm.state | dict(zip(arm.samples.joint_names, proposal.tolist(), strict=True))
        board = se3.apply(arm.description.link_pose(HAND, joints) @ arm.Z, corners)
        over = (board[:, 0] > table.x[0]) & (np.abs(board[:, 1]) < table.y[1])
        assert (board[over, 2] > table.top_z + 0.015).all()  # the ruler was 10 mm off


def test_no_board_and_a_board_that_can_not_be_seen_are_refused_with_what_to_do() -> None:
    arm = Arm("wrist")
    unknown = PoseSearch(arm.description, arm.camera.T_parent_optical, None, QUICK)
    with refuses(Code.NOT_READY, "the position of the board is not known"):
        unknown.propose(arm.samples, arm.state)
    with pytest.raises(OpenArmError, match="without a sample"):
        unknown.learn(arm.samples)
    behind = se3.make(None, (-3.0, 0.0, 0.5))
    blind = PoseSearch(arm.description, arm.camera.T_parent_optical, behind, QUICK)
    with refuses(Code.UNREACHABLE, "no posture of 'openarm_right_link7' shows all of"):
        blind.propose(arm.samples, arm.state)


def score(arm: Arm) -> float:
    """Return the Cramér-Rao bound on the mount of the camera, in units of 1 mm and 0.1°."""
    noise = Noise(0.05, 1e-4, 2e-4)
    information = information_at(arm.samples.problem(), arm.X[None], arm.Z[None], noise)
    return math.sqrt(np.sum(np.diag(np.linalg.inv(information))[:6] / UNITS**2))


@pytest.mark.long
@pytest.mark.parametrize("name", ["wrist", "overhead"])
@pytest.mark.requirement("N-07", "A-40")
def test_the_proposed_pose_is_more_informative_than_others_that_show_the_board(name: str) -> None:
    """By the true mounts: with a sample at the first proposal the bound is below that with one at the average other."""
    arm, rng = Arm(name), np.random.default_rng(0)
    search = arm.search()
    arm.follow(search, 4, rng)
    begun, with_one = arm.samples.samples, []
    for proposal in search.propose(arm.samples, arm.state, most=100):
        other = Arm(name)
        for sample in begun:
            other.samples.add(sample)
        if other.look(proposal, rng):
            with_one.append(score(other))
    assert len(with_one) >= 20
    assert with_one[0] < 0.95 * np.mean(with_one[1:])


@pytest.mark.long
@pytest.mark.requirement("R-11")
def test_poses_that_are_chosen_for_joint_zeros_tell_them_better() -> None:
    """Six poses of each kind: the deviation that is left of the zeros which no mount takes up, by the true mounts."""
    left = {}
    for zeros in (0.0, 0.02):
        arm, rng = Arm("overhead"), np.random.default_rng(0)
        search = arm.search(zeros)
        arm.follow(search, 6, rng)
        noise, X, Z = Noise(0.05, 1e-4, 2e-4), arm.X[None], arm.Z[None]
        joints = len(arm.samples.joint_names)
        priors = Priors(zeros=np.full(joints, 0.02))
        information = information_at(arm.samples.problem(), X, Z, noise, ("zeros",), priors)
        left[zeros] = math.sqrt(np.sum(np.diag(np.linalg.inv(information))[1 - joints : -1]))
    assert left[0.02] < 0.9 * left[0.0], left


@pytest.mark.requirement("N-07")
def test_advice_names_the_axis_that_is_missing() -> None:
    """Turns about z only: x or y is asked for; with enough of everything it says so."""
    assert "first sample" in advice([])
    turned = [se3.make(se3.rot_z(0.2 * k), (0.01 * k, 0.0, 0.0)) for k in range(5)]
    assert "wrist's x axis by 30° or more" in advice(turned)
    rng = np.random.default_rng(3)
    many = [se3.make(se3.exp_so3(rng.uniform(-0.5, 0.5, 3)), rng.uniform(-0.1, 0.1, 3)) for _ in range(12)]
    assert advice(many).startswith("enough")
    assert advice(many[:8]).startswith("4 more")
