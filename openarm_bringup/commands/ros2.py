# SPDX-License-Identifier: Apache-2.0
"""`openarm topic`, `service`, `action`, `node`, `param`: what the ros2 command does, without an installed ROS.

Messages are written and read as YAML. Every command finds the graph that runs on this machine.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from contextlib import suppress
from itertools import pairwise
from typing import Annotated, Any, Literal

from cyclopts import App, Parameter

from openarm_bringup.commands.connect import Count, Domain, graph_peer
from openarm_bringup.outcome import Outcome, show
from openarm_common.errors import Code, OpenArmError

topic = App(name="topic", help="List topics, echo them, measure their rate, publish.")
service = App(name="service", help="List services and call them.")
action = App(name="action", help="List actions and send goals.")
node = App(name="node", help="List nodes and what each offers and uses.")
param = App(name="param", help="List, read, set and dump parameters of running nodes.")

#: Longer arrays are shown as their size.
_LONGEST = 32
#: The service by which an action takes goals.
_GOAL = "/_action/send_goal"
#: A subscriber knows of a publisher a little later than the publisher of it, s.
_SETTLE_S = 0.3


def _listing(names: dict[str, str], key: str) -> Outcome:
    width = max((len(name) for name in names), default=0)
    text = "\n".join(f"{name:<{width}}  {kind}" for name, kind in sorted(names.items()))
    if not names:
        return Outcome(False, f"no discovered node has {key}", Code.NOT_READY, {key: {}})
    return Outcome(True, data={key: names}, text=text)


@topic.command(name="list")
def topic_list(*, domain: Domain = None) -> Outcome:
    """List topics and their types."""
    with graph_peer(domain) as peer:
        return _listing(peer.topics(), "topics")


@topic.command(name="type")
def topic_type(name: str, *, domain: Domain = None) -> Outcome:
    """Print the type of a topic.

    Args:
        name: Name of the topic.
    """
    return _type("topic", name, domain)


@topic.command(name="info")
def topic_info(name: str, *, domain: Domain = None) -> Outcome:
    """Show the type of a topic, and who publishes and subscribes to it with which quality of service.

    Args:
        name: Name of the topic.
    """
    with graph_peer(domain) as peer:
        found, kind = peer.find("topic", name)
        ends = {"publishers": peer.endpoints(found, publish=True), "subscribers": peer.endpoints(found, publish=False)}
    lines = [f"{found}  {kind}"]
    for key, rows in ends.items():
        lines += [f"  {key}:", *(f"    {row['node']}  {row['reliability']}, {row['durability']}" for row in rows)]
    return Outcome(True, data={"topic": found, "type": kind, **ends}, text="\n".join(lines))


def _type(what: Literal["topic", "service"], name: str, domain: int | None) -> Outcome:
    with graph_peer(domain) as peer:
        found, kind = peer.find(what, name)
    return Outcome(True, data={what: found, "type": kind}, text=kind)


@topic.command
def echo(name: str, *, count: Count = 0, full: bool = False, timeout: float = 10.0, domain: Domain = None) -> Outcome:
    """Print the messages of a topic as YAML, until Ctrl-C.

    Args:
        name: Name of the topic.
        count: End after this many messages; 0: no limit.
        full: Print long arrays whole.
        timeout: Longest wait for the first message, s.
    """
    from openarm_bringup.messages import interface, to_data, to_yaml

    taken: deque[Any] = deque(maxlen=count)
    waiting: list[Any] = []
    with graph_peer(domain) as peer:
        found, kind = peer.find("topic", name)
        offered = peer.offered(found)
        peer.node.create_subscription(interface(kind), found, waiting.append, offered)
        if not peer.spin_until(lambda: waiting, timeout):
            raise OpenArmError(Code.TIMEOUT, f"{found} was silent for {timeout:g} s")
        if count and offered.durability == offered.durability.TRANSIENT_LOCAL:
            # Kept messages come at once, the oldest first: some of them means the newest.
            peer.spin_until(lambda: False, _SETTLE_S)
            del waiting[:-count]
        with suppress(KeyboardInterrupt):  # ends it
            while not count or len(taken) < count:
                peer.spin_until(lambda: waiting, float("inf"))
                data = to_data(waiting.pop(0), None if full else _LONGEST)
                taken.append(data)
                show(to_yaml(data) + "---\n")
    return Outcome(True, data={"topic": found, "type": kind, "messages": list(taken)})


@topic.command
def hz(name: str, *, seconds: float = 5.0, domain: Domain = None) -> Outcome:
    """Measure the rate of a topic by the wall clock, what is lost, and how long messages take to arrive.

    The delay holds where publisher and this machine have one clock.

    Args:
        name: Name of the topic.
        seconds: Time to listen, s.
    """
    from statistics import median

    from openarm_bringup.bags.losses import Arrivals
    from openarm_bringup.messages import interface

    at: list[float] = []
    delays: list[float] = []
    size, lost, arrivals = [0], [0], Arrivals()
    with graph_peer(domain) as peer:
        found, kind = peer.find("topic", name)

        def take(data: bytes, info: Any) -> None:
            at.append(time.monotonic())
            delays.append((info["received_timestamp"] - info["source_timestamp"]) * 1e-6)
            size[0] += len(data)
            lost[0] += arrivals.missing(info["publication_sequence_number"], lambda: peer.node.count_publishers(found))

        peer.node.create_subscription(interface(kind), found, take, peer.offered(found), raw=True)
        peer.spin_until(lambda: False, seconds)
    if len(at) < 2:
        return Outcome(False, f"{found}: {len(at)} messages in {seconds:g} s", Code.TIMEOUT, {"topic": found})
    gaps = [later - earlier for earlier, later in pairwise(at)]
    rate = len(gaps) / (at[-1] - at[0])
    data = {
        "topic": found,
        "rate_hz": rate,
        "period_min_ms": min(gaps) * 1e3,
        "period_max_ms": max(gaps) * 1e3,
        "messages": len(at),
        "lost": lost[0],
        "delay_median_ms": median(delays),
        "delay_max_ms": max(delays),
        "bytes_per_s": size[0] / seconds,
    }
    message = f"{found}: {rate:.2f} Hz, period {min(gaps) * 1e3:.1f} to {max(gaps) * 1e3:.1f} ms, {len(at)} messages"
    message += f", {lost[0]} lost, {median(delays):.1f} ms of delay ({max(delays):.1f} at most)"
    return Outcome(True, f"{message}, {size[0] / seconds / 1e6:.2f} MB/s", data=data)


@topic.command
def pub(
    name: str,
    *message: str,
    type_: Annotated[str, Parameter(name="--type")] = "",
    rate: float | None = None,
    duration: float | None = None,
    count: Annotated[int | None, Parameter(name=["--count", "-n"])] = None,
    once: bool = False,
    domain: Domain = None,
) -> Outcome:
    """Publish a message, given as YAML: once, or as a stream.

    Args:
        name: Name of the topic.
        message: Its fields, such as "{name: [a], position: [0.1]}"; what is left out keeps its default. As with ros2,
            the type may precede it.
        type_: Type of the message, where no other node has the topic.
        rate: Hz of a stream, until Ctrl-C, or for as long or as often as is said; 10 where only that is said.
        duration: End after this time, s.
        count: End after this many messages.
        once: Publish one message; what happens without the other options.
    """
    from openarm_bringup.messages import fill, interface, type_and_fields

    most, hertz = _stream(rate, duration, count, once)
    with graph_peer(domain) as peer:
        asked, fields = type_and_fields(message)
        if asked or type_:
            found, kind = name if name.startswith("/") else f"/{name}", asked or type_
        else:
            found, kind = peer.find("topic", name)
        filled = fill(interface(kind)(), fields)
        publisher = peer.node.create_publisher(interface(kind), found, 10)
        heard = peer.spin_until(publisher.get_subscription_count, 2.0)
        peer.spin_until(lambda: False, _SETTLE_S if heard else 0.0)
        sent, began = 0, time.monotonic()
        with suppress(KeyboardInterrupt):  # ends the stream
            while sent < most:
                # By the clock, not by pauses: their errors would add up.
                peer.spin_until(lambda: False, began + sent / hertz - time.monotonic())
                publisher.publish(filled)
                sent += 1
        if heard:
            peer.wait_delivered(publisher)
    data = {"topic": found, "type": kind, "messages": sent}
    text = f"{sent} x {kind} on {found}" + ("" if heard else "; it has no subscriber")
    return Outcome(heard, text, Code.OK if heard else Code.NOT_READY, data)


def _stream(rate: float | None, duration: float | None, count: int | None, once: bool) -> tuple[float, float]:
    """Return how many messages are published, and at how many Hz.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a value out of range, or `--once` with what makes a stream.
    """
    for flag, value, most in (("--rate", rate, 1e4), ("--duration", duration, 1e7), ("--count", count, 1e9)):
        if value is not None and not 0.0 < value <= most:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{flag} {value:g}: expected more than 0, at most {most:g}")
        if value is not None and once:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"--once publishes one message; leave out {flag}")
    hertz = 10.0 if rate is None else rate
    limits = [] if count is None else [float(count)]
    limits += [] if duration is None else [max(1.0, round(duration * hertz))]
    return min(limits, default=1.0 if rate is None else float("inf")), hertz


@service.command(name="list")
def service_list(*, all_: Annotated[bool, Parameter("--all")] = False, domain: Domain = None) -> Outcome:
    """List services and their types.

    Args:
        all_: Also those for parameters and types that every node has.
    """
    with graph_peer(domain) as peer:
        return _listing(peer.services(all_=all_), "services")


@service.command(name="type")
def service_type(name: str, *, domain: Domain = None) -> Outcome:
    """Print the type of a service.

    Args:
        name: Name of the service.
    """
    return _type("service", name, domain)


@service.command
def call(name: str, *request: str, timeout: float = 30.0, domain: Domain = None) -> Outcome:
    """Call a service; the request and the answer are YAML. The exit code follows the answer's `success`, if it has one.

    Args:
        name: Name of the service.
        request: Its fields, such as "{label: red}"; as with ros2, the type may precede it.
        timeout: Longest wait for the answer, s.
    """
    from openarm_bringup.messages import fields_of, fill, interface, to_data

    with graph_peer(domain) as peer:
        found, kind = peer.find("service", name)
        filled = fill(interface(kind).Request(), fields_of(request, found, kind))
        client = peer.node.create_client(interface(kind), found)
        peer.wait_for(client.service_is_ready, found)
        answer = peer.result(client.call_async(filled), timeout, found)
    return _answered(to_data(answer), {"service": found, "type": kind})


@action.command(name="list")
def action_list(*, domain: Domain = None) -> Outcome:
    """List actions and their types."""
    with graph_peer(domain) as peer:
        return _listing(peer.actions(), "actions")


@action.command(name=["send", "send_goal"])
def send(name: str, *goal: str, feedback: bool = False, timeout: float = 300.0, domain: Domain = None) -> Outcome:
    """Send a goal and wait for its result; Ctrl-C cancels it.

    Args:
        name: Name of the action.
        goal: Its fields as YAML; as with ros2, the type may precede it.
        feedback: Print the feedback.
        timeout: Longest wait for the result, s.
    """
    from openarm_bringup.messages import fields_of, fill, interface, to_data, to_yaml

    def on_feedback(message: Any) -> None:
        if feedback:
            sys.stderr.write(to_yaml(to_data(message.feedback, _LONGEST)) + "---\n")

    with graph_peer(domain) as peer:
        found, kind = peer.find("action", name)
        filled = fill(interface(kind).Goal(), fields_of(goal, found, kind))
        client = peer.action_client(interface(kind), found)
        died = client.watch()
        handle = peer.result(client.send_goal_async(filled, feedback_callback=on_feedback), 10.0, found, died)
        if not handle.accepted:
            return Outcome(False, f"{found} refused the goal", Code.INVALID_ARGUMENT, {"action": found})
        future = handle.get_result_async()
        try:
            result = peer.result(future, timeout, found, died)
        except (KeyboardInterrupt, OpenArmError):
            if not died():
                peer.result(handle.cancel_goal_async(), 5.0, f"cancelling {found}")
            raise
    return _answered(to_data(result.result, _LONGEST), {"action": found, "type": kind, "status": result.status})


@node.command(name="list")
def node_list(*, domain: Domain = None) -> Outcome:
    """List nodes."""
    with graph_peer(domain) as peer:
        names = peer.nodes()
    return Outcome(True, data={"nodes": names}, text="\n".join(names))


@node.command
def info(name: str, *, domain: Domain = None) -> Outcome:
    """Show what a node publishes and subscribes to, the services that it offers and calls, and its actions.

    Args:
        name: Name of the node.
    """
    with graph_peer(domain) as peer:
        found, _ = peer.find("node", name)
        space, _, short = found.rpartition("/")
        where = (short, space or "/")
        parts = {
            "publishes": peer.node.get_publisher_names_and_types_by_node(*where),
            "subscribes to": peer.node.get_subscriber_names_and_types_by_node(*where),
            "offers": peer.node.get_service_names_and_types_by_node(*where),
            "calls": peer.node.get_client_names_and_types_by_node(*where),
        }
    data = {
        key: {entry: kinds[0] for entry, kinds in sorted(entries) if "/_action/" not in entry}
        for key, entries in parts.items()
    }
    for key, services in (("offers actions", "offers"), ("sends goals to", "calls")):
        goals = [(entry, kinds[0]) for entry, kinds in sorted(parts[services]) if entry.endswith(_GOAL)]
        data[key] = {entry.removesuffix(_GOAL): kind.removesuffix("_SendGoal") for entry, kind in goals}
    lines = [found]
    for key, entries in data.items():
        lines += [f"  {key}:", *(f"    {entry}  {kind}" for entry, kind in entries.items())]
    return Outcome(True, data={"node": found, **data}, text="\n".join(lines))


@node.command
def health(*, domain: Domain = None) -> Outcome:
    """Show what the nodes report of themselves, and the rates of the topics that have a steady one."""
    from openarm_bringup.doctor.ros.listener import listen

    status = listen(domain)
    width = max((len(name) for name in (*status.diagnostics, *status.rates)), default=0)
    lines = [
        f"{name:<{width}}  {'ok' if good else 'error':<5}  {message}"
        for name, (good, message) in sorted(status.diagnostics.items())
    ]
    lines += [f"{topic:<{width}}  {rate:.1f} Hz" for topic, rate in sorted(status.rates.items())]
    faulty = sorted(name for name, (good, _) in status.diagnostics.items() if not good)
    if faulty:
        return Outcome(False, f"{', '.join(faulty)}: not well", Code.NOT_READY, vars(status), "\n".join(lines))
    return Outcome(True, data=vars(status), text="\n".join(lines))


def _answered(answer: dict[str, Any], data: dict[str, Any]) -> Outcome:
    from openarm_bringup.messages import to_yaml

    text, data = to_yaml(answer), {**data, "answer": answer}
    if answer.get("success") is False:
        return Outcome(False, str(answer.get("message", "")), answer.get("code") or Code.INTERNAL, data, text)
    return Outcome(True, data=data, text=text)


@param.command(name="list")
def param_list(node: str, *, domain: Domain = None) -> Outcome:
    """List the parameters of a node.

    Args:
        node: Its name.
    """
    with graph_peer(domain) as peer:
        names = peer.parameters(node).names
    return Outcome(True, data={"parameters": names}, text="\n".join(names))


@param.command(name="get")
def param_get(node: str, name: str, *, domain: Domain = None) -> Outcome:
    """Print a parameter.

    Args:
        node: Name of the node.
        name: Name of the parameter, such as approach.lift_height.
    """
    with graph_peer(domain) as peer:
        value = peer.parameters(node).get([name])[name]
    return Outcome(True, data={"name": name, "value": value}, text=str(value))


@param.command(name="dump")
def param_dump(node: str, *, domain: Domain = None) -> Outcome:
    """Print all parameters of a node as a ROS parameter file.

    Args:
        node: Name of the node.
    """
    import yaml

    with graph_peer(domain) as peer:
        parameters = peer.parameters(node)
        values = parameters.get(parameters.names)
    file = {node.rpartition("/")[2]: {"ros__parameters": values}}
    return Outcome(True, data={"parameters": values}, text=yaml.safe_dump(file, sort_keys=True))


@param.command(name="set")
def param_set(node: str, name: str, value: str, *, domain: Domain = None) -> Outcome:
    """Set a parameter; most of the suite's are fixed at the start (`openarm up --set`) and say so.

    Args:
        node: Name of the node.
        name: Name of the parameter.
        value: Value as YAML.
    """
    from openarm_common.config import parse_yaml

    with graph_peer(domain) as peer:
        parameters = peer.parameters(node)
        accepted, reason = parameters.set(name, parse_yaml(value, "the value", Code.INVALID_ARGUMENT))
    found = parameters.node
    data = {"node": found, "name": name, "value": value}
    if not accepted:
        hint = f"{reason or 'refused'}; give it at the start: openarm up --set {found.strip('/')}.{name}={value}"
        return Outcome(False, f"{found} {name}: {hint}", Code.INVALID_ARGUMENT, data)
    return Outcome(True, f"{found} {name} = {value}", data=data)
