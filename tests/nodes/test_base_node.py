# SPDX-License-Identifier: Apache-2.0
"""The node base: parameters from the model, diagnostics, worker threads, orderly end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
from functools import partial

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from pydantic import Field
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from std_srvs.srv import Trigger

from openarm_common.config import Config
from openarm_common.errors import OpenArmError
from openarm_common.ros.node import QOS_COMMAND, BaseNode


class _Limits(Config):
    force: float = Field(30.0, gt=0.0, description="N")


class _Example(Config):
    rate: float = Field(100.0, gt=0.0, le=1000.0, description="Hz")
    names: tuple[str, ...] = ("a", "b")
    seed: int | None = None
    limits: _Limits = _Limits()


@pytest.mark.requirement("B-62")
def test_parameters_come_from_the_model_and_take_overrides(ros) -> None:
    node = ros.start(partial(BaseNode, "example", _Example), rate=50, limits__force=5.0)
    assert node.config == _Example(rate=50.0, limits=_Limits(force=5.0))
    descriptor = node.describe_parameter("rate")
    assert descriptor.description == "Hz"
    assert "<= 1000" in descriptor.additional_constraints
    assert descriptor.read_only


def test_a_wrong_parameter_is_named_with_its_value(ros) -> None:
    with pytest.raises(OpenArmError, match=r"/example:rate: .*greater than 0.*got -1"):
        ros.start(partial(BaseNode, "example", _Example), rate=-1.0)


def test_a_value_of_an_unknown_type_is_refused_and_the_node_goes_on(ros) -> None:
    """It ends rclpy's own service, and with it the process."""
    ros.add(BaseNode("example", _Example))
    client = ros.node.create_client(SetParameters, "/example/set_parameters")
    value = ParameterMessage(name="rate")
    value.value.type = 255
    (answer,) = ros.call(client, SetParameters.Request(parameters=[value])).results
    assert not answer.successful
    assert answer.reason == "parameter 'rate' has a value of type 255, expected 0 .. 9"
    atomic = ros.node.create_client(SetParametersAtomically, "/example/set_parameters_atomically")
    assert not ros.call(atomic, SetParametersAtomically.Request(parameters=[value])).result.successful


def test_diagnostics_are_published_each_second(ros) -> None:
    got = ros.hear(DiagnosticArray, "/diagnostics", QOS_COMMAND)
    node = ros.add(BaseNode("example", _Example))
    node.diagnose(True, "all is well", frames=3)
    ros.spin_until(lambda: any(s.message == "all is well" for m in got for s in m.status), what="a status")
    status = got[-1].status[0]
    assert status.name == "example: status"
    assert status.level == b"\x00"
    assert {v.key: v.value for v in status.values} == {"frames": "3"}


def test_work_in_a_thread_leaves_the_node_answering_and_wakes_it(ros) -> None:
    node = ros.add(BaseNode("example", _Example))
    gate = threading.Event()

    async def slow(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = await node.in_thread(gate.wait, 20.0)
        return response

    def fast(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        return response

    node.create_service(Trigger, "slow", slow)
    node.create_service(Trigger, "fast", fast)
    slow_client, fast_client = (ros.node.create_client(Trigger, name) for name in ("slow", "fast"))
    ros.spin_until(slow_client.service_is_ready)
    pending = slow_client.call_async(Trigger.Request())
    assert ros.call(fast_client, Trigger.Request()).success
    assert not pending.done()
    gate.set()
    assert ros.result(pending).success


def test_an_error_in_a_thread_reaches_who_awaits_it(ros) -> None:
    node = ros.add(BaseNode("example", _Example))

    def fail() -> None:
        raise ValueError("wrong")

    future = node.in_thread(fail)
    ros.spin_until(future.done)
    with pytest.raises(ValueError, match="wrong"):
        future.result()


_SCRIPT = textwrap.dedent(
    """
    from openarm_common.config import Config
    from openarm_common.ros.node import BaseNode, run
    class Settings(Config):
        rate: float = 1.0
    class Example(BaseNode[Settings]):
        def __init__(self):
            super().__init__("example", Settings)
            print("ready", flush=True)
        def close(self):
            super().close()
            print("closed", flush=True)
    run(Example)
    """
)


@pytest.mark.requirement("P-34")
def test_a_signal_lets_the_node_bring_to_rest_what_it_moves_while_the_graph_is_there() -> None:
    spins = (
        "timer = self.create_timer(0.01, lambda: (timer.cancel(), print('ready', flush=True)), clock=self.steady_clock)"
    )
    script = _SCRIPT.replace('print("ready", flush=True)', spins).replace(
        "    def close(self):",
        """\
    async def hold(self):
        import asyncio, rclpy
        done = rclpy.task.Future(executor=self.executor)
        self.create_timer(0.1, lambda: done.done() or done.set_result(None), clock=self.steady_clock)
        await done
        print("held", rclpy.ok(), flush=True)
    def close(self):""".replace("\\\n", ""),
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, env=os.environ) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=60.0)
        assert (process.returncode, out) == (0, "held True\nclosed\n")


@pytest.mark.requirement("P-34")
def test_a_signal_ends_a_node_that_holds_an_arm_with_exit_code_0() -> None:
    """Its context is gone when it lets go."""
    holds = "from openarm_common.ros.holds import Holder; self.holder = Holder(self); self.holder.hold('left')"
    script = _SCRIPT.replace('print("ready", flush=True)', f"{holds}; print('ready', flush=True)").replace(
        "super().close()", "self.holder.release(); super().close()"
    )
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": os.environ}
    with subprocess.Popen([sys.executable, "-c", script], **pipes) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=60.0)
        assert (process.returncode, out) == (0, "closed\n"), error


def test_an_end_that_takes_too_long_is_located_by_a_second_signal() -> None:
    hangs = "print('closing', flush=True); import threading; threading.Event().wait()"
    script = _SCRIPT.replace("super().close()", hangs)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": os.environ}
    with subprocess.Popen([sys.executable, "-c", script], **pipes) as process:
        try:
            assert process.stdout.readline() == "ready\n"
            process.send_signal(signal.SIGINT)
            assert process.stdout.readline() == "closing\n"
            process.send_signal(signal.SIGTERM)
            lines = iter(process.stderr.readline, "")
            assert any("in close" in line for line in lines)
        finally:
            process.kill()


def test_a_wrong_parameter_ends_the_process_with_a_sentence_and_exit_code_1() -> None:
    command = [sys.executable, "-c", _SCRIPT, "--ros-args", "-p", "rate:=fast"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
    assert done.returncode == 1
    assert "rate" in done.stdout + done.stderr
    assert "Traceback" not in done.stderr
