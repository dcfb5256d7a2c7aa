# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes of this package."""

from __future__ import annotations

from pydantic import Field

from openarm_common.config import Config


class PublisherConfig(Config):
    """Parameters of the node `calibration_publisher`."""

    cameras: str = Field("", description="YAML of the cameras; empty is config/params/cameras.yaml")
