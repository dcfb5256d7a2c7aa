# SPDX-License-Identifier: Apache-2.0
"""A detector that is a network in an ONNX file, run on the CPU by onnxruntime in one thread.

Any file in the layout of YOLOv8 will do: input (1, 3, h, w) of red, green, blue 0 to 1; output (1, 4 + classes, n) of
cx, cy, width, height in input pixels and a score per class, 0 to 1. Non-maximum suppression is done here.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from openarm_common.config import Config, RunTimeField, load_yaml
from openarm_common.detection import KINDS
from openarm_common.errors import Code, OpenArmError, said
from openarm_common.printable import brief
from openarm_common.resources import is_file, models_dir
from openarm_perception.detection.boxes import Candidates, Letterbox, blob, decode
from openarm_perception.detection.detector import Detection2D, Image, require_rgb

#: Boxes that come this near to the border of the image may be cut by it, pixels.
_BORDER = 2.0
#: What the file is read with; the rest of the configuration filters its boxes.
_OF_THE_FILE = {"model", "names", "width", "height"}
#: Longest text of the names of all classes in a file: it takes a hundred times as much memory while it is parsed.
_MAX_NAMES = 2**16
_LAYOUT = "expected the layout of YOLOv8: input (1, 3, h, w), output (1, 4 + classes, n)"


class NetworkConfig(Config):
    """Which network, and what counts as found."""

    model: str = RunTimeField(default="shapes_640x480", description="ONNX file, or a name in models/detector")
    names: tuple[str, ...] = RunTimeField(
        default=(), description="of the classes; empty: those of the file, or `names` of the YAML next to it"
    )
    classes: tuple[str, ...] = RunTimeField(default=(), description="classes that are detected; empty: all")
    threshold: float = RunTimeField(default=0.5, gt=0.0, lt=1.0, description="least score, 0..1")
    max_overlap: float = RunTimeField(
        default=0.6, gt=0.0, lt=1.0, description="boxes of one class that overlap more are one object (IoU)"
    )
    width: int = Field(
        default=640, ge=32, le=1920, multiple_of=32, description="of the input, where the file leaves it free, pixels"
    )
    height: int = Field(
        default=480, ge=32, le=1920, multiple_of=32, description="of the input, where the file leaves it free, pixels"
    )


class NetworkDetector:
    """Finds what a network was trained for. The masks of its detections are their whole boxes.

    Args:
        config: Which network.

    Raises:
        OpenArmError: CONFIG_INVALID, naming the file and what is wrong with it: missing, damaged, of another layout,
            without names for its classes; INVALID_ARGUMENT, when a class is configured that it does not know.
    """

    def __init__(self, config: NetworkConfig) -> None:
        self.config = config
        self.path = model_path(config.model)
        self._session = _open(self.path)
        self._input, self.size = self._check_input()
        classes = self._check_output()
        self.names = self._find_names(classes)
        self._wanted: frozenset[int] = frozenset()
        self.set_classes(config.classes)

    def changed(self, config: NetworkConfig) -> NetworkDetector:
        """The same network with other numbers; the file is read only where the configuration asks for another one.

        Raises:
            OpenArmError: As the constructor; this detector is as it was.
        """
        if config.model_dump(include=_OF_THE_FILE) != self.config.model_dump(include=_OF_THE_FILE):
            return NetworkDetector(config)
        other = copy.copy(self)
        other.config = config
        other.set_classes(config.classes)
        return other

    def set_classes(self, names: Sequence[str]) -> None:
        """Look only for classes of these names from now on; for all when there are none.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing the classes that the network knows.
        """
        unknown = [name for name in names if name not in self.names]
        if unknown:
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"{self.path.name} knows no {', '.join(map(repr, unknown))}; classes: {', '.join(self.names)}",
            )
        self._wanted = frozenset(self.names.index(name) for name in (names or self.names))

    def detect(self, rgb: Image) -> tuple[Detection2D, ...]:
        """Return objects of an image (h, w, 3) uint8, largest first.

        Raises:
            OpenArmError: BAD_IMAGE, for another shape or type.
        """
        found = self.candidates(rgb, self.config.threshold)
        height, width = rgb.shape[:2]
        out: list[Detection2D] = []
        for kind, score, box in zip(found.classes, found.scores, found.boxes, strict=True):
            left, top, right, bottom = (round(float(edge)) for edge in box)
            if kind not in self._wanted or right <= left or bottom <= top:
                continue
            cut = box[0] < _BORDER or box[1] < _BORDER or box[2] > width - _BORDER or box[3] > height - _BORDER
            centre = ((left + right - 1) / 2.0, (top + bottom - 1) / 2.0)
            size = (right - left, bottom - top)
            mask = np.ones((size[1], size[0]), np.bool_)
            what = self.names[kind]
            name, shape = ("", what) if what in KINDS else (what, "")
            out.append(Detection2D(name, float(score), centre, size, mask, bool(cut), shape))
        return tuple(sorted(out, key=lambda d: -d.area))

    def candidates(self, rgb: Image, threshold: float) -> Candidates:
        """Return everything from a score on, boxes in pixels of the image."""
        require_rgb(rgb)
        letterbox = Letterbox.fit((rgb.shape[1], rgb.shape[0]), self.size)
        output = self.run(blob(letterbox.place(rgb)))
        found = decode(output, threshold, self.config.max_overlap)
        return Candidates(found.classes, found.scores, letterbox.back(found.boxes))

    def run(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Run the network alone: (4 + classes, n) of an input (1, 3, h, w)."""
        return cast(NDArray[np.float32], self._session.run(None, {self._input: image})[0])[0]

    # --- contents of the file
    def _check_input(self) -> tuple[str, tuple[int, int]]:
        inputs = self._session.get_inputs()
        shape: list[Any] = list(inputs[0].shape)
        if len(inputs) != 1 or len(shape) != 4 or shape[1] != 3 or inputs[0].type != "tensor(float)":
            found = "; ".join(f"{item.name} {item.shape} {item.type}" for item in inputs)
            raise self._wrong(f"its input is {found}, of tensor(float); {_LAYOUT}")
        if shape[0] not in (1, None) and not isinstance(shape[0], str):
            raise self._wrong(f"it takes {shape[0]} images at a time, expected one; export it with a batch of 1")
        height, width = (
            size if isinstance(size, int) else free
            for size, free in zip(shape[2:], (self.config.height, self.config.width), strict=True)
        )
        return inputs[0].name, (width, height)

    def _check_output(self) -> int:
        """Return the number of classes, by the shape of what a grey image gives."""
        image = np.full((1, 3, self.size[1], self.size[0]), 0.5, np.float32)
        try:
            outputs = self._session.run(None, {self._input: image})
        # onnxruntime raises types of its own, which it does not document
        except Exception as error:
            raise self._wrong(f"it does not run on a {self.size[0]}x{self.size[1]} image: {said(error)}") from error
        first = np.asarray(outputs[0])
        if first.ndim != 3 or first.shape[0] != 1 or first.shape[1] < 5 or first.shape[1] > first.shape[2]:
            hint = ""
            if first.ndim == 3 and first.shape[1] > first.shape[2] >= 5:
                hint = "; that is the layout of YOLOv5, or a file exported with its own non-maximum suppression"
            raise self._wrong(f"its output has shape {first.shape}{hint}; {_LAYOUT}")
        scores = first[0, 4:]
        if not np.isfinite(first).all() or scores.min() < -1e-3 or scores.max() > 1.0 + 1e-3:
            raise self._wrong(
                f"its scores go from {scores.min():.3g} to {scores.max():.3g}, expected 0 to 1; export it with"
                " its sigmoid"
            )
        return int(first.shape[1]) - 4

    def _find_names(self, classes: int) -> tuple[str, ...]:
        if self.config.names:
            names, where = self.config.names, "the parameter names"
        else:
            try:
                metadata = dict(self._session.get_modelmeta().custom_metadata_map)
            except UnicodeDecodeError as error:
                raise self._wrong(f"its metadata are no text: {said(error)}") from error
            names, where = _names_of(self.path, metadata)
        if not names:
            raise self._wrong(
                f"its {classes} classes have no names: give them in the parameter names, or in"
                f" {self.path.with_suffix('.yaml').name} next to it (names: [a, b, …])"
            )
        if len(names) != classes:
            raise self._wrong(f"it has {classes} classes, but {where} names {len(names)}: {', '.join(names)}")
        return names

    def _wrong(self, text: str) -> OpenArmError:
        return OpenArmError(Code.CONFIG_INVALID, f"network {self.path}: {text}")


def model_path(model: str) -> Path:
    """Return the file of a model: a path, or a name in `models/detector`.

    Raises:
        OpenArmError: CONFIG_INVALID, listing the models that there are.
    """
    folder = models_dir() / "detector"
    path = Path(model) if model.endswith(".onnx") else folder / f"{model}.onnx"
    if not is_file(path):
        names = ", ".join(sorted(file.stem for file in folder.glob("*.onnx"))) or "none"
        raise OpenArmError(
            Code.CONFIG_INVALID, f"there is no network {str(path)!r:.300}; models: {names}, or the path of an ONNX file"
        )
    return path


def _open(path: Path) -> Any:
    """Return a session of onnxruntime, imported here alone: detection by colour does not need it."""
    try:
        import onnxruntime
    except ImportError as error:
        raise OpenArmError(
            Code.ENVIRONMENT, f"network {path} needs onnxruntime, which is not installed: pip install onnxruntime"
        ) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # cores are for the other nodes
    options.log_severity_level = 4  # the exception has the reason
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    # onnxruntime raises types of its own, which it does not document
    except Exception as error:
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"network {path} ({path.stat().st_size} bytes) is damaged or no ONNX file: {said(error)}; export or copy it"
            " again",
        ) from error


def _names_of(path: Path, metadata: Mapping[str, str]) -> tuple[tuple[str, ...], str]:
    """Names of the classes and their source: the metadata of the file (a Python or JSON mapping or list), or a YAML."""
    if "names" in metadata:
        where, text = "its metadata", metadata["names"]
    elif path.with_suffix(".yaml").is_file():
        where, text = path.with_suffix(".yaml").name, ""
    else:
        return (), "its metadata"
    names: Any = None
    try:
        if len(text) > _MAX_NAMES:
            raise ValueError("too long")
        names = ast.literal_eval(text) if text else load_yaml(path.with_suffix(".yaml")).get("names")
        if isinstance(names, dict):
            by_number = {int(key): value for key, value in cast(dict[Any, Any], names).items()}
            names = [by_number[key] for key in sorted(by_number)]
        return tuple(str(name) for name in cast(list[Any], names or [])), where
    # a text of many brackets is refused by the parser of Python with errors of memory or recursion
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError) as error:
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"network {path}: {where} has names {brief(text or names)}; expected {{0: 'a', 1: 'b', …}} or a list",
        ) from error
