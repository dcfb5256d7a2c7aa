# SPDX-License-Identifier: Apache-2.0
"""Tasks of a campaign: a scene, the requested objects, and an injected fault; all of it from a set and a seed.

Positions are in the base frame, m; the same set and seed always give the same task.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from openarm_common.draws import first_fit
from openarm_common.errors import Code
from openarm_common.scene.scene import PALETTE, SPACING, Scene, random_scene

_ENDURANCE = 10


@dataclass(frozen=True)
class FaultPlan:
    """Something that goes wrong.

    Attributes:
        name: Name in `openarm_sim_bridge.faults.faults`.
        parameters: Parameters of the fault.
        when: State that is entered when it begins; "" begins with the scene.
        until_attempt: It is cleared when this attempt begins; 0: never.
    """

    name: str
    parameters: Mapping[str, Any] = field(default_factory=dict[str, Any])
    when: str = ""
    until_attempt: int = 0


@dataclass(frozen=True)
class Task:
    """One row of a campaign.

    Attributes:
        set_name: Name in `SUITES`.
        seed: Seed of everything that is drawn.
        scene: Scene with the objects on the table.
        labels: Requested objects, one after the other.
        arm: auto, or an arm of the robot.
        kind: Kind of the scene, for the report.
        fault: Fault to inject; None: none.
        sets: Parameters of nodes, `node.param=value`: faults that nodes inject themselves.
        codes: Allowed results; OK is placed. Without OK it is impossible and must be refused.
        mount_seed: Seed of the true camera mounts; None: nominal.
        dynamics_seed: Seed of motors, masses and joint zeros; None: that of the configuration.
        hand_seed: Seed of stops and friction of the fingers; None: that of the configuration.
        place: (x, y) of the requested footprint centre, base frame, m; None: chosen by the suite.
        place_on: Object that it is to stand on or in, in words; "": the table.
        posture: Joints that start elsewhere than at home, rad by name.
        clear: Repeated labels are several objects: what was placed stays where it is.
        route: Route by which it must come to its place, as in `GraspOutcome.route`; "": any.
        together: Two labels are requested at once, of both arms.
        graspable: Reason why a hand can't take an object of any shape, by name, as the judge decides; "" where it can.
    """

    set_name: str
    seed: int
    scene: Scene
    labels: tuple[str, ...]
    arm: str = "auto"
    kind: str = "nominal"
    fault: FaultPlan | None = None
    sets: tuple[str, ...] = ()
    codes: tuple[Code, ...] = (Code.OK,)
    mount_seed: int | None = None
    dynamics_seed: int | None = None
    hand_seed: int | None = None
    place: tuple[float, float] | None = None
    place_on: str = ""
    posture: Mapping[str, float] = field(default_factory=dict[str, float])
    clear: bool = False
    route: str = ""
    together: bool = False
    graspable: Mapping[str, str] = field(default_factory=dict[str, str])


def within(ends: tuple[float, float], low: float, high: float) -> tuple[float, float]:
    """Return an interval less so much at its ends, m, to the millimetre; negative: beyond them."""
    return round(ends[0] + low, 3), round(ends[1] - high, 3)


def past(ends: tuple[float, float], near: float, far: float) -> tuple[float, float]:
    """Return the interval that begins and ends so much after the end of another one, m, to the millimetre."""
    return round(ends[1] + near, 3), round(ends[1] + far, 3)


def nominal(seed: int) -> Task:
    """Make a random scene with one or two requested objects; the others are obstacles."""
    scene = random_scene(seed)
    rng = np.random.default_rng([seed, 1])
    wanted = min(len(scene.objects), 1 + int(rng.random() < 0.5))
    return Task("nominal", seed, scene, tuple(item.label for item in scene.objects[:wanted]))


def clutter(seed: int) -> Task:
    """Request all of five to eight objects; where there are more than colours, two of a colour are two requests."""
    rng = np.random.default_rng([seed, 2])
    scene = crowded_scene(seed, int(rng.integers(5, 9)))
    return Task("clutter", seed, scene, tuple(item.label for item in scene.objects), kind="clutter", clear=True)


def crowded_scene(seed: int, count: int) -> Scene:
    """Make a random scene with more objects than colours: colours are used again."""
    whole, k = random_scene(seed, count=min(count, len(PALETTE))), itertools.count(1)
    objects = list(whole.objects)

    def draw() -> Scene | None:
        if len(objects) == count:
            return whole.model_copy(update={"objects": tuple(objects), "name": f"crowded_{seed}"})
        number = next(k)
        for twin in random_scene(seed + number * 1_000_000, count=len(PALETTE)).objects:
            far = all(math.dist(twin.position[:2], item.position[:2]) >= SPACING for item in objects)
            if len(objects) < count and far:
                objects.append(twin.model_copy(update={"name": f"{twin.name}_{number + 1}"}))
        return None

    return first_fit(f"scene {seed}: {count} objects {SPACING:g} m apart", "enlarge work.region of robot.yaml", draw)


def endurance(seed: int) -> Task:
    """Request two objects ten times each in one world: nothing is reset or repaired in between."""
    scene = random_scene(seed, count=2)
    labels = tuple(item.label for item in scene.objects)
    return Task("endurance", seed, scene, _ENDURANCE * labels, kind="endurance")
