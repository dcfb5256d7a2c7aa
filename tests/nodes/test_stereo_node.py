# SPDX-License-Identifier: Apache-2.0
"""Node `stereo_depth`: pairs of images to depth images that other nodes take."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from openarm_common.camera.cameras import load_cameras
from openarm_common.errors import OpenArmError
from openarm_common.robot.folder import ROBOT
from openarm_common.ros.convert import info_from_intrinsics, points_from_cloud, stamp_to_ns
from openarm_common.ros.images import array_to_image, depth_image, lens_from_info
from openarm_common.ros.node import QOS_SENSOR
from openarm_perception.ros.cloud_node import CloudNode
from openarm_perception.ros.stereo_node import StereoNode

#: Disparity of the wall that is seen, pixels.
SHIFT = 40


@pytest.fixture(autouse=True)
def cell(monkeypatch: pytest.MonkeyPatch) -> None:
    """The robot with a stereo head."""
    monkeypatch.setenv(ROBOT, "openarm_v2_cell")


class Bench:
    """Both cameras of a pair before a textured wall, the node, and what it says."""

    def __init__(self, ros, **params) -> None:
        self.ros = ros
        self.left, self.right = load_cameras()["head_left"], load_cameras()["head_right"]
        self.depth_of_wall = self.left.intrinsics.fx * self.right.baseline / SHIFT
        rng = np.random.default_rng(1)
        size = (self.left.width + SHIFT, self.left.height)
        wall = cv2.resize(rng.integers(0, 255, (160, 300), dtype=np.uint8), size, interpolation=cv2.INTER_CUBIC)
        self.images = {c.name: np.repeat(w[..., None], 3, axis=2) for c, w in self._views(wall)}
        make = ros.node.create_publisher
        self.publishers = {
            camera.name: (
                make(Image, f"/{camera.name}/color/image_raw", QOS_SENSOR),
                make(CameraInfo, f"/{camera.name}/color/camera_info", QOS_SENSOR),
            )
            for camera in (self.left, self.right)
        }
        self.node = ros.start(StereoNode, **params)
        self.t_ns = 0
        self.baseline = self.right.baseline
        self.reports: list[str] = []
        ros.node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 10)

    def _views(self, wall):
        return (self.left, wall[:, :-SHIFT]), (self.right, wall[:, SHIFT:])

    def _hear(self, message) -> None:
        self.reports += [s.message for s in message.status if s.name.startswith("stereo_depth")]

    def pump(self, condition, what: str, apart_ns: int = 0) -> None:
        """Publish a pair each quarter of a second until `condition` holds."""

        def send() -> None:
            self.t_ns += 250_000_000
            for camera in (self.left, self.right):
                t_ns = self.t_ns + (apart_ns if camera is self.right else 0)
                image, info = self.publishers[camera.name]
                baseline = self.baseline if camera is self.right else 0.0
                info.publish(info_from_intrinsics(camera.intrinsics, camera.optical_frame, t_ns, baseline))
                image.publish(array_to_image(self.images[camera.name], "rgb8", camera.optical_frame, t_ns))

        self.ros.send_until(send, 0.25, condition, what)


@pytest.mark.long
@pytest.mark.requirement("R-05")
def test_depth_of_a_pair_is_what_the_cloud_node_takes(ros) -> None:
    """Depth, CameraInfo and cloud at the stamp of the left image, in its frame; the margin it alone sees is invalid."""
    bench = Bench(ros)
    ros.start(CloudNode, cameras=["head_left"])
    depths = ros.hear(Image, "/head_left/depth/image_raw", QOS_SENSOR)
    infos = ros.hear(CameraInfo, "/head_left/depth/camera_info", QOS_SENSOR)
    clouds = ros.hear(PointCloud2, "/head_left/depth/points", QOS_SENSOR)
    bench.pump(lambda: depths and infos and clouds, "depth and a cloud")
    depth = depth_image(depths[0])
    assert (depths[0].encoding, depths[0].header.frame_id) == ("16UC1", bench.left.optical_frame)
    assert stamp_to_ns(depths[0].header.stamp) % 250_000_000 == 0
    k = lens_from_info(infos[0]).intrinsics
    own = bench.left.intrinsics
    assert (k.width, k.height, k.fx, k.cx) == pytest.approx((own.width, own.height, own.fx, own.cx))
    assert np.median(depth[:, SHIFT + 10 :]) == pytest.approx(1e3 * bench.depth_of_wall, abs=6.0)
    assert np.count_nonzero(depth[:, SHIFT + 10 :]) > 0.95 * depth[:, SHIFT + 10 :].size
    assert np.count_nonzero(depth[:, : SHIFT - 5]) < 0.2 * depth[:, : SHIFT - 5].size
    points = points_from_cloud(clouds[0])
    assert np.nanmedian(points[..., 2]) == pytest.approx(bench.depth_of_wall, abs=0.006)


@pytest.mark.long
@pytest.mark.requirement("R-05")
def test_a_pair_without_a_baseline_is_refused_with_the_reason_until_it_has_one(ros) -> None:
    bench = Bench(ros, encoding="32FC1", stamp_gap=0.01)
    depths = ros.hear(Image, "/head_left/depth/image_raw", QOS_SENSOR)
    bench.baseline = 0.0
    bench.pump(lambda: any("the baseline is" in text for text in bench.reports), "the reason", apart_ns=3_000_000)
    assert not depths
    bench.baseline = bench.right.baseline
    bench.pump(lambda: depths, "depth", apart_ns=3_000_000)
    assert np.nanmedian(depth_image(depths[0])) == pytest.approx(bench.depth_of_wall, abs=0.006)


def test_it_listens_only_while_its_depth_is_wanted(ros) -> None:
    bench = Bench(ros)
    image, _ = bench.publishers["head_left"]
    ros.spin_until(lambda: "idle: no subscribers" in bench.reports, what="a report")
    assert image.get_subscription_count() == 0
    wanted = ros.node.create_subscription(Image, "/head_left/depth/image_raw", lambda _: None, QOS_SENSOR)
    ros.spin_until(lambda: image.get_subscription_count() == 1, what="a subscription")
    ros.node.destroy_subscription(wanted)
    ros.spin_until(lambda: image.get_subscription_count() == 0, what="its end")


def test_a_camera_that_is_no_left_one_is_refused_with_those_that_are(ros) -> None:
    with pytest.raises(OpenArmError, match="left cameras: head_left"):
        ros.start(StereoNode, camera="ceiling")
