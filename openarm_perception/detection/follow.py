# SPDX-License-Identifier: Apache-2.0
"""The objects of a camera, followed from image to image: what was detected gets the ids of what it shows."""

from __future__ import annotations

from collections.abc import Mapping

from openarm_common.camera.depth_view import DepthView
from openarm_common.labelled_cloud import LabelledCloud
from openarm_perception.detection.clouds import labelled_cloud, smooth_depth
from openarm_perception.detection.pipeline import Perceived
from openarm_perception.geometry.depth import DepthLimits, View
from openarm_world.carried import HeldBoxes
from openarm_world.objects import Objects


def followed(
    objects: Objects,
    perceived: Perceived,
    seen: View,
    limits: DepthLimits,
    t_ns: int,
    carried: Mapping[str, HeldBoxes] | None,
) -> tuple[Objects, Perceived, LabelledCloud]:
    """Return the objects after an image, what was detected in it with their ids, and its points in the optical frame.

    Args:
        objects: After the image before.
        perceived: Objects that were detected.
        seen: The image.
        limits: Depths that count.
        t_ns: Stamp of the image.
        carried: Boxes that the hands hold, by name; None: not known.
    """
    smooth = smooth_depth(seen, limits)
    cloud = labelled_cloud(seen, smooth, perceived.boxes, limits)
    view = DepthView(smooth, seen.intrinsics, seen.T_base_camera, limits.near, limits.far)
    objects, sight = objects.update(view, cloud.moved(seen.T_base_camera), t_ns, carried)
    return objects, perceived.identified(sight.ids), cloud
