# SPDX-License-Identifier: Apache-2.0
"""Base of every node of the suite: parameters, QoS, diagnostics, worker threads, orderly shutdown."""

from __future__ import annotations

import faulthandler
import signal
import socket
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future as ThreadFuture
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import wraps
from inspect import iscoroutinefunction
from typing import Any, Generic, ParamSpec, TypeVar, get_args

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from openarm_interfaces.msg import ImageRates
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.callback_groups import CallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from openarm_common.config import AT_RUN_TIME, Config, validate
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.actions import RCLError, show_life
from openarm_common.ros.executor import WaitSetExecutor
from openarm_common.ros.log import PrintableLogger

#: By the parameter `executor` of a node.
EXECUTORS: dict[str, type[Executor]] = {"wait_set": WaitSetExecutor, "rclpy": SingleThreadedExecutor}
ConfigT = TypeVar("ConfigT", bound=Config)
P = ParamSpec("P")
R = TypeVar("R")

#: Topic of `openarm_interfaces/ImageRates`.
IMAGE_RATES = "/image_rates"
#: Time that a node has to stop motion before the process ends, s.
_HOLD = 2.0
_ENDING = (signal.SIGINT, signal.SIGTERM)


def _profile(depth: int, *, reliable: bool = True, latched: bool = False) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def reliable(depth: int) -> QoSProfile:
    """Return the profile reliable, volatile, keep last `depth`."""
    return _profile(depth)


def best_effort(depth: int) -> QoSProfile:
    """Return the profile best effort, volatile, keep last `depth`."""
    return _profile(depth, reliable=False)


#: Camera images, info, clouds as published (REP-2003).
QOS_SENSOR = _profile(5, reliable=False)
#: A subscriber that only ever wants the newest frame.
QOS_NEWEST = _profile(1, reliable=False)
QOS_COMMAND = _profile(10)
QOS_CLOCK = _profile(1, reliable=False)
QOS_TF = _profile(100)
QOS_LATCHED = _profile(1, latched=True)
#: As tf2: publishers keep one message each, the listener takes those of many publishers.
QOS_STATIC_TF = _profile(100, latched=True)


def offered_qos(node: Node, topic: str, depth: int) -> QoSProfile:
    """Return the quality of service that is compatible with all present publishers of a topic.

    Args:
        node: A node of the graph.
        topic: Absolute name; without a publisher, best effort and volatile.
        depth: Messages that may wait.
    """
    profiles = [info.qos_profile for info in node.get_publishers_info_by_topic(topic)]
    dependable = bool(profiles) and all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    latched = bool(profiles) and all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
    return _profile(depth, reliable=dependable, latched=latched)


@contextmanager
def until_shutdown(context: Context) -> Iterator[None]:
    """Let publishing fail when a signal has shut the context down in the meantime."""
    try:
        yield
    except RCLError:
        if context.ok():
            raise


class BaseNode(Node, Generic[ConfigT]):
    """A node with validated parameters, /diagnostics, a worker pool, and `steady_clock`, which no simulated time stops.

    Args:
        name: Node name.
        model: Configuration model; every field becomes a ROS parameter (nested models joined by dots), read-only but
            for those that are marked `AT_RUN_TIME`.
        kwargs: Passed to `rclpy.node.Node`.

    Raises:
        OpenArmError: CONFIG_INVALID, naming each wrong parameter.
    """

    #: Between two messages on /diagnostics, s of wall clock.
    REPORT_PERIOD_S = 1.0
    #: Other nodes of the process, which run in its executor and end with it.
    companions: tuple[BaseNode[Any], ...] = ()

    def __init__(self, name: str, model: type[ConfigT], **kwargs: Any) -> None:
        #: Messages that were refused, by topic.
        self.__refused = Counter[str]()
        self.__logger: PrintableLogger | None = None
        super().__init__(name, **kwargs)
        self.declare_parameter(
            "executor",
            "wait_set",
            ParameterDescriptor(
                description="wait_set: entities are kept from one wait to the next; rclpy: SingleThreadedExecutor",
                additional_constraints=f"one of {', '.join(EXECUTORS)}",
                read_only=True,
            ),
        )
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        data = _declare(self, model, "", {})
        self.config: ConfigT = validate(model, data, f"parameters of {self.get_fully_qualified_name()}")
        self.__pool = ThreadPoolExecutor(max_workers=4, thread_name_prefix=name)
        self.__description: RobotDescription | None = None
        self.__rates: dict[str, float] = {}
        self.__rates_out: Any = None
        self.__status = DiagnosticStatus(
            level=DiagnosticStatus.STALE, name=f"{self.get_name()}: status", hardware_id="openarm"
        )
        self.__diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", QOS_COMMAND)
        show_life(self)
        if "numba" in sys.modules:
            from openarm_common.compiling import announce  # numba is imported by nodes that have kernels

            announce(self.get_logger().info)
        self.create_timer(self.REPORT_PERIOD_S, self.__publish_diagnostics, clock=self.steady_clock)

    @property
    def default_callback_group(self) -> CallbackGroup:
        """Callbacks may overlap at their awaits: a coroutine that waits must not keep the others from running."""
        if not hasattr(self, "_BaseNode__group"):  # used in the constructor of Node
            self.__group = ReentrantCallbackGroup()
        return self.__group

    def get_logger(self) -> PrintableLogger:
        """The logger of the node, which makes text of others printable."""
        if self.__logger is None:
            self.__logger = PrintableLogger(super().get_logger().name)
        return self.__logger

    @property
    def description(self) -> RobotDescription:
        """The robot, loaded at first use."""
        if self.__description is None:
            self.__description = RobotDescription.load()
        return self.__description

    @description.setter
    def description(self, robot: RobotDescription) -> None:
        self.__description = robot

    def diagnose(self, ok: bool, message: str, **values: object) -> None:
        """Set what /diagnostics reports of this node once per second: OK or an error."""
        self.__report(DiagnosticStatus.OK if ok else DiagnosticStatus.ERROR, message, values)

    def diagnose_warning(self, message: str, **values: object) -> None:
        """The same of a warning."""
        self.__report(DiagnosticStatus.WARN, message, values)

    def __report(self, level: bytes, message: str, values: Mapping[str, object]) -> None:
        status = DiagnosticStatus(name=self.__status.name, hardware_id=self.__status.hardware_id, message=message)
        status.level = level
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        self.__status = status

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], *args: Any, **kwargs: Any
    ) -> Any:
        """Subscribe; what the callback refuses with an OpenArmError is counted, and reported now and then."""

        @wraps(callback)
        def take(*given: Any) -> Any:
            try:
                return callback(*given)
            except OpenArmError as error:
                self.refuse(topic, error)

        @wraps(callback)
        async def take_async(*given: Any) -> Any:
            try:
                return await callback(*given)
            except OpenArmError as error:
                self.refuse(topic, error)

        guarded: Any = take_async if iscoroutinefunction(callback) else take
        return super().create_subscription(msg_type, topic, guarded, *args, **kwargs)

    def take_images_at(self, rate: float, topics: Iterable[str]) -> None:
        """Tell who makes images how many of topics this node takes, Hz; 0: what is made for others is enough."""
        self.__rates |= dict.fromkeys(map(self.resolve_topic_name, topics), rate)
        if self.__rates_out is None:
            self.__rates_out = self.create_publisher(ImageRates, IMAGE_RATES, QOS_LATCHED)
        said = ImageRates(node=self.get_fully_qualified_name(), topics=[*self.__rates], rates=[*self.__rates.values()])
        self.__rates_out.publish(said)

    def create_service(self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **kwargs: Any) -> Any:
        """Offer a service; those that set parameters refuse a value of an unknown type, which would end rclpy."""
        if srv_type in (SetParameters, SetParametersAtomically):
            callback = _refusing_unknown_types(callback)
        return super().create_service(srv_type, srv_name, callback, **kwargs)

    def refuse(self, topic: str, error: OpenArmError) -> None:
        """Count a message that is refused, and report it now and then."""
        self.__refused[topic] += 1
        text = f"message of {topic} refused, {self.__refused[topic]} so far: {error.message}"
        self.get_logger().warning(text, throttle_duration_sec=5.0)

    def accept_changes(self, take: Callable[[ConfigT], None]) -> None:
        """Let parameters marked `AT_RUN_TIME` change: `take` gets the new configuration before it takes effect.

        A change that the model or `take` refuses with an OpenArmError has no effect; the client gets the reason.
        """

        def change(parameters: list[Parameter]) -> SetParametersResult:
            data = self.config.model_dump()
            for parameter in parameters:
                *groups, key = parameter.name.split(".")
                place = data
                for group in groups:
                    place = place.get(group, {})
                if key in place:  # else it is none of the model's, such as use_sim_time
                    place[key] = parameter.value
            try:
                config = validate(type(self.config), data, f"parameters of {self.get_fully_qualified_name()}")
                take(config)
            except OpenArmError as error:
                return SetParametersResult(successful=False, reason=error.message)
            self.config = config
            return SetParametersResult(successful=True)

        self.add_on_set_parameters_callback(change)

    def awaitable(self, work: ThreadFuture[Any]) -> Any:
        """Return an rclpy future (which carries no type) that a coroutine callback awaits for the outcome of a thread.

        A future that is completed in another thread does not wake a waiting executor; this one does. Cancelled work
        yields None.
        """
        future = Future(executor=self.executor)

        def done(ended: ThreadFuture[Any]) -> None:
            if ended.cancelled():
                future.cancel()
            elif (error := ended.exception()) is not None:
                future.set_exception(error)
            else:
                future.set_result(ended.result())
            if self.executor is not None:
                self.executor.wake()

        work.add_done_callback(done)
        return future

    def in_thread(self, fn: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> Any:
        """Run `fn` in a worker thread; await the returned future in a coroutine callback."""
        return self.awaitable(self.__pool.submit(fn, *args, **kwargs))

    def make_executor(self) -> Executor:
        """Return the executor that the parameter `executor` names.

        Raises:
            OpenArmError: CONFIG_INVALID, when it names none.
        """
        name = self.get_parameter("executor").value
        if name not in EXECUTORS:
            text = f"executor of {self.get_fully_qualified_name()} is {brief(str(name))}"
            raise OpenArmError(Code.CONFIG_INVALID, f"{text}; expected one of {', '.join(EXECUTORS)}")
        return EXECUTORS[name]()

    async def hold(self) -> None:
        """Stop all motion that the node commands; called before the process ends, while the graph is still there."""

    def close(self) -> None:
        """Stop worker threads, and take the companions down; subclasses with threads of their own extend this."""
        companions, self.companions = self.companions, ()
        for one in companions:
            one.close()
            one.destroy_node()
        self.__pool.shutdown(wait=True, cancel_futures=True)

    def __publish_diagnostics(self) -> None:
        status = self.__status
        refused = [KeyValue(key=f"refused/{topic}", value=str(count)) for topic, count in list(self.__refused.items())]
        status.values = [value for value in status.values if not value.key.startswith("refused/")] + refused
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self.__diagnostics.publish(message)


def _refusing_unknown_types(callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    known = {kind.value for kind in Parameter.Type}

    def answer(request: Any, response: Any) -> Any:
        wrong = [one for one in request.parameters if one.value.type not in known]
        if not wrong:
            return callback(request, response)
        text = f"parameter {brief(wrong[0].name)} has a value of type {wrong[0].value.type}, expected 0 .. {max(known)}"
        refusal = SetParametersResult(successful=False, reason=text)
        if hasattr(response, "results"):
            response.results = [refusal] * len(request.parameters)
        else:
            response.result = refusal
        return response

    return answer


def _declare(node: Node, model: type[BaseModel], prefix: str, defaults: Mapping[str, Any]) -> dict[str, Any]:
    data: dict[str, Any] = {}
    for key, field in model.model_fields.items():
        name = prefix + key
        default: Any = defaults.get(key, field.get_default(call_default_factory=True))
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            given: dict[str, Any] = default.model_dump() if isinstance(default, BaseModel) else default or {}
            data[key] = _declare(node, field.annotation, name + ".", given)
            continue
        descriptor = ParameterDescriptor(
            description=field.description or "",
            additional_constraints=_constraints(field),
            read_only=field.json_schema_extra != AT_RUN_TIME,
        )
        # Types are checked by the model, which says more (and takes 1 for 1.0) than rcl does.
        descriptor.dynamic_typing = True
        value = node.declare_parameter(name, _to_ros(default), descriptor).value
        if value is not None:
            data[key] = list(value) if hasattr(value, "tolist") else value
    return data


def _to_ros(value: Any) -> Any:
    if isinstance(value, tuple | list):
        items: list[Any] = list(value)  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
        return items
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def _constraints(field: FieldInfo) -> str:
    limits = [
        f"{symbol} {getattr(limit, key)}"
        for limit in field.metadata
        for key, symbol in _SYMBOLS.items()
        if getattr(limit, key, None) is not None
    ]
    choices = [repr(choice) for choice in get_args(field.annotation) if isinstance(choice, str)]
    return ", ".join(limits + (["one of " + ", ".join(choices)] if choices else []))


_SYMBOLS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}


def prepare() -> None:
    """Load what all nodes need: of a process that forks nodes, before it does."""
    from numba.core.registry import cpu_target

    RobotDescription.load()
    contexts: tuple[Any, Any] = cpu_target.typing_context, cpu_target.target_context
    for context in contexts:
        context.refresh()  # what the first kernel of a process would load
    messages = [module for name, module in list(sys.modules.items()) if name.endswith((".msg", ".srv", ".action"))]
    kinds: list[Any] = [type(one) for module in messages for one in vars(module).values() if isinstance(one, type)]
    for kind in kinds:
        if hasattr(kind, "__import_type_support__"):
            kind.__import_type_support__()


def run(factory: Callable[[], BaseNode[Any]]) -> None:
    """Run a node: create, spin until SIGINT or SIGTERM, shut down in order, exit.

    The process exits with 0 after a signal and with 1 when the node could not be created.
    """
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signals = _Signals()
    executor: Executor | None = None
    node: BaseNode[Any] | None = None
    code = 0
    try:
        node = factory()
        if not rclpy.ok():  # the signal came while the node was being made
            raise ExternalShutdownException
        executor = node.make_executor()
        for one in (node, *node.companions):
            executor.add_node(one)
        signals.node = node
        executor.spin()
    except OpenArmError as error:
        PrintableLogger("openarm").fatal(str(error))
        code = 1
    except ExternalShutdownException:
        pass  # the normal end
    except (RCLError, TypeError):  # the latter from an executor in a context that has ended
        if rclpy.ok():
            raise
        # The signal came while something of rcl was being made.
    finally:
        if executor is not None:
            executor.shutdown(timeout_sec=2.0)
        if node is not None:
            node.close()
            node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(code)


class _Signals:
    """Ends the context when SIGINT or SIGTERM comes, after `BaseNode.hold`: rclpy's own handlers end it at once.

    They are read in a thread: the main one may be waiting in rcl, where Python's handlers don't run. And these do
    nothing: a KeyboardInterrupt could cut the shutdown short. A SIGTERM after another signal, because the end takes too
    long, writes the stacks of all threads to stderr.
    """

    def __init__(self) -> None:
        self.node: BaseNode[Any] | None = None
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        for kind in _ENDING:
            signal.signal(kind, lambda *_: None)
        threading.Thread(target=self._wait, name="signals", daemon=True).start()

    def _wait(self) -> None:
        while self._reader.recv(1)[0] not in _ENDING:
            pass
        faulthandler.register(signal.SIGTERM)
        executor = self.node.executor if self.node is not None else None
        if self.node is not None and executor is not None:
            rested = threading.Event()
            executor.create_task(self.node.hold).add_done_callback(lambda _: rested.set())
            rested.wait(_HOLD)
        rclpy.try_shutdown()
