# SPDX-License-Identifier: Apache-2.0
"""Training: the loop, its schedule and its checkpoints. It may be stopped at any time and goes on where it was."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_evaluation.detector.training.model import Deployed, Network, grid, loss
from openarm_evaluation.detector.training.samples import Sample, Samples, vary
from openarm_evaluation.detector.training.scores import Scores, Truth, score
from openarm_perception.detection.boxes import Candidates, Letterbox
from openarm_perception.detection.layouts import decode

#: Sizes (width, height) that weights are exported for and chosen by.
SIZES = ((320, 256), (640, 480))
_LEAST = 0.05
#: Batches between two checkpoints.
_KEEP = 100


class FitConfig(Config):
    """How to train."""

    steps: int = Field(default=7000, ge=1, description="batches")
    batch: int = Field(default=16, ge=1, le=256, description="pictures a batch")
    width: int = Field(default=320, ge=64, le=1280, multiple_of=32, description="of a crop, pixels")
    height: int = Field(default=256, ge=64, le=1280, multiple_of=32, description="of a crop, pixels")
    rate: float = Field(default=2e-3, gt=0.0, le=0.1, description="learning rate; with few pictures of your own, 1e-3")
    warm_up: int = Field(default=100, ge=1, description="batches until the full rate")
    falling: float = Field(default=0.6, gt=0.0, le=1.0, description="share of the steps in which the rate falls to 2 %")
    decay: float = Field(default=0.02, ge=0.0, description="of the weights")
    box_weight: float = Field(default=3.0, gt=0.0, description="of the box loss against the class loss")
    every: int = Field(default=1000, ge=1, description="batches between two evaluations on the selection set")
    patience: int = Field(default=3, ge=1, description="evaluations without a better one until it stops early")
    threads: int = Field(default=1, ge=1, le=64, description="of torch; one a process is most work per CPU second")
    seed: int = Field(default=0, ge=0, description="of weights, order and variations")


class Fit:
    """A training run in a folder: `last.pt` to go on from, `best.pt` the weights, `curve.json` what happened.

    Args:
        data: Folder of the data set.
        folder: Folder of the run; one that holds a run of the same settings goes on.
        config: Settings of the training.
        first: Weights to begin with, such as the suite's; their classes must be those of the data.

    Raises:
        OpenArmError: CONFIG_INVALID, for a data set that can't be read; INVALID_ARGUMENT, when the folder holds a run
            of other settings, or the first weights are of other classes.
    """

    def __init__(self, data: Path, folder: Path, config: FitConfig, first: Path | None = None) -> None:
        self.config, self.folder = config, folder
        torch.set_num_threads(config.threads)
        torch.manual_seed(config.seed)
        self.train, self.select = Samples(data, "train"), Samples(data, "select")
        self.names = self.train.names
        self.network = Network(len(self.names)).to(memory_format=torch.channels_last)  # pyright: ignore
        plain = [p for p in self.network.parameters() if p.ndim <= 1]
        matrices = [p for p in self.network.parameters() if p.ndim > 1]
        groups = [{"params": matrices, "weight_decay": config.decay}, {"params": plain, "weight_decay": 0.0}]
        self._optimizer = torch.optim.AdamW(groups, lr=config.rate)
        self._middles = grid(config.height, config.width)
        self.step, self.best, self._since_best = 0, -1.0, 0
        self._used_s = 0.0
        self._started = time.process_time()
        self.curve: list[dict[str, float]] = []
        if first is not None:
            self.network.load_state_dict(load_weights(first, self.names))
        self._mean: dict[str, Tensor] = {k: v.clone() for k, v in self.network.state_dict().items()}
        self._resume()

    @property
    def cpu_s(self) -> float:
        """CPU time of the run so far, with all that was before it was stopped, s."""
        return self._used_s + time.process_time() - self._started

    def averaged(self) -> Network:
        """The network with the running mean of the weights, which is the better one."""
        network = Network(len(self.names))
        network.load_state_dict(self._mean)
        return network.eval()

    def run(self, on_row: Callable[[dict[str, float]], None], advance: Callable[[], None] = lambda: None) -> None:
        """Train to the end; `on_row` is called with each row of the curve, `advance` after each batch."""
        config, losses = self.config, np.zeros((0, 2))
        batches = self._batches()
        self.network.train()
        while self.step < config.steps and self._since_best < config.patience:
            losses = np.vstack([losses, self._learn(next(batches))])
            advance()
            if self.step % config.every and self.step != config.steps:
                if self.step % _KEEP == 0:
                    self._keep()
                continue
            scores = [evaluate(self.averaged(), self.select, size) for size in SIZES]
            mean = float(np.mean([s.map50 for s in scores]))
            row = {"step": self.step, "cpu_s": round(self.cpu_s, 1), "rate": self._rate()}
            row |= dict(zip(("class_loss", "box_loss"), losses.mean(axis=0).round(4).tolist(), strict=True))
            row |= {f"map50_{size[0]}": round(s.map50, 4) for size, s in zip(SIZES, scores, strict=True)}
            row |= {"centre_px": round(scores[-1].centre_median_px, 3)}
            self.curve.append(row)
            losses = losses[:0]
            self._since_best += 1
            if mean > self.best:
                self.best, self._since_best = mean, 0
                save(self.folder / "best.pt", {"weights": self._mean, "names": self.names, "step": self.step})
            self._keep()
            on_row(row)

    def _learn(self, samples: list[Sample]) -> tuple[float, float]:
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate()
        pixels = torch.from_numpy(np.stack([s.rgb for s in samples])).permute(0, 3, 1, 2)
        images = pixels.float().div_(255.0).contiguous(memory_format=torch.channels_last)
        targets = [(torch.from_numpy(s.classes), torch.from_numpy(s.boxes).float()) for s in samples]
        class_loss, box_loss = loss(self.network, images, targets, self._middles)
        self._optimizer.zero_grad()
        (class_loss + self.config.box_weight * box_loss).backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 10.0)
        self._optimizer.step()
        self.step += 1
        keep = min(0.998, self.step / (self.step + 50.0))
        for name, value in self.network.state_dict().items():
            if value.dtype.is_floating_point:
                self._mean[name].mul_(keep).add_(value, alpha=1.0 - keep)
            else:
                self._mean[name].copy_(value)
        return float(class_loss.detach()), float(box_loss.detach())

    def _rate(self) -> float:
        """Learning rate of the next step: rises, stays, falls along a cosine."""
        config = self.config
        falls = max(0.0, self.step / config.steps - 1.0 + config.falling) / config.falling
        return config.rate * min(1.0, (self.step + 1) / config.warm_up) * (0.51 + 0.49 * float(np.cos(np.pi * falls)))

    def _batches(self) -> Iterator[list[Sample]]:
        """Batches from the present step on; the next one is prepared meanwhile."""
        with ThreadPoolExecutor(1, thread_name_prefix="samples") as pool:
            coming = pool.submit(self._prepare, self.step)
            while True:
                samples = coming.result()
                coming = pool.submit(self._prepare, self.step + 1)
                yield samples

    def _prepare(self, step: int) -> list[Sample]:
        """The batch of a step; each is drawn from a seed of its own, so that a stopped run goes on as it would have."""
        config = self.config
        rng = np.random.default_rng([config.seed, 1, step])
        epoch, place = divmod(step * config.batch, len(self.train))
        order = np.concatenate(
            [np.random.default_rng([config.seed, 2, epoch + k]).permutation(len(self.train)) for k in (0, 1)]
        )
        chosen = np.resize(order[place:], config.batch)
        return [vary(self.train[int(i)], rng, config.width, config.height) for i in chosen]

    # --- files
    def _keep(self) -> None:
        state = {
            "config": self.config.model_dump(),
            "names": self.names,
            "step": self.step,
            "best": self.best,
            "since_best": self._since_best,
            "cpu_s": self.cpu_s,
            "network": self.network.state_dict(),
            "mean": self._mean,
            "optimizer": self._optimizer.state_dict(),
            "curve": self.curve,
        }
        save(self.folder / "last.pt", state)
        (self.folder / "curve.json").write_text(json.dumps(self.curve, indent=1), encoding="utf-8")

    def _resume(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / "last.pt"
        if not path.is_file():
            return
        state = torch.load(path, weights_only=True)
        mine = {k: v for k, v in self.config.model_dump().items() if k not in ("threads", "patience")}
        changed = [key for key, value in mine.items() if state["config"].get(key) != value]
        if changed or tuple(state["names"]) != self.names:
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"{path.parent} holds a run with other {', '.join(changed) or 'classes'}; give the same settings to"
                " go on with it, or another folder",
            )
        self.network.load_state_dict(state["network"])
        self._mean = state["mean"]
        self._optimizer.load_state_dict(state["optimizer"])
        self.step, self.best, self._since_best = state["step"], state["best"], state["since_best"]
        self.curve, self._used_s = state["curve"], state["cpu_s"]


def evaluate(network: Network, samples: Samples, size: tuple[int, int]) -> Scores:
    """Figures of a network on a set, its input of (width, height)."""
    deployed = Deployed(network, size[1], size[0]).eval()
    found: list[Candidates] = []
    truth: list[Truth] = []
    with torch.no_grad():
        for i in range(len(samples)):
            sample = samples[i]
            letterbox = Letterbox.fit((sample.rgb.shape[1], sample.rgb.shape[0]), size)
            image = torch.from_numpy(letterbox.place(sample.rgb)).permute(2, 0, 1)[None].float().div_(255.0)
            candidates = decode(deployed(image)[0].numpy(), _LEAST, 0.6)
            found.append(Candidates(candidates.classes, candidates.scores, letterbox.back(candidates.boxes)))
            truth.append((sample.classes, sample.boxes))
    return score(found, truth, len(samples.names))


def load_weights(path: Path, names: tuple[str, ...]) -> dict[str, Tensor]:
    """Weights of a run for these classes.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when there is no such file, or it is of other classes.
    """
    if not path.is_file():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"no weights {path}; expected the best.pt of a run")
    state = torch.load(path, weights_only=True)
    if tuple(state["names"]) != names:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"{path} is of the classes {', '.join(state['names'])}, the data of {', '.join(names)}",
        )
    return state["weights"]


def save(path: Path, state: dict[str, Any]) -> None:
    """Whole or not at all: the run may be stopped in the middle of it."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    torch.save(state, part)
    part.replace(path)
