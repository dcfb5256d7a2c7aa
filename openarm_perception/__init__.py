# SPDX-License-Identifier: Apache-2.0
"""From colour and depth images to clouds, and to objects in the base frame.

Example:
    >>> from openarm_common import load_cameras, load_config
    >>> from openarm_common.resources import config_dir
    >>> from openarm_perception import (
    ...     ColorDetector, ColorDetectorConfig, DepthLimits, Localizer, LocalizerConfig, Pipeline
    ... )
    >>> colors = load_config(config_dir() / "params" / "detector.yaml", ColorDetectorConfig)
    >>> localizer = Localizer(LocalizerConfig(), DepthLimits(near=0.2, far=2.0), table_height=0.40)
    >>> pipeline = Pipeline(ColorDetector(colors), localizer)
    >>> camera = load_cameras()["overhead"]
    >>> result = pipeline.run(rgb, depth, camera.intrinsics, T_base_camera)  # doctest: +SKIP
    >>> [(found.label, found.p_base, found.size) for found in result.located]  # doctest: +SKIP

The nodes `cloud` and `detector` are in `ros/`.
"""

from typing import TYPE_CHECKING

from openarm_common.lazy import attach

if TYPE_CHECKING:
    from openarm_perception.config import CloudNodeConfig, DetectNodeConfig
    from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig, Detection2D
    from openarm_perception.detection.localize import Localizer, LocalizerConfig, LocatedObject
    from openarm_perception.detection.pipeline import Pipeline, make_pipeline
    from openarm_perception.geometry.depth import Deprojector, DepthLimits

__all__ = [
    "CloudNodeConfig",
    "ColorDetector",
    "ColorDetectorConfig",
    "Deprojector",
    "DepthLimits",
    "DetectNodeConfig",
    "Detection2D",
    "Localizer",
    "LocalizerConfig",
    "LocatedObject",
    "Pipeline",
    "make_pipeline",
]

__getattr__, __dir__ = attach(__name__, __file__)
