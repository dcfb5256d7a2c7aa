# SPDX-License-Identifier: Apache-2.0
"""Every number of a grasp: metres, and seconds of robot time (simulated, in simulation) unless it says wall clock."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from openarm_common.camera.cameras import table_camera
from openarm_common.config import Config, Interval
from openarm_common.robot.folder import robot_hand, robot_work

#: Slowest motions, as a share of the limits of the joints.
LEAST_SCALE = 0.001


class ApproachConfig(Config):
    """Where the hand stands before, at and after the grasp."""

    pregrasp_distance: float = Field(
        default=0.08, ge=0.05, le=0.08, description="straight approach before the grasp, m"
    )
    path_tolerance: float = Field(
        default=0.02, gt=0.0, le=0.04, description="a hand this far off its straight approach is stopped, m"
    )
    lift_height: float = Field(default=0.12, ge=0.03, le=0.25, description="straight lift after the grasp, m")
    tilts_deg: tuple[float, ...] = Field(
        default=(0.0, 15.0, 30.0, 45.0), description="leans of the hand from vertical, deg"
    )
    round_step_deg: float = Field(
        default=30.0, gt=0.0, le=90.0, description="turns of the hand around what is round that are tried, deg"
    )
    max_width: float = Field(
        default_factory=lambda: robot_hand().max_width,
        gt=0.0,
        le=0.2,
        description="widest object side that is grasped, m; a hand that was learned may admit less",
    )
    width_noise: float = Field(
        default=0.002, ge=0.0, le=0.005, description="error of a measured width allowed beyond it, m"
    )
    overlap_half_width: float = Field(
        default=0.12, ge=0.0, le=0.3, description="|y| up to which `auto` tries both arms, m"
    )
    obstacle_margin: float = Field(default=0.005, ge=0.0, le=0.03, description="other objects are inflated by this, m")
    table_gap: float = Field(
        default=0.003, ge=0.0, le=0.01, description="the object's own box ends this above the table, m"
    )

    @model_validator(mode="after")
    def _pregrasp_is_beyond_tolerance(self) -> Self:
        if self.pregrasp_distance < 2.0 * self.path_tolerance:
            raise ValueError(
                f"pregrasp_distance {self.pregrasp_distance:g} m must be at least twice path_tolerance"
                f" {self.path_tolerance:g} m: a hand that far off its path could touch the object before the straight"
                " approach begins"
            )
        if not self.tilts_deg or any(not 0.0 <= tilt <= 60.0 for tilt in self.tilts_deg):
            raise ValueError(f"tilts_deg {list(self.tilts_deg)} must hold angles from 0 to 60 deg")
        return self


class HandConfig(Config):
    """How hands open and close."""

    close_effort: float = Field(
        default=0.0,
        ge=0.0,
        le=100.0,
        description="largest closing force, N; 0: the driver's limit. Spares what is soft",
    )
    open_tolerance: float = Field(
        default=0.004, gt=0.0, le=0.01, description="a finger this near to where it is open is there, m"
    )
    learn: bool = Field(
        default=False,
        description="whether hands of which nothing was learned are closed and opened before the first request; never"
        " where somebody may reach between the fingers",
    )
    lets_go: float = Field(
        default=0.010, gt=0.0, le=0.05, description="a gap wider than what was held by this holds nothing, m"
    )


class TimingConfig(Config):
    """Pauses of the grasp, for who watches a robot; nothing else needs them."""

    pause_at_grasp: float = Field(default=0.0, ge=0.0, le=5.0, description="at the grasp before the hand closes, s")
    after_close: float = Field(default=0.0, ge=0.0, le=5.0, description="after the hand has closed, before the lift, s")
    settle_limit: float = Field(default=1.0, gt=0.0, le=5.0, description="longest wait for the fingers to rest, s")


class HeldConfig(Config):
    """What counts as holding an object."""

    closed_below: float = Field(
        default=0.003,
        gt=0.0,
        le=0.02,
        description="a gap up to this, beyond that of a learned hand closed on nothing, is an empty hand, m",
    )
    width_tolerance: float = Field(default=0.005, gt=0.0, le=0.02, description="gap against the object's width, m")
    max_speed: float = Field(default=0.001, gt=0.0, le=0.01, description="fingers slower than this rest, m/s")
    min_effort: float = Field(default=5.0, gt=0.0, le=50.0, description="least closing force of the finger, N")
    use_effort: bool = Field(default=True, description="false for drivers that report no effort: the gap alone decides")
    use_finger_force: bool = Field(
        default=False, description="whether both finger pads must feel the object; for hands with sensors there"
    )
    min_pad_force: float = Field(default=0.5, gt=0.0, le=20.0, description="least force on each finger pad, N")
    max_tcp_error: float = Field(
        default=0.008, gt=0.0, le=0.05, description="TCP this far from the grasp hit something, m"
    )
    sag: float = Field(
        default=0.02, ge=0.0, le=0.1, description="a lift that ends so near to its goal has ended; heavy things, m"
    )
    slip: float = Field(
        default=0.003, gt=0.0, le=0.02, description="change of the gap on the way that counts as slipping, m"
    )
    rise: float = Field(default=0.03, gt=0.0, le=0.2, description="what is seen this much higher hangs in the hand, m")
    askew: float = Field(
        default=0.015, gt=0.0, le=0.1, description="a lifted object that sticks out farther has turned or slipped, m"
    )
    moved: float = Field(
        default=0.012, gt=0.0, le=0.1, description="a plan for an object seen this far out of its place is void, m"
    )


class DetectConfig(Config):
    """How detections become one trusted object."""

    frames: int = Field(default=3, ge=2, le=30, description="frames that are averaged")
    agree_within: float = Field(
        default=0.003, gt=0.0, le=0.02, description="largest spread of the object's position, m"
    )
    shape_agrees_within: float = Field(
        default=0.010,
        gt=0.0,
        le=0.05,
        description="the same of what is no prism, by the middle of its points, m",
    )
    max_age: float = Field(default=0.5, gt=0.0, le=5.0, description="oldest detection that is acted on, s")
    attempts: int = Field(
        default=3, ge=1, le=20, description="rounds of frames without the object before it is refused"
    )
    frame_timeout: float = Field(
        default=5.0, gt=0.0, le=60.0, description="wait for the frames of one round, wall clock, s"
    )


class NearLookConfig(Config):
    """A second observation from the pre-grasp, by a camera on the hand; skipped without it or its detector."""

    enabled: bool = Field(default=True, description="whether the camera on the hand is asked before the grasp")
    topic: str = Field(default="/{camera}/detections_3d", description="what the detector of {camera} finds")
    frames: int = Field(default=2, ge=1, le=10, description="that are averaged")
    least: float = Field(default=0.001, ge=0.0, le=0.01, description="smaller corrections are not made, m")
    largest: float = Field(default=0.03, gt=0.0, le=0.1, description="what is seen farther off is another object, m")
    timeout: float = Field(default=2.0, gt=0.0, le=20.0, description="wait for its frames, wall clock, s")


class CloudConfig(Config):
    """How grasps are found on the cloud of an object of any shape."""

    voxel: float = Field(default=0.0025, ge=0.001, le=0.01, description="edge of a voxel of the fused surface, m")
    cone_deg: float = Field(
        default=25.0,
        gt=0.0,
        le=45.0,
        description="friction cone: normals at both contacts against the closing axis, deg",
    )
    margin: float = Field(
        default=0.004, ge=0.0, le=0.02, description="least room between an open finger and the object, m"
    )
    table_clearance: float = Field(default=0.0034, ge=0.0, le=0.02, description="hand over the table, m")
    pairs: int = Field(default=200, ge=10, le=2000, description="pairs of opposite contacts that are tried")
    poses: int = Field(default=2500, ge=100, le=100_000, description="poses of the hand that are tried")
    best: int = Field(default=60, ge=1, le=500, description="candidates that are offered to the planner")


class ConfirmConfig(Config):
    """When a plan that a person has confirmed is still that plan."""

    joints: float = Field(
        default=0.02, gt=0.0, le=0.1, description="joints farther from where it begins than this end it, rad"
    )
    correction: float = Field(
        default=0.005,
        ge=0.0,
        le=0.01,
        description="smaller corrections of the second observation are left out, larger ones are asked about, m",
    )


class PlaceConfig(Config):
    """Where and how objects are put down."""

    release_height: float = Field(default=0.001, ge=0.0, le=0.01, description="above touching the table at release, m")
    tolerance: float = Field(
        default=0.02,
        gt=0.0,
        le=0.1,
        description="this near to the target counts as placed, m; the camera must see 3/4 of it",
    )
    yaw_step_deg: float = Field(default=30.0, gt=0.0, le=180.0, description="turns of the object that are tried, deg")
    region_x: Interval = Field(
        default_factory=lambda: robot_work().region.x, description="x of free spots, base frame, m"
    )
    region_abs_y: Interval = Field(
        default_factory=lambda: robot_work().region.abs_y, description="|y| of free spots on the arm's side, m"
    )
    spot_step: float = Field(default=0.04, gt=0.0, le=0.2, description="grid of free spots, m")
    spots: int = Field(default=6, ge=1, le=50, description="free spots that are offered to the planner")
    neighbour_distance: float = Field(default=0.10, ge=0.0, le=0.5, description="least distance to other objects, m")
    neighbour_room: float = Field(
        default=0.13, ge=0.0, le=0.5, description="so far apart, both can be grasped from any side; preferred, m"
    )
    origin_distance: float = Field(
        default=0.08, ge=0.0, le=0.5, description="least distance to where the object came from, m"
    )


class HandOverConfig(Config):
    """Where objects change hands: on the table, on a strip in the middle that both arms reach."""

    x: Interval = Field(default_factory=lambda: robot_work().strip.x, description="ends of the strip, base frame, m")
    abs_y: float = Field(
        default_factory=lambda: robot_work().strip.abs_y, gt=0.0, le=0.2, description="half of its width, m"
    )
    step: float = Field(default=0.03, gt=0.0, le=0.2, description="grid of spots, m")
    tries: int = Field(default=9, ge=1, le=50, description="spots and turns that the other arm is asked about")
    margin: float = Field(
        default=0.005, ge=0.0, le=0.02, description="the other arm must cope with an object so far off its spot, m"
    )
    margin_deg: float = Field(default=5.0, ge=0.0, le=15.0, description="and turned by so much, deg")
    rounds: int = Field(
        default=3, ge=1, le=5, description="times that the object is brought to the middle until the other arm takes it"
    )


class PushConfig(Config):
    """How objects that no arm can grasp are pushed into reach."""

    most: int = Field(default=3, ge=0, le=10, description="pushes of one object, each followed by a check; 0: none")
    lengths: tuple[float, ...] = Field(default=(0.06, 0.10), description="lengths of a push that are tried, m")
    aside: tuple[float, ...] = Field(
        default=(0.20, 0.15, 0.10, 0.06), description="lengths of a push aside that are tried, the longest first, m"
    )
    levels: tuple[float, ...] = Field(
        default=(0.0, 0.03, 0.06, 0.09),
        description="heights above the table at which the hand pushes what lies on other things, in this order, m",
    )
    directions: int = Field(default=12, ge=1, le=72, description="directions of a push that are tried")
    gap: float = Field(default=0.012, ge=0.005, le=0.05, description="hand to object before it is pushed, m")
    velocity_scale: float = Field(
        default=0.25, gt=0.0, le=1.0, description="share of the speed of other motions, so that nothing slides on"
    )
    tilts_deg: tuple[float, ...] = Field(
        default=(0.0, 15.0, 30.0, 45.0, 60.0), description="leans of the pushing hand from vertical, deg"
    )


class HeightConfig(Config):
    """How a robot on a lift searches for a height from which it can grasp."""

    step: float = Field(default=0.05, ge=0.01, le=0.5, description="between two heights that are tried, m")


class LimitsConfig(Config):
    """When to stop trying and when to stop waiting."""

    max_attempts: int = Field(default=3, ge=1, le=10, description="physical attempts of one grasp")
    plan_attempts: int = Field(
        default=2, ge=1, le=10, description="detections planned for in vain before the grasp is refused"
    )
    joint_state_timeout: float = Field(
        default=1.0, gt=0.0, le=10.0, description="silent joints = robot lost, wall clock, s"
    )
    ready_timeout: float = Field(default=8.0, ge=0.0, le=60.0, description="wait for the other nodes, wall clock, s")
    answer_timeout: float = Field(
        default=5.0, gt=0.0, le=60.0, description="an action server accepts within, wall clock, s"
    )
    plan_timeout: float = Field(default=30.0, gt=0.0, le=300.0, description="one planning request, wall clock, s")
    beside_timeout: float = Field(
        default=60.0, gt=0.0, le=600.0, description="an arm waits for the other one, s (robot time in simulation)"
    )
    beside_wait: float = Field(
        default=20.0, gt=0.0, le=60.0, description="an arm rests so long before a motion until the other leaves room, s"
    )
    move_timeout: float = Field(default=60.0, gt=0.0, le=600.0, description="one motion, wall clock, s")
    gripper_timeout: float = Field(default=20.0, gt=0.0, le=120.0, description="one gripper motion, wall clock, s")


def _budget(seconds: float, what: str) -> Any:
    return Field(default=seconds, ge=0.0, le=600.0, description=f"{what}, s of robot time; 0: no budget")


class BudgetConfig(Config):
    """How long a state is expected to take; one that takes longer is reported, and goes on."""

    detect: float = _budget(5.0, "clear the view and observe")
    transform: float = _budget(1.0, "express what was detected in the base frame")
    plan: float = _budget(5.0, "plan grasp and place, the time to confirm left out")
    move_to_pregrasp: float = _budget(4.0, "transfer and second observation")
    move_to_grasp: float = _budget(3.0, "last observation and straight approach")
    close_gripper: float = _budget(3.0, "close and judge the grip")
    lift: float = _budget(4.0, "lift and judge it")
    place: float = _budget(9.0, "plan, carry, put down and leave")
    reset: float = _budget(6.0, "go home and observe the place")


#: ParallelGripperCommand, the older GripperCommand, or FollowJointTrajectory.
GripperAction = Literal["parallel", "classic", "trajectory"]


class DriftConfig(Config):
    """When residuals of grasps raise an alarm."""

    window: int = Field(default=10, ge=3, le=100, description="grasps that are evaluated")
    least: int = Field(default=5, ge=3, le=100, description="grasps before an alarm may be raised")
    bias: float = Field(default=0.004, gt=0.0, le=0.05, description="mean residual that is an alarm, m")
    sigmas: float = Field(default=3.0, gt=0.0, le=10.0, description="and it must be so many times its own error")


class GraspConfig(Config):
    """Parameters of the grasp node."""

    scene: str = Field(default="demo", description="scene file whose table the objects stand on")
    calibrations: str = Field(
        default="", description="folder of calibrations, which holds learned hands; empty: the default one"
    )
    gripper_action: GripperAction = Field(
        default="parallel", description="type of the action `gripper`, as the bridge or the driver serves it"
    )
    gripper: str = Field(
        default="/{arm}_gripper_controller/gripper_cmd", description="action of a gripper; {arm} stands for its side"
    )
    home_state: str = Field(
        default="home", description="SRDF group state of both arms that keeps the camera's view free"
    )
    home_tolerance: float = Field(default=0.05, gt=0.0, le=0.5, description="joints this near to home are home, rad")
    camera: str = Field(
        default_factory=table_camera, description="that the detections come from; named by the drift alarm"
    )
    velocity_scale: float = Field(
        default=1.0, ge=LEAST_SCALE, le=1.0, description="share of the limits of the joints, where a request has none"
    )
    sampler: str = Field(
        default="auto",
        description="what finds grasps: boxes (across the faces of what is measured as a box or cylinder), cloud (on"
        " the cloud of any shape), auto (boxes where they fit, else cloud), or package.module:Class of another one",
    )
    approach: ApproachConfig = ApproachConfig()
    cloud: CloudConfig = CloudConfig()
    hand: HandConfig = HandConfig()
    timing: TimingConfig = TimingConfig()
    held: HeldConfig = HeldConfig()
    detect: DetectConfig = DetectConfig()
    near: NearLookConfig = Field(default_factory=NearLookConfig)
    confirm: ConfirmConfig = ConfirmConfig()
    place: PlaceConfig = Field(default_factory=PlaceConfig)
    hand_over: HandOverConfig = Field(default_factory=HandOverConfig)
    push: PushConfig = PushConfig()
    height: HeightConfig = HeightConfig()
    limits: LimitsConfig = LimitsConfig()
    budget: BudgetConfig = BudgetConfig()
    drift: DriftConfig = DriftConfig()
