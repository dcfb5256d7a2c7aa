# SPDX-License-Identifier: Apache-2.0
"""The network detector compared with OpenCV's network module: how good, how fast.

    python benchmarks/detector.py [--quick] [--data FOLDER] [--json PATH]

Pictures are those of the report set (`openarm detector data`), rendered into FOLDER if they are not there yet; --quick
takes 100 of 600. Both read the same files, see the same inputs and run in one thread.

    map50, map50_320              mean average precision at an overlap of one half, input 640x480 and 320x256; peer: the
                                  same file through cv2.dnn and the same decoding
    centre_error_px               median distance of the middles of right boxes, pixels of the 640x480 picture; peer:
                                  cv2.dnn
    centre_jitter_px              standard deviation of a box's middle over 20 pictures that differ by sensor noise
    infer_320_ms, infer_640_ms    CPU time of the network alone, median; peer: cv2.dnn
    detect_640_ms                 from the image to the boxes: letterbox, network, non-maximum suppression
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Row, write_report
from openarm_evaluation.detector.data import DataConfig, make_data
from openarm_evaluation.detector.training.report import LEAST, evaluate
from openarm_evaluation.detector.training.samples import Samples
from openarm_evaluation.detector.training.scores import Scores, score
from openarm_perception.detection.boxes import Candidates, Letterbox, blob
from openarm_perception.detection.layouts import decode
from openarm_perception.detection.network import NetworkConfig, NetworkDetector

MODELS = {"320": "shapes_320x256", "640": "shapes_640x480"}


class CvNetwork:
    """The same file through cv2.dnn."""

    def __init__(self, network: NetworkDetector) -> None:
        self._size = network.size
        self._net = cv2.dnn.readNetFromONNX(str(network.path))

    def run(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """(4 + classes, n) of an input (1, 3, h, w)."""
        self._net.setInput(image)
        return np.asarray(self._net.forward(), np.float32)[0]

    def score(self, samples: Samples, count: int) -> Scores:
        """Figures on a set."""
        found, truth = [], []
        for i in range(count):
            sample = samples[i]
            letterbox = Letterbox.fit((sample.rgb.shape[1], sample.rgb.shape[0]), self._size)
            got = decode(self.run(blob(letterbox.place(sample.rgb))), LEAST, 0.6)
            found.append(Candidates(got.classes, got.scores, letterbox.back(got.boxes)))
            truth.append((sample.classes, sample.boxes))
        return score(found, truth, len(samples.names))


def cpu_ms(work: Callable[[], object], rounds: int) -> float:
    """Median CPU time of a call, ms."""
    times: list[float] = []
    for i in range(rounds + 3):
        started = time.process_time()
        work()
        if i >= 3:
            times.append((time.process_time() - started) * 1e3)
    return float(np.median(times))


def jitter(network: NetworkDetector, samples: Samples, count: int) -> float:
    """Standard deviation of a box's middle under sensor noise of three counts, px; median over the boxes."""
    rng = np.random.default_rng(0)
    stds: list[float] = []
    for i in range(count):
        sample = samples[i]
        middles: dict[int, list[NDArray[np.float64]]] = {}
        for _ in range(20):
            noisy = np.clip(sample.rgb + rng.normal(0.0, 3.0, sample.rgb.shape), 0, 255).astype(np.uint8)
            found = network.candidates(noisy, 0.5)
            for k, box in enumerate(sample.boxes):
                middle = (box[:2] + box[2:]) / 2.0
                near = [m for b in found.boxes if np.hypot(*((m := (b[:2] + b[2:]) / 2.0) - middle)) < 8.0]
                middles.setdefault(k, []).extend(near[:1])
        stds += [float(np.hypot(*np.std(m, axis=0))) for m in middles.values() if len(m) >= 15]
    return float(np.median(stds))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="100 pictures")
    parser.add_argument("--data", type=Path, default=Path("runs/detector/report_set"), help="data set")
    parser.add_argument("--json", type=Path, help="where the rows go")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    if not (args.data / "images" / "report" / "000599.jpg").is_file():
        make_data(args.data, DataConfig(train=0, select=0, report=100 if args.quick else 600))
    samples = Samples(args.data, "report")
    count = min(100 if args.quick else 600, len(samples))
    networks = {size: NetworkDetector(NetworkConfig(model=name)) for size, name in MODELS.items()}
    peers = {size: CvNetwork(network) for size, network in networks.items()}
    ours = {size: evaluate(network, samples, count=count).scores for size, network in networks.items()}
    theirs = {size: peer.score(samples, count) for size, peer in peers.items()}
    best, other = ours["640"], theirs["640"]
    rows = [
        Row("map50", best.map50, "", "higher", 0.9, "cv2.dnn", other.map50, count),
        Row("map50_320", ours["320"].map50, "", "higher", None, "cv2.dnn", theirs["320"].map50, count),
        *(
            Row(f"ap50_{name}", value, "", "higher", None, n=count)
            for name, value in zip(samples.names, best.ap50, strict=True)
        ),
        Row("centre_error_px", best.centre_median_px, "px", "lower", 1.5, "cv2.dnn", other.centre_median_px, count),
        Row("centre_jitter_px", jitter(networks["640"], samples, 20), "px", "lower", 2.0, n=20),
    ]
    rng = np.random.default_rng(0)
    rounds = 30 if args.quick else 100
    for size, target in (("320", 6.0), ("640", 15.0)):
        width, height = networks[size].size
        image = rng.random((1, 3, height, width), np.float32)
        peer = cpu_ms(lambda size=size, image=image: peers[size].run(image), rounds)
        mine = cpu_ms(lambda size=size, image=image: networks[size].run(image), rounds)
        rows.append(Row(f"infer_{size}_ms", mine, "ms", "lower", target, "cv2.dnn", peer, rounds))
    rgb = samples[0].rgb
    rows.append(
        Row("detect_640_ms", cpu_ms(lambda: networks["640"].detect(rgb), rounds), "ms", "lower", None, n=rounds)
    )
    write_report(rows, args.json)


if __name__ == "__main__":
    main()
