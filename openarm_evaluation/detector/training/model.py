# SPDX-License-Identifier: Apache-2.0
"""The network: small, anchor-free, three levels; and its loss.

Pixels are those of the network's input. A cell of level s answers for the point in its middle: four distances to the
sides of the box (left, top, right, bottom; softplus times the stride) and one logit per class.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

STRIDES = (8, 16, 32)
_CHANNELS, _DEPTH, _NECK = (8, 16, 32, 48, 64), (0, 1, 2, 1), 32


class ConvUnit(nn.Sequential):
    """Convolution, batch norm, ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
            nn.BatchNorm2d(outputs, eps=1e-3, momentum=0.03),
            nn.ReLU(inplace=True),
        )


class Residual(nn.Module):
    """A narrow detour that is added."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.detour = nn.Sequential(ConvUnit(channels, channels // 2, 1), ConvUnit(channels // 2, channels))

    def forward(self, x: Tensor) -> Tensor:
        """Same shape."""
        return x + self.detour(x)


class Network(nn.Module):
    """Boxes and classes of every cell.

    Args:
        classes: Number of classes.
    """

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.classes = classes
        self.stem = ConvUnit(3, _CHANNELS[0], 3, 2)
        self.stages = nn.ModuleList(
            nn.Sequential(ConvUnit(a, b, 3, 2), *(Residual(b) for _ in range(depth)))
            for a, b, depth in zip(_CHANNELS, _CHANNELS[1:], _DEPTH, strict=False)
        )
        self.across = nn.ModuleList(ConvUnit(channels, _NECK, 1) for channels in _CHANNELS[2:])
        self.mix = nn.ModuleList(ConvUnit(_NECK, _NECK) for _ in STRIDES[1:])
        self.box_head, self.class_head = (
            nn.ModuleList(nn.Sequential(ConvUnit(_NECK, _NECK), nn.Conv2d(_NECK, n, 1)) for _ in STRIDES)
            for n in (4, classes)
        )
        for boxes, scores in zip(self.box_head, self.class_head, strict=True):
            nn.init.constant_(boxes[1].bias, 1.5)  # pyright: ignore[reportIndexIssue]
            nn.init.constant_(scores[1].bias, -4.6)  # pyright: ignore[reportIndexIssue]

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Distances (b, 4, n), pixels, and logits (b, classes, n) of images (b, 3, h, w), 0 to 1; h, w by 32."""
        x = self.stages[0](self.stem(x))
        levels: list[Tensor] = []
        for stage, across in zip(list(self.stages)[1:], self.across, strict=True):
            x = stage(x)
            levels.append(across(x))
        for i in (1, 0):
            levels[i] = self.mix[i](levels[i] + functional.interpolate(levels[i + 1], scale_factor=2.0, mode="nearest"))
        boxes = [functional.softplus(h(f)) * s for h, f, s in zip(self.box_head, levels, STRIDES, strict=True)]
        scores = [h(f) for h, f in zip(self.class_head, levels, strict=True)]
        return torch.cat([b.flatten(2) for b in boxes], 2), torch.cat([c.flatten(2) for c in scores], 2)


def grid(height: int, width: int) -> Tensor:
    """Middles (2, n) of all cells of an input, x and y in pixels, in the order of the network's output."""
    levels: list[Tensor] = []
    for stride in STRIDES:
        ys, xs = (torch.arange(n // stride) * float(stride) + stride / 2.0 for n in (height, width))
        y, x = torch.meshgrid(ys, xs, indexing="ij")
        levels.append(torch.stack([x.flatten(), y.flatten()]))
    return torch.cat(levels, 1)


class Deployed(nn.Module):
    """The network for one input size with the output that readers of YOLOv8 files know: (b, 4 + classes, n).

    Rows are cx, cy, width, height in pixels, then a score 0 to 1 per class. Batch norms are folded in.
    """

    def __init__(self, network: Network, height: int, width: int) -> None:
        super().__init__()
        self.network = folded(network)
        self.register_buffer("middles", grid(height, width)[None])

    def forward(self, x: Tensor) -> Tensor:
        """Of images (b, 3, h, w), 0 to 1."""
        sides, logits = self.network(x)
        low, high = self.middles - sides[:, :2], self.middles + sides[:, 2:]
        return torch.cat([(low + high) / 2.0, high - low, logits.sigmoid()], 1)


def folded(network: Network) -> Network:
    """A copy in which each batch norm is part of its convolution."""
    network = copy.deepcopy(network).eval()
    for unit in network.modules():
        if not isinstance(unit, ConvUnit):
            continue
        conv, norm = unit[0], unit[1]
        if not (isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d)):
            raise TypeError(f"a unit of {type(conv).__name__} and {type(norm).__name__}; it is folded already")
        joined = fuse_conv_bn_eval(conv, norm)
        unit[0], unit[1] = joined, nn.Identity()
    return network


def overlap(a: Tensor, b: Tensor, *, complete: bool = False) -> Tensor:
    """Intersection over union of boxes (..., 4); `complete` also counts distance and proportions (CIoU, Zheng 2020)."""
    size = (torch.minimum(a[..., 2:], b[..., 2:]) - torch.maximum(a[..., :2], b[..., :2])).clamp(0.0)
    common = size[..., 0] * size[..., 1]
    size_a, size_b = a[..., 2:] - a[..., :2], b[..., 2:] - b[..., :2]
    iou = common / (size_a.prod(-1) + size_b.prod(-1) - common + 1e-7)
    if not complete:
        return iou
    hull = torch.maximum(a[..., 2:], b[..., 2:]) - torch.minimum(a[..., :2], b[..., :2])
    apart = (((a[..., :2] + a[..., 2:] - b[..., :2] - b[..., 2:]) / 2.0) ** 2).sum(-1)
    turn_a, turn_b = (torch.atan(s[..., 0] / (s[..., 1] + 1e-7)) for s in (size_a, size_b))
    shape = 0.405285 * (turn_a - turn_b) ** 2  # 4 / pi²
    with torch.no_grad():
        weight = shape / (shape - iou + 1.0 + 1e-7)
    return iou - apart / ((hull**2).sum(-1) + 1e-7) - weight * shape


@torch.no_grad()
def assign(
    scores: Tensor, boxes: Tensor, middles: Tensor, kinds: Tensor, truth: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Which cells answer for which object: task-aligned assignment (Feng 2021) for one picture.

    Args:
        scores: (n, classes), 0 to 1.
        boxes: (n, 4).
        middles: (2, n).
        kinds: (m,) classes of the objects.
        truth: (m, 4) their boxes.

    Returns:
        Cells (k,), the object of each (k,), and how good its score should be (k,), 0 to 1.
    """
    centre = (truth[:, :2] + truth[:, 2:]) / 2.0
    half = ((truth[:, 2:] - truth[:, :2]) / 2.0).clamp(6.0)
    inside = ((middles.T[None] - centre[:, None]).abs() < half[:, None]).all(-1)
    iou = overlap(truth[:, None], boxes[None]).clamp(0.0)
    metric = (scores[:, kinds].T.clamp(1e-6) ** 0.5 * iou**4 + 1e-9) * inside
    best = metric.topk(min(10, metric.shape[1]), 1)
    chosen = torch.zeros_like(inside).scatter_(1, best.indices, best.values > 0.0)
    owner = torch.where(chosen, iou + 1e-6, torch.zeros_like(iou)).argmax(0)
    cells = chosen.any(0).nonzero()[:, 0]
    owner = owner[cells]
    top_metric, top_iou = (
        torch.zeros(len(truth)).scatter_reduce(0, owner, values[owner, cells], "amax") for values in (metric, iou)
    )
    aim = metric[owner, cells] / (top_metric[owner] + 1e-9) * top_iou[owner].clamp(0.1)
    return cells, owner, aim


def loss(
    network: Network, images: Tensor, targets: Sequence[tuple[Tensor, Tensor]], middles: Tensor
) -> tuple[Tensor, Tensor]:
    """Class loss and box loss of a batch (b, 3, h, w) with classes (m,) and boxes (m, 4) of each picture."""
    sides, logits = network(images)
    boxes = torch.cat([middles[None] - sides[:, :2], middles[None] + sides[:, 2:]], 1).transpose(1, 2)
    logits = logits.transpose(1, 2)
    scores = logits.detach().sigmoid()
    aims = torch.zeros_like(logits)
    box_loss = logits.new_zeros(())
    for i, (kinds, truth) in enumerate(targets):
        if len(kinds):
            cells, owner, aim = assign(scores[i], boxes[i].detach(), middles, kinds, truth)
            aims[i, cells, kinds[owner]] = aim
            box_loss = box_loss + ((1.0 - overlap(boxes[i][cells], truth[owner], complete=True)) * aim).sum()
    norm = aims.sum().clamp(1.0)
    # most cells see no object: what they have learnt counts little
    weight = torch.where(aims > 0.0, torch.ones_like(scores), 0.75 * scores**1.5 + 0.02)
    class_loss = (functional.binary_cross_entropy_with_logits(logits, aims, reduction="none") * weight).sum()
    return class_loss / norm, box_loss / norm
