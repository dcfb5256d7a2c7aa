# SPDX-License-Identifier: Apache-2.0
"""What the grasp node hears of finger pads."""

from __future__ import annotations

import pytest
from geometry_msgs.msg import WrenchStamped

from openarm_common.config import Config
from openarm_common.ros.node import QOS_SENSOR, BaseNode
from openarm_grasp.ros.pad_listener import Pads


@pytest.mark.requirement("A-69")
def test_both_pads_of_a_hand_are_heard_while_listening_and_a_silent_one_says_nothing(ros) -> None:
    pads = Pads(ros.add(BaseNode("listener", Config)))
    topics = [f"/openarm_right_{finger}_finger/contact_wrench" for finger in ("left", "right")]
    left, right = (ros.node.create_publisher(WrenchStamped, topic, QOS_SENSOR) for topic in topics)
    assert all(ros.node.count_subscribers(topic) == 0 for topic in topics)
    pads.enable(True)
    message = WrenchStamped()
    message.wrench.force.x, message.wrench.force.y = 3.0, -4.0

    def heard(*publishers) -> bool:
        for publisher in publishers:
            publisher.publish(message)
        return bool(pads.of("right"))

    ros.spin_until(lambda: left.get_subscription_count() and right.get_subscription_count(), what="discovery")
    ros.spin_until(lambda: heard(left, right), what="both pads")
    assert pads.of("right") == pytest.approx((5.0, 5.0))
    assert pads.of("left") == ()
    ros.spin_until(lambda: not heard(left), what="the right pad's silence")
    pads.enable(False)
    ros.spin_until(lambda: ros.node.count_subscribers(topics[0]) == 0, what="the end of listening")
