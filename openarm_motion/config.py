# SPDX-License-Identifier: Apache-2.0
"""Parameters of the motion node and its core. SI units; angles rad.

`{arm}` in a name is replaced by each of `arms`, so another robot is described here and in its URDF and SRDF alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from openarm_common.config import Config, RunTimeField
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.motors import JointMotion
from openarm_common.types import Array
from openarm_motion.collision.exact import Clearance
from openarm_motion.timing.trajectory import JointLimits


class MotionLimits(Config):
    """What the joints of an arm may do, from the shoulder to the wrist; plans use these times the velocity scale."""

    velocity: tuple[float, ...] = Field(default=(), description="rad/s, one number a joint; empty: the robot's")
    acceleration: tuple[float, ...] = Field(default=(), description="rad/s2, one number a joint; empty: the robot's")
    jerk: tuple[float, ...] = Field(default=(), description="rad/s3, one number a joint; empty: the robot's")
    straight_speed: float = Field(default=0.5, gt=0.0, le=2.0, description="tool on straight lines at scale 1, m/s")
    default_scale: float = Field(default=0.5, gt=0.0, le=1.0, description="velocity scale of a request that has none")

    @model_validator(mode="after")
    def _positive_and_alike(self) -> MotionLimits:
        sizes = {len(row) for row in (self.velocity, self.acceleration, self.jerk) if row}
        if len(sizes) > 1 or min(self.velocity + self.acceleration + self.jerk, default=1.0) <= 0.0:
            raise ValueError("velocity, acceleration and jerk need one number > 0 for each joint")
        return self

    def of(self, robot: JointMotion | None, arm: str, names: Sequence[str]) -> JointLimits:
        """Return the limits of an arm.

        Args:
            robot: Limits in the robot's folder; None: none.
            arm: Its name.
            names: Its joints.

        Raises:
            OpenArmError: CONFIG_INVALID, naming the row that does not fit the joints.
        """
        rows: list[Array] = []
        for key in ("velocity", "acceleration", "jerk"):
            row = getattr(self, key) or getattr(robot, key, ())
            if len(row) != len(names):
                joints = f"arm {arm!r} has {len(names)} joints: {', '.join(names)}"
                raise OpenArmError(Code.CONFIG_INVALID, f"limits.{key} has {len(row)} numbers, {joints}")
            rows.append(np.array(row, dtype=np.float64))
        return JointLimits(*rows)


class StraightClearance(Clearance):
    """Clearance on straight parts, where the gripper works near surfaces."""

    hand: float = Field(default=0.003, ge=0.0, le=0.1, description="hand, or what it holds, to boxes, m")
    rest: float = Field(
        default=-0.004, ge=-0.02, le=0.05, description="held box to what it rests on; < 0 allows overlap, m"
    )


class PlanningConfig(Config):
    """How plans are searched for."""

    planner: str = Field(
        default="fast",
        pattern=r"^(fast|ompl|[A-Za-z_][\w.]*:[A-Za-z_]\w*)$",
        description="what searches for free paths: fast, ompl, or package.module:Class of another one",
    )
    timing: Literal["blended", "stops", "quintic"] = Field(
        default="blended",
        description="corners of free paths: rounded where that is proven free, with a stop, or quintic with a stop",
    )
    joint_margin: float = Field(
        default=0.05, ge=0.0, le=0.5, description="kept from joint limits on lines, and at poses that allow it, rad"
    )
    swivels: int = Field(default=48, ge=4, le=720, description="elbow angles tried a turn")
    time_limit: float = Field(default=5.0, gt=0.0, le=120.0, description="of a search, s of wall clock")
    iterations: int = Field(
        default=0, ge=0, description="samples of a search, which then may take as long as it takes; 0: limited by time"
    )
    seed: int = Field(default=1, ge=1, description="of random numbers; the same request gives the same plan")
    edge_step: float = Field(default=0.05, gt=0.0, le=0.2, description="joint turn between two collision checks, rad")
    edge_travel: float = Field(default=0.02, gt=0.0, le=0.1, description="travel of any point between two checks, m")
    start_overlap: float = Field(default=0.005, ge=0.0, le=0.05, description="overlap at a start taken for an error, m")
    estimate_overlap: float = Field(default=0.03, ge=0.0, le=0.2, description="the same with obstacles of a request, m")
    score_step: float = Field(
        default=0.05, ge=0.0, description="targets whose scores differ by less count as equally good"
    )
    keep: int = Field(default=4, ge=1, le=64, description="configurations kept a target")
    period: float = Field(default=0.02, ge=0.002, le=0.2, description="greatest time between trajectory samples, s")


class ExecutionConfig(Config):
    """How execution is watched."""

    #: Fast DDS halts a publisher for a third of a second to a second while it opens the port of who has just ended.
    stale_after: float = Field(default=1.2, gt=0.05, le=5.0, description="age of /joint_states that counts as lost, s")
    start_tolerance: float = Field(default=0.05, gt=0.0, le=0.5, description="a trajectory must begin this near, rad")
    goal_tolerance: float = Field(default=0.02, gt=0.0, le=0.5, description="joints must end this near, rad")
    tool_tolerance: float = Field(default=0.01, gt=0.0, le=0.5, description="the tool must end this near, m")
    settle: float = Field(
        default=1.0, ge=0.0, le=10.0, description="time to come within the goal tolerance, s of robot time"
    )
    overtime: float = Field(
        default=5.0, gt=0.0, description="robot time beyond the duration before a motion is given up, s"
    )


class MapConfig(Config):
    """How the map of the surroundings is used."""

    use: Literal["required", "optional", "off"] = Field(
        default="optional",
        description="required: no plan without a fresh map; optional: plans go without one that is missing or old",
    )
    max_age: float = Field(
        default=3.0,
        gt=0.0,
        le=60.0,
        description="oldest update, and oldest contribution of each camera, that counts, s",
    )
    cameras: tuple[str, ...] = Field(
        default=(), description="cameras that must have contributed; empty: all of the map's"
    )
    name: str = Field(
        default="", pattern=r"^[A-Za-z0-9_.-]*$", description="of the map's shared memory; empty: by ROS domain"
    )
    certain_padding: float = Field(
        default=0.018, ge=0.0, le=0.2, description="cells this near to the table or a body of the scene are theirs, m"
    )
    estimate_padding: float = Field(
        default=0.03, ge=0.0, le=0.2, description="the same for a request's boxes and for what is held, m"
    )
    robot_padding: float = Field(default=0.005, ge=0.0, le=0.2, description="the same for the robot itself, m")

    @field_validator("use", mode="before")
    @classmethod
    def _off(cls, value: Any) -> Any:
        return "off" if value is False else value  # as YAML reads it without quotes


class FaultsConfig(Config):
    """Fault injection: approach plans that fail with NO_PLAN; counted from the last change of these."""

    no_plan_share: float = RunTimeField(default=0.0, ge=0.0, le=1.0, description="share of approach plans that fail")
    no_plan_limit: int = RunTimeField(default=0, ge=0, description="no more than so many fail; 0: without limit")
    seed: int = RunTimeField(default=0, ge=0, description="of which fail")


class MoveGroupConfig(Config):
    """The node `move_group`, which answers MoveIt's clients in the process of the motion node."""

    enabled: bool = Field(default=False, description="whether it is there; it needs moveit_msgs (openarm up --moveit)")
    gripper: str = Field(default="/{arm}_gripper_controller/gripper_cmd", description="action that moves a hand")
    gripper_action: Literal["parallel", "classic"] = Field(
        default="parallel", description="its type: ParallelGripperCommand, or the older GripperCommand"
    )
    finger_speed: float = Field(default=0.1, gt=0.0, le=2.0, description="of fingers in plans, m/s or rad/s")
    map: str = Field(default="/octomap_full", description="service that has the octomap of the planning scene")
    clear_map: str = Field(default="/octomap/reset", description="service that /clear_octomap calls")


class ServoScaleConfig(Config):
    """What 1 is in a command without units."""

    linear: float = Field(default=0.4, gt=0.0, le=2.0, description="of the tool, m/s")
    rotational: float = Field(default=0.8, gt=0.0, le=6.0, description="of the tool, rad/s")
    joint: float = Field(default=0.5, gt=0.0, le=6.0, description="of a joint, rad/s or m/s")


class ServoClearance(Clearance):
    """Distances kept while servoing, m, in addition to what `lag` asks for."""

    own: float = Field(default=0.001, ge=0.0, le=0.05, description="between links, and to the robot's body, m")
    world: float = Field(default=0.005, ge=0.0, le=0.1, description="arm to boxes, m")
    arms: float = Field(default=0.020, ge=0.0, le=0.1, description="arm to the other arm, m")
    hand: float = Field(default=0.005, ge=0.0, le=0.1, description="hand, or what it holds, to boxes, m")


class ServoingConfig(Config):
    """How arms follow twists and joint velocities; names as MoveIt Servo has them."""

    enabled: bool = Field(
        default=False, description="whether the node servo_node is there; it needs moveit_msgs (openarm up --moveit)"
    )
    command_in_type: Literal["unitless", "speed_units"] = Field(
        default="unitless", description="unitless: -1 to 1, times scale; speed_units: m/s and rad/s"
    )
    scale: ServoScaleConfig = Field(default_factory=ServoScaleConfig, description="of commands without units")
    publish_period: float = Field(default=0.01, ge=0.004, le=0.05, description="from one set point to the next, s")
    incoming_command_timeout: float = Field(
        default=0.025, ge=0.01, le=1.0, description="the arm stops when no command came for so long, s"
    )
    thread_priority: int = Field(
        default=40, ge=0, le=99, description="of the process under SCHED_FIFO, where the system allows it; 0: ordinary"
    )
    lower_singularity_threshold: float = Field(
        default=17.0, gt=1.0, description="condition number of the Jacobian from which on twists are slowed"
    )
    hard_stop_singularity_threshold: float = Field(
        default=30.0, gt=1.0, description="condition number at which twists that raise it stop"
    )
    joint_limit_margin: float = Field(default=0.05, ge=0.0, le=0.5, description="kept from joint limits, rad")
    lookahead: float = Field(
        default=0.12, ge=0.0, le=1.0, description="an arm is slowed so that it may go on for so long and then stop, s"
    )
    clearance: ServoClearance = Field(default_factory=ServoClearance, description="distances kept while servoing")
    lag: float = Field(
        default=0.005, ge=0.0, le=0.05, description="joints may be this far from their set points, rad: adds clearance"
    )

    @model_validator(mode="after")
    def _in_order(self) -> ServoingConfig:
        low, high = self.lower_singularity_threshold, self.hard_stop_singularity_threshold
        if high <= low:
            raise ValueError(
                f"hard_stop_singularity_threshold {high:g} must exceed lower_singularity_threshold {low:g}"
            )
        return self


class MotionConfig(Config):
    """Parameters of the motion node."""

    arms: tuple[str, ...] = Field(default=(), description="names of the arms; empty: all of the robot")
    tool_link: str = Field(default="", description="link that is moved to poses; empty: the robot's tool centre point")
    group: str = Field(default="{arm}_arm", description="SRDF group of an arm's postures")
    controller: str = Field(
        default="/{arm}_joint_trajectory_controller/follow_joint_trajectory", description="FollowJointTrajectory action"
    )
    scene: str = Field(
        default="demo", description="scene whose table is an obstacle: a name, a path, or empty for none"
    )
    map: MapConfig = Field(default_factory=MapConfig, description="the map of the surroundings")
    limits: MotionLimits = Field(default_factory=MotionLimits, description="of the joints")
    clearance: Clearance = Field(default_factory=Clearance, description="on free paths")
    straight: StraightClearance = Field(default_factory=StraightClearance, description="clearance on straight parts")
    planning: PlanningConfig = Field(default_factory=PlanningConfig, description="search")
    execution: ExecutionConfig = Field(default_factory=ExecutionConfig, description="monitoring of execution")
    faults: FaultsConfig = Field(default_factory=FaultsConfig, description="fault injection")
    move_group: MoveGroupConfig = Field(default_factory=MoveGroupConfig, description="MoveIt's names")
    servo: ServoingConfig = Field(default_factory=ServoingConfig, description="twists and joint velocities")


class NoParameters(Config):
    """Parameters of a node beside the motion node in its process: they are those of the motion node."""
