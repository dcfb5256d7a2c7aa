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
    from openarm_perception.config import CloudNodeConfig as CloudNodeConfig
    from openarm_perception.config import DetectNodeConfig as DetectNodeConfig
    from openarm_perception.detection.detector import ColorDetector as ColorDetector
    from openarm_perception.detection.detector import ColorDetectorConfig as ColorDetectorConfig
    from openarm_perception.detection.detector import Detection2D as Detection2D
    from openarm_perception.detection.localize import Localizer as Localizer
    from openarm_perception.detection.localize import LocalizerConfig as LocalizerConfig
    from openarm_perception.detection.localize import LocatedObject as LocatedObject
    from openarm_perception.detection.pipeline import Pipeline as Pipeline
    from openarm_perception.detection.pipeline import make_pipeline as make_pipeline
    from openarm_perception.geometry.depth import Deprojector as Deprojector
    from openarm_perception.geometry.depth import DepthLimits as DepthLimits

__getattr__, __dir__ = attach(__name__, __file__)
