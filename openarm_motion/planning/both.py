# SPDX-License-Identifier: Apache-2.0
"""Both arms as one: configurations of the first arm's joints followed by the second's. Base frame, m, rad."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from openarm_common.types import Array
from openarm_motion.collision.collision import Box, Clearance, CollisionScene, Contact, Surroundings
from openarm_motion.collision.fast import FastScene
from openarm_motion.collision.looks import spread
from openarm_motion.collision.seen import NOTHING, Known
from openarm_motion.planning.arm import Arm, segment_time
from openarm_motion.planning.planner import PlanQuery, never
from openarm_motion.timing.trajectory import JointLimits

#: Two arms that move at once plan to stay this far apart, m: 20 mm remain when each lags behind its plan a little.
SEPARATION = 0.025


class BothScene:
    """Exact checks of two arms in one set of surroundings; not for two threads at once.

    Args:
        first: Scene of the first arm, which also looks at the other arm's links.
        second: Scene of the second arm.
        split: Joints of the first arm.
    """

    def __init__(self, first: CollisionScene, second: CollisionScene, split: int) -> None:
        self.first, self.second = first, second
        self._split = split
        self.levers: Array = np.concatenate([first.levers, second.levers])

    def collides(self, q: ArrayLike) -> bool:
        """Whether some pair is nearer than it may be at a configuration (n1 + n2,)."""
        a, b = self._put(q)
        return self.first.collides(a) or self.second.collides(b)

    def contacts(self, q: ArrayLike) -> list[Contact]:
        """All pairs that are nearer than they may be, the deepest first; a pair of both arms once."""
        a, b = self._put(q)
        found = self.first.contacts(a)
        seen = {frozenset((c.first, c.second)) for c in found}
        found += [c for c in self.second.contacts(b) if frozenset((c.first, c.second)) not in seen]
        return sorted(found, key=lambda contact: contact.distance - contact.required)

    def edge_free(self, a: Array, b: Array, step: float = 0.05, travel: float = 0.02) -> bool:
        """Whether the straight joint line between two configurations is free; see `CollisionScene.edge_free`."""
        return self.first_hit(a, b, step, travel) is None

    def first_hit(self, a: Array, b: Array, step: float = 0.05, travel: float = 0.02) -> Array | None:
        """Some colliding configuration on the line between two, or None; far-apart points are looked at first."""
        difference, k = b - a, self._split
        size = np.abs(difference)
        way = size * self.levers
        # two arms may close in on each other: their ways add up
        n = int(np.ceil(max(float(size.max()) / step, float(way[:k].sum() + way[k:].sum()) / travel, 1.0)))
        for u in spread(n):
            q = a + u * difference
            if self.collides(q):
                return q
        return None

    @contextmanager
    def lenient(self, share: float, arms: float | None = None) -> Iterator[None]:
        """Ask for only a share of each positive distance meanwhile, `arms` of that between the arms."""
        with self.first.lenient(share, arms), self.second.lenient(share, arms):
            yield

    def separation(self, q: ArrayLike) -> float:
        """Distance of the arms from each other at a configuration (n1 + n2,), what they hold included, m."""
        a, _ = self._put(q)
        # what the second arm holds goes with it as the first one sees it
        return self.first.gap(a, self.second.robot.arm.moving | self.first.carried)

    def placed(self, q: ArrayLike) -> tuple[CollisionScene, CollisionScene]:
        """Both scenes with the other arm where a configuration (n1 + n2,) has it."""
        self._put(q)
        return self.first, self.second

    def _put(self, q: ArrayLike) -> tuple[Array, Array]:
        values = np.asarray(q, dtype=np.float64)
        a, b = values[: self._split], values[self._split :]
        self.first.put_other(self.second.robot, b)
        self.second.put_other(self.first.robot, a)
        return a, b


class BothArms:
    """Two arms of one robot that are planned together.

    Args:
        first: One arm; its joints come first in every configuration.
        second: The other.
    """

    def __init__(self, first: Arm, second: Arm) -> None:
        self.arms = (first, second)
        self.names: tuple[str, ...] = (*first.names, *second.names)
        self.split = first.kinematics.n
        self.lower: Array = np.concatenate([first.kinematics.lower, second.kinematics.lower])
        self.upper: Array = np.concatenate([first.kinematics.upper, second.kinematics.upper])

    def parts(self, values: Array) -> tuple[Array, Array]:
        """What belongs to each arm, of values (..., n1 + n2)."""
        return values[..., : self.split], values[..., self.split :]

    def scene(
        self,
        state: Mapping[str, float],
        boxes: Sequence[Box] = (),
        separation: float = SEPARATION,
        held: tuple[Sequence[Box], Sequence[Box]] = ((), ()),
        known: Known = NOTHING,
    ) -> BothScene:
        """Surroundings of both arms with the table in them.

        Args:
            state: The robot's joints.
            boxes: Obstacles, base frame.
            separation: Distance that the arms keep from each other, m.
            held: Boxes held by each arm, its tool frame.
            known: Bodies of the planning scene and the map.
        """
        scenes = [self.scene_of(i, state, boxes, separation, held, known) for i in range(2)]
        return BothScene(scenes[0], scenes[1], self.split)

    def scene_of(
        self,
        index: int,
        state: Mapping[str, float],
        boxes: Sequence[Box] = (),
        separation: float = SEPARATION,
        held: tuple[Sequence[Box], Sequence[Box]] = ((), ()),
        known: Known = NOTHING,
    ) -> CollisionScene:
        """Surroundings of one of the arms, the other one in them where `state` says; arguments as `scene`."""
        arm = self.arms[index]
        keep = arm.config.clearance.model_copy(update={"arms": separation})
        certain = (*arm.static, *known.solids)
        fixed = frozenset(body.id for body in certain)
        around = Surroundings(
            state,
            [*certain, *boxes],
            held=held[index],
            carried=self.arms[1 - index].robot.on_tool(held[1 - index]),
            supports=fixed,
            fixed=fixed,
            clearance=keep,
            map=known.map,
        )
        return CollisionScene(arm.robot, around)

    def pair_scene(
        self, state: Mapping[str, float], separation: float, held: tuple[Sequence[Box], Sequence[Box]] = ((), ())
    ) -> BothScene:
        """Nothing but the arms and what they hold; arguments as `scene`."""
        first, second = (
            Surroundings(
                state,
                held=held[i],
                carried=self.arms[1 - i].robot.on_tool(held[1 - i]),
                clearance=Clearance(arms=separation),
                own=False,
            )
            for i in range(2)
        )
        a, b = self.arms
        return BothScene(CollisionScene(a.robot, first), CollisionScene(b.robot, second), self.split)

    def limits(self, scale: float) -> JointLimits:
        """Limits of all joints at a velocity scale."""
        a, b = (arm.limits(scale) for arm in self.arms)
        return JointLimits(
            np.concatenate([a.velocity, b.velocity]),
            np.concatenate([a.acceleration, b.acceleration]),
            np.concatenate([a.jerk, b.jerk]),
        )

    def query(
        self,
        scene: BothScene,
        start: Array,
        goals: Array,
        scale: float,
        time_limit: float,
        stopped: Callable[[], bool] = never,
        fineness: float = 1.0,
    ) -> PlanQuery:
        """What a planner is asked for a path (n1 + n2,) to one of several configurations (k, n1 + n2)."""
        search = self.arms[0].config.planning
        step, travel = search.edge_step / fineness, search.edge_travel / fineness
        limits = self.limits(scale)
        return PlanQuery(
            start=start,
            goals=goals,
            lower=self.lower,
            upper=self.upper,
            collides=scene.collides,
            edge_free=lambda a, b: scene.edge_free(a, b, step, travel),
            cost=lambda a, b: segment_time(a, b, limits),
            time_limit=time_limit,
            iterations=search.iterations,
            seed=search.seed,
            stopped=stopped,
            fast=cache(lambda: FastScene([scene.first, scene.second], scene.first.distances)),
            resolution=(step, travel),
            limits=(limits.velocity, limits.acceleration, limits.jerk),
        )
