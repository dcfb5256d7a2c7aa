# SPDX-License-Identifier: Apache-2.0
"""Publishing what the cameras see: colour, depth and their CameraInfo, each only while someone listens."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import CameraInfo, Image

from openarm_common.cameras import CameraConfig
from openarm_common.convert import ENCODINGS, info_from_intrinsics, ns_to_stamp
from openarm_common.node import QOS_SENSOR
from openarm_sim_bridge.cameras import SnapshotRenderer
from openarm_sim_bridge.handover import CameraSetup


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
        camera = self._cameras[name]
        wants_depth = camera.depth is not None and camera.depth.wants_image
        renderer.draw(name, camera.colour.pixels, camera.depth.pixels if camera.depth and wants_depth else None)

    def publish(self, name: str, t_ns: int, *, drawn: bool) -> None:
        """Publish what listeners want of a camera.

        Args:
            name: Of the camera.
            t_ns: Stamp.
            drawn: False when there is a CameraInfo only.
        """
        for stream in self._cameras[name].streams:
            stream.publish(t_ns, image=drawn)
