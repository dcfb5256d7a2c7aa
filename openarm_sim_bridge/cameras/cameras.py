# SPDX-License-Identifier: Apache-2.0
"""The simulated cameras: pictures of a snapshot with noise and injected faults, for the node and for campaigns."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from openarm_common.camera.cameras import CameraConfig, Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Floats
from openarm_sim_bridge.cameras.noise import ColourNoiseConfig, DepthNoiseConfig, add_colour_noise, add_depth_noise
from openarm_sim_bridge.cameras.renderer import Colour, Depth, SnapshotRenderer
from openarm_sim_bridge.faults.camera_faults import CameraFaults
from openarm_sim_bridge.world.world import Snapshot


class SimulatedCameras:
    """Draws what cameras measure. One thread.

    Args:
        renderer: Makes (or returns) what draws clean pictures; called at the first `load`.
        cameras: Cameras by name.
        depth_noise: Noise of depth images.
        colour_noise: Noise of colour images.
        rng: Source of all noise.

    Attributes:
        faults: Injected faults of cameras.
    """

    def __init__(
        self,
        renderer: Callable[[], SnapshotRenderer],
        cameras: Mapping[str, CameraConfig],
        depth_noise: DepthNoiseConfig,
        colour_noise: ColourNoiseConfig,
        rng: np.random.Generator,
    ) -> None:
        self.faults = CameraFaults()
        self._make_renderer = renderer
        self._renderer: SnapshotRenderer | None = None
        self._cameras = cameras
        self._depth_noise, self._colour_noise = depth_noise, colour_noise
        self._rng = rng

    def load(self, snapshot: Snapshot) -> None:
        """Take the state to draw.

        Raises:
            OpenArmError: ENVIRONMENT or CONFIG_INVALID, as `SnapshotRenderer`.
        """
        self._renderer = self._renderer or self._make_renderer()
        self.faults.apply(snapshot.model)
        self._renderer.load(snapshot)

    def draw(self, name: str, colour: Colour, depth: Depth | None) -> None:
        """Draw one camera's view of the loaded state.

        Args:
            name: Name of the camera.
            colour: (height, width, 3), filled.
            depth: (height, width), filled with mm (uint16) or m (float32); None without depth.

        Raises:
            OpenArmError: INTERNAL, when nothing is loaded.
        """
        if self._renderer is None:
            raise OpenArmError(Code.INTERNAL, "draw was called before load")
        self._renderer.draw(name, colour, depth, self._measure if self._depth_noise.enabled else None)
        add_colour_noise(colour, self._colour_noise, self._rng)
        if depth is not None:
            self.faults.spoil_depth(name, depth)

    def intrinsics(self, name: str) -> Intrinsics:
        """Return the intrinsics that a camera publishes."""
        return self.faults.intrinsics(name, self._cameras[name].intrinsics)

    def _measure(self, name: str, z: Floats) -> Floats:
        return add_depth_noise(z, self._cameras[name].intrinsics.fx, self._depth_noise, self._rng)
