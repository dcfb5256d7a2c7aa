# SPDX-License-Identifier: Apache-2.0
"""From one frame of a camera to objects in the base frame: detect, rank, locate. Usable without ROS."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import OpenArmError
from openarm_perception.detection.detector import Detection2D, Detector, Mask, Policy, rank
from openarm_perception.detection.localize import Localizer, LocatedObject
from openarm_perception.detection.view import Seen, View
from openarm_perception.geometry.depth import DepthImage, check_size, unit_scale


@dataclass(frozen=True)
class Perceived:
    """What a frame shows, the object to take first at the front.

    Attributes:
        found: In the image.
        located: In the base frame; those of `found` that could be.
        refused: Why the others could not be, one sentence each.
        unmeasured: Boxes around what is seen of those, with score 0: in the way, but not to be grasped.
        robot: (h, w) pixels that show the robot or what it holds; None when nobody looked for them.
    """

    found: tuple[Detection2D, ...]
    located: tuple[LocatedObject, ...]
    refused: tuple[str, ...]
    robot: Mask | None = None
    unmeasured: tuple[LocatedObject, ...] = ()

    @property
    def boxes(self) -> tuple[LocatedObject, ...]:
        """Everything that stands there, what could be measured first."""
        return (*self.located, *self.unmeasured)


class Pipeline:
    """Finds objects in images and locates them.

    Args:
        detector: Finds them in the colour image.
        localizer: Finds where they are.
        policy: Which comes first.
        label: Only objects of this name; empty takes all.
    """

    def __init__(self, detector: Detector, localizer: Localizer, policy: Policy = "score", label: str = "") -> None:
        self.detector = detector
        self.localizer = localizer
        self.policy: Policy = policy
        self.label = label

    def run(
        self,
        rgb: NDArray[np.uint8],
        depth: DepthImage,
        intrinsics: Intrinsics,
        T_base_camera: NDArray[np.float64],
        robot: Mask | None = None,
    ) -> Perceived:
        """The objects of a frame.

        Args:
            rgb: (h, w, 3) uint8.
            depth: (h, w) uint16 millimetres or float32 metres, aligned with `rgb`.
            intrinsics: Of both, from the CameraInfo.
            T_base_camera: (4, 4) optical frame in the base frame, at the stamp of the image.
            robot: (h, w) pixels that show the robot or what it holds; they belong to no object.

        Raises:
            OpenArmError: BAD_IMAGE, when colour, depth and intrinsics do not belong together.
        """
        check_size("colour image", rgb.shape, intrinsics)
        check_size("depth image", depth.shape, intrinsics)
        unit_scale(depth)
        size = (intrinsics.width, intrinsics.height)
        seen = self.look(View(rgb, depth, intrinsics, T_base_camera, robot))
        found = rank(seen.found, self.policy, size, self.label)
        located: list[LocatedObject] = []
        refused: list[str] = []
        unmeasured: list[LocatedObject] = []
        for detection in found:
            patch = self.localizer.cut(detection, depth, intrinsics, T_base_camera, robot)
            try:
                located.append(self.localizer.locate(patch))
            except OpenArmError as error:
                refused.append(error.message)
                with contextlib.suppress(OpenArmError):  # flat on the table, or the robot: it stands in nobody's way
                    unmeasured.append(self.localizer.enclose(patch))
        for doubt in seen.doubts:
            refused.append(doubt.why)
            patch = self.localizer.cut(doubt.found, depth, intrinsics, T_base_camera, robot)
            with contextlib.suppress(OpenArmError):
                unmeasured.append(self.localizer.enclose(patch))
        return Perceived(found, tuple(located), tuple(refused), robot, tuple(unmeasured))

    def look(self, view: View) -> Seen:
        """Objects of a frame in the image; what else than colour they are told by is the business of subclasses."""
        return Seen(self.detector.detect(view.rgb))
