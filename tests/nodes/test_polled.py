# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that are polled by a thread of their node, and left alone by its executor."""

from __future__ import annotations

import time

import pytest
from std_msgs.msg import String

from openarm_common.ros.node import QOS_COMMAND
from openarm_common.ros.polled import Polled, Source


@pytest.mark.long
def test_messages_are_taken_when_asked_for_with_the_time_of_their_arrival(ros) -> None:
    polled = Polled(ros.node, Source(String, "/polled", QOS_COMMAND, silence=0.2))
    publisher = ros.node.create_publisher(String, "/polled", QOS_COMMAND)
    ros.spin_until(lambda: publisher.get_subscription_count() == 1)
    sent: list[float] = []
    for text in ("first", "second"):
        sent.append(time.monotonic())
        publisher.publish(String(data=text))
        ros.spin_until(lambda: time.monotonic() > sent[-1] + 0.5)  # the executor takes none meanwhile

    assert "nothing on /polled for" in polled.fault
    taken, taken_at = polled.take_timed(), time.monotonic()

    assert [message.data for message, _ in taken] == ["first", "second"]
    first, second = (at for _, at in taken)
    assert first < sent[1] - 0.1 < second < taken_at - 0.1
    assert polled.fault == ""
    assert polled.newest() is None
    polled.close()
