# SPDX-License-Identifier: Apache-2.0
"""The graph as Foxglove sees it: channels, raw messages, services; and who may connect."""

from __future__ import annotations

import asyncio
import json
import struct
import threading
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import rclpy
from geometry_msgs.msg import PointStamped
from openarm_interfaces.srv import Grasp
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String

from openarm_common.ros.node import QOS_LATCHED

pytest.importorskip(
    "foxglove", reason="needs foxglove-sdk: .venv/bin/uv pip install --require-hashes -r requirements-viz.lock"
)

PROTOCOL = "foxglove.sdk.v1"


class Foxglove:
    """A node with a websocket client of it, which runs in a thread while the node is spun."""

    def __init__(self, ros) -> None:
        from openarm_bringup.view.ros.foxglove_node import FoxgloveNode

        self.ros = ros
        self.node = ros.start(FoxgloveNode, port=0)

    def address(self, token: str | None = None) -> str:
        return f"ws://127.0.0.1:{self.node.port}/?token={self.node.token if token is None else token}"

    def run(self, work: Callable[[aiohttp.ClientSession], Awaitable[Any]], seconds: float = 60.0) -> Any:
        outcome: list[Any] = []

        async def main() -> None:
            async with aiohttp.ClientSession() as session, asyncio.timeout(seconds):
                outcome.append(await work(session))

        def guarded() -> None:
            try:
                asyncio.run(main())
            except Exception as error:
                outcome.append(error)

        thread = threading.Thread(target=guarded)
        thread.start()
        self.ros.spin_until(lambda: not thread.is_alive(), seconds + 5.0, "the client to end")
        if isinstance(outcome[0], Exception):
            raise outcome[0]
        return outcome[0]


@pytest.fixture
def foxglove(ros) -> Foxglove:
    return Foxglove(ros)


async def advertised(socket: aiohttp.ClientWebSocketResponse, op: str, key: str, name: str) -> dict[str, Any]:
    """Wait until a topic or a service is advertised."""
    async for message in socket:
        if message.type is aiohttp.WSMsgType.TEXT:
            data = json.loads(message.data)
            for one in data.get(key, []) if data["op"] == op else []:
                if name in (one.get("topic"), one.get("name")):
                    return one
    raise AssertionError(f"{name} was not advertised")


async def message_of(socket: aiohttp.ClientWebSocketResponse, channel: dict[str, Any]) -> bytes:
    """Payload of the next message of a channel: opcode 1, its id, a stamp, the message.

    As viewers do, subscribe again when the topic is advertised anew: its publisher may have been lost for a moment.
    """
    wish = {"id": 7, "channelId": channel["id"]}
    await socket.send_json({"op": "subscribe", "subscriptions": [wish]})
    async for message in socket:
        if message.type is aiohttp.WSMsgType.TEXT:
            data = json.loads(message.data)
            again = [one for one in data.get("channels", []) if one["topic"] == channel["topic"]]
            if data["op"] == "advertise" and again:
                wish = {"id": wish["id"] + 1, "channelId": again[0]["id"]}
                await socket.send_json({"op": "subscribe", "subscriptions": [wish]})
        elif message.type is aiohttp.WSMsgType.BINARY and message.data[0] == 1:
            _, number, _ = struct.unpack_from("<BIQ", message.data)
            if number == wish["id"]:
                return message.data[13:]
    raise AssertionError("the connection ended before a message came")


def test_a_topic_is_advertised_with_its_definition_and_its_messages_come_byte_for_byte(ros, foxglove: Foxglove) -> None:
    """Twice, for the second client of a latched topic gets the message too."""
    message = PointStamped()
    message.header.frame_id = "table_frame"  # of a length that needs no padding, whose bytes are anything
    message.point.x = 0.25
    publisher = ros.node.create_publisher(PointStamped, "/somewhere", QOS_LATCHED)
    publisher.publish(message)

    async def look(session: aiohttp.ClientSession) -> None:
        sockets = []
        for _ in range(2):
            socket = await session.ws_connect(foxglove.address(), protocols=[PROTOCOL], max_msg_size=0)
            sockets.append(socket)
            channel = await advertised(socket, "advertise", "channels", "/somewhere")
            assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
            assert channel["schemaName"] == "geometry_msgs/msg/PointStamped"
            for part in ("std_msgs/Header header\n", "MSG: builtin_interfaces/Time\n", "float64 z\n"):
                assert part in channel["schema"]
            assert await message_of(socket, channel) == serialize_message(message)
        for socket in sockets:
            await socket.close()

    assert publisher.get_subscription_count() == 0  # lazily: no client has asked yet
    foxglove.run(look)
    ros.spin_until(lambda: publisher.get_subscription_count() == 0, what="the subscription ends with the clients")


def test_a_latched_message_comes_where_its_publisher_does_after_the_client(ros, foxglove: Foxglove) -> None:
    """Until then the topic is known by a subscription only, and what will be offered is not."""
    ros.hear(String, "/later")
    elsewhere = rclpy.Context()
    rclpy.init(context=elsewhere)

    async def look(session: aiohttp.ClientSession) -> bytes:
        async with session.ws_connect(foxglove.address(), protocols=[PROTOCOL], max_msg_size=0) as socket:
            asked = asyncio.ensure_future(
                message_of(socket, await advertised(socket, "advertise", "channels", "/later"))
            )
            while "/later" not in foxglove.node._forwarded:
                await asyncio.sleep(0.02)
            # before anyone has found the publisher, which is another participant's
            node = rclpy.create_node("later", context=elsewhere)
            node.create_publisher(String, "/later", QOS_LATCHED).publish(String(data="here"))
            return await asked

    try:
        assert foxglove.run(look) == serialize_message(String(data="here"))
    finally:
        rclpy.shutdown(context=elsewhere)


def test_a_service_is_called_from_foxglove(ros, foxglove: Foxglove) -> None:
    def grasp(request: Grasp.Request, response: Grasp.Response) -> Grasp.Response:
        response.message = f"asked for {request.label}"
        return response

    ros.node.create_service(Grasp, "/grasp", grasp)

    async def call(session: aiohttp.ClientSession) -> bytes:
        async with session.ws_connect(foxglove.address(), protocols=[PROTOCOL], max_msg_size=0) as socket:
            service = await advertised(socket, "advertiseServices", "services", "/grasp")
            assert service["type"] == "openarm_interfaces/srv/Grasp"
            assert "bool dry_run" in service["request"]["schema"]
            head = struct.pack("<BIII", 2, service["id"], 1, 3) + b"cdr"
            await socket.send_bytes(head + serialize_message(Grasp.Request(label="red")))
            async for message in socket:
                if message.type is aiohttp.WSMsgType.BINARY and message.data[0] == 3:
                    return message.data[13 + 3 :]
                assert "serviceCallFailure" not in str(message.data), message.data
        raise AssertionError("no answer")

    assert deserialize_message(foxglove.run(call), Grasp.Response).message == "asked for red"


def test_the_meshes_of_the_description_are_served_and_no_other_file(ros, foxglove: Foxglove, tmp_path: Path) -> None:
    mesh, secret = tmp_path / "link 1.stl", tmp_path / "secret"
    mesh.write_bytes(bytes(range(256)) * 9000)
    secret.write_text("not for viewers")
    publisher = ros.node.create_publisher(String, "/robot_description", QOS_LATCHED)
    publisher.publish(String(data=f'<robot><mesh filename="file://{str(mesh).replace(" ", "%20")}"/></robot>'))

    async def look(session: aiohttp.ClientSession) -> list[bytes | None]:
        async with session.ws_connect(foxglove.address(), protocols=[PROTOCOL], max_msg_size=0) as socket:
            channel = await advertised(socket, "advertise", "channels", "/robot_description")
            urdf = deserialize_message(await message_of(socket, channel), String).data
            address = urdf.split('"')[1]
            assert address.startswith("package://")
            name = mesh.name.replace(" ", "%20")
            return [
                await asset_of(socket, one)
                for one in (
                    address,
                    address.replace(name, "secret"),
                    f"file://{mesh}",
                    address.replace(name, "./" + name),
                )
            ]

    assert foxglove.run(look) == [mesh.read_bytes(), None, None, None]


async def asset_of(socket: aiohttp.ClientWebSocketResponse, address: str) -> bytes | None:
    """A fetched file; None when it is refused. Answer: opcode 4, id, status, length of the error, error, file."""
    await socket.send_json({"op": "fetchAsset", "uri": address, "requestId": 3})
    async for message in socket:
        if message.type is aiohttp.WSMsgType.BINARY and message.data[0] == 4:
            _, _, status, length = struct.unpack_from("<BIBI", message.data)
            return message.data[10 + length :] if status == 0 else None
    raise AssertionError("no answer")


@pytest.mark.parametrize(
    ("token", "headers", "why"),
    [
        ("", {}, "no token"),
        ("x" * 32, {}, "wrong token"),
        (None, {"Origin": "https://evil.example"}, "may not ask"),
        (None, {"Host": "evil.example:8765"}, "was called 'evil.example'"),
    ],
)
def test_who_may_not_is_refused(foxglove: Foxglove, token: str | None, headers: dict[str, str], why: str) -> None:
    async def knock(session: aiohttp.ClientSession) -> tuple[int, str]:
        url = foxglove.address(token).replace("ws:", "http:")
        async with session.get(url, headers=headers) as response:
            return response.status, (await response.json())["message"]

    status, message = foxglove.run(knock)
    assert status == 403
    assert why in message


def test_foxglove_s_own_page_may_connect_with_the_token(foxglove: Foxglove) -> None:
    async def knock(session: aiohttp.ClientSession) -> Any:
        headers = {"Origin": "https://app.foxglove.dev"}
        async with session.ws_connect(foxglove.address(), protocols=[PROTOCOL], headers=headers) as socket:
            assert socket.protocol == PROTOCOL
            return await socket.receive_json()

    info = foxglove.run(knock)
    assert info["op"] == "serverInfo"
    assert "services" in info["capabilities"]
