# SPDX-License-Identifier: Apache-2.0
"""The nodes of the graph in one process, each in a thread of its own, and what can be sent to them."""

from __future__ import annotations

import json
import os
import random
import re
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.fuzz.alter import HOSTILE, altered_bytes
from benchmarks.fuzz.files.reader import BAG
from benchmarks.fuzz.hostile import hostile, plausible
from benchmarks.fuzz.judge import Tally, peak_mib, reset_peak, where
from openarm_bringup.messages import interface
from openarm_common.camera.cameras import load_cameras
from openarm_common.config import validate
from openarm_common.domain import release_domain, reserve_domain
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.lifecycle_node import RCLError

#: What is sent before the nodes are asked whether they still answer.
BATCH = 10
#: A node answers within this time, s that the process computes for; a request, or the result of a cancelled goal,
#: within this one of wall clock, s.
ALIVE_S, ANSWER_S = 2.0, 20.0
#: A goal is cancelled after this time, s.
_GOAL_S = 1.0
#: Written by what should not happen.
_DEFECT = re.compile(
    r"^.*(Error raised in|(physics|control) thread ended|Exception in|exception was never).*$", re.MULTILINE
)
#: Names that both nodes offer that control arms.
_OF_BOTH = ("/stop", "/joint_commands")
_CAMERA = re.compile(r"/(?P<camera>\w+)/(?P<stream>color|depth)/(image_raw|camera_info)")


class Nodes:
    """All nodes, and a probe.

    Args:
        folder: For what they write; the working folder of the process.
    """

    def __init__(self, folder: Path) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from rclpy.parameter import Parameter

        from openarm_bringup.bags.ros.flight_recorder import FlightRecorder
        from openarm_bringup.view.ros.layers import makers
        from openarm_calibration.ros.node import CalibrationNode
        from openarm_calibration.ros.publisher import PublisherNode
        from openarm_control.ros.node import ArmControl
        from openarm_grasp.ros.node import GraspNode
        from openarm_motion.ros.node import MotionNode
        from openarm_octomap.ros.node import OctomapNode
        from openarm_perception.ros.cloud_node import CloudNode
        from openarm_perception.ros.detector_node import DetectNode
        from openarm_sim_bridge.ros.node import MujocoBridge

        rclpy.init()
        self._executor = SingleThreadedExecutor
        self._ending = False
        self._threads: list[threading.Thread] = []
        #: Errors that came out of a callback, by node.
        self.errors: list[str] = []
        self.nodes, self._owners = list[Any](), list[Any]()
        self.probe: Any = Node("probe")
        self._spin(self.probe)
        self._alive = {}
        store = str(folder / "store")
        # Both offer these; and what it commands is not the robot of the bridge, which others command.
        behind = {f"topics.{part}": f"/arm_control/{{arm}}_{part}/joint_trajectory" for part in ("arm", "gripper")}
        remaps = [part for name in _OF_BOTH for part in ("-r", f"{name}:=/arm_control{name}")]
        for kind, parameters in (
            (MujocoBridge, {"images": False}),
            (PublisherNode, {"store": store}),
            (CloudNode, {}),
            (DetectNode, {}),
            (OctomapNode, {}),
            (MotionNode, {}),
            (GraspNode, {}),
            (CalibrationNode, {"store": store, "camera": "wrist"}),
            (FlightRecorder, {"folder": str(folder / "recordings")}),
            (ArmControl, {"calibrations": store, **behind}),
        ):
            overrides = [Parameter(name, value=value) for name, value in parameters.items()]
            arguments = ["--ros-args", *remaps] if kind is ArmControl else []
            node: Any = kind(parameter_overrides=overrides, cli_args=arguments)
            self._owners.append(node)
            self.nodes += [node, *node.companions]
            self._spin(node, *node.companions)
        self._listen()
        #: What the page shows; polled, not spun.
        self.page: Any = Node("page")
        cameras = list(load_cameras().values())
        #: Nodes whose subscriptions are polled: they are not spun.
        self.polled = (self.page, *(node._driver._listener for node in self.nodes if isinstance(node, ArmControl)))
        self.layers = [make(self.page) for make in makers(RobotDescription.load(), cameras, "overhead").values()]

    def _spin(self, node: Any, *companions: Any) -> None:
        executor = self._executor()
        for one in (node, *companions):
            executor.add_node(one)

        def spin() -> None:
            while not self._ending:
                try:
                    executor.spin_once(timeout_sec=0.1)
                # Anything that comes out of a callback is what this looks for: it would end the process.
                except Exception as error:
                    if not self._ending:
                        self.errors.append(f"{node.get_name()}: {where(error)}")

        thread = threading.Thread(target=spin, name=node.get_name(), daemon=True)
        thread.start()
        self._threads.append(thread)

    def _listen(self) -> None:
        """Subscribe to all that the nodes publish: some of them work only while it is wanted."""
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.newest_ns = 0
        for node in self.nodes:
            for publisher in node.publishers:
                if publisher.topic_name in ("/rosout", "/parameter_events"):
                    continue
                take = self._take_state if publisher.topic_name == "/joint_states" else lambda _: None
                self.probe.create_subscription(publisher.msg_type, publisher.topic_name, take, profile)

    def _take_state(self, message: Any) -> None:
        self.newest_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec

    def look(self) -> None:
        """Let the page show what has come."""
        for layer in self.layers:
            try:
                for key, payload in layer.update():
                    if isinstance(payload, str):
                        json.loads(payload, parse_constant=lambda word: _no_json(word))
                    assert key
            except OpenArmError:
                continue  # what can't be shown is said on the page
            # Anything else would end its thread.
            except Exception as error:
                self.errors.append(f"page: {where(error)}")

    def silent(self) -> list[str]:
        """Return the nodes that do not answer a request for a parameter in time, and note the longest time."""
        from rcl_interfaces.srv import GetParameters

        waiting: dict[str, Any] = {}
        for node in self.nodes:
            name = node.get_fully_qualified_name()
            if name not in self._alive:
                self._alive[name] = self.probe.create_client(GetParameters, f"{name}/get_parameters")
                self._alive[name].wait_for_service(timeout_sec=10.0)
            waiting[name] = self._alive[name].call_async(GetParameters.Request(names=["use_sim_time"]))
        began, computed = time.monotonic(), time.process_time()
        while not all(future.done() for future in waiting.values()):
            # on a busy machine the process gets less time than passes
            passed = min(time.monotonic() - began, time.process_time() - computed)
            if passed > ALIVE_S or time.monotonic() - began > ANSWER_S:
                break
            time.sleep(0.005)
        return [name for name, future in waiting.items() if not future.done()]

    def close(self) -> None:
        """End everything."""
        import rclpy

        self._ending = True
        for thread in self._threads:
            thread.join(timeout=5.0)
        for layer in self.layers:
            layer.close()
        self.page.destroy_node()
        for node in self._owners:
            node.close()
            node.destroy_node()
        rclpy.try_shutdown()


class Lot:
    """Draws from what there is at the time, what was not drawn yet before anything comes again.

    Args:
        rng: Source of all choices.
    """

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._drawn: set[Any] = set()
        #: How often everything was drawn.
        self.rounds = 0

    def draw(self, there: Iterable[Any]) -> Any:
        """Choose one of these; their order does not matter."""
        items = set(there)
        item = self._rng.choice(sorted(items - self._drawn or items, key=str))
        self._drawn.add(item)
        if self._drawn >= items:
            self.rounds += 1
            self._drawn.clear()
        return item


class Sender:
    """Hostile inputs for the nodes.

    Args:
        nodes: Running.
        rng: Source of all choices.
    """

    def __init__(self, nodes: Nodes, rng: random.Random) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile

        self._nodes, self._rng = nodes, rng
        self._probe = nodes.probe
        self._profile = QoSProfile(depth=2, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._made: dict[Any, Any] = {}
        self._sound, self._mounts = _recorded()
        self._actions: list[tuple[str, Any]] = []
        #: Of subscriptions, services or actions.
        self.lot = Lot(rng)

    # --- topics
    def restore(self) -> None:
        """Undo what would keep inputs from being worked on: other camera mounts, a pause, an emergency stop."""
        from openarm_interfaces.srv import SetPause
        from std_srvs.srv import Trigger

        for name, kind in (
            ("/sim/set_pause", SetPause),
            ("/mujoco_bridge/reset", Trigger),
            ("/arm_control/reset", Trigger),
        ):
            client = self._made.get(name) or self._made.setdefault(name, self._probe.create_client(kind, name))
            if client.wait_for_service(timeout_sec=5.0):
                client.call_async(kind.Request())
        kind = type(self._mounts[0])
        for message in self._mounts:
            self._publisher("/tf_static", kind).publish(message)

    def message(self) -> Callable[[], object]:
        """One message on one subscription."""
        heard = {
            (s.topic_name, s.msg_type)
            for node in (*self._nodes.nodes, *self._nodes.polled)
            for s in list(node.subscriptions)
            if s.topic_name not in ("/clock", "/parameter_events")
        }
        topic, kind = self.lot.draw(heard)
        return partial(self._publish, topic, kind)

    def _publish(self, topic: str, kind: Any) -> None:
        from rclpy.serialization import serialize_message

        match = _CAMERA.fullmatch(topic)
        others = [t for t in self._sound if match and t.startswith(f"/{match['camera']}/")]
        stamp = self._nodes.newest_ns
        for other in others:  # of the same stamp, without which a frame is not taken up
            if other != topic:
                self._publisher(other, type(self._sound[other])).publish(_stamped(self._sound[other], stamp))
        sound = self._sound.get(topic)
        sound = plausible(kind, self._rng) if sound is None or not isinstance(sound, kind) else _stamped(sound, stamp)
        publisher = self._publisher(topic, kind)
        message = hostile(sound, self._rng)
        if self._rng.random() < 0.2:
            data = serialize_message(sound)
            with suppress(RCLError):  # the sender's own middleware refuses it
                publisher.publish(data[:4] + altered_bytes(data[4:400], self._rng) + data[400:])
        else:
            publisher.publish(message)

    def _publisher(self, topic: str, kind: Any) -> Any:
        if topic not in self._made:
            self._made[topic] = self._probe.create_publisher(kind, topic, self._profile)
            deadline = time.monotonic() + 0.5
            while not self._made[topic].get_subscription_count() and time.monotonic() < deadline:
                time.sleep(0.01)
        return self._made[topic]

    # --- services and actions
    def request(self) -> Callable[[], object]:
        """One request to one service."""
        offered = [
            (node.resolve_service_name(s.srv_name), s.srv_type) for node in self._nodes.nodes for s in node.services
        ]
        name, kind = self.lot.draw(offered)
        request = hostile(plausible(kind.Request, self._rng), self._rng)
        return partial(self._call, name, kind, request)

    def _call(self, name: str, kind: Any, request: Any) -> None:
        if name.endswith("/change_state") and request.transition.id not in range(5):
            request.transition.id = 200  # no transition; a shutdown would end the node for good
        if name == "/sim/step":  # answered when so much time has been simulated
            request.steps = min(request.steps, 1000)
        client = self._made.get(name) or self._made.setdefault(name, self._probe.create_client(kind, name))
        client.wait_for_service(timeout_sec=5.0)
        answer = _wait(client.call_async(request), ANSWER_S, f"no answer of {name}")
        if not getattr(answer, "success", True):
            raise OpenArmError(getattr(answer, "code", "") or "REFUSED", getattr(answer, "message", ""))

    def goal(self) -> Callable[[], object]:
        """One goal of one action; cancelled after a while."""
        from rclpy.action import get_action_server_names_and_types_by_node

        if not self._actions:
            for node in self._nodes.nodes:
                found = get_action_server_names_and_types_by_node(self._probe, node.get_name(), node.get_namespace())
                self._actions += [(name, interface(kinds[0])) for name, kinds in found]
        name, kind = self.lot.draw(self._actions)
        return partial(self._send, name, kind, hostile(plausible(kind.Goal, self._rng), self._rng))

    def _send(self, name: str, kind: Any, goal: Any) -> None:
        from rclpy.action import ActionClient

        client = self._made.get(name) or self._made.setdefault(name, ActionClient(self._probe, kind, name))
        client.wait_for_server(timeout_sec=5.0)
        handle = _wait(self._begun(client.send_goal_async, goal), ANSWER_S, f"no answer of {name}")
        if not handle.accepted:
            raise OpenArmError("REJECTED", "")
        result = self._begun(handle.get_result_async)
        try:
            done = _wait(result, _GOAL_S, "")
        except _SilentError:
            self._begun(handle.cancel_goal_async)
            done = _wait(result, ANSWER_S, f"no result of {name}")
        code = getattr(done.result, "error_code", 0)  # a number of control_msgs, or MoveIt's message
        if not getattr(done.result, "success", code == 0 if isinstance(code, int) else code.val == code.SUCCESS):
            raise OpenArmError(getattr(done.result, "code", "") or "REFUSED", getattr(done.result, "message", ""))

    def _begun(self, ask: Callable[..., Any], *args: Any) -> Any:
        """Ask in the probe's thread: a client of an action loses an answer that comes before it has noted what for."""
        return _wait(self._probe.executor.create_task(ask, *args), ANSWER_S, "the probe does not spin")

    # --- parameters
    def parameter(self) -> Callable[[], object]:
        """One parameter: of a running node, or of one that starts."""
        node = self._rng.choice(self._nodes.nodes)
        if self._rng.random() < 0.5 and node.config.model_dump():
            return partial(self._start, node)
        return partial(self._set, node)

    def _start(self, node: Any) -> None:
        data = node.config.model_dump()
        place: Any = data
        while True:
            key = self._rng.choice(list(place))
            if not isinstance(place[key], dict) or not place[key] or self._rng.random() < 0.1:
                break
            place = place[key]
        place[key] = self._rng.choice(HOSTILE)
        validate(type(node.config), data, "parameters")

    def _set(self, node: Any) -> None:
        from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
        from rcl_interfaces.srv import SetParameters

        name = self._rng.choice(sorted(node._parameters))
        before = node.get_parameter(name).get_parameter_value()
        value = hostile(plausible(ParameterValue, self._rng), self._rng)
        value.type = self._rng.choice((before.type, self._rng.randrange(11)))
        if name == "use_sim_time" and value.type == ParameterType.PARAMETER_BOOL:
            value.type = ParameterType.PARAMETER_STRING
        service = f"{node.get_fully_qualified_name()}/set_parameters"
        client = self._made.get(service) or self._made.setdefault(
            service, self._probe.create_client(SetParameters, service)
        )
        client.wait_for_service(timeout_sec=5.0)
        request = SetParameters.Request(parameters=[Parameter(name=name, value=value)])
        answer = _wait(client.call_async(request), ANSWER_S, f"no answer of {service}").results[0]
        if not answer.successful:
            raise OpenArmError("REFUSED", answer.reason)
        back = SetParameters.Request(parameters=[Parameter(name=name, value=before)])
        _wait(client.call_async(back), ANSWER_S, f"no answer of {service}")


def _no_json(word: str) -> None:
    raise AssertionError(f"{word} is no JSON")


class _SilentError(Exception):
    """No answer came in time."""


def _wait(future: Any, seconds: float, what: str) -> Any:
    deadline = time.monotonic() + seconds
    while not future.done():
        if time.monotonic() > deadline:
            raise _SilentError(f"{what} within {seconds:g} s")
        time.sleep(0.002)
    return future.result()


def _recorded() -> tuple[dict[str, Any], list[Any]]:
    """One message of each topic of the bag of the repository, of those types that are as they were; all of mounts."""
    from openarm_bringup.bags.bag import open_bag
    from openarm_bringup.bags.ros.messages import message_of, messages_of

    found: dict[str, Any] = {}
    with open_bag(BAG) as bag:
        for topic in bag.topics:
            try:
                found[topic] = message_of(bag, next(bag.records([topic])))
            except OpenArmError:
                continue
        return found, messages_of(bag, ["/tf_static"])["/tf_static"]


def _stamped(message: Any, t_ns: int) -> Any:
    if hasattr(message, "header"):
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(t_ns, 10**9)
    return message


#: By kind: which of the sender's.
KINDS: dict[str, Callable[[Sender], Callable[[], object]]] = {
    "messages": Sender.message,
    "requests": Sender.request,
    "goals": Sender.goal,
    "parameters": Sender.parameter,
}


@contextmanager
def _running() -> Iterator[tuple[Nodes, Path]]:
    domain = reserve_domain()
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.setdefault("MUJOCO_GL", "egl")
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder, "a/b/c")  # hostile paths lead out of it, not out of the folder
        home.mkdir(parents=True)
        os.chdir(home)
        nodes = Nodes(home)
        try:
            yield nodes, home
        finally:
            nodes.close()
            os.chdir("/")
            release_domain(domain)


def send_hostile(counts: dict[str, int], seed: int) -> list[Tally]:
    """Send hostile inputs of some kinds, in this process.

    Args:
        counts: Inputs by kind.
        seed: Seed of all choices; what nodes do meanwhile depends on the machine.
    """
    tallies: list[Tally] = []
    with ExitStack() as stack:
        log = stack.enter_context(tempfile.NamedTemporaryFile(suffix=".log"))
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
        nodes, _ = stack.enter_context(_running())
        nodes.silent()
        for kind, count in counts.items():
            rng = random.Random(f"{kind}{seed}")
            sender, tally = Sender(nodes, rng), Tally(kind)
            tallies.append(tally)
            done, first_mib = 0, reset_peak()
            while done < count:
                before = reset_peak()
                sender.restore()
                for _ in range(min(BATCH, count - done)):
                    tally.take(KINDS[kind](sender), bounded=False)
                    done += 1
                began = time.monotonic()
                for name in nodes.silent():
                    tally.raw[f"{name} did not answer for {ALIVE_S:g} s"] += 1
                tally.worst_s = max(tally.worst_s, time.monotonic() - began)
                tally.worst_mib = max(tally.worst_mib, peak_mib() - before)
                nodes.look()
                while nodes.errors:
                    tally.raw[nodes.errors.pop()] += 1
            if sender.lot.rounds:
                tally.notes.append(f"each subscription, service or action {sender.lot.rounds} times or more")
            tally.notes.append(f"{reset_peak() - first_mib:+.0f} MiB from the first input to the last")
            tally.notes += [f"{node.get_name()}: {node._BaseNode__status.message[:150]}" for node in nodes.nodes]
            at = Path(log.name)
            for found in _DEFECT.finditer(at.read_text("utf-8", "replace")):
                tally.raw[found.group()[:300]] += 1
            os.truncate(log.name, 0)
    return tallies
