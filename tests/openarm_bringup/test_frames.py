# SPDX-License-Identifier: Apache-2.0
"""The tree of frames: whose frame it is, and how it is drawn."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage

from openarm_bringup.commands import tf
from openarm_bringup.ros.peer import Frames
from openarm_bringup.view.tree_picture import Row, write
from tests.refusals import refused

SVG = "{http://www.w3.org/2000/svg}"
ROWS = (Row(0, "world", True), Row(1, "base", True), Row(2, "arm", False), Row(1, "table <1>", True))


def published(parent: str, child: str, x: float = 0.0) -> TFMessage:
    edge = TransformStamped(child_frame_id=child)
    edge.header.frame_id = parent
    edge.transform.translation.x = x
    edge.transform.rotation.w = 1.0
    return TFMessage(transforms=[edge])


def test_one_publisher_may_publish_repeatedly() -> None:
    frames = Frames()
    for number in range(5):
        frames.add(published("base", "arm", 0.1 * number), number, False)
    frames.add(published("world", "base"), 1, True)
    frames.add(published("world", "base", 1.0), 2, True)  # a calibration was stored
    assert frames.clashes == {}
    assert frames.edges["arm"][1][0, 3] == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("second", "number", "static", "said"),
    [
        (published("world", "arm"), 8, False, "has the parents base and world"),
        (published("base", "arm"), 8, True, "is published on /tf and on /tf_static"),
        (published("base", "arm"), 7, False, "has two publishers on /tf"),
        (published("base", "arm"), 3, False, "has two publishers on /tf"),
    ],
)
def test_a_second_publisher_of_a_frame_is_named(second: TFMessage, number: int, static: bool, said: str) -> None:
    frames = Frames()
    frames.add(published("base", "arm"), 7, False)
    frames.add(second, number, static)
    assert frames.clashes == {"arm": said}


def test_every_frame_is_drawn_below_and_right_of_its_parent(tmp_path: Path) -> None:
    for suffix in (".png", ".svg", ".pdf"):
        write(ROWS, tmp_path / f"tree{suffix}")
    drawn = ElementTree.parse(tmp_path / "tree.svg").getroot()
    at = {text.text: (float(text.get("x")), float(text.get("y"))) for text in drawn.iter(f"{SVG}text")}
    assert set(at) == {row.name for row in ROWS} | {"moves with the joints: /tf", "fixed: /tf_static"}
    assert at["world"][0] < at["base"][0] == at["table <1>"][0] < at["arm"][0]
    assert at["world"][1] < at["base"][1] < at["arm"][1] < at["table <1>"][1]
    width, height = (float(drawn.get(key).removesuffix("pt")) for key in ("width", "height"))
    assert all(0.0 < x < width and 0.0 < y < height for x, y in at.values())
    picture = cv2.imread(str(tmp_path / "tree.png"))
    assert picture.shape[:2] == pytest.approx((2.0 * height, 2.0 * width), abs=2.0)
    left, base = 2.0 * np.array(at["arm"])
    disc = picture[round(base) - 20 : round(base), round(left) - 26 : round(left) - 4]
    assert (disc == (178, 92, 20)).all(axis=2).sum() > 100  # blue, as OpenCV orders it
    page = (tmp_path / "tree.pdf").read_bytes()
    assert page.startswith(b"%PDF-1.4")
    assert b"/Subtype /Image" not in page


def test_a_picture_that_cannot_be_written_says_why(tmp_path: Path) -> None:
    refused(r"ends in \.png, \.svg or \.pdf", write, ROWS, tmp_path / "tree.gif")
    refused(r"can't write .*No such file", write, ROWS, tmp_path / "none" / "tree.png")


def test_what_is_wrong_with_many_frames_is_said_once() -> None:
    clashes = {f"link{i}": "has two publishers on /tf" for i in range(6)} | {"eye": "has the parents a and b"}
    assert tf._grouped(clashes) == [
        "eye has the parents a and b",
        "each of link0, link1, link2, link3 and 2 more has two publishers on /tf",
    ]
