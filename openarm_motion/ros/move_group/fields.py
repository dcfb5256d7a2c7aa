# SPDX-License-Identifier: Apache-2.0
"""Which fields of MoveIt's messages are honoured; any other one that is set is refused by name.

A field is named by its path, for example `goal_constraints.joint_constraints.position`; `path.*` is all below it. What
is not listed must have its default, so a field that is added upstream is refused until it is listed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief


def _under(prefix: str, *groups: Iterable[str]) -> tuple[str, ...]:
    return tuple(f"{prefix}.{path}" for group in groups for path in group)


_SHAPES = ("primitives.type", "primitives.dimensions", "primitive_poses.*")
CONSTRAINTS: tuple[str, ...] = (
    "name",
    "joint_constraints.*",
    *_under("position_constraints", ("header.*", "link_name", "target_point_offset.*", "weight")),
    *_under("position_constraints.constraint_region", _SHAPES),
    "orientation_constraints.*",
)
OBJECT: tuple[str, ...] = ("header.*", "pose.*", "id", *_SHAPES, "meshes.*", "mesh_poses.*", "operation")
ATTACHED: tuple[str, ...] = ("link_name", "touch_links", *_under("object", OBJECT))
#: A joint state is a reading: velocity, effort and stamp of it are no request.
STATE: tuple[str, ...] = ("joint_state.*", "is_diff")
_HELD_STATE = (*STATE, *_under("attached_collision_objects", ATTACHED))
PLAN: tuple[str, ...] = (
    "workspace_parameters.*",
    *_under("start_state", _HELD_STATE),
    *_under("goal_constraints", CONSTRAINTS),
    *_under("path_constraints", CONSTRAINTS),
    "pipeline_id",
    "planner_id",
    "group_name",
    "num_planning_attempts",
    "allowed_planning_time",
    "max_velocity_scaling_factor",
    "max_acceleration_scaling_factor",
    "cartesian_speed_limited_link",  # says nothing without max_cartesian_speed
)
#: How often and how patiently to look around or to plan again says nothing while neither is asked for.
MOVE: tuple[str, ...] = (
    *_under("request", PLAN),
    *_under(
        "planning_options",
        ("plan_only", "look_around_attempts", "max_safe_execution_cost", "replan_attempts", "replan_delay"),
        ("planning_scene_diff.is_diff", "planning_scene_diff.robot_state.is_diff"),
    ),
)
EXECUTE: tuple[str, ...] = (
    "controller_names",
    *_under("trajectory.joint_trajectory", ("header.frame_id", "joint_names")),
    *_under("trajectory.joint_trajectory.points", ("positions", "velocities", "accelerations", "time_from_start.*")),
)
CARTESIAN: tuple[str, ...] = (
    "header.*",
    *_under("start_state", STATE),
    *_under("path_constraints", CONSTRAINTS),
    *("group_name", "link_name", "waypoints.*", "max_step", "jump_threshold", "revolute_jump_threshold"),
    *("prismatic_jump_threshold", "avoid_collisions", "cartesian_speed_limited_link"),
    *("max_velocity_scaling_factor", "max_acceleration_scaling_factor"),
)
IK: tuple[str, ...] = _under(
    "ik_request",
    _under("robot_state", STATE),
    _under("constraints", CONSTRAINTS),
    ("group_name", "avoid_collisions", "ik_link_name", "pose_stamped.*", "timeout.*"),
)
FK: tuple[str, ...] = ("header.*", "fk_link_names", *_under("robot_state", STATE))
VALIDITY: tuple[str, ...] = ("group_name", *_under("robot_state", STATE), *_under("constraints", CONSTRAINTS))
SCENE: tuple[str, ...] = (
    *("name", "robot_model_name", "allowed_collision_matrix.*", "object_colors.*", "is_diff"),
    *_under("robot_state", _HELD_STATE),
    *_under("world.collision_objects", OBJECT),
    *_under("world.octomap", ("header.*", "origin.*", "octomap.*")),
)


def check_fields(message: Any, honoured: Sequence[str], what: str) -> None:
    """Refuse what a message asks and no field of a list honours.

    Args:
        message: Message of any type.
        honoured: Paths.
        what: Names the message.

    Raises:
        OpenArmError: INVALID_ARGUMENT, naming the field and its value.
    """
    found = next(_set_fields(message, "", frozenset(honoured)), None)
    if found is not None:
        path, value = found
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{what}: field {path} is {brief(str(value))}; it is not supported, expected its default",
        )


def _set_fields(message: Any, prefix: str, honoured: frozenset[str]) -> Iterator[tuple[str, Any]]:
    default = type(message)()
    for name in message.get_fields_and_field_types():
        path, value = prefix + name, getattr(message, name)
        if path in honoured or f"{path}.*" in honoured:
            continue
        items = value if isinstance(value, list) else [value]
        if items and all(hasattr(item, "get_fields_and_field_types") for item in items):
            if isinstance(value, list) and not any(known.startswith(f"{path}.") for known in honoured):
                yield path, f"a list of {len(items)}"
            for item in items:
                yield from _set_fields(item, f"{path}.", honoured)
        elif not _same(value, getattr(default, name)):
            yield path, value


def _same(a: Any, b: Any) -> bool:
    if hasattr(a, "__len__") and not isinstance(a, str):
        return len(a) == len(b) and list(a) == list(b)
    return bool(a == b)
