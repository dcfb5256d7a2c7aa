# SPDX-License-Identifier: Apache-2.0
"""Publishers of the cameras: colour, depth and their CameraInfo, each only while it has subscribers."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterator
from functools import partial
from typing import cast

import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import CameraInfo, Image

from openarm_common.camera.cameras import CameraConfig, Intrinsics
from openarm_common.ros.convert import info_from_intrinsics, ns_to_stamp
from openarm_common.ros.image_rates import WantedRates
from openarm_common.ros.images import LAYOUTS, array_to_image, image_to_array
from openarm_common.ros.node import QOS_SENSOR
from openarm_sim_bridge.cameras.cameras import SimulatedCameras
from openarm_sim_bridge.cameras.handover import CameraSetup
from openarm_sim_bridge.cameras.renderer import Colour, Depth, SnapshotRenderer
from openarm_sim_bridge.faults.faults import Fault

_STREAMS = ("color", "depth")
_KINDS = ("image_raw", "camera_info")


def topic_names(camera: CameraConfig) -> tuple[str, ...]:
    """Return the topics of a camera before any remapping."""
    return tuple(f"/{camera.name}/{stream}/{kind}" for stream in _STREAMS[: 1 + camera.depth] for kind in _KINDS)


class _Stream:
    """One image topic with its info; the pixels are written into the message."""

    def __init__(self, node: Node, setup: CameraSetup, camera: CameraConfig, stream: str, encoding: str) -> None:
        dtype, channels = LAYOUTS[encoding]
        shape = (camera.height, camera.width, channels) if channels > 1 else (camera.height, camera.width)
        topics = (setup.topics[f"/{camera.name}/{stream}/{kind}"] for kind in _KINDS)
        self.image, self.info = (
            node.create_publisher(message, topic, QOS_SENSOR)
            for message, topic in zip((Image, CameraInfo), topics, strict=True)
        )
        self.message = array_to_image(np.zeros(shape, dtype), encoding, camera.optical_frame, 0)
        self._camera = camera
        self.info_message = self.info_of(camera.intrinsics)
        self.pixels = image_to_array(self.message)
        self.wants_image = self.wants_info = False

    def info_of(self, intrinsics: Intrinsics) -> CameraInfo:
        return info_from_intrinsics(intrinsics, self._camera.optical_frame, 0, self._camera.baseline)

    def poll(self, wanted: WantedRates) -> float:
        self.wants_image = self.image.get_subscription_count() > 0
        self.wants_info = self.info.get_subscription_count() > 0
        subscribed = [
            out.topic_name for out, to in ((self.image, self.wants_image), (self.info, self.wants_info)) if to
        ]
        return wanted.of(subscribed)

    def due(self, t_ns: int, *, image: bool) -> Iterator[tuple[Publisher, Image | CameraInfo]]:
        """Yield the messages to publish now; they are reused for the next frame."""
        stamp = ns_to_stamp(t_ns)
        if image and self.wants_image:
            self.message.header.stamp = stamp
            yield self.image, self.message
        if self.wants_info:
            self.info_message.header.stamp = stamp
            yield self.info, self.info_message


class CameraPublisher:
    """Topics of all cameras.

    Args:
        node: Owner of the publishers.
        setup: The cameras, encoding of depth, names of the topics.

    Attributes:
        cameras: Draw the pictures.
    """

    def __init__(self, node: Node, setup: CameraSetup) -> None:
        configs = {camera.name: camera for camera in setup.cameras}
        rng = np.random.default_rng(setup.noise_seed)
        self.cameras = SimulatedCameras(
            partial(SnapshotRenderer, configs), configs, setup.depth_noise, setup.colour_noise, rng
        )
        self._wanted = WantedRates(node)
        self._late: list[tuple[float, Publisher, Image | CameraInfo]] = []
        encodings = {"color": "rgb8", "depth": setup.depth_encoding}
        self._streams = {
            camera.name: [_Stream(node, setup, camera, kind, encodings[kind]) for kind in _STREAMS[: 1 + camera.depth]]
            for camera in setup.cameras
        }

    def poll(self) -> dict[str, float]:
        """Look who subscribes; return at which rate to each camera, as `CameraReport.rates`."""
        self._wanted.poll()
        return {name: max(stream.poll(self._wanted) for stream in streams) for name, streams in self._streams.items()}

    def wants_image(self, name: str) -> bool:
        """Whether an image of the camera has a subscriber, not only its CameraInfo."""
        return any(stream.wants_image for stream in self._streams[name])

    def draw(self, name: str) -> None:
        """Draw a camera's view of the loaded state into its messages; a frozen camera keeps its picture."""
        if self.cameras.faults.frozen(name):
            return
        streams = self._streams[name]
        depth = streams[1].pixels if len(streams) > 1 and streams[1].wants_image else None
        self.cameras.draw(name, cast(Colour, streams[0].pixels), cast(Depth | None, depth))

    def publish(self, name: str, t_ns: int, *, drawn: bool) -> None:
        """Publish the topics of a camera that have subscribers.

        Args:
            name: Name of the camera.
            t_ns: Stamp.
            drawn: False when there is a CameraInfo only.
        """
        faults = self.cameras.faults
        if faults.drops(name):
            return
        delay_s = faults.delay_s(name)
        stamp_ns = faults.stamp_ns(name, t_ns)
        for stream in self._streams[name]:
            for publisher, message in stream.due(stamp_ns, image=drawn):
                if delay_s > 0.0:
                    self._late.append((time.monotonic() + delay_s, publisher, copy.deepcopy(message)))
                else:
                    publisher.publish(message)

    def set_faults(self, faults: tuple[Fault, ...]) -> None:
        """Take the faults that are active from now on."""
        self.cameras.faults.set(faults)
        for name, streams in self._streams.items():
            for stream in streams:
                stream.info_message = stream.info_of(self.cameras.intrinsics(name))

    def publish_late(self) -> float:
        """Publish what was delayed until now; return in how many seconds the next is due."""
        now = time.monotonic()
        for _, publisher, message in (item for item in self._late if item[0] <= now):
            publisher.publish(message)
        self._late = [item for item in self._late if item[0] > now]
        return min((due - now for due, _, _ in self._late), default=math.inf)
