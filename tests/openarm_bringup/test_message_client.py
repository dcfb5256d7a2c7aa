# SPDX-License-Identifier: Apache-2.0
"""Messages as plain data and back."""

from __future__ import annotations

import sys

import pytest
from geometry_msgs.msg import PoseArray, PoseStamped
from openarm_interfaces.srv import Grasp
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import UInt8

from openarm_bringup.messages import fill, interface, to_data
from openarm_bringup.suggest import unknown
from openarm_common.errors import OpenArmError


def test_what_is_filled_in_is_read_back() -> None:
    data = {
        "header": {"stamp": {"sec": 3, "nanosec": 4}, "frame_id": "a"},
        "name": ["j1", "j2"],
        "position": [0.1, 2.0],
        "velocity": [],
        "effort": [1e-3],
    }
    assert to_data(fill(JointState(), data)) == data
    poses = fill(PoseArray(), {"poses": [{"position": {"x": 1}}, {"orientation": {"w": "1e-3"}}]})
    assert (poses.poses[0].position.x, poses.poses[1].orientation.w) == (1.0, 1e-3)
    assert list(fill(CameraInfo(), {"k": [float(i) for i in range(9)]}).k)[8] == 8.0
    assert fill(PoseStamped(), None) == PoseStamped()


def test_long_arrays_are_shown_as_their_size() -> None:
    image = Image(height=2, width=3, encoding="mono8", data=[0] * 600)
    assert to_data(image, 32)["data"] == "<600 values>"
    assert len(to_data(image)["data"]) == 600


@pytest.mark.parametrize(
    ("message", "data", "said"),
    [
        (Grasp.Request(), {"labl": "red"}, "no field of Grasp_Request 'labl'; did you mean label"),
        (Grasp.Request(), {"label": 3}, "label is 3; expected text"),
        (Grasp.Request(), {"dry_run": 1}, "dry_run is 1; expected true or false"),
        (Grasp.Request(), {"place_position": {"x": "a"}}, "place_position.x is 'a'; expected double"),
        (Grasp.Request(), [1], "expected a mapping of label"),
        (JointState(), {"position": 1.0}, "position is 1.0; expected a list of double"),
        (JointState(), {"header": {"stamp": {"sec": 1.5}}}, "header.stamp.sec is 1.5; expected a whole number"),
        (UInt8(), {"data": 300}, "data is 300; expected a whole number from 0 to 255"),
        (CameraInfo(), {"k": [1.0, 2.0]}, "k is [1.0, 2.0]; expected 9 values"),
    ],
)
def test_what_does_not_fit_is_named_with_what_was_expected(message: object, data: object, said: str) -> None:
    with pytest.raises(OpenArmError) as refused:
        fill(message, data)
    assert said in refused.value.message


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Grasp", "expected package/msg/Name"),
        ("no_msgs/msg/A", "'no_msgs' is not installed"),
        ("sensor_msgs/msg/Imag", "did you mean Image"),
    ],
)
def test_types_that_do_not_exist_are_refused(name: str, said: str) -> None:
    with pytest.raises(OpenArmError) as refused:
        interface(name)
    assert said in refused.value.message


def test_a_package_that_has_no_messages_is_not_imported() -> None:
    sys.modules.pop("this", None)
    with pytest.raises(OpenArmError, match="'this' is not installed"):
        interface("this/msg/A")
    assert "this" not in sys.modules


def test_names_that_are_nearly_right_are_suggested() -> None:
    assert "did you mean /grasp?" in unknown("service", "/graps", ["/grasp", "/octomap/reset"]).message
    assert "there are none" in unknown("topic", "/a", []).message
