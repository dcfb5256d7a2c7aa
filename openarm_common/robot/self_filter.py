# SPDX-License-Identifier: Apache-2.0
"""The robot and what it holds, found in depth images and clouds.

Shapes are the collision primitives of the robot description with a padding per link, and boxes that hang on links. All
poses are in the base frame, m, of the moment of the image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.depth_view import DepthView
from openarm_common.config import Config, metres_by_name
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot import filter_kernels as kernels
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.held import HeldBox
from openarm_common.types import Array, Bytes, Floats, Ints, Mask


class SelfFilterConfig(Config):
    """How the robot is removed from its camera images."""

    enabled: bool = Field(default=True, description="remove the robot and held objects from the images")
    padding: float = Field(default=0.02, ge=0.0, le=0.2, description="around every link, m")
    link_padding: tuple[str, ...] = Field(default=(), description="other paddings, as `link=metres`")
    held_padding: float = Field(default=0.02, ge=0.0, le=0.2, description="around what a hand holds, m")

    @model_validator(mode="after")
    def _pairs(self) -> Self:
        self.paddings()
        return self

    def paddings(self) -> dict[str, float]:
        """Return the paddings that differ, by link."""
        return metres_by_name(self.link_padding, "link_padding", "hand=0.03", 0.0, 0.2)


@dataclass(frozen=True, eq=False)
class Shapes:
    """The robot at one moment.

    Attributes:
        names: Owners of shapes: links, then held boxes as `held/NAME`.
        kinds: (n,) as the kernels count them.
        halves: (n, 3) half edges without padding, m.
        padding: (n,) m.
        owners: (n,) index in `names`.
        T_base_shape: (n, 4, 4).
    """

    names: tuple[str, ...]
    kinds: Ints
    halves: Array
    padding: Array
    owners: Ints
    T_base_shape: Array

    def seen_from(self, T_base_frame: Array) -> Array:
        """Return T_shape_frame (n, 3, 4) of a frame at (4, 4) in the base."""
        R_t = self.T_base_shape[:, :3, :3].transpose(0, 2, 1)
        out = np.empty((len(self.kinds), 3, 4))
        out[:, :, :3] = R_t @ T_base_frame[:3, :3]
        out[:, :, 3] = np.einsum("nij,nj->ni", R_t, T_base_frame[:3, 3] - self.T_base_shape[:, :3, 3])
        return out


class SelfFilter:
    """Knows the shapes of a robot.

    Args:
        description: The robot.
        config: Paddings.

    Raises:
        OpenArmError: CONFIG_INVALID, when a padding is given for a link that the robot does not have.
    """

    def __init__(self, description: RobotDescription, config: SelfFilterConfig) -> None:
        special = config.paddings()
        for link in special:
            if link not in description.links:
                raise OpenArmError(
                    Code.CONFIG_INVALID,
                    f"link_padding names link {link!r}; links: {', '.join(description.links)}",
                )
        self._config = config
        self._description = description
        self._links = tuple(name for name, link in description.links.items() if link.collision)
        found = [(i, shape) for i, name in enumerate(self._links) for shape in description.links[name].collision]
        self._owners = np.array([i for i, _ in found], np.int64)
        self._kinds = np.array([_KINDS[shape.kind] for _, shape in found], np.int64)
        self._halves = np.array([shape.half for _, shape in found]).reshape(-1, 3)
        self._T_link_shape = np.array([shape.T_link_primitive for _, shape in found]).reshape(-1, 4, 4)
        self._padding = np.array([special.get(self._links[i], config.padding) for i, _ in found])

    def shapes(self, joints: Mapping[str, float], held: Sequence[HeldBox] = ()) -> Shapes:
        """Place the shapes of the robot in a posture.

        Args:
            joints: Positions by joint name, rad or m.
            held: Boxes that hang on its links.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for a joint without a position; NO_TRANSFORM, for a held box on a link that
                the robot does not have.
        """
        poses = self._description.link_poses(joints)
        T = np.array([poses[name] for name in self._links]).reshape(-1, 4, 4)[self._owners] @ self._T_link_shape
        for box in held:
            if box.link not in poses:
                raise OpenArmError(
                    Code.NO_TRANSFORM, f"held {box.name!r} hangs on {box.link!r}, which is no link of the robot"
                )
        if not held:
            return Shapes(self._links, self._kinds, self._halves, self._padding, self._owners, T)
        n, first = len(held), len(self._links)
        return Shapes(
            names=self._links + tuple(f"held/{box.name}" for box in held),
            kinds=np.concatenate([self._kinds, np.full(n, kernels.BOX, np.int64)]),
            halves=np.concatenate([self._halves, [np.array(box.size) / 2.0 for box in held]]),
            padding=np.concatenate([self._padding, np.full(n, self._config.held_padding)]),
            owners=np.concatenate([self._owners, np.arange(first, first + n)]),
            T_base_shape=np.concatenate([T, [poses[box.link] @ box.T_link_box for box in held]]),
        )

    def label_depth(self, scan: DepthView, shapes: Shapes) -> tuple[Bytes, dict[str, int]]:
        """Find the robot in a depth image.

        Returns:
            Labels (h, w): 0 environment, 1 robot, 2 no return where the robot may be; and the pixels that each link
            took, of the links that took any.
        """
        label = np.zeros(scan.depth.shape, np.uint8)
        counts = np.zeros(len(shapes.names), np.int64)
        k = scan.intrinsics
        kernels.label_image(
            scan.depth, scan.scale, np.float32(scan.near), np.float32(scan.far), *scan.rays, k.fx, k.fy, k.cx, k.cy,
            shapes.kinds, shapes.halves + shapes.padding[:, None], shapes.seen_from(scan.T_base_camera),
            shapes.owners, label, counts,
        )  # fmt: skip
        return label, _named(shapes, counts)

    def outline(self, lens: Intrinsics, T_base_camera: Array, shapes: Shapes) -> Mask:
        """Return the pixels (h, w) of a camera whose rays meet the robot, whatever is measured there."""
        nothing = np.zeros((lens.height, lens.width), np.float32)
        return self.label_depth(DepthView(nothing, lens, T_base_camera, 1.0, 1.0), shapes)[0] > 0

    def label_points(self, points: Floats, shapes: Shapes) -> tuple[Bytes, dict[str, int]]:
        """Find the robot in points (n, 3) of the base frame: labels (n,), and the points that each link took."""
        label = np.zeros(points.shape[0], np.uint8)
        counts = np.zeros(len(shapes.names), np.int64)
        kernels.label_points(
            points, shapes.kinds, shapes.halves + shapes.padding[:, None], shapes.seen_from(np.eye(4)),
            shapes.owners, label, counts,
        )  # fmt: skip
        return label, _named(shapes, counts)


_KINDS = {"box": kernels.BOX, "cylinder": kernels.CYLINDER, "sphere": kernels.SPHERE}


def _named(shapes: Shapes, counts: Ints) -> dict[str, int]:
    return {name: int(n) for name, n in zip(shapes.names, counts, strict=True) if n}
