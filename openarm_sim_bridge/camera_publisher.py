# SPDX-License-Identifier: Apache-2.0
"""Publishing what the cameras see: colour, depth and their CameraInfo, each only while someone listens."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import CameraInfo, Image

from openarm_common.cameras import CameraConfig
from openarm_common.convert import ENCODINGS, info_from_intrinsics, ns_to_stamp
from openarm_common.errors import OpenArmError
from openarm_common.node import QOS_SENSOR
from openarm_sim_bridge.cameras import Colour, Depth, RenderThread
from openarm_sim_bridge.pacing import RateDivider
from openarm_sim_bridge.state_publisher import until_shutdown
from openarm_sim_bridge.world import Snapshot, World

#: The simulation begins after this long at the latest, images or not, s.
_WARM_UP_S = 20.0


@dataclass
class _Stream:
    """One image topic with its info; the pixels are written into the message."""

    image: Publisher
    info: Publisher
    message: Image
    info_message: CameraInfo
    pixels: NDArray[np.generic]
    wants_image: bool = False
    wants_info: bool = False

    @classmethod
    def make(cls, node: Node, camera: CameraConfig, topic: str, encoding: str) -> _Stream:
        dtype, channels = ENCODINGS[encoding]
        message = Image(height=camera.height, width=camera.width, encoding=encoding)
        message.is_bigendian = int(sys.byteorder == "big")
        message.step = camera.width * channels * np.dtype(dtype).itemsize
        message.header.frame_id = camera.optical_frame
        message.data = bytes(message.step * camera.height)
        shape = (camera.height, camera.width, channels) if channels > 1 else (camera.height, camera.width)
        return cls(
            image=node.create_publisher(Image, f"/{camera.name}/{topic}/image_raw", QOS_SENSOR),
            info=node.create_publisher(CameraInfo, f"/{camera.name}/{topic}/camera_info", QOS_SENSOR),
            message=message,
            info_message=info_from_intrinsics(camera.intrinsics, camera.optical_frame, 0),
            pixels=np.frombuffer(message.data, dtype=dtype).reshape(shape),
        )

    def poll(self) -> None:
        self.wants_image = self.image.get_subscription_count() > 0
        self.wants_info = self.info.get_subscription_count() > 0

    def publish(self, t_ns: int, *, image: bool) -> None:
        stamp = ns_to_stamp(t_ns)
        if image and self.wants_image:
            self.message.header.stamp = stamp
            self.image.publish(self.message)
        if self.wants_info:
            self.info_message.header.stamp = stamp
            self.info.publish(self.info_message)


@dataclass
class _Camera:
    colour: _Stream
    depth: _Stream | None
    ticks: RateDivider
    streams: tuple[_Stream, ...] = field(init=False)

    def __post_init__(self) -> None:
        self.streams = (self.colour,) if self.depth is None else (self.colour, self.depth)


class CameraPublisher:
    """Topics of all cameras, and the thread that draws for them.

    Args:
        node: Owner of the publishers.
        cameras: By name.
        first: A state of the world to warm up with; the constructor returns when that is done.
        depth_encoding: 16UC1 (mm) or 32FC1 (m).
        failed: Called (in the thread that draws) when it can't draw at all.
    """

    def __init__(
        self,
        node: Node,
        cameras: Mapping[str, CameraConfig],
        first: Snapshot,
        depth_encoding: str,
        failed: Callable[[OpenArmError], None],
    ) -> None:
        self._context = node.context
        self._cameras = {
            name: _Camera(
                _Stream.make(node, camera, "color", "rgb8"),
                _Stream.make(node, camera, "depth", depth_encoding) if camera.depth else None,
                RateDivider(camera.rate),
            )
            for name, camera in cameras.items()
        }
        self._thread = RenderThread(cameras, first, self._buffers, self._deliver, failed)
        self._thread.start()
        self._thread.warm.wait(_WARM_UP_S)

    @property
    def rendered(self) -> dict[str, int]:
        """Frames drawn so far, by camera."""
        return dict(self._thread.rendered)

    @property
    def dropped(self) -> int:
        """Frames that were not drawn because the machine was too slow."""
        return self._thread.dropped

    def poll(self) -> None:
        """Look who listens; for a timer of a few hertz."""
        for camera in self._cameras.values():
            for stream in camera.streams:
                stream.poll()

    def tick(self, world: World) -> None:
        """Hand the tick to the cameras that are due and watched; in the thread of the simulation, never waits."""
        due = [camera for camera in self._cameras.items() if camera[1].ticks.due(world.t_ns)]
        to_draw = [name for name, camera in due if any(stream.wants_image for stream in camera.streams)]
        if to_draw:
            self._thread.offer(world.snapshot(), to_draw)
        for name, camera in due:
            if name not in to_draw:
                for stream in camera.streams:
                    stream.publish(world.t_ns, image=False)

    def close(self) -> None:
        """Stop drawing."""
        self._thread.stop()

    def _buffers(self, name: str) -> tuple[Colour, Depth | None]:
        camera = self._cameras[name]
        wants_depth = camera.depth is not None and camera.depth.wants_image
        return camera.colour.pixels, camera.depth.pixels if camera.depth is not None and wants_depth else None

    def _deliver(self, name: str, t_ns: int) -> None:
        with until_shutdown(self._context):
            for stream in self._cameras[name].streams:
                stream.publish(t_ns, image=True)
