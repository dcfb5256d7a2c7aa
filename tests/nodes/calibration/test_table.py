# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate table`: measured by a detector, stored by the publisher, taken over by every node."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest
from openarm_interfaces.srv import SaveTable
from tf2_msgs.msg import TFMessage

from openarm_bringup.commands.calibrate_live import table
from openarm_bringup.outcome import Outcome
from openarm_calibration.ros.publisher import PublisherNode
from openarm_calibration.store.store import CalibrationStore, StoredCalibration
from openarm_calibration.store.table import TABLE, TableStore
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL
from openarm_common.errors import Code
from openarm_common.records import default_folder
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.node import QOS_STATIC_TF
from openarm_common.ros.tf import table_height
from openarm_perception.ros.detector_node import DetectNode
from tests.nodes.detect_bench import TABLE as SEEN
from tests.nodes.detect_bench import Bench, FakeCamera

pytestmark = pytest.mark.usefixtures("own_store")

BASE_FRAME = RobotDescription.load().base

#: 15 mm below what the camera sees.
CONFIGURED = SEEN - 0.015


@pytest.fixture
def scene(tmp_path: Path) -> str:
    """A scene whose table is lower than the one that is seen."""
    path = tmp_path / "low.yaml"
    path.write_text(f"table: {{top_z: {CONFIGURED}}}\nobjects: []\n")
    return str(path)


class Heights:
    """The heights of the frame `table`."""

    def __init__(self, ros) -> None:
        self.got: list[float] = []
        ros.node.create_subscription(TFMessage, "/tf_static", self._take, QOS_STATIC_TF)

    def _take(self, message: TFMessage) -> None:
        height = table_height(message)
        self.got += [] if height is None else [height]

    @property
    def now(self) -> float:
        return self.got[-1] if self.got else 0.0


@pytest.mark.long
@pytest.mark.requirement("B-63", "R-15")
def test_a_table_15_mm_off_is_refused_measured_stored_and_right_for_both_detectors(ros, scene: str) -> None:
    camera = FakeCamera(ros)
    mount = camera.T_base_optical @ se3.inverse(T_LINK_OPTICAL)
    CalibrationStore(default_folder()).save(StoredCalibration.of_mount("overhead", BASE_FRAME, mount))
    ros.start(PublisherNode, scene=scene, period=0.05)
    heights = Heights(ros)
    wrist = ros.start(partial(DetectNode, namespace="hand"), camera="wrist")
    bench = Bench(ros, camera=camera, mounted=False, scene=scene)
    bench.said("no object is a target: TABLE_MISMATCH: the table is seen at 0.400 m, +15 mm from where it is expected")
    assert bench.detect().detections[0].results[0].pose.covariance[0] == -3.0

    def calibrate(**options) -> Outcome:
        """As typed next to the running graph."""
        with ThreadPoolExecutor(1) as worker:
            done = worker.submit(table, domain=int(os.environ["ROS_DOMAIN_ID"]), **options)
            bench.pump(done.done, "the command to end")
            return done.result()

    dry = calibrate(dry_run=True)
    assert dry.success, dry.message
    assert TableStore(default_folder()).find(TABLE) is None
    assert heights.now == pytest.approx(CONFIGURED)
    done = calibrate()
    assert done.success, done.message
    assert f"before {CONFIGURED:.4f} m" in done.message
    ros.spin_until(lambda: heights.now == pytest.approx(SEEN, abs=0.0005), what="the measured height")
    for node in (bench.node, wrist):
        ros.spin_until(lambda node=node: node.table_height == heights.now, what="it is taken over")
    (found,) = bench.detect().detections
    assert found.results[0].pose.covariance[0] > 0.0
    assert found.bbox.size.z == pytest.approx(0.05, abs=0.0015)
    block = calibrate(block_height=0.04, label="red")
    assert block.data["height"] == pytest.approx(SEEN + 0.01, abs=0.0015)
    TableStore(default_folder()).rollback(TABLE)
    ros.spin_until(lambda: heights.now == pytest.approx(SEEN, abs=0.0005), what="the height before")


@pytest.mark.requirement("B-63")
def test_a_stored_height_outlives_the_node_and_is_not_taken_for_another_table(ros, scene: str) -> None:
    ros.start(PublisherNode, scene=scene, period=0.05)
    heights, client = Heights(ros), ros.node.create_client(SaveTable, "/calibration_publisher/save_table")
    steep = ros.call(client, SaveTable.Request(height=SEEN, tilt=0.05, method="surface"))
    assert (steep.success, steep.code) == (False, Code.INTRINSICS_MISMATCH)
    high = ros.call(client, SaveTable.Request(height=float("nan"), method="surface"))
    assert (high.success, high.code) == (False, Code.INVALID_ARGUMENT)
    saved = ros.call(client, SaveTable.Request(height=SEEN, std=0.001, method="surface"))
    assert saved.success, saved.message
    assert saved.path == str(TableStore(default_folder()).path(TABLE))
    ros.spin_until(lambda: heights.now == SEEN, what="the stored height")
    store = TableStore(default_folder())
    assert store.in_use(CONFIGURED, None)[0] == SEEN
    assert store.in_use(0.40 + CONFIGURED, None)[0] == 0.40 + CONFIGURED, "of another scene"
    assert store.in_use(CONFIGURED, 3)[0] == CONFIGURED, "of another robot"
    store.path(TABLE).write_text("height: 0.5\n")
    height, _, fault = store.in_use(CONFIGURED, None)
    assert height == SEEN
    assert "last good one" in fault
