# SPDX-License-Identifier: Apache-2.0
"""The page's side of the graph: it listens to what is wanted, shows what comes, and says what does not."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from action_msgs.srv import CancelGoal
from geometry_msgs.msg import Point, TransformStamped
from openarm_interfaces.msg import GraspStatus
from openarm_interfaces.srv import ConfirmPlan, ResetWorld
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from openarm_bringup.view.ros.page import GraphView
from openarm_bringup.view.server import Confirmation, Order, Reset
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.client import BackgroundNode
from openarm_common.ros.convert import info_from_intrinsics, matrix_to_transform
from openarm_common.ros.images import array_to_image
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_SENSOR, QOS_STATIC_TF


class Looking:
    """A view of the graph of a test, and the newest that it has seen of each key."""

    def __init__(self, ros, timeout: float = 0.3) -> None:
        self.ros = ros
        self.seen: dict[str, Any] = {}
        self.ended: list[BaseException] = []
        self.view = GraphView(self._take, self.ended.append, timeout=timeout)

    def _take(self, item) -> None:
        self.seen[item.key] = item.payload

    def wait(self, key: str, fits: Callable[[Any], object] = bool, seconds: float = 30.0) -> Any:
        """The newest payload of a key, once it fits."""
        self.ros.spin_until(lambda: self.ended or (key in self.seen and fits(self.seen[key])), seconds, key)
        assert not self.ended, self.ended
        return self.seen[key]


@pytest.fixture
def looking(ros):
    made = Looking(ros)
    with made.view:
        yield made


@pytest.fixture
def patient(ros):
    """A view that gives servers time to be discovered."""
    made = Looking(ros, timeout=30.0)
    with made.view:
        yield made


def serve(ros) -> None:
    """Offer what the page asks for."""

    def answered(_: Any, response: Any) -> Any:
        response.success, response.message = True, "heard"
        return response

    ros.node.create_service(ResetWorld, "/sim/reset_world", answered)
    for name in ("/stop", "~/reset"):
        ros.node.create_service(Trigger, name, answered)
    ros.node.create_service(CancelGoal, "/grasp/pick/_action/cancel_goal", lambda _, response: response)


def begin(question: Callable[[], Any]) -> list[Any]:
    """Ask in a thread; the returned list gets the answer, or the error in its place."""
    ended: list[Any] = []

    def run() -> None:
        try:
            ended.append(question())
        except OpenArmError as error:
            ended.append(error)

    threading.Thread(target=run, daemon=True).start()
    return ended


def ask(ros, question: Callable[[], Any]) -> Any:
    """The answer to a question, or the error in its place."""
    ended = begin(question)
    ros.spin_until(lambda: ended, what="an answer")
    return ended[0]


def test_a_cloud_is_made_of_depth_and_colour_of_one_stamp(ros, looking: Looking) -> None:
    frame = "overhead_color_optical_frame"
    intrinsics = Intrinsics.from_fovy(64, 48, 60.0)
    outs = {
        name: ros.node.create_publisher(kind, f"/overhead/{name}", QOS_SENSOR)
        for name, kind in (("color/image_raw", Image), ("depth/image_raw", Image), ("depth/camera_info", CameraInfo))
    }
    tf = ros.node.create_publisher(TFMessage, "/tf_static", QOS_STATIC_TF)
    down = np.array([[0.0, -1, 0, 0.4], [-1, 0, 0, 0], [0, 0, -1, 1.2], [0, 0, 0, 1]])
    edge: TransformStamped = matrix_to_transform("openarm_body_link0", frame, down, 0)
    tf.publish(TFMessage(transforms=[edge]))
    color = np.zeros((48, 64, 3), np.uint8)
    color[..., 2] = 255
    t_ns, lag = 0, 1

    def publish() -> None:
        nonlocal t_ns
        t_ns += 100_000_000
        outs["color/image_raw"].publish(array_to_image(color, "rgb8", frame, t_ns - lag))
        outs["depth/image_raw"].publish(array_to_image(np.full((48, 64), 800, np.uint16), "16UC1", frame, t_ns))
        outs["depth/camera_info"].publish(info_from_intrinsics(intrinsics, frame, t_ns))

    ros.node.create_timer(0.1, publish)
    looking.view.want(frozenset({"cloud"}))
    ros.spin_until(lambda: outs["depth/image_raw"].get_subscription_count(), what="the page listens")
    begun = t_ns
    ros.spin_until(lambda: t_ns > begun + 800_000_000, what="frames whose halves do not fit")
    assert "cloud" not in looking.seen
    lag = 0
    data = looking.wait("cloud")
    length = int.from_bytes(data[:4], "little")
    count = json.loads(data[4 : 4 + length])["count"]
    body = data[4 + length :]
    points = np.frombuffer(body[: 12 * count], np.float32).reshape(-1, 3)
    colors = np.frombuffer(body[12 * count :], np.uint8).reshape(-1, 3)
    np.testing.assert_allclose(points[:, 2], 0.4, atol=1e-3)  # the table
    assert abs(points[:, :2].mean(axis=0) - (0.4, 0.0)).max() < 0.05
    assert len(colors) == count > 100
    assert (colors == (0, 0, 255)).all()

    looking.view.want(frozenset())
    ros.spin_until(lambda: not outs["depth/image_raw"].get_subscription_count(), what="the page looks away")


def test_what_hangs_on_a_link_and_the_way_of_a_plan_are_shown(ros, looking: Looking) -> None:
    held = Marker(type=Marker.CUBE, action=Marker.ADD, ns="red")
    held.header.frame_id = "openarm_left_hand_tcp"
    held.scale.x = held.scale.y = held.scale.z = 0.05
    held.pose.orientation.w = 1.0
    ros.node.create_publisher(MarkerArray, "/motion/attached_objects", QOS_LATCHED).publish(MarkerArray(markers=[held]))
    way = Marker(type=Marker.LINE_STRIP, points=[Point(x=0.1), Point(x=0.2)])
    ros.node.create_publisher(MarkerArray, "/motion/preview", QOS_LATCHED).publish(MarkerArray(markers=[way]))
    joints = ros.node.create_publisher(JointState, "/joint_states", QOS_COMMAND)
    looking.view.want(frozenset({"robot", "plan"}))
    shown = json.loads(looking.wait("held"))["boxes"][0]
    assert (shown["label"], shown["link"], shown["size"]) == ("red", "openarm_left_hand_tcp", [0.05, 0.05, 0.05])
    ros.spin_until(joints.get_subscription_count, what="the page listens")
    looking.wait("fault:robot", lambda text: "nothing on /joint_states" in text)
    message = JointState(name=["openarm_left_joint1"], position=[0.3])
    ros.node.create_timer(0.05, lambda: joints.publish(message))
    looking.wait("robot")
    looking.wait("fault:robot", lambda text: json.loads(text)["text"] == "")


@pytest.mark.requirement("P-20", "R-25")
def test_the_plan_that_waits_is_shown_in_place_of_newer_ones_and_answered(ros, looking: Looking) -> None:
    def way(ns: str, x: float) -> MarkerArray:
        line = Marker(ns=ns, type=Marker.LINE_STRIP, points=[Point(x=x), Point(x=x + 0.1)])
        return MarkerArray(markers=[Marker(action=Marker.DELETEALL), line])

    answers: list[tuple[str, bool]] = []

    def answer(request: ConfirmPlan.Request, response: ConfirmPlan.Response) -> ConfirmPlan.Response:
        answers.append((request.plan_id, request.accept))
        response.success, response.message = request.accept, "heard"
        return response

    previews, grasps = (
        ros.node.create_publisher(MarkerArray, topic, QOS_LATCHED) for topic in ("/motion/preview", "/grasp/markers")
    )
    status = ros.node.create_publisher(GraspStatus, "/grasp/status", QOS_LATCHED)
    ros.node.create_service(ConfirmPlan, "/grasp/confirm", answer)
    status.publish(GraspStatus(state="PLAN", plan_id="4adc"))
    grasps.publish(way("plan/transfer", 0.5))
    previews.publish(way("right/way", 0.1))
    looking.view.want(frozenset({"plan", "states"}))
    assert json.loads(looking.wait("grasp"))["steps"][-1]["plan_id"] == "4adc"
    looking.wait("plan", lambda text: json.loads(text)["ways"] == [[[0.5, 0, 0], [0.6, 0, 0]]])
    previews.publish(way("right/way", 0.2))
    grasps.publish(way("plan/transfer", 0.7))
    looking.wait("plan", lambda text: json.loads(text)["ways"][0][0][0] == 0.7)
    grasps.publish(way("approach", 0.0))  # none waits any more
    ros.node.create_timer(0.1, lambda: previews.publish(way("right/way", 0.3)))
    looking.wait("plan", lambda text: json.loads(text)["ways"][0][0][0] == 0.3)
    replies: list[tuple[bool, str]] = []
    thread = threading.Thread(
        target=lambda: replies.extend(
            looking.view.confirm(Confirmation(plan_id="4adc", accept=accept)) for accept in (True, False)
        )
    )
    thread.start()
    ros.spin_until(lambda: not thread.is_alive(), what="the answers")
    assert (replies, answers) == ([(True, "heard"), (False, "heard")], [("4adc", True), ("4adc", False)])


def test_a_message_that_can_t_be_shown_is_said_and_the_rest_goes_on(ros, looking: Looking) -> None:
    images = ros.node.create_publisher(Image, "/overhead/color/image_raw", QOS_SENSOR)
    bad = Image(encoding="bayer", width=2, height=2, step=2, data=[0] * 4)
    ros.node.create_timer(0.05, lambda: images.publish(bad))
    looking.view.want(frozenset({"image:overhead", "states"}))
    looking.wait("fault:image:overhead", lambda text: "'bayer' is not supported" in text)
    looking.wait("health")


@pytest.mark.long
def test_without_a_graph_every_question_has_an_answer(looking: Looking) -> None:
    view = looking.view
    for ask in (lambda: view.pick(Order(label="red")), view.cancel, lambda: view.reset(Reset())):
        with pytest.raises(OpenArmError, match="is the graph up") as refused:
            ask()
        assert refused.value.code is Code.NOT_READY


def test_no_request_ends_the_client(ros, looking: Looking) -> None:
    """A value that no message can hold is refused; the same client then still resets, stops and cancels."""
    serve(ros)
    view = looking.view
    refused = ask(ros, lambda: view.reset(Reset.model_construct(scene="", seed=2**63)))
    assert isinstance(refused, OpenArmError)
    assert refused.code is Code.INVALID_ARGUMENT, refused
    assert (
        "/sim/reset_world can't be asked that: seed is 9223372036854775808; expected a whole number" in refused.message
    )
    assert ask(ros, lambda: view.reset(Reset(seed=3))) == (True, "heard")
    assert ask(ros, view.stop) == (True, "heard")
    assert ask(ros, view.release) == (True, "heard")
    assert ask(ros, view.cancel) == (False, "no grasp runs that was asked for by /grasp/pick")
    assert ask(ros, lambda: view.pick(Order())).code is Code.NOT_READY


def test_what_fails_in_the_thread_of_the_client_is_said_and_does_not_end_it(ros, patient: Looking, capfd) -> None:
    def fail() -> None:
        raise RuntimeError("a fault of the test")

    serve(ros)
    said = ""

    def is_said() -> bool:
        nonlocal said
        said += capfd.readouterr().err
        return "RuntimeError('a fault of the test')" in said

    client = patient.view._ask
    client._executor.create_task(fail)
    ros.spin_until(is_said, what="a line of the log")
    assert "what arrived could not be handled, the rest goes on: RuntimeError" in said
    assert ask(ros, lambda: patient.view.reset(Reset(seed=3))) == (True, "heard")
    assert client._thread.is_alive()


def test_stop_and_cancel_are_answered_while_another_request_is_stuck(ros, patient: Looking) -> None:
    serve(ros)
    view, stuck, go_on = patient.view, threading.Event(), threading.Event()
    cancelled = (False, "no grasp runs that was asked for by /grasp/pick")
    assert ask(ros, view.stop) == (True, "heard")  # the servers are discovered
    assert ask(ros, view.cancel) == cancelled

    def stick() -> None:
        stuck.set()
        go_on.wait(60.0)

    view._ask._executor.create_task(stick)
    try:
        ros.spin_until(stuck.is_set, what="a client that is stuck")
        reset = begin(lambda: view.reset(Reset(seed=3)))
        for question, answer in ((view.stop, (True, "heard")), (view.cancel, cancelled)):
            assert ask(ros, question) == answer
        assert not reset, "the other client was not stuck"
    finally:
        go_on.set()
    ros.spin_until(lambda: reset, what="an answer")
    assert reset == [(True, "heard")]


def test_a_layer_that_can_t_be_made_ends_the_view_with_its_error(ros, looking: Looking, monkeypatch) -> None:
    def fail(_: object) -> None:
        raise RuntimeError("a fault of the test")

    monkeypatch.setitem(looking.view._makers, "robot", fail)
    looking.view.want(frozenset({"robot"}))
    ros.spin_until(lambda: looking.ended, what="the end of the view")
    assert [repr(error) for error in looking.ended] == ["RuntimeError('a fault of the test')"]


@pytest.mark.parametrize(
    ("end", "why"),
    [
        (lambda client: client.close(), "it was closed"),
        (lambda client: client._context.try_shutdown(), "its context was shut down"),
        (lambda client: client._executor.create_task(sys.exit, 3), "SystemExit(3)"),
    ],
)
def test_a_request_whose_client_ends_says_why(ros, end: Callable[[BackgroundNode], object], why: str) -> None:
    asked: list[Trigger.Request] = []
    never = Future()

    async def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        asked.append(request)
        await never
        return response

    ros.node.create_service(Trigger, "/slow", answer)
    with BackgroundNode("client") as client:
        ended = begin(lambda: client.call(Trigger, "/slow", Trigger.Request()))
        ros.spin_until(lambda: asked, what="the request")
        end(client)
        ros.spin_until(lambda: ended, what="the end of the request")
    assert (ended[0].code, ended[0].message) == (Code.NOT_READY, f"the client ended while waiting for /slow: {why}")
