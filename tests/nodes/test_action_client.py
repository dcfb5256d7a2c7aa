# SPDX-License-Identifier: Apache-2.0
"""Goals whose answer is lost, refused, or that come one after another."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from control_msgs.action import FollowJointTrajectory
from rclpy import action
from rclpy.action import GoalResponse
from rclpy.impl.implementation_singleton import rclpy_implementation

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros import client
from openarm_common.ros.actions import ActionClient, ActionServer, RCLError
from openarm_common.ros.client import BackgroundNode

NAME = "/wait"


class Unheard(ActionClient):
    """Loses the answers to its goals, as a client that the server has not discovered yet."""

    async def execute(self, taken_data: dict[str, Any]) -> None:
        taken_data.pop("goal", None)
        await super().execute(taken_data)


@pytest.fixture
def asked(ros) -> Iterator[Callable[..., list[Any]]]:
    """Sends goals one after another to a server that ends each of them as it should; answers and refusals."""
    accepts: list[bool] = []

    async def work(handle) -> FollowJointTrajectory.Result:
        handle.succeed()
        return FollowJointTrajectory.Result(error_string="done")

    goal_callback = lambda _: GoalResponse.ACCEPT if accepts.pop(0) else GoalResponse.REJECT  # noqa: E731
    server = ActionServer(ros.node, FollowJointTrajectory, NAME, work, goal_callback=goal_callback)

    def ask(*wanted: bool) -> list[Any]:
        accepts.extend(wanted)
        answers: list[Any] = []

        def script() -> None:
            with BackgroundNode("asking") as asking:
                for _ in wanted:
                    try:
                        goal = FollowJointTrajectory.Goal()
                        answers.append(asking.do(FollowJointTrajectory, NAME, goal, timeout=60.0).error_string)
                    except OpenArmError as error:
                        answers.append(error.code)

        with ThreadPoolExecutor(1) as pool:
            done = pool.submit(script)
            ros.spin_until(done.done, what="the answers")
            done.result()
        return answers

    yield ask
    server.destroy()


@pytest.mark.requirement("R-21")
def test_a_goal_whose_answer_is_lost_is_accepted_by_the_status_of_its_server(asked, monkeypatch) -> None:
    monkeypatch.setattr(client, "ActionClient", Unheard)
    assert asked(True, True, True) == ["done"] * 3


@pytest.mark.long
@pytest.mark.requirement("R-21")
def test_a_client_that_is_not_discovered_yet_gets_its_answer_when_it_is_and_its_goal_runs(ros, monkeypatch) -> None:
    tried: list[int] = []
    send = rclpy_implementation.ActionServer.send_goal_response

    def undiscovered(*args: Any) -> None:
        tried.append(len(tried))
        if len(tried) < 4:
            raise RCLError("client will not receive response")
        send(*args)

    async def work(handle) -> FollowJointTrajectory.Result:
        handle.succeed()
        return FollowJointTrajectory.Result(error_string="done")

    server = ActionServer(ros.node, FollowJointTrajectory, NAME, work)
    plain = action.ActionClient(ros.node, FollowJointTrajectory, NAME)
    monkeypatch.setattr(rclpy_implementation.ActionServer, "send_goal_response", undiscovered)
    for _ in range(2):
        handle, ended = ros.send_goal(plain, FollowJointTrajectory.Goal())
        assert handle.accepted
        assert ros.result(ended).result.error_string == "done"
    assert tried == [0, 1, 2, 3, 4]
    plain.destroy()
    server.destroy()


def test_goals_are_accepted_once_and_refused_ones_stay_so(asked, capfd) -> None:
    assert asked(True, False, True, True) == ["done", Code.BUSY, "done", "done"]
    assert capfd.readouterr().err == ""
