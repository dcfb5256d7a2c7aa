# SPDX-License-Identifier: Apache-2.0
"""Ask for grasps from plain Python: no node, no executor and no spinning in the caller's code."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Self

import rclpy
from action_msgs.msg import GoalStatus
from openarm_interfaces.action import Pick, PickTwo
from openarm_interfaces.msg import GraspStatus, PickAnswer, PickRequest
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from openarm_common.convert import point, xyz
from openarm_common.errors import Code, OpenArmError
from openarm_grasp.answers import GraspResult, PairResult, Wanted
from openarm_grasp.convert import option_from_msg

OnFeedback = Callable[[GraspStatus], None]
#: How often a waiting call looks up, so that Ctrl-C is noticed.
_LOOK_S = 0.1
#: A server that is not in the graph at so many looks in a row is gone.
_GONE = 30


class GraspClient:
    """Asks the grasp node; a context manager.

    It brings its own ROS context, node and background thread, so it also works beside an rclpy program.

    Args:
        timeout: Longest wait for the grasp node to be there and to answer, s of wall clock.

    Example:
        ``with GraspClient() as grasp: print(grasp.pick("red").message)``
    """

    def __init__(self, *, timeout: float = 10.0) -> None:
        self._timeout = timeout
        self._context = Context()
        # Ctrl-C stays the caller's.
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = Node("grasp_client", context=self._context)
        self._pick = ActionClient(self._node, Pick, "/grasp/pick")
        self._pick_two = ActionClient(self._node, PickTwo, "/grasp/pick_two")
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._goal: ClientGoalHandle | None = None
        self._callback_error: Exception | None = None
        self._thread = threading.Thread(target=self._spin, name="grasp_client", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Stop the background thread and leave the graph; a running grasp goes on."""
        if not self._context.ok():
            return
        self._executor.shutdown(timeout_sec=2.0)
        self._thread.join(timeout=5.0)
        self._pick.destroy()
        self._pick_two.destroy()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def pick(
        self,
        label: str = "",
        *,
        arm: str = "auto",
        place: Sequence[float] | None = None,
        place_yaw: float | None = None,
        object_at: Sequence[float] | None = None,
        leave: Sequence[Sequence[float]] = (),
        phase: str = "all",
        dry_run: bool = False,
        time_limit: float = 0.0,
        timeout: float = 300.0,
        on_feedback: OnFeedback | None = None,
    ) -> GraspResult:
        """Pick an object and place it; returns when that has ended, well or not.

        Args:
            label: What to pick; "" takes the detection with the highest score.
            arm: "auto", "left" or "right".
            place: (x, y) or (x, y, z) of the footprint centre, base frame, m; z is not read. None lets a free spot be
                chosen.
            place_yaw: Of the object's x axis about the base z where it is put down, rad; None: as the hand likes.
            object_at: (x, y) near which the object stands, base frame, m, when there are several alike.
            leave: (x, y) of objects that stay where they are.
            phase: "all"; "pick": end with the object in the hand; "place": put down what the hand holds.
            dry_run: Plan and report, do not move.
            time_limit: s of robot time; then it ends with TIMEOUT, the hand keeping what it holds. 0: none.
            timeout: s of wall clock; then the grasp is cancelled.
            on_feedback: Called with each `GraspStatus`, in the background thread; it may call `cancel`.

        Returns:
            The result; `raise_for_code` turns a failure into an exception.

        Raises:
            OpenArmError: NOT_READY, when no grasp node answers; TIMEOUT; INVALID_ARGUMENT, for a place that is not two
                or three numbers.
        """
        goal = Pick.Goal(label=label, arm=arm, dry_run=dry_run, phase=phase, timeout=time_limit)
        _where(goal, place, place_yaw, object_at)
        goal.leave = [point((p[0], p[1], 0.0)) for p in leave]
        return _result(self._ask(self._pick, "/grasp/pick", goal, timeout, on_feedback))

    def pick_two(
        self,
        first: str | Wanted,
        second: str | Wanted,
        *,
        dry_run: bool = False,
        time_limit: float = 0.0,
        timeout: float = 300.0,
        on_feedback: OnFeedback | None = None,
    ) -> PairResult:
        """Pick two objects and place them, with both arms at the same time where planning allows that.

        Args:
            first: A label, or more about what is wanted.
            second: Another.
            dry_run: Plan and report, do not move.
            time_limit: s of robot time for both; then they end with TIMEOUT, hands keeping what they hold. 0: none.
            timeout: s of wall clock; then both are cancelled.
            on_feedback: Called with each `GraspStatus`, which says of what label and arm it is, in the background
                thread; it may call `cancel`.

        Returns:
            The result; `raise_for_code` turns a failure into an exception.

        Raises:
            OpenArmError: As `pick`.
        """
        goal = PickTwo.Goal(dry_run=dry_run, timeout=time_limit)
        for request, wanted in zip(goal.requests, (first, second), strict=True):
            wish = Wanted(wanted) if isinstance(wanted, str) else wanted
            request.label, request.arm = wish.label, wish.arm
            _where(request, wish.place, wish.place_yaw, wish.object_at)
        answer: PickTwo.Result = self._ask(self._pick_two, "/grasp/pick_two", goal, timeout, on_feedback)
        return PairResult(
            success=answer.success,
            outcome=answer.outcome,
            code=_code(answer.code),
            message=answer.message,
            at_once=answer.at_once,
            answers=tuple(_result(one) for one in answer.answers),
            duration=answer.duration,
        )

    def _ask(
        self, client: ActionClient, name: str, goal: object, timeout: float, on_feedback: OnFeedback | None
    ) -> Any:
        """Send a goal and return its result message."""
        self._callback_error = None
        if not client.wait_for_server(timeout_sec=self._timeout):
            raise OpenArmError(
                Code.NOT_READY,
                f"no action {name} within {self._timeout:g} s: is the graph up (./openarm up), with the same"
                " ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE?",
            )
        sent = self._begin(client.send_goal_async, goal, self._feedback(on_feedback))
        handle = self._wait(sent, self._timeout, "acceptance of the goal")
        if not handle.accepted:
            raise OpenArmError(Code.BUSY, "the grasp node rejected the goal")
        self._goal = handle
        try:
            answer = self._wait(self._begin(handle.get_result_async), timeout, "the end of the grasp")
        except BaseException:
            # Whatever keeps the caller from waiting (a deadline, Ctrl-C): nobody would see the arm go on.
            _done(self._begin(handle.cancel_goal_async)).wait(2.0)
            raise
        finally:
            self._goal = None
        if answer.status == GoalStatus.STATUS_UNKNOWN:
            raise OpenArmError(Code.NOT_READY, "the grasp node no longer knows the goal: it was started anew")
        return answer.result

    def cancel(self) -> None:
        """Ask what runs to stop; it returns with CANCELLED, the arms holding where they are."""
        goal = self._goal
        if goal is not None:
            self._begin(goal.cancel_goal_async)

    def _feedback(self, on_feedback: OnFeedback | None) -> Callable[[Any], None] | None:
        if on_feedback is None:
            return None

        def deliver(message: Any) -> None:
            try:
                on_feedback(message.feedback.status)
            except Exception as error:
                # Raised in the background it would stop the thread; `_wait` raises it where the caller is.
                self._callback_error = error

        return deliver

    def _begin(self, ask: Callable[..., Future], *args: Any) -> Future:
        """Send a request from the background thread; the returned future is done when the answer is there.

        rclpy files a request only after it has sent it: sent from another thread, a fast answer would find nobody.
        """

        async def exchange() -> Any:
            return await ask(*args)

        return self._executor.create_task(exchange)

    def _wait(self, future: Future, timeout: float, what: str) -> Any:
        done = _done(future)
        deadline = time.monotonic() + timeout
        missed = 0
        while not done.wait(_LOOK_S):
            missed = 0 if self._pick.server_is_ready() else missed + 1
            if missed > _GONE:
                raise OpenArmError(Code.NOT_READY, f"the grasp node is gone while waiting for {what}")
            if self._callback_error is not None:
                error, self._callback_error = self._callback_error, None
                raise error
            if not self._thread.is_alive():
                raise OpenArmError(Code.NOT_READY, f"the grasp client was closed while waiting for {what}")
            if time.monotonic() > deadline:
                raise OpenArmError(Code.TIMEOUT, f"no answer within {timeout:g} s while waiting for {what}")
        return future.result()

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            self._node.get_logger().debug("the context was shut down")


def _done(future: Future) -> threading.Event:
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    return done


def _where(
    request: Pick.Goal | PickRequest,
    place: Sequence[float] | None,
    place_yaw: float | None,
    object_at: Sequence[float] | None,
) -> None:
    """Fill in where an object stands and where it shall stand."""
    if place_yaw is not None:
        request.has_place_yaw, request.place_yaw = True, place_yaw
    if place is not None:
        if len(place) not in (2, 3):
            raise OpenArmError(Code.INVALID_ARGUMENT, f"place {list(place)} must be x, y or x, y, z in metres")
        request.has_place_position = True
        request.place_position = point((place[0], place[1], place[2] if len(place) == 3 else 0.0))
    if object_at is not None:
        request.has_object_position, request.object_position = True, point((object_at[0], object_at[1], 0.0))


def _code(text: str) -> Code:
    return Code(text) if text in Code.__members__ else Code.INTERNAL


def _result(message: Pick.Result | PickAnswer) -> GraspResult:
    x, y, z = (float(v) for v in xyz(message.place_position))
    return GraspResult(
        success=message.success,
        outcome=message.outcome,
        code=_code(message.code),
        message=message.message,
        label=message.label,
        arm=message.arm,
        attempts=message.attempts,
        place_position=(x, y, z),
        duration=message.duration,
        route=message.route,
        options=() if isinstance(message, PickAnswer) else tuple(map(option_from_msg, message.options)),
    )
