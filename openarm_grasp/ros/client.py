# SPDX-License-Identifier: Apache-2.0
"""Ask for grasps from plain Python: no node, no executor and no spinning in the caller's code. Base frame, m, rad."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from openarm_interfaces.action import Pick, PickTwo
from openarm_interfaces.msg import GraspStatus, PickResult
from openarm_interfaces.srv import ConfirmPlan, ReleaseHand
from std_srvs.srv import Trigger

from openarm_common.errors import Answer, Code
from openarm_common.ros.client import BackgroundNode
from openarm_common.ros.convert import xyz
from openarm_grasp.planning.options import Option
from openarm_grasp.requests.request import GraspRequest
from openarm_grasp.requests.state_times import StateTime
from openarm_grasp.ros.messages import code_from_text, fill_request, option_from_msg

OnFeedback = Callable[[GraspStatus], None]
OnPlan = Callable[[GraspStatus], bool]

#: Longest wait for a hand to open, and to be learned, s.
_RELEASE_S, _LEARN_S = 30.0, 90.0


@dataclass(frozen=True)
class GraspResult(Answer):
    """How a grasp ended.

    Success: the object was placed and seen there (dry run: it could be).

    Attributes:
        outcome: SUCCESS; PARTIAL: held, not placed as asked; FAILED; REFUSED: never touched; CANCELLED.
        label: Label of the object that was picked.
        arm: The arm that was used, or "".
        attempts: Physical attempts.
        place_position: (x, y, z) of the target on the table, base frame, m.
        object_position: (x, y, z) where the object was seen before it was lifted, or where an arm moved in vain, since;
            base frame, m; None: it was not.
        duration: s of robot time.
        route: "direct"; "hand_over": by way of the middle, with both arms; "push": pushed into reach; "" when it was
            not placed.
        options: Ways to grasp that were weighed for the newest plan, by arm, the preferred first; of one object only.
        state_times: Time spent in each state, and how long a visit is expected to take.
        recording: Path of the flight recording of a failure, of one object only; "" when there is none.
    """

    outcome: str
    label: str
    arm: str
    attempts: int
    place_position: tuple[float, float, float]
    duration: float
    object_position: tuple[float, float, float] | None = None
    route: str = ""
    options: tuple[Option, ...] = ()
    state_times: tuple[StateTime, ...] = ()
    recording: str = ""


@dataclass(frozen=True)
class PairResult(Answer):
    """How two grasps that were asked for at once ended.

    Success: of both; else the code is that of the first that failed.

    Attributes:
        outcome: SUCCESS; PARTIAL: one of them, or picked and not placed as asked; FAILED; REFUSED: none was touched;
            CANCELLED.
        simultaneous: Both arms moved at the same time.
        results: Results in the order asked; none when they were not taken.
        duration: s of robot time.
        recording: Path of the flight recording of a failure; "" when there is none.
    """

    outcome: str
    simultaneous: bool
    results: tuple[GraspResult, ...]
    duration: float
    recording: str = ""


class GraspClient(BackgroundNode):
    """Asks the grasp node, also from several threads; a context manager.

    It brings its own ROS context, node and background thread, so it also works next to an rclpy program.

    Args:
        timeout: Longest wait for the grasp node to be there and to answer, s of wall clock.

    Example:
        ``with GraspClient() as grasp: print(grasp.pick("red").message)``
    """

    def __init__(self, *, timeout: float = 10.0) -> None:
        super().__init__("grasp_client", timeout=timeout)
        self._stops: set[threading.Event] = set()

    def pick(
        self,
        label: str = "",
        *,
        arm: str = "auto",
        place: Sequence[float] | None = None,
        place_yaw: float | None = None,
        object_at: Sequence[float] | None = None,
        exclude_near: Sequence[Sequence[float]] = (),
        place_choices: Sequence[Sequence[float]] = (),
        phase: str = "all",
        dry_run: bool = False,
        confirm: OnPlan | bool = False,
        time_limit: float = 0.0,
        speed: float = 0.0,
        timeout: float = 300.0,
        on_feedback: OnFeedback | None = None,
    ) -> GraspResult:
        """Pick an object and place it; returns when that has ended, well or not.

        Args:
            label: Object to pick, in words, such as "red can", or "red on:blue box"; "" takes the detection with the
                highest score.
            arm: "auto", "left" or "right".
            place: (x, y) or (x, y, z) of the footprint centre, base frame, m; z is not read. None lets a free spot be
                chosen.
            place_yaw: Yaw of the object's x axis about the base z where it is put down, rad; None: unconstrained.
            object_at: (x, y) near which the object stands, base frame, m, when there are several alike.
            exclude_near: (x, y) of objects that stay where they are.
            place_choices: (x, y) of which a free one is chosen without a `place`, base frame, m; none: anywhere.
            phase: "all"; "pick": end with the object in the hand; "place": put down what the hand holds;
                "aside": push the object away from where it is.
            dry_run: Plan and report, do not move.
            confirm: Called in the thread of the caller with the `GraspStatus` of each plan that waits (its `plan_id`,
                `arm`, and `reason` in a sentence); whether that plan is executed. True: plans wait for somebody else,
                who calls `confirm` or /grasp/confirm. False: nothing waits.
            time_limit: s of robot time; then it ends with TIMEOUT, the hand keeping what it holds. 0: none.
            speed: Share of the limits of the joints, 0.001 to 1; 0: that of the grasp node.
            timeout: s of wall clock; then the grasp is cancelled.
            on_feedback: Called with each `GraspStatus`, in the background thread; it may call `cancel`.

        Returns:
            The result; `raise_for_code` turns a failure into an exception.

        Raises:
            OpenArmError: NOT_READY, when no grasp node answers; TIMEOUT; INVALID_ARGUMENT, for a place that is not two
                or three numbers.
        """
        asked = GraspRequest.of(
            label,
            arm=arm,
            place=None if place is None else tuple(place),
            place_yaw=place_yaw,
            object_at=None if object_at is None else tuple(object_at),
            exclude_near=tuple((p[0], p[1]) for p in exclude_near),
            place_choices=tuple((p[0], p[1]) for p in place_choices),
            phase=phase,
            dry_run=dry_run,
            timeout=time_limit,
            velocity_scale=speed,
        )
        return self.carry_out(asked, confirm=confirm, timeout=timeout, on_feedback=on_feedback)

    def carry_out(
        self,
        asked: GraspRequest,
        *,
        confirm: OnPlan | bool = False,
        timeout: float = 300.0,
        on_feedback: OnFeedback | None = None,
    ) -> GraspResult:
        """Carry out a request; the other arguments, the result and the errors are those of `pick`."""
        goal = Pick.Goal()
        fill_request(goal, replace(asked, confirm=bool(confirm)))
        return _result(self._ask(Pick, "/grasp/pick", goal, timeout, on_feedback, confirm))

    def confirm(self, plan_id: str, *, accept: bool) -> Answer:
        """Confirm or reject the plan that waits, of whichever client."""
        request = ConfirmPlan.Request(plan_id=plan_id, accept=accept)
        return _answer(self.call(ConfirmPlan, "/grasp/confirm", request, self._timeout))

    def release(self, arm: str = "") -> Answer:
        """Open a hand where it is, and forget what it held; "" is the one that holds something."""
        return _answer(self.call(ReleaseHand, "/grasp/release", ReleaseHand.Request(arm=arm), _RELEASE_S))

    def learn_hand(self, arm: str) -> Answer:
        """Learn where the fingers of a hand stop: it closes, opens and closes. Nothing may be between them."""
        answer: Trigger.Response = self.call(Trigger, f"/grasp/learn_hand/{arm}", Trigger.Request(), _LEARN_S)
        if answer.success:
            return Answer(True, Code.OK, answer.message)
        code, _, text = answer.message.partition(": ")
        return Answer(False, code_from_text(code, Code.INTERNAL), text)

    def pick_two(
        self,
        first: str | GraspRequest,
        second: str | GraspRequest,
        *,
        dry_run: bool = False,
        time_limit: float = 0.0,
        speed: float = 0.0,
        timeout: float = 300.0,
        on_feedback: OnFeedback | None = None,
    ) -> PairResult:
        """Pick two objects and place them, with both arms at the same time where planning allows that.

        Args:
            first: Words for an object, or a request, of which `dry_run`, `confirm`, `phase`, `timeout` and
                `velocity_scale` are not read.
            second: Another.
            dry_run: Plan and report, do not move.
            time_limit: s of robot time for both; then they end with TIMEOUT, hands keeping what they hold. 0: none.
            speed: Share of the limits of the joints, 0.001 to 1; 0: that of the grasp node.
            timeout: s of wall clock; then both are cancelled.
            on_feedback: Called with each `GraspStatus`, which says of what label and arm it is, in the background
                thread; it may call `cancel`.

        Returns:
            The result; `raise_for_code` turns a failure into an exception.

        Raises:
            OpenArmError: Same as `pick`.
        """
        goal = PickTwo.Goal(dry_run=dry_run, timeout=time_limit, velocity_scale=speed)
        for request, wanted in zip(goal.requests, (first, second), strict=True):
            fill_request(request, GraspRequest.of(wanted) if isinstance(wanted, str) else wanted)
        answer: PickTwo.Result = self._ask(PickTwo, "/grasp/pick_two", goal, timeout, on_feedback)
        results = tuple(_result(one) for one in answer.results)
        return PairResult(**_same(answer, "simultaneous", "recording"), results=results)

    def cancel(self) -> None:
        """Ask all that runs to stop; it returns with CANCELLED, the arms holding where they are. From any thread."""
        for stop in tuple(self._stops):
            stop.set()

    def _ask(
        self,
        kind: Any,
        name: str,
        goal: object,
        timeout: float,
        on_feedback: OnFeedback | None,
        confirm: OnPlan | bool = False,
    ) -> Any:
        """Send a goal and return its result message."""
        stop = threading.Event()
        plans: queue.SimpleQueue[GraspStatus] = queue.SimpleQueue()

        def deliver(feedback: Any) -> None:
            if feedback.status.plan_id:
                plans.put(feedback.status)
            if on_feedback is not None:
                on_feedback(feedback.status)

        def answer() -> None:
            while callable(confirm) and not plans.empty():
                plan = plans.get()
                self.confirm(plan.plan_id, accept=confirm(plan))

        self._stops.add(stop)
        try:
            return self.do(kind, name, goal, timeout=timeout, on_feedback=deliver, stop=stop, meanwhile=answer)
        finally:
            self._stops.discard(stop)


def _answer(message: ConfirmPlan.Response | ReleaseHand.Response) -> Answer:
    code = Code.OK if message.success else code_from_text(message.code, Code.INTERNAL)
    return Answer(message.success, code, message.message)


def _result(message: Pick.Result | PickResult) -> GraspResult:
    x, y, z = (float(v) for v in xyz(message.place_position))
    same = _same(message, "label", "arm", "attempts", "route")
    if not isinstance(message, PickResult):
        same |= {"options": tuple(map(option_from_msg, message.options)), "recording": message.recording}
    times = tuple(StateTime(one.state, one.duration, one.budget, one.longest) for one in message.state_times)
    u, v, w = (float(value) for value in xyz(message.object_position))
    seen = (u, v, w) if message.has_object_position else None
    return GraspResult(**same, place_position=(x, y, z), object_position=seen, state_times=times)


def _same(message: Pick.Result | PickResult | PickTwo.Result, *names: str) -> dict[str, Any]:
    """The code, and the fields that a result has by the same name as its message."""
    code = Code.OK if message.success else code_from_text(message.code, Code.INTERNAL)
    fields = ("success", "outcome", "message", "duration", *names)
    return {"code": code} | {name: getattr(message, name) for name in fields}
