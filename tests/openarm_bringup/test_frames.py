# SPDX-License-Identifier: Apache-2.0
"""The tree of frames: whose frame it is, and how it is drawn."""

from __future__ import annotations

import re
import zlib
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage

from openarm_bringup.commands import tf
from openarm_bringup.ros.peer import Frames
from openarm_bringup.view.tree_picture import Row, lay_out, write
from openarm_common.errors import OpenArmError

ROWS = (Row(0, "world", True), Row(1, "base", True), Row(2, "arm", False), Row(1, "table <1>", True))


def told(parent: str, child: str, x: float = 0.0) -> TFMessage:
    edge = TransformStamped(child_frame_id=child)
    edge.header.frame_id = parent
    edge.transform.translation.x = x
    edge.transform.rotation.w = 1.0
    return TFMessage(transforms=[edge])


def test_one_publisher_may_tell_again_and_again() -> None:
    frames = Frames()
    for number in range(5):
        frames.add(told("base", "arm", 0.1 * number), number, False)
    frames.add(told("world", "base"), 1, True)
    frames.add(told("world", "base", 1.0), 2, True)  # a calibration was stored
    assert frames.clashes == {}
    assert frames.edges["arm"][1][0, 3] == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("second", "number", "static", "said"),
    [
        (told("world", "arm"), 8, False, "hangs below base and below world"),
        (told("base", "arm"), 8, True, "is told on /tf and on /tf_static"),
        (told("base", "arm"), 7, False, "is told by two on /tf"),
        (told("base", "arm"), 3, False, "is told by two on /tf"),
    ],
)
def test_a_second_publisher_of_a_frame_is_named(second: TFMessage, number: int, static: bool, said: str) -> None:
    frames = Frames()
    frames.add(told("base", "arm"), 7, False)
    frames.add(second, number, static)
    assert frames.clashes == {"arm": said}


def test_every_frame_is_drawn_below_and_right_of_its_parent(tmp_path: Path) -> None:
    layout = lay_out(ROWS)
    at = {text: (x, y) for x, y, text, _ in layout.words}
    assert at["world"][0] < at["base"][0] == at["table <1>"][0] < at["arm"][0]
    assert at["world"][1] < at["base"][1] < at["arm"][1] < at["table <1>"][1]
    assert all(0.0 < x < layout.width and 0.0 < y < layout.height for x, y, *_ in (*layout.words, *layout.dots))
    for suffix in (".png", ".svg", ".pdf"):
        write(ROWS, tmp_path / f"tree{suffix}")
    picture = cv2.imread(str(tmp_path / "tree.png"))
    assert picture.shape[:2] == (round(2 * layout.height), round(2 * layout.width))
    x, y = layout.dots[4][:2]  # after the two of the legend: world, base, arm
    np.testing.assert_array_equal(picture[round(2 * y), round(2 * x)], (178, 92, 20))  # blue, as OpenCV orders it
    drawn = ElementTree.parse(tmp_path / "tree.svg").getroot()
    assert {text.text for text in drawn.iter("{http://www.w3.org/2000/svg}text")} >= {row.name for row in ROWS}
    stream = re.search(rb"stream\n(.*)\nendstream", (tmp_path / "tree.pdf").read_bytes(), re.DOTALL)
    assert stream is not None
    assert b"(table <1>) Tj" in zlib.decompress(stream.group(1))


def test_a_picture_that_cannot_be_written_says_why(tmp_path: Path) -> None:
    with pytest.raises(OpenArmError, match=r"ends in \.png, \.svg or \.pdf"):
        write(ROWS, tmp_path / "tree.gif")
    with pytest.raises(OpenArmError, match=r"can't write .*No such file"):
        write(ROWS, tmp_path / "none" / "tree.png")


def test_what_is_wrong_with_many_frames_is_said_once() -> None:
    clashes = {f"link{i}": "is told by two on /tf" for i in range(6)} | {"eye": "hangs below a and below b"}
    assert tf._grouped(clashes) == [
        "eye hangs below a and below b",
        "each of link0, link1, link2, link3 and 2 more is told by two on /tf",
    ]
