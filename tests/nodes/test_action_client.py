# SPDX-License-Identifier: Apache-2.0
"""Goals whose answer is lost, refused, or that come one after another."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from control_msgs.action import FollowJointTrajectory
from rclpy.action import GoalResponse

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros import client
from openarm_common.ros.actions import ActionClient, ActionServer
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
                        answers.append(asking.do(FollowJointTrajectory, NAME, goal, timeout=10.0).error_string)
                    except OpenArmError as error:
                        answers.append(error.code)

        with ThreadPoolExecutor(1) as pool:
            done = pool.submit(script)
            ros.spin_until(done.done, 60.0, "the answers")
            done.result()
        return answers

    yield ask
    server.destroy()


@pytest.mark.requirement("R-21")
def test_a_goal_whose_answer_is_lost_is_accepted_by_the_status_of_its_server(asked, monkeypatch) -> None:
    monkeypatch.setattr(client, "ActionClient", Unheard)
    assert asked(True, True, True) == ["done"] * 3


def test_goals_are_accepted_once_and_refused_ones_stay_so(asked, capfd) -> None:
    assert asked(True, False, True, True) == ["done", Code.BUSY, "done", "done"]
    assert capfd.readouterr().err == ""
