# SPDX-License-Identifier: Apache-2.0
"""A detector that is a network in an ONNX file, run on the CPU by onnxruntime in one thread.

Its input is (1, 3, h, w) of red, green, blue, 0 to 1 (of uint8: 0 to 255). Its output has one of the layouts of
`layouts`; boxes around masks, key points and turned boxes are used, and the rest of those is not. Non-maximum
suppression is done here, where the network has done none.
"""

from __future__ import annotations

import ast
import copy
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from threading import Timer
from types import NoneType
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from openarm_common.config import Config, RunTimeField, load_yaml
from openarm_common.detection import KINDS
from openarm_common.errors import Code, OpenArmError, said
from openarm_common.printable import brief, brief_text, printable
from openarm_common.resources import is_file, models_dir
from openarm_perception.detection.boxes import Candidates, Letterbox, blob, suppress
from openarm_perception.detection.detector import Detection2D, Image, require_rgb
from openarm_perception.detection.layouts import END_TO_END, RT_DETR_ROWS, Layout, Table, layout_of

#: Boxes that come this near to the border of the image may be cut by it, pixels.
_BORDER = 2.0
#: What the file is read with; the rest of the configuration filters its boxes.
_OF_THE_FILE = {"model", "names", "width", "height"}
#: Longest text of the names of all classes in a file: it takes a hundred times as much memory while it is parsed.
_MAX_NAMES = 2**16
#: Largest number of a class, and largest side of an input, pixels: memory is taken for them.
_MOST_CLASSES, _LARGEST = 10_000, 4096
#: Names of classes that a message lists.
_LISTED = 20
#: Longest time that a network may take to be read, or for an image, and most memory of all networks of a process.
_MOST_SECONDS, _MOST_BYTES = 30.0, 4 * 2**30
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}
#: Outputs of DETR and its kin after their choice of the best.
_LABELLED = {"boxes", "scores", "labels"}
#: The input of RT-DETR for the (width, height) in which it gives boxes.
_TARGET = "orig_target_sizes"
#: Tasks of networks that give boxes, as the metadata names them.
_TASKS = ("detect", "segment", "pose", "obb")
#: What other files are, by their first bytes; and why onnxruntime does not read one, by what it says.
_OTHERS = {
    b"PK\x03\x04": "a file of PyTorch or an archive; export it: yolo export model=best.pt format=onnx, or unzip it",
    b"version https://git-lfs": "a pointer of Git LFS; get the file: git lfs pull",
}
_REASONS = (
    (r'External data path does not exist: "([^"]*)', "has its weights in {0}, which is missing; copy it there"),
    (
        "Opset [0-9]+ is under development|IR version",
        "is of a newer ONNX than onnxruntime {version} reads; export it again with opset=17, or update onnxruntime",
    ),
    (
        r"opset import for domain '(.*?)'|(\S+)\(-?\d+\) is not a registered function/op|No Op registered for (\S+)",
        "has operators that onnxruntime lacks ({0}{1}{2}); export it again without plugins",
    ),
)
_INPUT = "expected one image, channels first: (1, 3, h, w) of float, float16 or uint8 (tf2onnx: --inputs-as-nchw)"
_OUTPUT = (
    "expected (1, 4 + classes, n) as of YOLOv8, (1, n, 6) end to end, (1, n, 4 + classes) as of RT-DETR, (1, n, 5 +"
    " classes) as of YOLOv5 (not of YOLOX or YOLOv6, which take other images), or boxes, scores and labels;"
    " `yolo export model=best.pt format=onnx` of Ultralytics writes one"
)


class NetworkConfig(Config):
    """Which network, and what counts as found."""

    model: str = RunTimeField(
        default="shapes_640x480",
        description="ONNX file of YOLOv5 to YOLO26 or RT-DETR (boxes of the tasks detect, segment, pose, obb), or a"
        " name in models/detector",
    )
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
        config: File of the network, and its thresholds.

    Raises:
        OpenArmError: CONFIG_INVALID, naming the file and what is wrong with it: missing, damaged, of another layout,
            without names for its classes; INVALID_ARGUMENT, when a class is configured that it does not know.
    """

    def __init__(self, config: NetworkConfig) -> None:
        self.config = config
        self.path = model_path(config.model)
        self._session, self._metadata = _open(self.path)
        self._fed, self._type, self.size = self._check_inputs()
        self.names, self._layout, table = self._check_outputs()
        self._check_scores(table)
        #: Classes of one name are one class: the first.
        self._kinds = np.array([self.names.index(name) for name in self.names])
        self._wanted: frozenset[int] = frozenset()
        self.set_classes(config.classes)

    def changed(self, config: NetworkConfig) -> NetworkDetector:
        """The same network with other numbers; the file is read only where the configuration asks for another one.

        Raises:
            OpenArmError: Same as the constructor; this detector is as it was.
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
                f"{self.path.name} knows no {', '.join(map(repr, unknown))}; classes: {_listed(self.names)}",
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
        """Return everything from a score on, boxes in pixels of the image.

        Raises:
            OpenArmError: BAD_IMAGE, for another shape or type; CONFIG_INVALID, for a class that has no name.
        """
        require_rgb(rgb)
        letterbox = Letterbox.fit((rgb.shape[1], rgb.shape[0]), self.size, stretched=self._layout.stretched)
        image = letterbox.place(rgb)
        table = self.run(image.transpose(2, 0, 1)[None] if self._type is np.uint8 else blob(image))
        found = self._found(table, threshold)
        found = suppress(replace(found, classes=self._kinds[found.classes]), self.config.max_overlap)
        return Candidates(found.classes, found.scores, letterbox.back(found.boxes))

    def run(self, image: NDArray[Any]) -> Table:
        """Run the network alone on an input (1, 3, h, w): (channels, n) of its output, as `layouts` has it."""
        return self._layout.table(self._main(self._outputs(image)))

    def _outputs(self, image: NDArray[Any]) -> dict[str, NDArray[Any]]:
        import onnxruntime

        name, *others = self._fed
        fed = {name: image.astype(self._type, copy=False), **dict.fromkeys(others, np.array([self.size]))}
        options = onnxruntime.RunOptions()
        try:
            with _limited(lambda: setattr(options, "terminate", True)):
                outputs = self._session.run(None, fed, options)
            return {item.name: np.asarray(out) for item, out in zip(self._session.get_outputs(), outputs, strict=True)}
        # onnxruntime raises types of its own, which it does not document
        except Exception as error:
            why = "it takes more memory" if "BFCArena" in str(error) else said(error)
            why = "it was stopped" if options.terminate else why
            limits = f"{_MOST_SECONDS:g} s and {_MOST_BYTES / 2**30:g} GiB"
            raise self._wrong(
                f"it does not run on a {self.size[0]}x{self.size[1]} image within {limits}: {why}; export it again,"
                " without loops, or a smaller one"
            ) from error

    def _main(self, outputs: Mapping[str, NDArray[Any]]) -> NDArray[np.floating]:
        """Return the output (a, b) that has boxes, scores and classes."""
        main = next(iter(outputs.values()), np.empty(0))
        if outputs.keys() >= _LABELLED:
            boxes, scores, labels = outputs["boxes"], outputs["scores"], outputs["labels"]
            if boxes.size == 4 * scores.size == 4 * labels.size:
                main = np.concatenate([boxes.reshape(-1, 4), np.c_[scores.ravel(), labels.ravel()]], axis=1)[None]
        if main.ndim != 3 or len(main) != 1 or main.dtype.kind not in "fiu":
            raise self._unread(outputs)
        return main[0]

    def _found(self, table: Table, threshold: float) -> Candidates:
        found = self._layout.found(table, len(self.names), threshold, self.size)
        if not np.isfinite(found.boxes).all() or not np.isfinite(found.scores).all():
            raise self._wrong("its output has values that are no finite numbers; export it again, in float32")
        if strange := set(found.classes.tolist()) - set(range(len(self.names))):
            raise self._wrong(
                f"it finds class {min(strange)}, but only 0 to {len(self.names) - 1} have names"
                f" ({_listed(self.names)}): give all in the parameter network.names, '[a, b, …]'"
            )
        return found

    # --- contents of the file
    def _check_inputs(self) -> tuple[list[str], Any, tuple[int, int]]:
        """Return the names of the inputs, the type of the first, and its (width, height)."""
        inputs = self._session.get_inputs()
        shape: list[Any] = list(inputs[0].shape) if inputs else []
        kind = _TYPES.get(inputs[0].type) if inputs else None
        others = [item.name for item in inputs[1:]]
        if kind is None or len(shape) != 4 or shape[1] != 3 or others not in ([], [_TARGET]):
            found = "; ".join(f"{item.name} {item.shape} {item.type}" for item in inputs)
            raise self._wrong(f"its input is {found or 'missing'}; {_INPUT}")
        if isinstance(shape[0], int) and shape[0] != 1:
            raise self._wrong(f"it takes {shape[0]} images at a time, expected one; export it with batch=1")
        height, width = (
            size if isinstance(size, int) else free
            for size, free in zip(shape[2:], (self.config.height, self.config.width), strict=True)
        )
        if not (0 < width <= _LARGEST and 0 < height <= _LARGEST):
            raise self._wrong(f"its input is {width}x{height} pixels, expected at most {_LARGEST}x{_LARGEST}")
        return [inputs[0].name, *others], kind, (width, height)

    def _check_outputs(self) -> tuple[tuple[str, ...], Layout, Table]:
        """Return the names of the classes, the layout, and (channels, n) of a grey image, by which that is known."""
        grey = 127 if self._type is np.uint8 else 0.5
        outputs = self._outputs(np.full((1, 3, self.size[1], self.size[0]), grey, self._type))
        main, metadata = self._main(outputs), self._metadata
        if not np.isfinite(main).all():
            raise self._wrong("its output has values that are no finite numbers; export it again, in float32")
        extras = _extras(metadata, outputs)
        count = main.shape[0] - 4 - extras[0]
        many = 0 < count < main.shape[1]
        if not many and main.shape[1] < 6:
            raise self._unread(outputs)
        names, where = self._find_names(f"{count} classes" if many else "classes")
        layouts = (layout_of(main, len(names), extra, self.size) for extra in extras)
        layout = END_TO_END if outputs.keys() >= _LABELLED else next(filter(None, layouts), None)
        if layout is None:
            if many:
                text = f"it has {count} classes, but {where} names {len(names)}: {_listed(names)}"
                raise self._wrong(f"{text}; give {count} in the parameter network.names, '[a, b, …]'")
            raise self._unread(outputs, f", and {where} names {len(names)} classes")
        if metadata.get("task") == "obb":
            layout = replace(layout, turned=True, corners=False)
        elif metadata.get("head") == "RTDETRDecoder" and layout is END_TO_END:
            layout = RT_DETR_ROWS
        elif len(self._fed) > 1:
            layout = replace(layout, stretched=True)
        return names, layout, layout.table(main)

    def _check_scores(self, table: Table) -> None:
        scores = self._found(table, -np.inf).scores
        low, high = scores.min(initial=0.0), scores.max(initial=0.0)
        if low < -1e-3 or high > 1.0 + 1e-3:
            raise self._wrong(
                f"its scores go from {low:.3g} to {high:.3g}, expected 0 to 1; export it with its sigmoid"
            )

    def _find_names(self, classes: str) -> tuple[tuple[str, ...], str]:
        """Return the names of the classes, and where they come from."""
        if self.config.names:
            return self.config.names, "the parameter network.names"
        names, where = _names_of(self.path, self._metadata)
        if not names:
            raise self._wrong(
                f"its {classes} have no names: give them in the parameter network.names, '[a, b, …]', or in"
                f" {self.path.with_suffix('.yaml').name} next to it (names: [a, b, …])"
            )
        return names, where

    def _unread(self, outputs: Mapping[str, NDArray[Any]], more: str = "") -> OpenArmError:
        """Return what to say of outputs that have none of the layouts."""
        task = self._metadata.get("task", "detect")
        if task not in _TASKS:
            return self._wrong(f"its task is {brief(task)}, which gives no boxes; export one of {', '.join(_TASKS)}")
        shapes = ", ".join(f"{name} {out.shape}" for name, out in outputs.items())
        return self._wrong(f"its output is {brief_text(shapes) or 'missing'}{more}; {_OUTPUT}")

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
            Code.CONFIG_INVALID,
            f"there is no network {str(path)!r:.300}; models: {names}, or the path of an ONNX"
            " file (of best.pt, `yolo export model=best.pt format=onnx` writes it)",
        )
    return path


def _open(path: Path) -> tuple[Any, dict[str, str]]:
    """Return a session of onnxruntime, imported here alone (detection by colour does not need it), and the metadata."""
    try:
        import onnxruntime
    except ImportError as error:
        raise OpenArmError(
            Code.ENVIRONMENT, f"network {path} needs onnxruntime, which is not installed: pip install onnxruntime"
        ) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # cores are for the other nodes
    options.log_severity_level = 4  # the exception has the reason
    options.add_session_config_entry("session.use_env_allocators", "1")
    memory = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    onnxruntime.create_and_register_allocator(memory, onnxruntime.OrtArenaCfg({"max_mem": _MOST_BYTES}))
    try:
        # by its default it prints a failure, and tries again
        with _limited(lambda: options.set_load_cancellation_flag(True)):
            session = onnxruntime.InferenceSession(str(path), options, ["CPUExecutionProvider"], enable_fallback=0)
        for item in (*session.get_inputs(), *session.get_outputs()):
            str(item)  # names that are no text fail here
        return session, dict(session.get_modelmeta().custom_metadata_map)
    # onnxruntime raises types of its own, which it does not document
    except Exception as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"network {path} {_unreadable(path, str(error))}") from error


def _unreadable(path: Path, error: str) -> str:
    """Return what is wrong with a file that onnxruntime does not read, and what to do."""
    with path.open("rb") as file:
        first = file.read(64)
    for magic, text in _OTHERS.items():
        if first.startswith(magic):
            return f"is {text}"
    for pattern, text in _REASONS:
        if found := re.search(pattern, error):
            return text.format(*(group or "" for group in found.groups()), version=version("onnxruntime"))
    text = brief_text(printable(error.rpartition("failed:")[2] or error))
    return f"({path.stat().st_size} bytes) is damaged or no ONNX file: {text}; export or copy it again"


@contextmanager
def _limited(stop: Callable[[], object]) -> Iterator[None]:
    """Stop what onnxruntime does after `_MOST_SECONDS`: a file may hold a loop without an end."""
    timer = Timer(_MOST_SECONDS, stop)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _extras(metadata: Mapping[str, str], outputs: Mapping[str, NDArray[Any]]) -> tuple[int, ...]:
    """Return how many channels the output may have after scores and classes: for an angle, key points or masks."""
    task = metadata.get("task")
    if task == "obb":
        return (1,)
    if task == "pose":  # kpt_shape is such as [17, 3]
        return (math.prod(int(number) for number in re.findall(r"\d{1,4}", metadata.get("kpt_shape", ""))[:2]),)
    masks = [out.shape[1] for out in list(outputs.values())[1:] if out.ndim == 4]
    return (*masks[:1], 0)


def _listed(names: Sequence[str]) -> str:
    few = list(dict.fromkeys(names[:_LISTED]))
    return ", ".join([*few, f"… ({len(names)} in all)"] if len(names) > _LISTED else few)


def _names_of(path: Path, metadata: Mapping[str, str]) -> tuple[tuple[str, ...], str]:
    """Names of the classes and their source: the metadata of the file (a Python or JSON mapping or list), or a YAML.

    Numbers of a mapping that have no name get one, as class1.
    """
    if metadata.get("names"):
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
            by_number = {int(str(key)): value for key, value in cast(dict[Any, Any], names).items()}
            if by_number.keys() - range(_MOST_CLASSES) or len(by_number) < len(names):
                raise ValueError("no numbers of classes")
            names = [by_number.get(number, "") for number in range(max(by_number, default=-1) + 1)]
        if not isinstance(names, list | tuple | NoneType):
            raise TypeError("no list")
        listed = cast(list[Any], names or [])
        return tuple(str(name) or f"class{number}" for number, name in enumerate(listed)), where
    # a text of many brackets is refused by the parser of Python with errors of memory or recursion
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError) as error:
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"network {path}: {where} has names {brief(text or names)}; expected {{0: 'a', 1: 'b', …}} or a list",
        ) from error
