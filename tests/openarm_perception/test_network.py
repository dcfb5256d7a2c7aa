# SPDX-License-Identifier: Apache-2.0
"""Networks in ONNX files: which are taken, which are refused by name, and what comes out."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_perception.detection import network
from openarm_perception.detection.detector import rank
from openarm_perception.detection.network import NetworkConfig, NetworkDetector
from tests.openarm_perception.onnx_file import boxes, field, write_endless, write_network
from tests.openarm_perception.onnx_layouts import BALL, BOX, OBB, READ
from tests.refusals import refused, refuses


def make(path, output, **kwargs) -> NetworkDetector:
    config = kwargs.pop("config", {})
    return NetworkDetector(NetworkConfig(model=str(write_network(path / "net.onnx", output, **kwargs)), **config))


IMAGE = np.zeros((480, 640, 3), np.uint8)


@pytest.mark.requirement("B-36", "B-38")
def test_boxes_of_the_input_are_boxes_of_the_image(tmp_path) -> None:
    """320x256 takes a 640x480 image at half its size, 8 rows lower."""
    network = make(tmp_path, boxes((100, 58, 130, 88, 0, 0.9), (200, 108, 240, 168, 1, 0.6)))
    found = {d.label: d for d in network.detect(IMAGE)}
    assert found["box"].origin == (200, 100)
    assert found["box"].size == (60, 60)
    assert found["box"].score == pytest.approx(0.9)
    assert found["ball"].centre == (439.5, 259.5)
    assert not found["ball"].truncated
    assert found["ball"].mask.all()


@pytest.mark.requirement("B-26")
def test_the_threshold_is_one_half_by_default(tmp_path) -> None:
    output = boxes((10, 20, 40, 60, 0, 0.49), (100, 58, 130, 88, 0, 0.51))
    assert [d.score for d in make(tmp_path, output).detect(IMAGE)] == pytest.approx([0.51])
    assert len(make(tmp_path, output, config={"threshold": 0.4}).detect(IMAGE)) == 2


@pytest.mark.requirement("B-27")
def test_policies_choose_among_several(tmp_path) -> None:
    found = make(tmp_path, boxes((10, 20, 40, 60, 0, 0.95), (150, 110, 180, 140, 0, 0.7))).detect(IMAGE)
    assert rank(found, "score", (640, 480))[0].score == pytest.approx(0.95)
    assert rank(found, "centre", (640, 480))[0].score == pytest.approx(0.7)


def test_a_box_at_the_border_is_cut_and_one_beyond_it_is_dropped(tmp_path) -> None:
    found = make(tmp_path, boxes((0, 58, 30, 88, 0, 0.9), (-50, 58, -20, 88, 1, 0.9))).detect(IMAGE)
    assert [(d.label, d.truncated, d.origin[0]) for d in found] == [("box", True, 0)]


def test_set_classes_looks_for_some_only_and_lists_what_it_knows(tmp_path) -> None:
    network = make(tmp_path, boxes((10, 20, 40, 60, 0, 0.9), (100, 58, 130, 88, 1, 0.9)))
    network.set_classes(["ball"])
    assert [d.label for d in network.detect(IMAGE)] == ["ball"]
    refused(r"net\.onnx knows no 'cube'; classes: box, ball", network.set_classes, ["ball", "cube"])
    network.set_classes([])
    assert len(network.detect(IMAGE)) == 2


@pytest.mark.parametrize("classes", [1, 2, 3, 17, 80])
@pytest.mark.parametrize("size", [(256, 320), (480, 640), (640, 640)])
@pytest.mark.requirement("N-15")
def test_any_layout_of_yolov8_is_read(tmp_path, classes: int, size: tuple[int, int]) -> None:
    """The number of classes is that of the shape, the size of the input that of the file."""
    cells = sum(size[0] // s * (size[1] // s) for s in (8, 16, 32))
    names = [f"thing{i}" for i in range(classes)]
    output = boxes((64, 64, 96, 96, classes - 1, 0.8), cells=cells, classes=classes)
    network = make(tmp_path, output, shape=(1, 3, *size), names=str(names))
    assert network.names == tuple(names)
    assert network.size == size[::-1]
    assert [d.label for d in network.detect(np.zeros((*size, 3), np.uint8))] == [names[-1]]


@pytest.mark.requirement("N-15")
def test_sizes_that_the_file_leaves_free_are_those_of_the_configuration(tmp_path) -> None:
    network = make(tmp_path, boxes(), shape=("n", 3, "h", "w"), config={"width": 416, "height": 320})
    assert network.size == (416, 320)


def test_names_come_from_the_configuration_the_file_or_a_yaml(tmp_path) -> None:
    assert make(tmp_path, boxes(), config={"names": ("a", "b")}).names == ("a", "b")
    (tmp_path / "net.yaml").write_text("names: {0: c, 1: d}\n")
    assert make(tmp_path, boxes()).names == ("box", "ball")
    assert make(tmp_path, boxes(), names="").names == ("c", "d")
    (tmp_path / "net.yaml").unlink()
    refused(r"2 classes have no names: give them .* net\.yaml", make, tmp_path, boxes(), names="")
    refused("it has 2 classes, but its metadata names 1: box", make, tmp_path, boxes(), names="['box']")
    refused(r"expected {0: 'a', 1: 'b', …} or a list", make, tmp_path, boxes(), names="box; ball")


def test_numbers_of_the_metadata_are_those_of_the_classes_and_one_without_a_name_gets_one(tmp_path) -> None:
    output = boxes((100, 58, 130, 88, 2, 0.9), (200, 108, 240, 168, 1, 0.6), classes=3)
    network = make(tmp_path, output, names="{2: 'ball', 0: 'box'}")
    assert network.names == ("box", "class1", "ball")
    assert {d.label: d.origin for d in network.detect(IMAGE)} == {"ball": (200, 100), "class1": (400, 200)}
    words = "it has 2 classes, but its metadata names 3: box, class1, ball"
    refused(words, make, tmp_path, boxes(), names="{0: 'box', 2: 'ball'}")


@pytest.mark.parametrize("classes", [(), ("box",)])
def test_classes_of_one_name_are_one_class(tmp_path, classes) -> None:
    """Both are detected, and of two boxes that are as near as those of one object only the better one."""
    rows = ((100, 58, 130, 88, 0, 0.9), (200, 108, 240, 168, 1, 0.6), (100, 60, 130, 89, 1, 0.8))
    network = make(tmp_path, boxes(*rows), names="['box', 'box']", config={"classes": classes})
    assert [(d.label, d.origin) for d in network.detect(IMAGE)] == [("box", (400, 200)), ("box", (200, 100))]


@pytest.mark.parametrize("layout", READ)
@pytest.mark.requirement("N-15", "B-38", "M-03")
def test_every_layout_gives_the_same_boxes_of_the_same_classes(tmp_path, layout: str) -> None:
    output, more = READ[layout]
    found = make(tmp_path, output, **more).detect(IMAGE)
    assert [d.label for d in found] == ["ball", "box"]
    assert [d.score for d in found] == pytest.approx([0.6, 0.9], 1e-3)
    for one, box in zip(found, (BALL, BOX), strict=True):
        assert (*one.origin, *one.size) == (*box[:2], box[2] - box[0], box[3] - box[1])


def test_a_turned_box_becomes_the_box_around_it(tmp_path) -> None:
    """A square of 40 pixels on its corner is 56.6 wide."""
    output = np.zeros((1, 7, 100))
    output[0, :, 0] = (160, 128, 40, 40, 0.9, 0, np.pi / 4)
    (found,) = make(tmp_path, output, metadata=OBB).detect(IMAGE)
    assert found.size == (114, 114)
    assert found.centre == (319.5, 239.5)


def test_rows_of_no_class_are_none(tmp_path) -> None:
    """As exporters pad them."""
    rows = np.full((1, 300, 6), -1.0)
    rows[0, 0] = (10.0, 20.0, 60.0, 80.0, 0.9, 0.0)
    (found,) = make(tmp_path, rows).detect(IMAGE)
    assert found.label == "box"


def test_a_network_that_gives_no_row_for_a_grey_image_is_read(tmp_path) -> None:
    assert make(tmp_path, np.zeros((1, 0, 6))).detect(IMAGE) == ()


#: As of YOLO-NAS.
NAS = {"boxes": np.zeros((1, 84, 4), np.float32), "scores": np.zeros((1, 84, 9), np.float32)}
#: The answers to queries before the choice of the best, as of DETR.
QUERIES = {"boxes": np.zeros((1, 3, 4), np.float32), "logits": np.zeros((1, 3, 2), np.float32)}


@pytest.mark.parametrize(
    ("output", "kwargs", "words"),
    [
        (np.zeros((1, 1680, 7)), {}, r"output0 \(1, 1680, 7\).*not of YOLOX or YOLOv6.*`yolo export"),
        (np.zeros((1, 100, 9)), {}, r"output0 \(1, 100, 9\), and its metadata names 2 classes; expected"),
        (np.zeros((1, 4, 100)), {}, r"output0 \(1, 4, 100\).*expected \(1, 4 \+ classes, n\) as of YOLOv8"),
        (np.zeros((7, 100)), {}, r"output0 \(7, 100\)"),
        (np.zeros((2, 7, 100)), {}, r"output0 \(2, 7, 100\)"),
        (np.zeros((1, 38, 100)), {}, "it has 34 classes, but its metadata names 2: box, ball"),
        (np.zeros((1, 1000)), {"metadata": {"task": "classify"}}, "'classify', .* detect, segment, pose, obb"),
        (np.zeros((1, 6, 100)), {"metadata": {"task": "obb"}}, "it has 1 classes, but its metadata names 2"),
        (np.zeros((1, 57, 100)), {"metadata": {"task": "pose"}}, "it has 52 classes, but its metadata names 2"),
        (np.array([[[5, 5, 9, 9, 0.5, 3]]]), {}, r"finds class 3, but only 0 to 1 have names \(box, ball\): give all"),
        (np.full((1, 6, 100), 3.0), {}, "scores go from 0 to 3, expected 0 to 1; export it with its sigmoid"),
        (np.full((1, 6, 100), np.nan), {}, "no finite numbers; export it again, in float32"),
        (NAS, {"names": ""}, r"boxes \(1, 84, 4\), scores \(1, 84, 9\); expected"),
        (QUERIES, {"names": "['a']"}, r"boxes \(1, 3, 4\), logits \(1, 3, 2\); expected"),
        (boxes(), {"shape": (1, 1, 256, 320)}, r"its input is images \[1, 1, 256, 320\]"),
        (boxes(), {"shape": (1, 256, 320, 3)}, r"\[1, 256, 320, 3\].*channels first"),
        (boxes(), {"shape": (4, 3, 256, 320)}, "it takes 4 images at a time, expected one; export it with batch=1"),
        (boxes(), {"shape": (1, 3, 10**6, 320)}, "its input is 320x1000000 pixels, expected at most 4096x4096"),
        (boxes(), {"kind": 7}, r"tensor\(int64\); expected .* of float, float16 or uint8"),
        (boxes(), {"second": "scale_factor"}, r"images .*; scale_factor \[1, 2\] tensor\(int64\); expected one image"),
    ],
)
@pytest.mark.requirement("N-15")
def test_files_of_another_layout_are_refused_by_name(tmp_path, output, kwargs, words: str) -> None:
    with refuses(Code.CONFIG_INVALID, words) as caught:
        make(tmp_path, output, **kwargs)
    assert "net.onnx" in caught.value.message


def test_missing_and_damaged_files_are_refused_by_name(tmp_path) -> None:
    with pytest.raises(OpenArmError, match=r"there is no network .*nowhere\.onnx'; models: ") as caught:
        NetworkDetector(NetworkConfig(model=str(tmp_path / "nowhere.onnx")))
    assert "shapes_640x480" in caught.value.message
    refused("there is no network .*best.pt.* `yolo export", NetworkDetector, NetworkConfig(model="best.pt"))
    path = write_network(tmp_path / "half.onnx", boxes())
    path.write_bytes(path.read_bytes()[:200])
    with refuses(Code.CONFIG_INVALID, r"half\.onnx \(200 bytes\) is damaged or no ONNX file"):
        NetworkDetector(NetworkConfig(model=str(path)))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"version https://git-lfs.github.com/spec/v1", "is a pointer of Git LFS; get the file: git lfs pull"),
        (b"PK\x03\x04" + bytes(100), "is a file of PyTorch or an archive; export it: yolo export"),
        (b"", r"\(0 bytes\) is damaged or no ONNX file: No graph .*; export or copy it again"),
        ((field(8, field(1, b"") + field(2, 17)), field(8, field(1, b"") + field(2, 99))), "newer ONNX .* opset=17"),
        ((field(1, 8), field(1, 99)), "newer ONNX than onnxruntime .* reads; export it again with opset=17"),
        (
            (field(4, b"Identity"), field(4, b"NMS_TRTs")),
            r"operators that onnxruntime lacks \(.*NMS_TRTs\); .* plugins",
        ),
    ],
)
def test_files_that_onnxruntime_does_not_read_are_refused_with_a_way_out(tmp_path, data, words: str) -> None:
    path = write_network(tmp_path / "net.onnx", boxes())
    path.write_bytes(data if isinstance(data, bytes) else path.read_bytes().replace(*data))
    with refuses(Code.CONFIG_INVALID, words):
        NetworkDetector(NetworkConfig(model=str(path)))


def test_a_file_whose_weights_are_missing_names_them(tmp_path) -> None:
    path = write_network(tmp_path / "net.onnx", boxes())
    there = field(9, boxes().tobytes())
    place = b"./" * 1188 + b"nets.data"  # as long as what it replaces
    elsewhere = field(13, field(1, b"location") + field(2, place)) + field(14, 1)
    assert len(elsewhere) == len(there)
    path.write_bytes(path.read_bytes().replace(there, elsewhere))
    with refuses(Code.CONFIG_INVALID, r"has its weights in .*, which is missing; copy it there"):
        NetworkDetector(NetworkConfig(model=str(path)))


@pytest.mark.parametrize("growing", [False, True])
def test_a_network_that_never_ends_is_refused_in_bounded_time_and_memory(tmp_path, monkeypatch, growing: bool) -> None:
    monkeypatch.setattr(network, "_MOST_SECONDS", 60.0 if growing else 0.5)
    monkeypatch.setattr(network, "_MOST_BYTES", 2**28)
    path = write_endless(tmp_path / "endless.onnx", growing=growing)
    why = "it takes more memory" if growing else "it was stopped"
    with refuses(Code.CONFIG_INVALID, f"320x256 image within .* s and 0.25 GiB: .*{why}.*; export it again, without"):
        NetworkDetector(NetworkConfig(model=str(path)))


def test_without_onnxruntime_networks_are_refused_and_say_what_to_install(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert refused("needs onnxruntime, which is not installed", make, tmp_path, boxes()).code is Code.ENVIRONMENT


@pytest.mark.requirement("B-28")
def test_images_of_another_kind_are_refused(tmp_path) -> None:
    network = make(tmp_path, boxes())
    for image in (
        np.zeros((480, 640), np.uint8),
        np.zeros((480, 640, 4), np.uint8),
        np.zeros((480, 640, 3), np.float32),
    ):
        assert refused(r"expected .h, w, 3. of uint8", network.detect, image).code is Code.BAD_IMAGE


def test_other_numbers_do_not_read_the_file_again(tmp_path) -> None:
    """Thresholds and classes hold although the file is gone; another model needs its file, and the old one goes on."""
    network = make(tmp_path, boxes((10, 20, 40, 60, 0, 0.9), (100, 58, 130, 88, 1, 0.6)))
    network.path.unlink()
    strict = network.changed(network.config.model_copy(update={"threshold": 0.7}))
    balls = network.changed(network.config.model_copy(update={"classes": ("ball",)}))
    assert [d.label for d in strict.detect(IMAGE)] == ["box"]
    assert [d.label for d in balls.detect(IMAGE)] == ["ball"]
    assert sorted(d.label for d in network.detect(IMAGE)) == ["ball", "box"]
    with pytest.raises(OpenArmError, match="knows no 'pear'; classes: box, ball"):
        network.changed(network.config.model_copy(update={"classes": ("pear",)}))
    for read_with in ({"model": str(network.path.with_name("other.onnx"))}, {"width": 320}):
        refused("there is no network", network.changed, network.config.model_copy(update=read_with))


@pytest.mark.parametrize(
    "names",
    [
        "{0: 'a', '0': 'b'}", "{10_000_000: 'a'}", "{-1: 'a', 0: 'b'}", "'box'", "{'x': 'box'}", "5", "{0: 'box'",
        "[" * 100_000, "(" + "1+" * 20_000 + "1)", f"['{'x' * 100_000}']",
    ],
)  # fmt: skip
def test_hostile_names_are_refused_in_a_sentence(tmp_path: Path, names: str) -> None:
    path = write_network(tmp_path / "a.onnx", boxes(), names=names)
    error = refused(r"a\.onnx: its metadata has names", NetworkDetector, NetworkConfig(model=str(path)))
    assert len(error.message) < 500


@pytest.mark.parametrize("text", ["names: 5", "names: {x: box}", "names: {[1]: box}"])
def test_names_next_to_the_file_that_are_none_are_refused(tmp_path: Path, text: str) -> None:
    path = write_network(tmp_path / "a.onnx", boxes(), names="")
    path.with_suffix(".yaml").write_text(text)
    refused(r"a\.yaml", NetworkDetector, NetworkConfig(model=str(path)))
