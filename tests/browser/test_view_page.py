# SPDX-License-Identifier: Apache-2.0
"""The page of `openarm view` in a real browser, against a graph of stand-ins; screenshots go to $OPENARM_SHOTS."""

from __future__ import annotations

import array
import asyncio
import os
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from openarm_bringup.view.gate import listening
from openarm_common.domain import release_domain, reserve_domain
from openarm_common.robot.description import RobotDescription

SIDES = RobotDescription.load().arm_names

#: A label that would be run if it were ever taken for markup.
NASTY = "<img src=x onerror='document.title=1'>"


#: JavaScript: what sticks out of the window to the right.
_TOO_WIDE = """[...document.querySelectorAll("body *")]
  .filter((one) => one.getBoundingClientRect().right > innerWidth + 1)
  .map((one) => one.tagName + "#" + one.id + "." + one.className)"""


class StandIns:
    """Publishes what a graph would and notes what is asked; spins in a thread until it is closed."""

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
        from octomap_msgs.msg import Octomap
        from openarm_interfaces.action import Pick
        from openarm_interfaces.msg import GraspStatus
        from openarm_interfaces.srv import ConfirmPlan, ResetWorld
        from rclpy.action import ActionServer, CancelResponse
        from rclpy.callback_groups import ReentrantCallbackGroup
        from rclpy.context import Context
        from rclpy.executors import MultiThreadedExecutor
        from sensor_msgs.msg import Image, JointState
        from std_srvs.srv import Trigger
        from vision_msgs.msg import Detection3DArray
        from visualization_msgs.msg import MarkerArray

        from openarm_common.octree.codec import encode_states
        from openarm_common.octree.lattice import Lattice
        from openarm_common.robot.description import RobotDescription
        from openarm_common.ros.images import array_to_image
        from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_SENSOR

        self.picks: list[Any] = []
        self.resets: list[Any] = []
        self.stops = 0
        self.answers: list[tuple[str, bool]] = []
        self._context = Context()
        rclpy.init(context=self._context, domain_id=int(os.environ["ROS_DOMAIN_ID"]))
        self._node = node = rclpy.create_node("stand_ins", context=self._context)
        self._executor = MultiThreadedExecutor(2, context=self._context)
        self._executor.add_node(node)
        publisher = node.create_publisher
        self._status = publisher(GraspStatus, "/grasp/status", QOS_LATCHED)
        self._step = GraspStatus
        self.say("IDLE", "waiting for a request")

        description = RobotDescription.load()
        q = {n: p for s in SIDES for n, p in description.group_state(f"{s}_arm", "home").items()}
        q |= {description.finger_joint(side): 0.02 for side in SIDES}
        joints = JointState(name=list(q), position=list(q.values()))
        picture = np.zeros((48, 64, 3), np.uint8)
        picture[:, :, 0] = 200
        image = array_to_image(picture, "rgb8", "overhead_color_optical_frame", 0)
        node_status = DiagnosticStatus(name="detector: status", message="no camera", level=DiagnosticStatus.ERROR)
        diagnostics = DiagnosticArray(status=[node_status])
        states = np.zeros((4, 4, 4), np.uint8)
        states[1:3, 1:3, :2] = 2
        payload = encode_states(Lattice.from_bounds(0.1, (0.2, -0.2, 0.0), (0.6, 0.2, 0.4)), states)
        octree = Octomap(binary=True, id="OcTree", resolution=0.1)
        octree.data = array.array("b", payload.data.tobytes())
        sent = [
            (publisher(JointState, "/joint_states", QOS_COMMAND), joints),
            (publisher(Image, "/overhead/color/image_raw", QOS_SENSOR), image),
            (publisher(Detection3DArray, "/detections_3d", QOS_COMMAND), _detections("blue", NASTY)),
            (publisher(DiagnosticArray, "/diagnostics", QOS_COMMAND), diagnostics),
            (publisher(Octomap, "/octomap_binary", QOS_LATCHED), octree),
            (publisher(MarkerArray, "/motion/preview", QOS_LATCHED), _plan()),
            (publisher(MarkerArray, "/motion/attached_objects", QOS_LATCHED), _held("openarm_body_link0")),
        ]
        self.image = sent[1][0]
        self.detections = sent[2][1]
        node.create_timer(0.1, lambda: [out.publish(message) for out, message in sent])
        group = ReentrantCallbackGroup()
        node.create_service(ConfirmPlan, "/grasp/confirm", self._confirm)
        node.create_service(ResetWorld, "/sim/reset_world", self._reset)
        node.create_service(Trigger, "/stop", self._stop)
        self._action = ActionServer(
            *(node, Pick, "/grasp/pick", self._pick),
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=group,
        )
        self._result = Pick.Result
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def say(
        self, state: str, reason: str, attempt: int = 0, *, label: str = "blue", arm: str = "left", plan_id: str = ""
    ) -> None:
        step = self._step(state=state, reason=reason, attempt=attempt, label=label, arm=arm, plan_id=plan_id)
        self._status.publish(step)

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join(5.0)
        self._node.destroy_node()
        self._context.try_shutdown()

    def _reset(self, request: Any, response: Any) -> Any:
        self.resets.append(request)
        response.success, response.message = True, "the world is as it was"
        return response

    def _stop(self, _: Any, response: Any) -> Any:
        self.stops += 1
        response.success, response.message = True, "the arms hold"
        return response

    def _confirm(self, request: Any, response: Any) -> Any:
        self.answers.append((request.plan_id, request.accept))
        response.success, response.message = request.accept, "" if request.accept else "no plan waits"
        return response

    def _pick(self, goal: Any) -> Any:
        self.picks.append(goal.request)
        self.say("LIFT", "the object is in the hand", 1)
        give_up = time.monotonic() + 20.0
        while not goal.is_cancel_requested and time.monotonic() < give_up:
            threading.Event().wait(0.02)
        goal.canceled()
        return self._result(success=False, code="CANCELLED", message="cancelled while lifting")


def _detections(*labels: str) -> Any:
    from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesis, ObjectHypothesisWithPose

    message = Detection3DArray()
    for i, label in enumerate(labels):
        one = Detection3D(results=[ObjectHypothesisWithPose(hypothesis=ObjectHypothesis(class_id=label, score=0.9))])
        one.bbox.center.position.x, one.bbox.center.position.y = 0.3, 0.2 * i
        one.bbox.center.position.z, one.bbox.center.orientation.w = 0.45, 1.0
        one.bbox.size.x = one.bbox.size.y = one.bbox.size.z = 0.06
        message.detections.append(one)
    return message


def _plan() -> Any:
    """Return forty lines through the picture: a line is a pixel wide."""
    from geometry_msgs.msg import Point
    from visualization_msgs.msg import Marker, MarkerArray

    ends = [Point(x=0.6, y=y, z=0.1 + 0.02 * i) for i in range(20) for y in (-0.5, 0.5)]
    return MarkerArray(markers=[Marker(type=Marker.LINE_STRIP, points=ends)])


def _held(link: str) -> Any:
    from visualization_msgs.msg import Marker, MarkerArray

    box = Marker(ns="held", type=Marker.CUBE)
    box.header.frame_id = link
    box.pose.position.x, box.pose.position.y, box.pose.position.z = 0.2, 0.6, 0.3
    box.pose.orientation.w = 1.0
    box.scale.x = box.scale.y = box.scale.z = 0.3
    return MarkerArray(markers=[box])


@pytest.fixture
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> Iterator[StandIns]:
    domain = reserve_domain()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    made = StandIns()
    yield made
    made.close()
    release_domain(domain)


def with_page(open_tab: Any, test: Callable[[Any], Awaitable[None]]) -> None:
    """Serve the page as the command does, open it in the browser, and run a test on it."""
    from openarm_bringup.commands.view import make_server

    async def main() -> None:
        ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        with make_server("127.0.0.1", ended.set_exception) as server:
            async with listening(server.app(), "127.0.0.1", 0, 0.2) as port:
                url = f"http://127.0.0.1:{port}/#{server.guard.token}"
                async with asyncio.timeout(120.0), open_tab(url) as tab:
                    await test(tab)
            assert not ended.done(), ended.exception()

    asyncio.run(main())


async def seen(tab: Any, count: Callable[[Any], int], least: int) -> None:
    """Wait until so many pixels of the scene (h, w, BGR) are counted."""
    give_up = time.monotonic() + 20.0
    while (n := int(count((await tab.image("#scene")).astype(int)))) < least:
        assert time.monotonic() < give_up, f"{n} pixels, expected {least}; complaints: {tab.complaints}"
        await asyncio.sleep(0.1)


async def shoot(tab: Any, name: str) -> None:
    """Keep a picture where one was asked for: for review by eye."""
    folder = os.environ.get("OPENARM_SHOTS")
    if folder:
        await tab.picture(Path(folder) / f"{name}.png")


def test_the_page_shows_the_graph_and_asks_it(stand_ins: StandIns, open_tab: Any) -> None:
    """One browser, one walk: it is what costs the time."""

    async def walk(tab: Any) -> None:
        await tab.until("document.querySelector('#link').dataset.level === 'ok'")
        assert await tab.js("location.pathname + location.search + location.hash") == "/", "the token is not shown"
        await tab.do("Page.reload")
        await tab.until("document.querySelector('#link')?.dataset.level === 'ok'")

        # the state of the grasp, nodes, detections: as text
        await tab.until("document.querySelector('#state').textContent === 'Idle'")
        assert await tab.js("document.querySelector('#track').children.length") == 10
        await tab.until("document.querySelector('#nodes li[data-level=error] em')?.textContent === 'no camera'")
        await tab.until("document.querySelectorAll('#choices button').length === 2")
        assert NASTY in await tab.js("[...document.querySelectorAll('#labels span')].map(one => one.textContent)")
        assert await tab.js("document.querySelectorAll('#labels img, #choices img').length") == 0
        assert await tab.js("document.title") == "OpenArm"

        # a camera's picture, and no cloud without depth
        await tab.until("document.querySelector('[data-camera=overhead] img').naturalWidth === 64")
        await tab.until("document.querySelector('#fault-cloud')?.textContent.includes('/overhead/depth/image_raw')")

        # the robot, much of which is black; the plan, orange lines; a held box, of glass; then the map, blue below
        await seen(tab, lambda image: (image.max(axis=2) < 75).sum(), 4000)
        await seen(tab, lambda image: ((image[..., 2] > image[..., 0] + 100) & (image[..., 1] > 80)).sum(), 1500)
        await seen(tab, lambda image: (image[..., 0] > image[..., 2] + 30).sum(), 15000)
        await tab.click("#layers button:nth-child(4)")
        await tab.click("#layers button:nth-child(3)")
        await seen(tab, lambda image: ((image[..., 0] > image[..., 2] + 40) & (image[..., 2] < 120)).sum(), 12000)
        await shoot(tab, "light")

        # the view: a drag turns it, a wheel comes closer, a double click is the start again
        label = "document.querySelector('#labels button').style.transform"
        start = await tab.js(label)
        for steer in (
            lambda: tab.drag("#scene", 120, 40),
            lambda: tab.do("Input.dispatchMouseEvent", type="mouseWheel", x=600, y=650, deltaX=0, deltaY=-200),
        ):
            await steer()
            await tab.until(f"{label} !== {start!r}")
            await tab.click("#scene", count=2)
            await tab.until(f"{label} === {start!r}")

        await tab.size(900, 700, dark=True)
        await tab.until("document.querySelector('#scene').width < 700")
        await shoot(tab, "dark")
        assert await tab.js(_TOO_WIDE) == []
        await tab.size(1440, 900)

        # pick: as the mouse does it
        await tab.click("#choices button[aria-checked='false']")
        await tab.until("document.querySelector('#pick').textContent === 'Pick blue'")
        await tab.click("#arms label:nth-of-type(2)")
        await tab.click(".switch")
        await tab.click(".switch:nth-of-type(2)")
        await tab.click("#pick")
        await tab.until("document.querySelector('#state').textContent === 'Lift'")
        assert await tab.js("document.querySelector('#pick').disabled")
        assert await tab.js("document.querySelector('#facts').textContent") == "blue · left arm · attempt 1"
        await tab.click("#cancel")
        await tab.until("document.querySelector('#outcome').textContent.startsWith('CANCELLED: cancelled while')")

        # the emergency stop, by key and by button
        await tab.js(
            "document.dispatchEvent(new KeyboardEvent('keydown', { key: 'Escape', shiftKey: true, bubbles: true }))"
        )
        await tab.until("document.querySelector('#stop-answer').textContent.includes('the arms hold')")
        await tab.click("#stop")
        await tab.until("!document.querySelector('#stopped').hidden")
        await tab.click("#shuffle")
        await tab.until("document.querySelector('#world-answer').textContent === 'the world is as it was'")

        # a plan that waits is confirmed or rejected; it needs no other request
        await tab.until("document.querySelector('#confirm').hidden")
        for button in ("run", "reject"):
            stand_ins.say("PLAN", f"grasp blue; plan '{button}' waits", 1, plan_id=button)
            await tab.until(f"document.querySelector('#reason').textContent.includes({button!r})")
            await shoot(tab, f"confirm_{button}")
            await tab.click(f"#{button}")
        await tab.until("document.querySelector('#confirm-answer').textContent === 'REFUSED: no plan waits'")
        stand_ins.say("IDLE", "rejected", label="blue")
        await tab.until("document.querySelector('#confirm').hidden")

        # of two at once each step says whose it is
        stand_ins.say("PLACE", "carrying", 1, label="red", arm="right")
        await tab.until("document.querySelector('#steps em').textContent === 'red · right arm'")
        assert await tab.js("document.querySelector('#steps li:nth-child(2) em').textContent") == "blue · left arm"

        # one that is no longer seen can't be asked for
        stand_ins.detections.detections.pop()
        await tab.until("document.querySelectorAll('#choices button').length === 1")
        assert await tab.js("document.querySelectorAll('#labels button').length") == 1

        # who looks away takes nothing
        assert stand_ins.image.get_subscription_count() > 0
        await tab.click("[data-camera=overhead] button")
        await tab.click("#layers button:nth-child(2)")
        async with asyncio.timeout(10.0):
            while stand_ins.image.get_subscription_count():
                await asyncio.sleep(0.05)
        assert tab.complaints == []

    with_page(open_tab, walk)
    assert [(p.label, p.arm, p.dry_run, p.confirm) for p in stand_ins.picks] == [("blue", "left", True, True)]
    assert stand_ins.answers == [("run", True), ("reject", False)]
    assert stand_ins.stops == 2
    assert [reset.scene for reset in stand_ins.resets] == ["random"]
