# SPDX-License-Identifier: Apache-2.0
"""From one frame of a camera to objects in the base frame: detect, rank, locate.

Objects are detected by colour, by a network whose boxes are cut out by depth, by both checking each other, or as
clusters of depth, all of them or those that show a tag. A network knows shapes and no colours, the colour detector
knows colours and no shapes: they fail independently. An object has the colour of the palette that most of it has,
whichever detector found it. The class of a network is its name, or its shape where it names one.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.depth_view import DepthImage, check_size, unit_scale
from openarm_common.errors import Code, OpenArmError
from openarm_common.wanted import describe, fits
from openarm_perception.detection.anything import clusters
from openarm_perception.detection.detector import ColorDetector, Detection2D, Detector, Image, Mask, Policy, rank
from openarm_perception.detection.faults import DetectionFaults
from openarm_perception.detection.kinds import DetectorKind
from openarm_perception.detection.localize import Localizer, LocatedObject
from openarm_perception.detection.network import NetworkConfig, NetworkDetector
from openarm_perception.detection.tags import TagConfig, TagDetector
from openarm_perception.geometry.depth import View
from openarm_perception.geometry.table import TableMeasurement, measure_table, of_block


@dataclass(frozen=True)
class Doubt:
    """An object that detectors do not agree on: an obstacle that must be observed again before it is grasped."""

    found: Detection2D
    why: str


@dataclass(frozen=True)
class ImageDetections:
    """What a detector finds in an image: objects, and those in doubt."""

    found: tuple[Detection2D, ...]
    doubts: tuple[Doubt, ...] = ()


@dataclass(frozen=True)
class Perceived:
    """The objects of a frame, the first choice at the front.

    Attributes:
        found: Detections in the image.
        located: Objects in the base frame; those of `found` that could be located.
        refused: Why the others could not be, one sentence each.
        unmeasured: Boxes around what is visible of those: obstacles, but no targets.
        robot: (h, w) pixels that show the robot or what it holds; None when it was not searched for.
        withheld: Why none of them may be a target.
    """

    found: tuple[Detection2D, ...]
    located: tuple[LocatedObject, ...]
    refused: tuple[str, ...]
    robot: Mask | None = None
    unmeasured: tuple[LocatedObject, ...] = ()
    withheld: OpenArmError | None = None

    @property
    def boxes(self) -> tuple[LocatedObject, ...]:
        """All objects, those that could be measured first."""
        return (*self.located, *self.unmeasured)

    def identified(self, ids: Mapping[int, str]) -> Perceived:
        """Return the same with the ids of objects: of the i-th of `boxes`, counted from 1; a missing one has none."""
        named = [replace(place, id=ids.get(i, "")) for i, place in enumerate(self.boxes, start=1)]
        n = len(self.located)
        return replace(self, located=tuple(named[:n]), unmeasured=tuple(named[n:]))


@dataclass(eq=False)
class Pipeline:
    """Finds objects in images and locates them.

    Args:
        detector: Finds them in the colour image.
        localizer: Finds where they are.
        policy: Rule by which they are ranked.
        label: Only objects that these words fit; empty takes all.
        faults: Objects that are missed, by fault injection.
    """

    detector: Detector
    localizer: Localizer
    policy: Policy = "score"
    label: str = ""
    faults: DetectionFaults = field(default_factory=DetectionFaults)

    def run(
        self,
        rgb: NDArray[np.uint8],
        depth: DepthImage,
        intrinsics: Intrinsics,
        T_base_camera: NDArray[np.float64],
        robot: Mask | None = None,
        withheld: OpenArmError | None = None,
        t_ns: int = 0,
    ) -> Perceived:
        """Detect and locate the objects of a frame.

        Args:
            rgb: (h, w, 3) uint8.
            depth: (h, w) uint16 millimetres or float32 metres, aligned with `rgb`.
            intrinsics: Intrinsics of both, from the CameraInfo.
            T_base_camera: (4, 4) optical frame in the base frame, at the stamp of the image.
            robot: (h, w) pixels that show the robot or what it holds; they belong to no object.
            withheld: Why no object of the frame may be a target, from `CameraWatch`.
            t_ns: Stamp of the frame, by which injected faults are drawn.

        Raises:
            OpenArmError: BAD_IMAGE, when colour, depth and intrinsics do not belong together.
        """
        check_size("colour image", rgb.shape, intrinsics)
        check_size("depth image", depth.shape, intrinsics)
        unit_scale(depth)
        size = (intrinsics.width, intrinsics.height)
        view = self.localizer.levelled(View(rgb, depth, intrinsics, T_base_camera, robot))
        detected = self.detect(view)
        unseen = carriers(view, detected)
        found = rank(self.faults.seen(detected.found, t_ns), self.policy, size)
        doubts = self.faults.seen(detected.doubts, t_ns)
        located: list[LocatedObject] = []
        refused: list[str] = []
        unmeasured: list[LocatedObject] = []
        for detection, doubt in [*((one, "") for one in found), *((one.found, one.why) for one in (*doubts, *unseen))]:
            patch = self.localizer.cut(detection, view)
            try:
                if doubt:
                    raise OpenArmError(Code.NOTHING_DETECTED, doubt)
                place = self.localizer.locate(patch)
                if withheld is None:
                    located.append(place)
                else:
                    refused.append(f"{detection.label} is no target")
                    unmeasured.append(replace(place, measured=False, code=withheld.code))
            except OpenArmError as error:
                refused.append(error.message)
                with contextlib.suppress(OpenArmError):  # flat on the table, or the robot: it is no obstacle
                    unmeasured.append(self.localizer.enclose(patch, withheld))
        if self.policy == "score":  # what is partly hidden is less certain than it seemed in the image
            located.sort(key=lambda place: -place.score)
        if self.label:
            located, unmeasured = ([p for p in places if fits(self.label, p)] for places in (located, unmeasured))
            kept = {id(place.source) for place in (*located, *unmeasured)}
            found = tuple(one for one in found if id(one) in kept)
        return Perceived(found, tuple(located), tuple(refused), robot, tuple(unmeasured), withheld)

    def measure_table(self, view: View, block_height: float = 0.0, label: str = "") -> TableMeasurement:
        """Measure the height of the table, by its surface or under a block of known height.

        Args:
            view: The frame.
            block_height: Height of the block, m; 0: by the surface.
            label: Words for the block; empty: the only one in view.

        Raises:
            OpenArmError: NOTHING_DETECTED, when there is no such surface, or not one such block; INVALID_ARGUMENT, for
                a height that no block has; BAD_IMAGE, when depth and intrinsics do not fit.
        """
        if block_height == 0.0:
            return measure_table(view, self.localizer.limits, self.localizer.table_height)
        found = self.run(view.rgb, view.depth, view.intrinsics, view.T_base_camera, view.robot).located
        blocks = [place for place in found if fits(label, place) and place.from_depth]
        if len(blocks) != 1:
            raise OpenArmError(
                Code.NOTHING_DETECTED,
                f"expected one block {label!r} in view, which shows {describe(found)}; give its label",
            )
        return of_block(blocks[0], block_height)

    def detect(self, view: View) -> ImageDetections:
        """Detect the objects of a frame in the image; subclasses use more than colour."""
        return ImageDetections(self.detector.detect(view.rgb))


#: Name of what carries something and was not detected itself.
SUPPORT = "support"
#: Pixels around a box of a network that are examined: its sides are that exact.
_MARGIN = 4
#: An object has a colour when this share of its pixels has it.
_COLOURED = 0.5
#: Masks that share this much of the smaller one are the same object.
_SAME = 0.5
#: Fewer pixels are nothing.
_PIXELS = 60


@dataclass(eq=False)
class NetworkPipeline(Pipeline):
    """Detects with a network.

    Args:
        detector: The network, which finds boxes.
        colors: Names the colours of what is in them.
    """

    detector: NetworkDetector  # pyright: ignore[reportIncompatibleVariableOverride] - never replaced
    colors: ColorDetector = field(kw_only=True)

    def detect(self, view: View) -> ImageDetections:
        """Return what the network detects, with the pixels that are the object's."""
        return ImageDetections(self._by_network(view))

    def _by_network(self, view: View) -> tuple[Detection2D, ...]:
        found = [cut_out(box, view, self.localizer) for box in self.detector.detect(view.rgb)]
        kept: list[Detection2D] = []
        for detection in sorted((d for d in found if d is not None), key=lambda d: -d.score):
            if not any(same(detection, other) for other in kept):
                kept.append(with_colour(detection, view.rgb, self.colors))
        return tuple(sorted(kept, key=lambda d: -d.area))


class CheckedPipeline(NetworkPipeline):
    """Detects with a network and by colour; what they do not agree on is observed again, not grasped."""

    def detect(self, view: View) -> ImageDetections:
        """Return what both detect; the rest is in doubt, unless it has none of the configured colours."""
        by_shape, by_colour = list(self._by_network(view)), self.colors.detect(view.rgb)
        found: list[Detection2D] = []
        doubts: list[Doubt] = []
        for coloured in by_colour:
            shaped = next((d for d in by_shape if same(coloured, d)), None)
            if shaped is None:
                doubts.append(Doubt(coloured, _doubt(coloured, coloured.color, "the network detects nothing there")))
                continue
            by_shape.remove(shaped)
            if shaped.color not in ("", coloured.color):
                doubts.append(Doubt(coloured, _doubt(coloured, coloured.color, f"most of it is {shaped.color}")))
            else:
                score = (coloured.score + shaped.score) / 2.0
                found.append(replace(coloured, name=shaped.name, kind=shaped.kind, score=score))
        for shaped in by_shape:
            if shaped.color:
                why = _doubt(shaped, shaped.name or shaped.kind, f"by colour nothing {shaped.color} is there")
                doubts.append(Doubt(shaped, why))
            else:
                found.append(shaped)
        return ImageDetections(tuple(sorted(found, key=lambda d: -d.area)), tuple(doubts))


@dataclass(eq=False)
class TagPipeline(Pipeline):
    """Detects what stands on the table and shows a tag, which names it; depth says which pixels are its.

    Args:
        detector: Names the colours.
        tags: Finds the tags; one that is flat on the table, or on the robot, is on no object.
    """

    detector: ColorDetector  # pyright: ignore[reportIncompatibleVariableOverride] - never replaced
    tags: TagDetector = field(kw_only=True)

    def detect(self, view: View) -> ImageDetections:
        """Return what shows one tag; what shows different ones is in doubt."""
        found: list[Detection2D] = []
        doubts: list[Doubt] = []
        masks = {tag: tag.mask(view.depth.shape) for tag in self.tags.detect(view.rgb)}
        for cluster in clusters(view, self.localizer) if masks else ():
            (u, v), (w, h) = cluster.origin, cluster.size
            shown = {tag: np.count_nonzero(mask[v : v + h, u : u + w] & cluster.mask) for tag, mask in masks.items()}
            on_it = [tag for tag, count in shown.items() if 2 * count > np.count_nonzero(masks[tag])]
            names = sorted({tag.name for tag in on_it})
            if not names:
                continue
            one = with_colour(replace(cluster, name=names[0]), view.rgb, self.detector)
            why = "they touch, or are on one object" if len(names) > 1 else ""
            why = why or next(filter(None, (self.tags.doubt(tag, view, self.localizer.limits) for tag in on_it)), "")
            if why:
                doubts.append(Doubt(one, _doubt(one, " and ".join(names), why)))
            else:
                found.append(one)
        return ImageDetections(tuple(found), tuple(doubts))


@dataclass(eq=False)
class ClusterPipeline(Pipeline):
    """Detects everything on the table by depth; the detector that it is made with names colours."""

    detector: ColorDetector  # pyright: ignore[reportIncompatibleVariableOverride] - never replaced

    def detect(self, view: View) -> ImageDetections:
        """Return everything above the table that is not the robot."""
        found = clusters(view, self.localizer)
        return ImageDetections(tuple(with_colour(one, view.rgb, self.detector) for one in found))


def make_pipeline(
    kind: DetectorKind,
    colors: ColorDetector,
    network: NetworkConfig,
    localizer: Localizer,
    policy: Policy = "score",
    label: str = "",
    before: Pipeline | None = None,
    tags: TagConfig = TagConfig(),  # noqa: B008 - frozen
) -> Pipeline:
    """Make the pipeline of a kind; the network is read only by those that use it.

    Args:
        kind: Kind of the detector.
        colors: Finds and names colours.
        network: File of the network, and its thresholds.
        localizer: Finds where objects are.
        policy: Rule by which they are ranked.
        label: Only objects that these words fit; empty takes all.
        before: The pipeline that it takes the place of, whose network is not read again where it is the same.
        tags: Family and size of the tags.

    Raises:
        OpenArmError: CONFIG_INVALID or INVALID_ARGUMENT, from the network.
    """
    if kind in ("network", "both"):
        loaded = before.detector.changed(network) if isinstance(before, NetworkPipeline) else NetworkDetector(network)
        made = NetworkPipeline if kind == "network" else CheckedPipeline
        return made(loaded, localizer, policy, label, colors=colors)
    if kind == "tag":
        return TagPipeline(colors, localizer, policy, label, tags=TagDetector(tags))
    if kind == "anything":
        return ClusterPipeline(colors, localizer, policy, label)
    return Pipeline(colors, localizer, policy, label)


def carriers(view: View, detected: ImageDetections) -> tuple[Doubt, ...]:
    """Return the surfaces that something stands on and of which nothing was detected: obstacles."""
    if view.levels is None:
        return ()
    taken = np.zeros(view.depth.shape, np.bool_)
    for one in (*detected.found, *(doubt.found for doubt in detected.doubts)):
        (u, v), (w, h) = one.origin, one.size
        taken[v : v + h, u : u + w] |= one.mask
    size, found = (view.intrinsics.width, view.intrinsics.height), list[Doubt]()
    for number in range(1, len(view.levels.height)):
        face = view.levels.face == number
        shown = _detection(face, (0, 0), size, SUPPORT, 1.0)
        if shown is not None and np.mean(taken[face]) < _SAME:
            found.append(Doubt(shown, f"{SUPPORT}: nothing was detected that it is the top of"))
    return tuple(found)


def cut_out(box: Detection2D, view: View, localizer: Localizer) -> Detection2D | None:
    """Cut out the object in a box: what rises above the table there and has the colour of its middle.

    Args:
        box: Box of the network.
        view: The frame.
        localizer: Has the height of the table.

    Returns:
        The detection with mask and box of those pixels; None when hardly any are left.
    """
    height, width = view.rgb.shape[:2]
    (u, v), (w, h) = box.origin, box.size
    rows = slice(max(v - _MARGIN, 0), min(v + h + _MARGIN, height))
    columns = slice(max(u - _MARGIN, 0), min(u + w + _MARGIN, width))
    floor = localizer.table_height + localizer.config.table_margin
    above = view.heights(localizer.limits, (rows, columns))
    solid = above > floor
    # what has no depth may still be the object: only what is seen on the table is not
    standing = solid | np.isnan(above)
    if view.robot is not None:
        standing &= ~view.robot[rows, columns]
    core = np.zeros_like(standing)
    inner_v, inner_u = standing.shape[0] // 4, standing.shape[1] // 4
    core[inner_v : -inner_v or None, inner_u : -inner_u or None] = True
    core &= standing & (solid if (solid & core).any() else True)
    if not core.any():
        return None
    if view.levels is not None:  # neither what it stands on, nor what stands on it
        standing &= view.levels.under[rows, columns] == view.levels.of((rows, columns), core)
        core &= standing
    alike = _alike(view.rgb[rows, columns], core)
    plain = np.count_nonzero(alike & core) >= 0.5 * np.count_nonzero(core)
    # what is of many colours is separated from the background by depth alone
    mask = _largest(standing & alike if plain else standing)
    return _detection(mask, (columns.start, rows.start), (width, height), box.name, box.score, box.kind)


def with_colour(detection: Detection2D, rgb: Image, colors: ColorDetector) -> Detection2D:
    """Return the detection with the colour that most of it has, where one has."""
    (u, v), (w, h) = detection.origin, detection.size
    color, share = colors.name(np.ascontiguousarray(rgb[v : v + h, u : u + w]), detection.mask)
    return replace(detection, color=color) if share >= _COLOURED else detection


def same(a: Detection2D, b: Detection2D) -> bool:
    """Return whether two detections are of one object."""
    (ua, va), (ub, vb) = a.origin, b.origin
    left, top = max(ua, ub), max(va, vb)
    right, bottom = min(ua + a.size[0], ub + b.size[0]), min(va + a.size[1], vb + b.size[1])
    if right <= left or bottom <= top:
        return False
    in_a = a.mask[top - va : bottom - va, left - ua : right - ua]
    in_b = b.mask[top - vb : bottom - vb, left - ub : right - ub]
    return bool(np.count_nonzero(in_a & in_b) >= _SAME * min(a.area, b.area))


def _alike(rgb: Image, core: Mask) -> Mask:
    """Return pixels (h, w) of the colour that most of the core has; how light they are does not matter."""
    lab = cv2.cvtColor(cv2.medianBlur(np.ascontiguousarray(rgb), 3), cv2.COLOR_RGB2LAB)
    ab = lab[..., 1:].astype(np.float32) - 128.0
    middle = np.median(ab[core], axis=0)
    chroma = float(np.hypot(*middle))
    if chroma < 15.0:
        return np.asarray(np.hypot(ab[..., 0], ab[..., 1]) < 20.0)
    # along and across the direction of the colour: shadow takes chroma, not hue
    along = ab @ (middle / chroma)
    across = ab @ (np.array([-middle[1], middle[0]], np.float32) / chroma)
    return np.asarray((along > 0.25 * chroma) & (np.abs(across) < 0.45 * along))


def _largest(mask: Mask) -> Mask:
    """Return the largest connected part, specks and bridges cut, holes healed."""
    clean = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(clean, connectivity=4)
    if count < 2:
        return np.zeros_like(mask)
    part = (labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))).astype(np.uint8)
    contours, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(part, contours, -1, 1, cv2.FILLED) > 0


def _detection(
    mask: Mask, origin: tuple[int, int], image: tuple[int, int], name: str, score: float, kind: str = ""
) -> Detection2D | None:
    rows, columns = np.nonzero(mask.any(axis=1))[0], np.nonzero(mask.any(axis=0))[0]
    if np.count_nonzero(mask) < _PIXELS:
        return None
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    u, v, w, h = int(origin[0] + left), int(origin[1] + top), int(right - left), int(bottom - top)
    cut = u == 0 or v == 0 or u + w == image[0] or v + h == image[1]
    centre = (u + (w - 1) / 2.0, v + (h - 1) / 2.0)
    return Detection2D(name, score, centre, (w, h), mask[top:bottom, left:right].copy(), cut, kind)


def _doubt(found: Detection2D, name: str, other: str) -> str:
    return f"{name} at pixel ({found.centre[0]:.0f}, {found.centre[1]:.0f}): {other}; it is observed again"
