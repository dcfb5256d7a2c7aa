# SPDX-License-Identifier: Apache-2.0
"""Messages with values that their fields can't hold are refused; the conversion to C would end the process at some."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from openarm_interfaces.action import Pick
from openarm_interfaces.srv import ResetWorld
from sensor_msgs.msg import CameraInfo, JointState
from std_msgs.msg import Bool, ByteMultiArray, Float64, Header, String, UInt8
from unique_identifier_msgs.msg import UUID

from openarm_common.errors import Code, OpenArmError
from openarm_common.fields import check_field, check_message
from openarm_common.ros.client import BackgroundNode

_INT64 = f"expected a whole number from {-(2**63)} to {2**63 - 1}"


def put(message: Any, name: str, value: Any) -> Any:
    """A message with a field that its setter has not checked."""
    setattr(message, f"_{name}", value)
    return message


@pytest.mark.parametrize(
    ("message", "said"),
    [
        *((put(ResetWorld.Request(), "seed", value), f"seed is {value!r}; {_INT64}") for value in ("7", float("nan"))),
        *((put(ResetWorld.Request(), "seed", value), f"seed is {value!r}; {_INT64}") for value in (2**63, None, True)),
        (put(ResetWorld.Request(), "seed", np.int64(7)), _INT64),
        (put(UInt8(), "data", 300), "data is 300; expected a whole number from 0 to 255"),
        (put(Float64(), "data", "1"), "data is '1'; expected a number"),
        (put(Bool(), "data", 1), "data is 1; expected true or false"),
        (put(String(), "data", b"red"), "data is b'red'; expected text"),
        (put(String(), "data", "\ud800"), "expected text that UTF-8 can hold"),
        (put(ByteMultiArray(), "data", [300]), "data[0] is 300; expected one byte"),
        (put(JointState(), "name", ["elbow", 3]), "name[1] is 3; expected text"),
        (put(JointState(), "name", "elbow"), "name is 'elbow'; expected a list of string"),
        (put(JointState(), "header", None), "header is None; expected a message of type std_msgs/Header"),
        (JointState(header=put(Header(), "frame_id", 3)), "header.frame_id is 3; expected text"),
        (put(CameraInfo(), "k", [1.0]), "k is [1.0]; expected 9 values"),
    ],
)
def test_a_field_that_can_t_hold_its_value_is_named_with_what_was_expected(message: Any, said: str) -> None:
    with pytest.raises(OpenArmError) as refused:
        check_message(message)
    assert refused.value.code is Code.INVALID_ARGUMENT
    assert said in refused.value.message


@pytest.mark.parametrize(("kind", "value"), [("string<3>", "four"), ("sequence<int8, 2>", [1, 2, 3])])
def test_bounds_of_texts_and_sequences_hold(kind: str, value: Any) -> None:
    with pytest.raises(OpenArmError, match="at most"):
        check_field(kind, value, "field")


@pytest.mark.parametrize(
    "message",
    [
        ResetWorld.Request(seed=2**63 - 1),
        Pick.Goal(label="rød"),
        JointState(name=["elbow"], position=np.zeros(3)),
        CameraInfo(),
        UUID(),
        ByteMultiArray(data=[b"\x00"]),
    ],
)
def test_messages_that_hold_what_their_types_say_pass(message: Any) -> None:
    check_message(message)


def test_a_client_refuses_to_send_what_would_end_its_process() -> None:
    never_started: Any = object.__new__(BackgroundNode)
    with pytest.raises(OpenArmError, match="seed is '7'"):
        BackgroundNode.call(never_started, ResetWorld, "/reset", put(ResetWorld.Request(), "seed", "7"))
    with pytest.raises(OpenArmError, match="timeout is 'x'"):
        BackgroundNode.do(never_started, Pick, "/pick", put(Pick.Goal(), "timeout", "x"), timeout=1.0)
