# SPDX-License-Identifier: Apache-2.0
"""Node `calibration_publisher`: mounts on /tf_static."""

from __future__ import annotations

import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo
from tf2_msgs.msg import TFMessage

from openarm_calibration.ros.publisher import PublisherNode
from openarm_calibration.store.store import CalibrationStore, StoredCalibration
from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics, load_cameras, true_mount
from openarm_common.errors import OpenArmError
from openarm_common.records import default_folder
from openarm_common.ros.convert import transform_to_matrix
from openarm_common.ros.images import lens_from_info
from openarm_common.ros.node import QOS_LATCHED, QOS_STATIC_TF
from openarm_common.scene.scene import load_scene

pytestmark = pytest.mark.usefixtures("own_store")


def edges(ros) -> dict[tuple[str, str], np.ndarray]:
    """What a late listener gets."""
    got = ros.hear(TFMessage, "/tf_static", QOS_STATIC_TF)
    ros.spin_until(lambda: got, what="/tf_static")
    assert len(got) == 1
    return {(e.header.frame_id, e.child_frame_id): transform_to_matrix(e.transform) for e in got[0].transforms}


@pytest.mark.requirement("A-73", "B-34")
def test_mounts_and_optical_frames_of_all_cameras(ros) -> None:
    """Parent → link is the nominal mount, link → optical the turn of the axes; a late listener gets them (latched)."""
    ros.add(PublisherNode())
    published = edges(ros)
    cameras = load_cameras()
    assert len(published) == 2 * len(cameras) + 1
    assert published["openarm_body_link0", "table"][2, 3] == load_scene("demo").table.top_z
    assert ("openarm_body_link0", "overhead_link") in published
    assert ("openarm_right_link7", "wrist_link") in published
    for name, camera in cameras.items():
        mount = published[camera.parent, f"{name}_link"]
        turn = published[f"{name}_link", f"{name}_color_optical_frame"]
        np.testing.assert_allclose(mount, camera.T_parent_link, atol=1e-9)
        # optical z is the link's x (forward), optical x is the link's -y (right)
        np.testing.assert_allclose(turn[:3, 2], (1.0, 0.0, 0.0), atol=1e-9)
        np.testing.assert_allclose(turn[:3, 0], (0.0, -1.0, 0.0), atol=1e-9)


def test_the_right_camera_of_a_pair_goes_with_the_left_one(ros, monkeypatch) -> None:
    """At the baseline to the right of it, also where the calibrated left one is turned."""
    monkeypatch.setenv("OPENARM_ROBOT", "openarm_v2_cell")
    right = load_cameras()["head_right"]
    T = se3.make(se3.exp_so3((0.1, 0.4, 0.2)), (0.1, 0.2, 0.3))
    parent = load_cameras()[right.left].parent
    CalibrationStore(default_folder()).save(StoredCalibration.of_mount(right.left, parent, T))
    ros.add(PublisherNode())
    offset = edges(ros)[parent, "head_right_link"][:3, 3] - T[:3, 3]
    np.testing.assert_allclose(offset, -right.baseline * T[:3, 1], atol=1e-6)


def test_a_camera_on_an_unknown_link_is_refused(ros, tmp_path) -> None:
    """The camera, its parent and the links that there are."""
    path = tmp_path / "cameras.yaml"
    path.write_text(
        "cameras: [{name: a, parent: nowhere, position: [0, 0, 0], forward: [1, 0, 0], image_right: [0, -1, 0]}]"
    )
    with pytest.raises(OpenArmError, match=r"parent 'nowhere' is no link of the robot; links: .*openarm_body_link0"):
        ros.start(PublisherNode, cameras=str(path))


def stored(x: float, seed: int | None, parent: str = "openarm_right_link7") -> StoredCalibration:
    T = se3.make(se3.exp_so3((0.1, 0.0, 0.2)), (x, 0.0, 0.08))
    return StoredCalibration.of_mount("wrist", parent, T, mount_seed=seed)


@pytest.mark.requirement("A-45")
def test_stored_calibrations_are_latched_and_a_change_arrives_without_a_restart(ros) -> None:
    """Stored, replaced, damaged (the last good one stays), rolled back."""
    store = CalibrationStore(default_folder())
    store.save(stored(0.10, 3))
    ros.start(PublisherNode, mount_seed=3, period=0.05)
    got = ros.hear(TFMessage, "/tf_static", QOS_STATIC_TF)

    def wrist() -> float:
        edge = [e for e in got[-1].transforms if e.child_frame_id == "wrist_link"] if got else []
        return edge[0].transform.translation.x if edge else 0.0

    ros.spin_until(lambda: wrist() == 0.10, what="the stored mount")
    path = store.save(stored(0.11, 3))
    ros.spin_until(lambda: wrist() == 0.11, what="the new mount")
    count = len(got)
    path.write_text("camera: wrist\n")
    ros.spin_until(lambda: len(got) > count, what="a message after the damage")
    assert wrist() == 0.11
    store.rollback("wrist")
    ros.spin_until(lambda: wrist() == 0.10, what="the mount before")


@pytest.mark.requirement("A-32", "R-15")
def test_the_intrinsics_of_the_calibration_in_use_are_latched_and_taken_back_without_a_record(ros) -> None:
    store, optics = CalibrationStore(default_folder()), Intrinsics(640, 480, 600.0, 601.0, 320.0, 240.0)
    store.save(stored(0.10, None).model_copy(update={"intrinsics": optics}))
    ros.start(PublisherNode, period=0.05)
    wrist = ros.hear(CameraInfo, "/calibration/wrist/camera_info", QOS_LATCHED)
    overhead = ros.hear(CameraInfo, "/calibration/overhead/camera_info", QOS_LATCHED)
    ros.spin_until(lambda: wrist and overhead, what="camera infos")
    assert lens_from_info(wrist[-1]).intrinsics == optics
    assert overhead[-1].width == 0, "the mount is nominal"
    store.save(stored(0.11, None))
    ros.spin_until(lambda: wrist[-1].width == 0, what="a calibration without intrinsics")


@pytest.mark.parametrize("wrong", [stored(0.2, 1), stored(0.2, None, "openarm_left_link7")])
def test_a_calibration_of_other_mounts_is_refused_and_the_nominal_mount_served(ros, wrong) -> None:
    """Another mount seed, another parent."""
    CalibrationStore(default_folder()).save(wrong)
    ros.add(PublisherNode())
    camera = load_cameras()["wrist"]
    np.testing.assert_allclose(edges(ros)[camera.parent, "wrist_link"], camera.T_parent_link, atol=1e-9)


@pytest.mark.parametrize("nominal", [False, True])
def test_the_suite_s_calibration_of_mount_seed_1_is_served_unless_the_nominal_mounts_are_asked_for(
    ros, nominal: bool
) -> None:
    ros.start(PublisherNode, mount_seed=1, nominal=nominal)
    published = edges(ros)
    for name in ("overhead", "wrist"):
        camera = load_cameras()[name]
        expected = camera.T_parent_link if nominal else true_mount(camera, 1)
        np.testing.assert_allclose(published[camera.parent, f"{name}_link"], expected, atol=1e-4)
