# SPDX-License-Identifier: Apache-2.0
"""Node `detector` with the other ways to see; the network is a file that always gives the same box."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from rclpy.parameter import Parameter

from openarm_bringup.ros.object_client import DetectionListener
from openarm_common import se3
from openarm_common.errors import Code
from openarm_common.ros.convert import pose_to_matrix, stamp_to_ns
from openarm_common.ros.detections import UNKNOWN, detections_from_msg
from openarm_common.wanted import select
from openarm_perception.ros.detector_node import DetectNode
from tests.nodes.detect_bench import TABLE, TOP, Bench, FakeCamera
from tests.openarm_perception.onnx_file import boxes, write_network
from tests.refusals import refuses
from tests.tag_paint import paint


@pytest.fixture
def camera(ros) -> FakeCamera:
    return FakeCamera(ros)


@pytest.fixture
def model(camera, tmp_path) -> str:
    """A network that sees a box where the camera shows one."""
    rows, columns = camera.patch
    box = (columns.start, rows.start, columns.stop, rows.stop, 0, 0.8)
    return str(write_network(tmp_path / "net.onnx", boxes(box), (1, 3, 480, 640)))


def change(bench: Bench, **values) -> list:
    """Set parameters of the running node; dots are double underscores."""
    return bench.node.set_parameters([Parameter(k.replace("__", "."), value=v) for k, v in values.items()])


def becomes(bench: Bench, *expected: list[str]) -> None:
    """Frames until the objects are called so; an answer to a frame before a change may still be on its way."""

    def heard() -> bool:
        message = bench.watch.got[-1] if bench.watch.got else None
        if message is None or stamp_to_ns(message.header.stamp) <= began:
            return False
        return [[r.hypothesis.class_id for r in found.results] for found in message.detections] == list(expected)

    began = bench.t_ns
    bench.pump(heard, f"detections called {expected}")


@pytest.mark.parametrize(
    ("detector", "called"),
    [("network", ["red", "box"]), ("tag", ["tag_7", "red", "box"]), ("anything", ["anything", "red", "box"])],
)
@pytest.mark.requirement("P-17")
def test_every_detector_finds_the_box_behind_the_same_topic(ros, camera, model, detector, called) -> None:
    if detector == "tag":
        T_camera_top = se3.inverse(camera.T_base_optical) @ se3.make(se3.rot_z(0.3), (0.30, -0.20, TOP))
        paint(camera.rgb, camera.depth, camera.K, T_camera_top, 7, 0.024)
    bench = Bench(ros, camera=camera, detector=detector, **{"network.model": model})
    (found,) = bench.detect().detections
    assert [r.hypothesis.class_id for r in found.results] == called
    np.testing.assert_allclose(pose_to_matrix(found.bbox.center)[:3, 3], (0.30, -0.20, TABLE + 0.025), atol=0.002)
    size = found.bbox.size
    np.testing.assert_allclose((size.x, size.y, size.z), (0.04, 0.06, 0.05), atol=0.0025)
    bench.said("in view: " + called[0])
    values = {v.key: v.value for v in bench.diagnostics.got[-1].status[0].values}
    assert values["detector"] == detector
    assert float(values["processing_ms"]) > 0.0
    assert float(values["rate_hz"]) >= 0.0


@pytest.mark.requirement("B-69")
def test_the_detector_is_switched_while_it_runs(ros, camera, model, tmp_path) -> None:
    """What is set holds from the next frame on; what cannot be is refused with a reason, and the one before goes on."""
    bench = Bench(ros, camera=camera, **{"network.model": model})
    becomes(bench, ["red", "box"])
    assert change(bench, detector="anything")[0].successful
    becomes(bench, ["anything", "red", "box"])
    blind = write_network(tmp_path / "blind.onnx", boxes(), (1, 3, 480, 640))
    assert change(bench, network__model=str(blind), detector="network")[-1].successful
    becomes(bench)
    (refused,) = change(bench, network__model="nothing.onnx")
    assert not refused.successful
    assert "there is no network 'nothing.onnx'; models: " in refused.reason
    (refused,) = change(bench, detector="hearing")
    assert "'color', 'network', 'both', 'tag' or 'anything'" in refused.reason
    (refused,) = change(bench, network__threshold=1.5)
    assert "less than 1" in refused.reason
    (refused,) = change(bench, network__classes=["pear"])
    assert "blind.onnx knows no 'pear'; classes: box, ball" in refused.reason
    assert bench.node.config.network.model == str(blind)
    becomes(bench)
    assert change(bench, detector="color")[0].successful
    becomes(bench, ["red", "box"])
    assert change(bench, label="blue")[0].successful
    becomes(bench)


def test_only_another_network_is_read_from_its_file(ros, camera, model) -> None:
    """The file is taken away while the node runs: all else may change; the colour detector forgets the network."""
    bench = Bench(ros, camera=camera, detector="network", **{"network.model": model})
    becomes(bench, ["red", "box"])
    Path(model).unlink()
    for values in ({"label": "red"}, {"policy": "centre"}, {"network__threshold": 0.4}, {"network__max_overlap": 0.5}):
        (answer,) = change(bench, **values)
        assert answer.successful, answer.reason
    assert change(bench, detector="both")[0].successful
    becomes(bench, ["red", "box"])
    assert change(bench, network__threshold=0.9)[0].successful
    becomes(bench, ["red"])  # colour alone sees it now
    assert change(bench, detector="color")[0].successful
    (refused,) = change(bench, detector="network")
    assert "there is no network" in refused.reason


@pytest.mark.parametrize("detector", ["color", "network", "both"])
@pytest.mark.requirement("N-15")
def test_the_node_does_not_start_with_a_network_that_cannot_be_used(ros, tmp_path, detector: str) -> None:
    """Of whichever detector; `openarm up` shows why, as of any parameter that is wrong."""
    path = tmp_path / "damaged.onnx"
    path.write_bytes(b"no network")
    with refuses(Code.CONFIG_INVALID, rf"network {path} \(10 bytes\) is damaged or no ONNX file"):
        ros.start(DetectNode, detector=detector, **{"network.model": str(path)})


def test_a_network_that_is_set_for_later_is_refused_at_once(ros, camera, model) -> None:
    bench = Bench(ros, camera=camera, **{"network.model": model})
    (refused,) = change(bench, network__model="nothing.onnx")
    assert "there is no network 'nothing.onnx'; models: " in refused.reason
    assert bench.node.config.network.model == model


@pytest.mark.requirement("N-16")
def test_what_only_colour_sees_is_reported_but_not_given_to_be_grasped(ros, camera, tmp_path) -> None:
    """Published as detected but not measured: an obstacle."""
    blind = write_network(tmp_path / "blind.onnx", boxes(), (1, 3, 480, 640))
    bench = Bench(ros, camera=camera, detector="both", **{"network.model": str(blind)})
    (found,) = bench.detect().detections
    assert found.results[0].pose.covariance[0] == UNKNOWN
    assert 0.0 < found.results[0].hypothesis.score <= 1.0
    bench.said("the network detects nothing there; it is observed again")


@pytest.mark.requirement("R-18", "B-18")
def test_classes_of_a_users_own_network_are_told_from_colour_and_shape(ros, camera, tmp_path) -> None:
    """Plain class ids for any consumer; the order is the same in the image and in space."""
    rows, columns = camera.patch
    box = (columns.start, rows.start, columns.stop, rows.stop, 1, 0.8)
    names = str(["mug", "Coca Cola 1/2"])
    path = write_network(tmp_path / "own.onnx", boxes(box), (1, 3, 480, 640), names)
    bench = Bench(ros, camera=camera, detector="network", **{"network.model": str(path)})
    (found,) = bench.detect().detections
    assert [r.hypothesis.class_id for r in found.results] == ["Coca Cola 1/2", "red", "box"]
    (thing,) = detections_from_msg(bench.watch.got[-1])
    assert (thing.name, thing.color, thing.kind) == ("Coca Cola 1/2", "red", "box")
    for words in ("coca cola 1/2", "red", "box", "red Coca Cola 1/2 box"):
        assert select(words, [thing]) == (thing,)
    assert change(bench, label="mug")[0].successful
    becomes(bench)
    assert change(bench, label="red coca cola 1/2")[0].successful
    becomes(bench, ["Coca Cola 1/2", "red", "box"])


def test_requests_in_words_are_answered_by_the_running_detector(ros, camera, model) -> None:
    """`openarm detector find`: labels and shapes of the hypotheses, places and extents of the boxes."""
    bench = Bench(ros, camera=camera, detector="both", **{"network.model": model})
    with DetectionListener() as listener, ThreadPoolExecutor(1) as pool:
        answer = pool.submit(listener.next, 20.0)
        bench.pump(answer.done, "the listener hears the detector")
    things = answer.result()
    found = select("the leftmost red box", things)[0]
    assert (found.label, found.kind) == ("red", "box")
    np.testing.assert_allclose(found.p_base, (0.30, -0.20, TABLE + 0.025), atol=0.002)
    np.testing.assert_allclose(found.size, (0.04, 0.06, 0.05), atol=0.0025)
