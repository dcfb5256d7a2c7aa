# SPDX-License-Identifier: Apache-2.0
"""Node `cloud`: depth images to points."""

from __future__ import annotations

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from openarm_common.camera.cameras import load_cameras
from openarm_common.ros.convert import info_from_intrinsics, points_from_cloud, stamp_to_ns
from openarm_common.ros.images import array_to_image
from openarm_common.ros.node import QOS_SENSOR
from openarm_perception.ros.cloud_node import CloudNode
from tests.refusals import refused

CAMERAS = load_cameras()
OVERHEAD = CAMERAS["overhead"]
K, FRAME = OVERHEAD.intrinsics, OVERHEAD.optical_frame


class Bench:
    """A camera, the node and a watcher of its points."""

    def __init__(self, ros, **params) -> None:
        self.ros = ros
        self.depth = ros.node.create_publisher(Image, "/overhead/depth/image_raw", QOS_SENSOR)
        self.info = ros.node.create_publisher(CameraInfo, "/overhead/depth/camera_info", QOS_SENSOR)
        self.node = ros.start(CloudNode, **params)
        self.clouds: list[PointCloud2] = []
        self.t_ns = 0

    def watch(self):
        return self.ros.node.create_subscription(PointCloud2, "/overhead/depth/points", self.clouds.append, QOS_SENSOR)

    def pump(self, pixels, encoding: str, condition, what: str, frame: str = FRAME, K=K) -> None:
        """Publish a frame each half second until `condition` holds."""

        def send() -> None:
            self.t_ns += 33_000_000
            self.depth.publish(array_to_image(pixels, encoding, frame, self.t_ns))
            self.info.publish(info_from_intrinsics(K, frame, self.t_ns))

        self.ros.send_until(send, 0.5, condition, what)


def flat(millimetres: int = 700):
    """A wall with one pixel too near and one without depth."""
    depth = np.full((480, 640), millimetres, np.uint16)
    depth[10, 20], depth[30, 40] = 100, 0
    return depth


@pytest.mark.requirement("B-29", "A-47", "A-48")
def test_organised_points_of_every_pixel(ros) -> None:
    """Frame and stamp of the image; x = (u - cx) z / fx; what is invalid or nearer than the camera can is NaN."""
    bench = Bench(ros)
    bench.watch()
    bench.pump(flat(), "16UC1", lambda: bench.clouds, "a cloud")
    cloud = bench.clouds[0]
    assert cloud.header.frame_id == FRAME
    assert stamp_to_ns(cloud.header.stamp) % 33_000_000 == 0
    assert not cloud.is_dense
    points = points_from_cloud(cloud)
    assert points.shape == (480, 640, 3)
    np.testing.assert_allclose(points[200, 600], ((600 - K.cx) * 0.7 / K.fx, (200 - K.cy) * 0.7 / K.fy, 0.7), atol=1e-6)
    invalid = np.isnan(points[..., 2])
    assert sorted(map(tuple, np.argwhere(invalid).tolist())) == [(10, 20), (30, 40)]


@pytest.mark.requirement("A-50")
def test_one_point_a_centimetre_after_the_voxel_filter(ros) -> None:
    """No two in a cell, every cell of the surface has one; of metres too."""
    bench = Bench(ros, organised=False, **{"filter.voxel": 0.01})
    bench.watch()
    bench.pump((flat() * 1e-3).astype(np.float32), "32FC1", lambda: bench.clouds, "a cloud")
    assert bench.clouds[0].is_dense
    points = points_from_cloud(bench.clouds[0]).astype(np.float64)
    cells = np.unique(np.floor(points[:, :2] / 0.01 + 1e-6), axis=0)
    assert len(cells) >= 0.999 * len(points)
    width, height = 640 / K.fx * 0.7, 480 / K.fy * 0.7
    assert len(points) == pytest.approx(width * height / 1e-4, rel=0.05)
    np.testing.assert_allclose(points[:, 2], 0.7, atol=1e-3)


@pytest.mark.long
@pytest.mark.requirement("A-51")
def test_flying_pixels_are_dropped_as_statistical_outliers(ros) -> None:
    """With k = 20 and 2 sigma pixels between the near and the far surface go, the surfaces stay."""
    depth, rng = np.zeros((480, 640), np.uint16), np.random.default_rng(3)
    depth[120:360, 160:480], depth[180:300, 220:420] = 700, 600
    v, u = rng.choice(np.arange(180, 300), 60, replace=False), rng.choice((219, 420), 60)
    depth[v, u] = rng.integers(630, 670, 60)
    bench = Bench(ros, organised=False, **{"filter.outliers": True})
    bench.watch()
    bench.pump(depth, "16UC1", lambda: bench.clouds, "a cloud")
    z = points_from_cloud(bench.clouds[0])[:, 2]
    assert np.count_nonzero((z > 0.61) & (z < 0.69)) <= 3
    assert np.count_nonzero(z >= 0.69) + np.count_nonzero(z <= 0.61) >= 0.97 * (240 * 320 - 60)


def test_colour_comes_with_the_points_when_asked_for(ros) -> None:
    """As RViz reads it; sizes are checked."""
    bench = Bench(ros, color=True)
    color = ros.node.create_publisher(Image, "/overhead/color/image_raw", QOS_SENSOR)
    pixels = np.zeros((480, 640, 3), np.uint8)
    pixels[..., 0] = 200
    bench.watch()

    def with_color() -> bool:
        color.publish(array_to_image(pixels, "rgb8", FRAME, bench.t_ns))
        return bool(bench.clouds)

    bench.pump(flat(), "16UC1", with_color, "a coloured cloud")
    cloud = bench.clouds[0]
    assert [f.name for f in cloud.fields] == ["x", "y", "z", "rgb"]
    rgb = np.frombuffer(cloud.data, np.uint32).reshape(480, 640, 4)[..., 3]
    assert (rgb == 200 << 16).all()


@pytest.mark.parametrize(
    "params", [{"filter.voxel": 0.01}, {"filter.outliers": True}, {"color": True, "organised": False}]
)
def test_what_takes_points_away_is_not_organised(ros, params) -> None:
    refused(r"set organised to (false as well .--set cloud|true, or color)", ros.start, CloudNode, **params)


@pytest.mark.requirement("A-58")
def test_images_are_subscribed_to_only_while_points_have_a_subscriber(ros) -> None:
    """Of that camera alone."""
    bench = Bench(ros)
    wrist = ros.node.create_publisher(Image, "/wrist/depth/image_raw", QOS_SENSOR)
    ros.spin_until(lambda: ros.node.count_publishers("/wrist/depth/points"), what="the node is up")
    assert bench.depth.get_subscription_count() == 0
    watcher = bench.watch()
    ros.spin_until(lambda: bench.depth.get_subscription_count(), what="the camera is listened to")
    assert wrist.get_subscription_count() == 0
    ros.node.destroy_subscription(watcher)
    ros.spin_until(lambda: not bench.depth.get_subscription_count(), what="the camera is let go")


@pytest.mark.requirement("B-28", "B-30", "B-34")
def test_what_does_not_fit_is_named_and_dropped(ros) -> None:
    """On /diagnostics; no cloud comes of it."""
    bench = Bench(ros)
    bench.watch()
    said = ros.hear(DiagnosticArray, "/diagnostics")
    for pixels, encoding, frame, text in (
        (np.zeros((480, 640), np.uint8), "mono8", FRAME, "16UC1"),
        (np.zeros((240, 320), np.uint16), "16UC1", FRAME, "320x240"),
        (np.zeros((480, 640), np.uint16), "16UC1", "overhead_link", "expected the optical frame"),
    ):

        def heard(text: str = text) -> bool:
            return any(text in s.message and s.level == b"\x02" for m in said for s in m.status)

        bench.pump(pixels, encoding, heard, f"diagnostics with {text!r}", frame=frame)
    assert bench.clouds == []


def test_an_unknown_camera_is_named(ros) -> None:
    """With those that there are."""
    refused("'rear' is unknown or has no depth; cameras: overhead, wrist", ros.start, CloudNode, cameras=["rear"])
