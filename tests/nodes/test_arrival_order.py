# SPDX-License-Identifier: Apache-2.0
"""The same frame and joint states, the arm moving, in the two orders they can arrive in: the same cloud, the same map.

That of the detector is in `test_detect_node`.
"""

from __future__ import annotations

import pytest
from sensor_msgs.msg import JointState, PointCloud2
from std_srvs.srv import Empty

from openarm_common.ros.convert import ns_to_stamp, stamp_to_ns
from openarm_common.ros.images import array_to_image
from openarm_common.ros.node import QOS_SENSOR
from openarm_perception.ros.cloud_node import CloudNode
from tests.nodes.octomap_bench import FRAME, JOINTS, ROBOT, Bench, sheet

MS = 1_000_000
#: The left arm moves by so much, rad, from 3 ms before the stamp of the image to 12 ms after it, at so many rad/s.
SWEEP = 0.5
SPEED = SWEEP / 0.015


class Arm(Bench):
    """Looks at a sheet at the height of the left tool, from which map and cloud cut the robot."""

    def __init__(self, ros, tmp_path) -> None:
        super().__init__(ros, tmp_path, transform_wait=5.0)
        params = {"cameras": ["overhead"], "self_filter.enabled": True, "transform_wait": 5.0}
        self.cloud_node = ros.start(CloudNode, **params)
        self.clouds: list[PointCloud2] = ros.hear(PointCloud2, "/overhead/depth/points", QOS_SENSOR)
        ros.spin_until(lambda: self.joints.get_subscription_count() == 2, what="both listen to the joints")
        tool = ROBOT.link_pose("openarm_left_hand_tcp", dict.fromkeys(JOINTS, 0.0))
        self.image = sheet(tool[2, 3])

    def state_at(self, offset_ms: int, q: float) -> None:
        """A joint state next to the stamp of the image."""
        position = [q if name == "openarm_left_joint1" else 0.0 for name in JOINTS]
        velocity = [SPEED if name == "openarm_left_joint1" else 0.0 for name in JOINTS]
        state = JointState(name=list(JOINTS), position=position, velocity=velocity)
        state.header.stamp = ns_to_stamp(self.t_ns + offset_ms * MS)
        self.joints.publish(state)

    def show_until(self, condition, what: str) -> None:
        """Publish the image, and again every half second, until `condition` holds."""

        def send() -> None:
            self.send(array_to_image(self.image, "16UC1", FRAME, self.t_ns), joints=False)

        self.ros.send_until(send, 0.5, condition, what)

    def made(self) -> bool:
        """Whether there are a cloud and a map of the image."""
        cloud = any(stamp_to_ns(cloud.header.stamp) == self.t_ns for cloud in self.clouds)
        return cloud and any(stamp_to_ns(m.header.stamp) == self.t_ns and len(m.data) for m in self.maps)

    def results(self) -> tuple[bytes, bytes]:
        """Points and octree of the image; both are then forgotten."""
        points, tree = bytes(self.clouds[-1].data), bytes(self.maps[-1].data)
        self.ros.spin_until(lambda: self.node.idle, what="no update runs")
        self.call(Empty, "/octomap/reset")
        self.ros.spin_until(lambda: not len(self.maps[-1].data), what="the map is empty")
        return points, tree


@pytest.mark.requirement("B-61")
def test_clouds_and_maps_do_not_depend_on_what_arrives_first(ros, tmp_path) -> None:
    bench = Arm(ros, tmp_path)

    bench.state_at(-3, 0.0)
    bench.state_at(12, SWEEP)
    bench.joints.wait_for_all_acked()
    bench.show_until(bench.made, "cloud and map, the joint states first")
    early = bench.results()

    bench.t_ns += 1_000 * MS
    bench.state_at(-3, 0.0)
    bench.show_until(
        lambda: bench.cloud_node.waiting_ns("overhead") == bench.t_ns and not bench.node.idle, "both have the frame"
    )
    bench.state_at(12, SWEEP)
    ros.spin_until(bench.made, what="cloud and map, the frame first")
    late = bench.results()

    bench.t_ns += 1_000 * MS
    bench.state_at(0, 0.0)
    bench.show_until(bench.made, "cloud and map, the arm as it was 3 ms before")
    elsewhere = bench.results()

    assert early == late
    assert all(a != b for a, b in zip(early, elsewhere, strict=True)), "the sweep must show"
