# SPDX-License-Identifier: Apache-2.0
"""Publishing what the cameras see: colour, depth and their CameraInfo, each only while someone listens."""

from __future__ import annotations

import copy
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import cast

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import CameraInfo, Image

from openarm_common.camera.cameras import CameraConfig, Intrinsics
from openarm_common.ros.convert import ENCODINGS, info_from_intrinsics, ns_to_stamp
from openarm_common.ros.node import QOS_SENSOR
from openarm_sim_bridge.cameras.handover import CameraSetup
from openarm_sim_bridge.cameras.noise import add_colour_noise, add_depth_noise
from openarm_sim_bridge.cameras.renderer import Colour, Depth, SnapshotRenderer
from openarm_sim_bridge.faults.camera_faults import CameraFaults
from openarm_sim_bridge.faults.faults import Fault


def topic_names(camera: CameraConfig) -> tuple[str, ...]:
    """Topics of a camera before any remapping."""
    streams = ("color", "depth") if camera.depth else ("color",)
    return tuple(f"/{camera.name}/{stream}/{kind}" for stream in streams for kind in ("image_raw", "camera_info"))


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
    def make(cls, node: Node, setup: CameraSetup, camera: CameraConfig, stream: str, encoding: str) -> _Stream:
        dtype, channels = ENCODINGS[encoding]
        message = Image(height=camera.height, width=camera.width, encoding=encoding)
        message.is_bigendian = int(sys.byteorder == "big")
        message.step = camera.width * channels * np.dtype(dtype).itemsize
        message.header.frame_id = camera.optical_frame
        message.data = bytes(message.step * camera.height)
        shape = (camera.height, camera.width, channels) if channels > 1 else (camera.height, camera.width)
        image, info = (setup.topics[f"/{camera.name}/{stream}/{kind}"] for kind in ("image_raw", "camera_info"))
        return cls(
            image=node.create_publisher(Image, image, QOS_SENSOR),
            info=node.create_publisher(CameraInfo, info, QOS_SENSOR),
            message=message,
            info_message=info_from_intrinsics(camera.intrinsics, camera.optical_frame, 0),
            pixels=np.frombuffer(message.data, dtype=dtype).reshape(shape),
        )

    def poll(self) -> bool:
        self.wants_image = self.image.get_subscription_count() > 0
        self.wants_info = self.info.get_subscription_count() > 0
        return self.wants_image or self.wants_info

    def due(self, t_ns: int, *, image: bool) -> Iterator[tuple[Publisher, Image | CameraInfo]]:
        """What is to be published now; the messages are used again for the next frame."""
        stamp = ns_to_stamp(t_ns)
        if image and self.wants_image:
            self.message.header.stamp = stamp
            yield self.image, self.message
        if self.wants_info:
            self.info_message.header.stamp = stamp
            yield self.info, self.info_message

    def tell_intrinsics(self, intrinsics: Intrinsics) -> None:
        self.info_message = info_from_intrinsics(intrinsics, self.info_message.header.frame_id, 0)


@dataclass
class _Camera:
    colour: _Stream
    depth: _Stream | None
    streams: tuple[_Stream, ...] = field(init=False)

    def __post_init__(self) -> None:
        self.streams = (self.colour,) if self.depth is None else (self.colour, self.depth)


class CameraPublisher:
    """Topics of all cameras.

    Args:
        node: Owner of the publishers.
        setup: The cameras, how depth is told, names of the topics.
    """

    def __init__(self, node: Node, setup: CameraSetup) -> None:
        self.faults = CameraFaults()
        self._depth_noise, self._colour_noise = setup.depth_noise, setup.colour_noise
        self._rng = np.random.default_rng(setup.noise_seed)
        self._late: list[tuple[float, Publisher, Image | CameraInfo]] = []
        self._configs = {camera.name: camera for camera in setup.cameras}
        self._cameras = {
            camera.name: _Camera(
                _Stream.make(node, setup, camera, "color", "rgb8"),
                _Stream.make(node, setup, camera, "depth", setup.depth_encoding) if camera.depth else None,
            )
            for camera in setup.cameras
        }

    def poll(self) -> tuple[str, ...]:
        """Look who listens; return the cameras that anyone listens to."""
        watched = {name: [stream.poll() for stream in camera.streams] for name, camera in self._cameras.items()}
        return tuple(name for name, streams in watched.items() if any(streams))

    def wants_image(self, name: str) -> bool:
        """Whether anyone listens to an image of the camera, not only to its CameraInfo."""
        return any(stream.wants_image for stream in self._cameras[name].streams)

    def draw(self, renderer: SnapshotRenderer, name: str) -> None:
        """Draw a camera's view of the loaded state into its messages."""
        if self.faults.frozen(name):
            return
        camera = self._cameras[name]
        colour = cast(Colour, camera.colour.pixels)
        depth = camera.depth.pixels if camera.depth is not None and camera.depth.wants_image else None
        renderer.draw(name, colour, cast(Depth | None, depth), self._noise if self._depth_noise.enabled else None)
        add_colour_noise(colour, self._colour_noise, self._rng)
        if depth is not None:
            self.faults.spoil_depth(name, depth)

    def _noise(self, name: str, z: NDArray[np.float32]) -> NDArray[np.float32]:
        return add_depth_noise(z, self._configs[name].intrinsics.fx, self._depth_noise, self._rng)

    def publish(self, name: str, t_ns: int, *, drawn: bool) -> None:
        """Publish what listeners want of a camera.

        Args:
            name: Of the camera.
            t_ns: Stamp.
            drawn: False when there is a CameraInfo only.
        """
        if self.faults.drops(name):
            return
        delay_s = self.faults.delay_s(name)
        stamp_ns = self.faults.stamp_ns(name, t_ns)
        for stream in self._cameras[name].streams:
            for publisher, message in stream.due(stamp_ns, image=drawn):
                if delay_s > 0.0:
                    self._late.append((time.monotonic() + delay_s, publisher, copy.deepcopy(message)))
                else:
                    publisher.publish(message)

    def set_faults(self, faults: tuple[Fault, ...]) -> None:
        """Take the faults that are active from now on."""
        self.faults.set(faults)
        for name, config in self._configs.items():
            for stream in self._cameras[name].streams:
                stream.tell_intrinsics(self.faults.intrinsics(name, config.intrinsics))

    def publish_late(self) -> float:
        """Publish what was delayed until now; return in how many seconds the next is due."""
        now = time.monotonic()
        waiting, self._late = self._late, []
        for item in waiting:
            if item[0] <= now:
                item[1].publish(item[2])
            else:
                self._late.append(item)
        return min((due - now for due, _, _ in self._late), default=math.inf)
