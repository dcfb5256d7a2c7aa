# SPDX-License-Identifier: Apache-2.0
"""The flight recorder: what a graph said until now, as a bag, when it is asked; and it listens where others do."""

from __future__ import annotations

from pathlib import Path

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from openarm_interfaces.srv import SaveRecording
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from openarm_bringup.bags.bag import open_bag
from openarm_bringup.bags.ros.flight_recorder import FlightRecorder
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED

pytestmark = pytest.mark.requirement("R-24")


@pytest.fixture
def start(ros, tmp_path: Path):
    def make(**parameters: object) -> FlightRecorder:
        given = {"folder": str(tmp_path), "topics": ["/chatter|/latched"], "on_demand": ["/costly"], **parameters}
        return ros.start(FlightRecorder, **given)

    return make


def save(ros, reason: str) -> SaveRecording.Response:
    client = ros.node.create_client(SaveRecording, "/flight_recorder/save")
    return ros.call(client, SaveRecording.Request(reason=reason))


def chat(ros, recorder: FlightRecorder, *texts: str) -> None:
    chatter = ros.node.create_publisher(String, "/chatter", QOS_COMMAND)
    ros.spin_until(
        lambda: any(r.topic_name == "/chatter" and r.get_publisher_count() for r in recorder._listener.readers)
    )
    ros.spin_until(chatter.get_subscription_count, what="the recorder listens")
    for text in texts:
        chatter.publish(String(data=text))
    chatter.wait_for_all_acked()


@pytest.mark.long
def test_what_was_said_is_saved_with_the_reason(ros, start, tmp_path: Path) -> None:
    recorder = start()
    refused = save(ros, "TOO_EARLY")
    assert (refused.success, refused.code, refused.path) == (False, "NOT_READY", "")
    latched = ros.node.create_publisher(String, "/latched", QOS_LATCHED)
    latched.publish(String(data="always"))
    chat(ros, recorder, "a", "b")
    ros.spin_until(lambda: len(recorder._listener.readers) == 2, what="it has found both topics")
    ros.spin_until(lambda: len(recorder._ring.moment().packed) == 3, what="it has heard all")
    answer = save(ros, "GRASP_LOST: it fell: twice\nrequest: red\nagain: openarm pick red --arm left")
    assert answer.success, answer.message
    path = Path(answer.path)
    assert path == tmp_path / "01_GRASP_LOST"
    ros.spin_until(path.exists, what="the recording is complete")
    with open_bag(path) as bag:
        said = [deserialize_message(record.data, String).data for record in bag.records(["/chatter"])]
        assert (said, bag.counts["/latched"]) == (["a", "b"], 1)
        assert bag.custom["reason"] == "GRASP_LOST: it fell: twice"
        assert bag.custom["again"] == "openarm pick red --arm left"
        assert bag.custom["openarm-vision"]
    assert Path(save(ros, "../../etc: not a code").path).name == "02_ASKED"


def test_costly_topics_are_kept_while_another_node_asks_for_them(ros, start) -> None:
    recorder = start()
    costly = ros.node.create_publisher(String, "/costly", QOS_COMMAND)
    chat(ros, recorder, "a")
    assert costly.get_subscription_count() == 0
    asking = ros.node.create_subscription(String, "/costly", lambda _: None, QOS_COMMAND)
    ros.spin_until(lambda: costly.get_subscription_count() == 2, what="it joins who asks")
    ros.node.destroy_subscription(asking)
    ros.spin_until(lambda: costly.get_subscription_count() == 0, what="and leaves with it")


@pytest.mark.requirement("P-31")
def test_a_recorder_at_rest_listens_to_nothing_and_still_saves_what_it_has(ros, start) -> None:
    recorder = start()
    chat(ros, recorder, "a")
    ros.spin_until(lambda: recorder._ring.moment().packed, what="it has heard it")
    change = ros.node.create_client(ChangeState, "/flight_recorder/change_state")

    def go(label: str) -> bool:
        return ros.call(change, ChangeState.Request(transition=Transition(label=label))).success

    assert go("deactivate")
    ros.spin_until(lambda: not ros.node.count_subscribers("/chatter"), what="it has left")
    assert save(ros, "AT_REST").success
    assert go("activate")
    chat(ros, recorder, "b")
    ros.spin_until(lambda: len(recorder._ring.moment().packed) == 2, what="it goes on")
    assert go("deactivate")
    assert go("cleanup")
    assert save(ros, "EMPTY").code == "NOT_READY"


def test_a_folder_that_cannot_be_made_is_said_once_and_the_recorder_goes_on(ros, start, tmp_path: Path, capfd) -> None:
    (tmp_path / "file").write_text("")
    recorder = start(folder=str(tmp_path / "file" / "recordings"))
    chat(ros, recorder, "a")
    ros.spin_until(lambda: recorder._ring.moment().packed, what="it has heard it")
    for _ in range(2):
        answer = save(ros, "NO_PLAN")
        assert (answer.success, answer.code, answer.path) == (False, "ENVIRONMENT", "")
        assert "recordings" in answer.message
    assert capfd.readouterr().err.count("nothing is recorded") == 1
