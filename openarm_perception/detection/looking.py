# SPDX-License-Identifier: Apache-2.0
"""Other ways to see than by colour: a network's boxes cut out by depth, both detectors checking each other, clusters.

A network knows shapes and no colours, the colour detector knows colours and no shapes: they fail independently. Labels
are colours wherever an object has one of the palette, whichever detector found it; its shape is its `kind`.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from openarm_perception.detection.detector import ColorDetector, Detection2D, Image, Mask, Policy
from openarm_perception.detection.kinds import DetectorKind
from openarm_perception.detection.localize import Localizer
from openarm_perception.detection.network import NetworkConfig, NetworkDetector
from openarm_perception.detection.pipeline import Pipeline
from openarm_perception.detection.view import Doubt, Seen, View
from openarm_perception.geometry.depth import unit_scale

#: Label of what is found without knowing what it is.
ANYTHING = "anything"
#: Pixels around a box of a network that are looked at: its sides are that exact.
_MARGIN = 4
#: An object has a colour when this share of its pixels has it.
_COLOURED = 0.5
#: Masks that share this much of the smaller one are the same object.
_SAME = 0.5
#: Fewer pixels are nothing.
_PIXELS = 60
#: Beyond this height above the table nothing stands on it, m; where depth jumps by more, objects end, m.
_TALLEST, _JUMP = 0.30, 0.020


class NetworkPipeline(Pipeline):
    """Sees with a network.

    Args:
        network: Finds boxes.
        colors: Names the colours of what is in them.
        localizer: Finds where objects are.
        policy: Which comes first.
        label: Only objects of this name; empty takes all.
    """

    def __init__(
        self,
        network: NetworkDetector,
        colors: ColorDetector,
        localizer: Localizer,
        policy: Policy = "score",
        label: str = "",
    ) -> None:
        super().__init__(network, localizer, policy, label)
        self.network, self.colors = network, colors

    def look(self, view: View) -> Seen:
        """What the network finds, with the pixels that are the object's."""
        return Seen(self._by_network(view))

    def _by_network(self, view: View) -> tuple[Detection2D, ...]:
        found = [cut_out(box, view, self.localizer) for box in self.network.detect(view.rgb)]
        kept: list[Detection2D] = []
        for detection in sorted((d for d in found if d is not None), key=lambda d: -d.score):
            if not any(same(detection, other) for other in kept):
                kept.append(self._named(detection, view.rgb))
        return tuple(sorted(kept, key=lambda d: -d.area))

    def _named(self, detection: Detection2D, rgb: Image) -> Detection2D:
        (u, v), (w, h) = detection.origin, detection.size
        color, share = self.colors.name(np.ascontiguousarray(rgb[v : v + h, u : u + w]), detection.mask)
        return replace(detection, label=color if share >= _COLOURED else detection.kind)


class CheckedPipeline(NetworkPipeline):
    """Sees with a network and by colour; what they do not agree on is looked at again, not grasped."""

    def look(self, view: View) -> Seen:
        """What both find; doubts about the rest, but for what has no colour that is looked for."""
        by_shape, by_colour = list(self._by_network(view)), self.colors.detect(view.rgb)
        palette = {item.label for item in self.colors.config.classes}
        found: list[Detection2D] = []
        doubts: list[Doubt] = []
        for coloured in by_colour:
            shaped = next((d for d in by_shape if same(coloured, d)), None)
            if shaped is None:
                doubts.append(Doubt(coloured, _doubt(coloured, coloured.label, "the network sees nothing there")))
                continue
            by_shape.remove(shaped)
            if shaped.label != coloured.label and shaped.label in palette:
                doubts.append(Doubt(coloured, _doubt(coloured, coloured.label, f"most of it is {shaped.label}")))
            else:
                score = (coloured.score + shaped.score) / 2.0
                found.append(replace(coloured, kind=shaped.kind, score=score))
        for shaped in by_shape:
            if shaped.label in palette:
                doubts.append(Doubt(shaped, _doubt(shaped, shaped.kind, f"colour sees nothing {shaped.label} there")))
            else:
                found.append(shaped)
        return Seen(tuple(sorted(found, key=lambda d: -d.area)), tuple(doubts))


class ClusterPipeline(Pipeline):
    """Sees whatever stands on the table, by depth alone; the detector that it is made with is not asked."""

    def look(self, view: View) -> Seen:
        """Everything that stands above the table and is not the robot."""
        return Seen(clusters(view, self.localizer))


def make_pipeline(
    kind: DetectorKind,
    colors: ColorDetector,
    network: NetworkConfig,
    localizer: Localizer,
    policy: Policy = "score",
    label: str = "",
    before: Pipeline | None = None,
) -> Pipeline:
    """The pipeline of a kind; the network is read only by those that use it.

    Args:
        kind: What finds objects.
        colors: Finds and names colours.
        network: Which network, and what counts as found.
        localizer: Finds where objects are.
        policy: Which comes first.
        label: Only objects of this name; empty takes all.
        before: The pipeline that it takes the place of, whose network is not read again where it is the same.

    Raises:
        OpenArmError: CONFIG_INVALID or INVALID_ARGUMENT, from the network.
    """
    if kind in ("network", "both"):
        loaded = before.network.changed(network) if isinstance(before, NetworkPipeline) else NetworkDetector(network)
        made = NetworkPipeline if kind == "network" else CheckedPipeline
        return made(loaded, colors, localizer, policy, label)
    if kind == "anything":
        return ClusterPipeline(colors, localizer, policy, label)
    return Pipeline(colors, localizer, policy, label)


def cut_out(box: Detection2D, view: View, localizer: Localizer) -> Detection2D | None:
    """The object in a box: what stands above the table there and has the colour of its middle.

    Returns:
        The detection with mask and box of those pixels, its class as `kind`; None when hardly any are left.
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
    alike = _alike(view.rgb[rows, columns], core)
    plain = np.count_nonzero(alike & core) >= 0.5 * np.count_nonzero(core)
    # what is of many colours is told from its surroundings by depth alone
    mask = _largest(standing & alike if plain else standing)
    return _detection(mask, (columns.start, rows.start), (width, height), box.label, box.score, kind=box.label)


def clusters(view: View, localizer: Localizer) -> tuple[Detection2D, ...]:
    """Everything that stands above the table, parted where depth jumps; the score is how full its outline is."""
    above = view.heights(localizer.limits) - np.float32(localizer.table_height)
    standing = (above > localizer.config.table_margin) & (above < _TALLEST)
    if view.robot is not None:
        standing &= ~view.robot
    z = view.depth.astype(np.float32) * np.float32(unit_scale(view.depth))
    for near, far in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        # the farther side of a jump is the surroundings of the nearer, whatever it belongs to
        standing[far] &= z[far] - z[near] < _JUMP
        standing[near] &= z[near] - z[far] < _JUMP
    count, labels, stats, _ = cv2.connectedComponentsWithStats(standing.astype(np.uint8), connectivity=4)
    size = (view.rgb.shape[1], view.rgb.shape[0])
    found: list[Detection2D] = []
    for i in range(1, count):
        left, top, w, h, area = (int(value) for value in stats[i])
        if area < 2 * _PIXELS:
            continue
        mask = labels[top : top + h, left : left + w] == i
        hull = cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32))
        full = min(1.0, area / max(float(cv2.contourArea(hull)), 1.0))
        detection = _detection(mask, (left, top), size, ANYTHING, full)
        if detection is not None:
            found.append(detection)
    return tuple(sorted(found, key=lambda d: -d.area))


def same(a: Detection2D, b: Detection2D) -> bool:
    """Whether two detections are of one object."""
    (ua, va), (ub, vb) = a.origin, b.origin
    left, top = max(ua, ub), max(va, vb)
    right, bottom = min(ua + a.size[0], ub + b.size[0]), min(va + a.size[1], vb + b.size[1])
    if right <= left or bottom <= top:
        return False
    in_a = a.mask[top - va : bottom - va, left - ua : right - ua]
    in_b = b.mask[top - vb : bottom - vb, left - ub : right - ub]
    return bool(np.count_nonzero(in_a & in_b) >= _SAME * min(a.area, b.area))


def _alike(rgb: Image, core: Mask) -> Mask:
    """Pixels (h, w) of the colour that most of the core has; how light they are does not matter."""
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
    """The largest connected part, specks and bridges cut, holes healed."""
    clean = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(clean, connectivity=4)
    if count < 2:
        return np.zeros_like(mask)
    part = (labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))).astype(np.uint8)
    contours, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(part, contours, -1, 1, cv2.FILLED) > 0


def _detection(
    mask: Mask, origin: tuple[int, int], image: tuple[int, int], label: str, score: float, kind: str = ""
) -> Detection2D | None:
    rows, columns = np.nonzero(mask.any(axis=1))[0], np.nonzero(mask.any(axis=0))[0]
    if np.count_nonzero(mask) < _PIXELS:
        return None
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    u, v, w, h = int(origin[0] + left), int(origin[1] + top), int(right - left), int(bottom - top)
    cut = u == 0 or v == 0 or u + w == image[0] or v + h == image[1]
    centre = (u + (w - 1) / 2.0, v + (h - 1) / 2.0)
    return Detection2D(label, score, centre, (w, h), mask[top:bottom, left:right].copy(), cut, kind)


def _doubt(found: Detection2D, name: str, other: str) -> str:
    return f"{name} at pixel ({found.centre[0]:.0f}, {found.centre[1]:.0f}): {other}; it is looked at again"
