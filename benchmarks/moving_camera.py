# SPDX-License-Identifier: Apache-2.0
"""Where the detector says that objects are while the wrist camera moves over them, by the speed of the camera.

    python benchmarks/moving_camera.py [--quick] [--images N] [--first-seed S] [--latency MS] [--json PATH]

Every image shows a random object from near the posture `wrist_look`; the camera passes there at the given speed in a
random direction along the table, swaying (2 to 6 rad/s, so that it speeds up or slows down there). Joint states are
those of 100 Hz in steps of 0.4 mrad and 0.02 rad/s, as geared motors report them; stamps of images lie anywhere between
them, and an image arrives `--latency` after its stamp (50 ms). The suite pairs them as its nodes do (`FrameStream`,
`PostureTracker`); the peer takes the latest joint state there is when the image arrives. Images are sharp: the renderer
knows no exposure time.

    at_SPEED_position_p50_mm, ..._p95_mm, ..._max_mm    middle of the object; peer: by the latest joint state
    at_SPEED_refused                                    of the images, those without an object; peer: likewise
    growth_p95_mm                                       p95 at the fastest speed less that at rest
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.localization import Studio, errors
from benchmarks.report import Row, write_report
from openarm_common.camera.stream import FrameStream
from openarm_common.draws import until
from openarm_common.robot.posture import PostureTracker
from openarm_common.scene.scene import random_scene
from openarm_common.types import Array

SPEEDS = (0.0, 0.1, 0.2, 0.4)
#: Joint states before the image, and their period, s.
_BEFORE, _PERIOD = 0.2, 0.01
_MS = 1_000_000
#: Steps of the positions and velocities in joint states, rad and rad/s.
_Q, _V = 0.4e-3, 0.02


@dataclass
class Errors:
    """Errors of position, mm, and images in which the object was not located."""

    suite: list[float] = field(default_factory=list)
    latest: list[float] = field(default_factory=list)
    refused: int = 0
    latest_refused: int = 0


def velocity(studio: Studio, joints: dict[str, float], direction: Array) -> Array:
    """Joint velocities (7,) of the right arm that move the wrist camera by `direction` (3,) m/s without turning it."""
    names, step = studio.description.arm_joints("right"), 1e-6
    T = studio.T_base_camera("wrist", joints)
    jacobian = np.empty((6, len(names)))
    for i, name in enumerate(names):
        moved = studio.T_base_camera("wrist", joints | {name: joints[name] + step})
        turn = (moved[:3, :3] @ T[:3, :3].T - np.eye(3)) / step
        jacobian[:, i] = (*(moved[:3, 3] - T[:3, 3]) / step, turn[2, 1], turn[0, 2], turn[1, 0])
    return np.linalg.pinv(jacobian) @ np.concatenate([direction, np.zeros(3)])


def measure(studio: Studio, speed: float, images: int, first_seed: int, latency: float = 0.05) -> Errors:
    """Locate the object of `images` images that were taken at a speed, m/s, and arrived after `latency`, s."""
    camera, names = studio.cameras["wrist"], studio.description.arm_joints("right")
    out, seed = Errors(), first_seed
    what = "scenes that the wrist camera sees"
    for _ in until(lambda: len(out.suite) + out.refused >= images, what, "move that camera", 100 * images):
        scene, rng = random_scene(seed, count=1), np.random.default_rng(seed)
        seed += 1
        item, at_image = scene.objects[0], studio.looking(rng)
        if not studio.shows("wrist", at_image, item, scene.table):
            continue
        angle = rng.uniform(0.0, 2.0 * np.pi)
        along = velocity(studio, at_image, np.array([np.cos(angle), np.sin(angle), 0.0]))
        sway, phase = rng.uniform(2.0, 6.0), rng.uniform(-1.0, 1.0)
        t_ns = int(rng.integers(1_000 * _MS, 2_000 * _MS))
        tracker = PostureTracker(studio.description, wait=0.5)
        tracker.buffer.set_static(camera.parent, camera.optical_frame, camera.T_parent_optical)
        tracker.listen(True, 0.0)
        stream: FrameStream[int] = FrameStream(("depth",), tracker, camera.optical_frame, joints="required")
        first = (t_ns - round(_BEFORE * 1e9)) // round(_PERIOD * 1e9) * round(_PERIOD * 1e9)
        for stamp in range(first, t_ns + round(latency * 1e9) + 1, round(_PERIOD * 1e9)):
            t = (stamp - t_ns) * 1e-9
            way = speed * (np.sin(sway * t + phase) - np.sin(phase)) / (sway * np.cos(phase))
            rate = speed * np.cos(sway * t + phase) / np.cos(phase)
            q = at_image | {n: at_image[n] + way * d for n, d in zip(names, along, strict=True)}
            v = dict.fromkeys(q, 0.0) | dict(zip(names, rate * along, strict=True))
            steps = [np.round(np.array(list(values.values())) / step) * step for values, step in ((q, _Q), (v, _V))]
            tracker.add(stamp, list(q), steps[0].tolist(), 0.0, steps[1].tolist())
        studio.load(scene, at_image)
        rgb, depth = studio.draw("wrist")
        stream.add("depth", t_ns, camera.optical_frame, 0, 0.0)
        frame = stream.take(0.0)
        assert frame is not None, "a joint state follows the stamp within the latency"
        for T, found in (
            (frame.posture.T_base_frame, out.suite),
            (studio.T_base_camera("wrist", tracker.buffer.latest()[1]), out.latest),
        ):
            located = studio.pipeline("wrist", scene.table).run(rgb, depth, camera.intrinsics, T).located
            mine = [place for place in located if place.label == item.label]
            if mine:
                found.append(errors(mine[0], item, scene.table)[0])
            elif found is out.suite:
                out.refused += 1
            else:
                out.latest_refused += 1
    return out


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="20 images a speed")
    parser.add_argument("--images", type=int, default=100, help="for each speed")
    parser.add_argument("--first-seed", type=int, default=5000)
    parser.add_argument("--latency", type=float, default=50.0, help="of an image, ms")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    studio, rows, p95 = Studio(), [], []
    peer = "latest joint state"
    for speed in SPEEDS:
        found = measure(studio, speed, 20 if args.quick else args.images, args.first_seed, args.latency * 1e-3)
        name, n = f"at_{speed:g}", len(found.suite)
        for share, rank in ((50.0, "p50"), (95.0, "p95"), (100.0, "max")):
            ours, theirs = (float(np.percentile(values, share)) for values in (found.suite, found.latest))
            rows.append(Row(f"{name}_position_{rank}_mm", ours, "mm", "lower", None, peer, theirs, n))
            if rank == "p95":
                p95.append(ours)
        images = n + found.refused
        rows.append(Row(f"{name}_refused", found.refused, "", "lower", None, peer, found.latest_refused, images))
    rows.append(Row("growth_p95_mm", p95[-1] - p95[0], "mm", "lower", 0.5, n=len(SPEEDS)))
    studio.close()
    write_report(rows, args.json)


if __name__ == "__main__":
    main()
