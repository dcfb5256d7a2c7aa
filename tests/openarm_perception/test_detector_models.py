# SPDX-License-Identifier: Apache-2.0
"""The networks that come with the suite, on what the simulated cameras see (seeds that no report uses)."""

from __future__ import annotations

import hashlib
import time

import numpy as np
import pytest

from benchmarks.localization import Studio, errors
from openarm_common.resources import models_dir
from openarm_common.scene.scene import SHAPES, random_scene
from openarm_perception.config import DetectNodeConfig
from openarm_perception.detection.localize import Localizer, LocalizerConfig
from openarm_perception.detection.network import NetworkConfig, NetworkDetector
from openarm_perception.detection.pipeline import make_pipeline
from openarm_perception.geometry.depth import DepthLimits

FOLDER = models_dir() / "detector"
MODELS = ("shapes_320x256", "shapes_640x480")


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.requirement("B-22", "B-67")
def test_the_shipped_files_are_small_and_need_no_gpu(name: str) -> None:
    """At most 3.2 million parameters of 4 bytes; run by the CPU provider alone; the card tells their hash."""
    path = FOLDER / f"{name}.onnx"
    assert path.stat().st_size < 4 * 3.2e6 / 4  # a quarter of it
    network = NetworkDetector(NetworkConfig(model=name))
    assert network._session.get_providers() == ["CPUExecutionProvider"]
    assert network.names == SHAPES
    assert hashlib.sha256(path.read_bytes()).hexdigest() in (FOLDER / "README.md").read_text()


@pytest.mark.parametrize("kind", ["network", "both"])
@pytest.mark.requirement("N-14", "N-16")
def test_the_shipped_network_finds_random_scenes(kind) -> None:
    """Every object of three scenes under the overhead camera, in place, by colour and shape."""
    studio = Studio()
    camera = studio.cameras["overhead"]
    limits = DepthLimits(near=camera.near, far=camera.far)
    joints = studio.home()
    for seed in range(5000, 5003):
        scene = random_scene(seed)
        studio.load(scene, joints)
        rgb, depth = studio.draw("overhead")
        localizer = Localizer(LocalizerConfig(), limits, scene.table.top_z)
        pipeline = make_pipeline(kind, studio.detector, NetworkConfig(), localizer)
        seen = pipeline.run(rgb, depth, camera.intrinsics, studio.T_base_camera("overhead", joints))
        items = {item.label: item for item in scene.objects}
        assert sorted(place.label for place in seen.located) == sorted(items), (seed, seen.refused)
        for place in seen.located:
            assert items[place.label].shape in place.attributes
            assert np.abs(errors(place, items[place.label], scene.table))[0] < 3.0
    studio.close()


def noisy_images() -> tuple[list[list[tuple[float, float]]], list[float]]:
    """Detect in five noisy images of a scene; returns the centres of each, px, and what it took, s of the processor."""
    studio = Studio()
    camera = studio.cameras["overhead"]
    joints = studio.home()
    scene = random_scene(5001)
    studio.load(scene, joints)
    rgb, depth = studio.draw("overhead")
    T_base_camera = studio.T_base_camera("overhead", joints)
    localizer = Localizer(LocalizerConfig(), DepthLimits(near=camera.near, far=camera.far), scene.table.top_z)
    pipeline = make_pipeline("network", studio.detector, NetworkConfig(), localizer)
    pipeline.run(rgb, depth, camera.intrinsics, T_base_camera)  # kernels are compiled, the session is warm
    rng = np.random.default_rng(1)
    centres: list[list[tuple[float, float]]] = []
    took: list[float] = []
    for _ in range(5):
        noisy = np.clip(rgb + rng.normal(0.0, 4.0, rgb.shape), 0, 255).astype(np.uint8)
        began = time.process_time()
        seen = pipeline.run(noisy, depth, camera.intrinsics, T_base_camera)
        took.append(time.process_time() - began)
        assert len(seen.located) == len(scene.objects)
        centres.append(sorted(found.centre for found in seen.found))
    studio.close()
    return centres, took


@pytest.mark.requirement("B-25", "B-37")
def test_noisy_images_of_a_scene_give_the_same_centres() -> None:
    centres, _ = noisy_images()
    spread = np.abs(np.array(centres) - np.mean(centres, axis=0)).max(axis=(0, 2))
    assert spread.max() <= 2.0, f"{spread.round(2)} px"


@pytest.mark.long
@pytest.mark.requirement("B-25", "B-37")
def test_images_are_detected_in_at_five_hertz() -> None:
    _, took = noisy_images()
    assert np.median(took) <= 0.2
    assert DetectNodeConfig().max_rate >= 5.0
