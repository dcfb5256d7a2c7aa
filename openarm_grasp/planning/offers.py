# SPDX-License-Identifier: Apache-2.0
"""Grasps that are offered to the planner: what the sampler finds for an object that was seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

from openarm_common.errors import Code, OpenArmError
from openarm_grasp.context import GraspContext
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.planning.candidates import GraspCandidate
from openarm_grasp.planning.retries import FailedGrasp, has_met
from openarm_grasp.sampling.samplers import Sampling, make_sampler
from openarm_grasp.sampling.surface import fuse
from openarm_grasp.sampling.views import views_of

_sampler = cache(make_sampler)


def offers(
    context: GraspContext, arm: str, sighting: Sighting, failed: Sequence[FailedGrasp] = ()
) -> tuple[GraspCandidate, ...]:
    """Find grasps for an arm, best first.

    Boxes and cylinders that fit into the hand are grasped across their faces; everything else on its cloud.

    Args:
        context: Parameters, hands, where the arms stand.
        arm: Arm of the hand.
        sighting: The object and what is around it.
        failed: Grasps of it that have failed.

    Raises:
        OpenArmError: Same as `openarm_grasp.sampling.samplers.GraspSampler`.
    """
    name = context.config.sampler
    sampler, target = _sampler(name), sighting.target
    spared = bool(target.kind) and name in ("auto", "boxes") and not has_met(failed)  # a surface takes some 50 ms
    try:
        return sampler.candidates(asked(context, arm, replace(sighting, clouds=()) if spared else sighting, failed))
    except OpenArmError as error:
        if error.code is not Code.TOO_WIDE or not (spared and sighting.clouds):
            raise
        try:
            return sampler.candidates(asked(context, arm, sighting, failed))
        except OpenArmError:
            raise error from None  # a prism that is too wide is just that


def asked(context: GraspContext, arm: str, sighting: Sighting, failed: Sequence[FailedGrasp] = ()) -> Sampling:
    """Return what a sampler is given; a surface where the points of the object are known. Arguments as `offers`."""
    config, surface = context.config_of(arm), None
    if sighting.clouds and all(cloud.measured for cloud in sighting.clouds):
        floor = sighting.target.bottom
        surface = fuse(views_of(sighting.clouds, floor), floor, step=config.cloud.voxel)
    return Sampling(
        sighting.target,
        config,
        context.parts(arm),
        sighting.beside,
        context.shoulders.get(arm, (0.0, 0.0)),
        surface,
        None if surface is None else context.shape(arm),
        failed=failed,
    )
