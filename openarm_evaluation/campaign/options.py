# SPDX-License-Identifier: Apache-2.0
"""What a campaign runs, and the command that runs one row of it again."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from typing import Any

from openarm_perception.detection.kinds import DetectorKind

Row = dict[str, Any]


@dataclass(frozen=True)
class CampaignOptions:
    """What a campaign runs.

    Attributes:
        set_name: One of `sets.SETS`.
        seeds: One task each.
        workers: Processes.
        noise: Depth as noisy as a D435's.
        mount_seeds: True camera mounts to go through, each with its calibration; empty: nominal mounts.
        use_effort: Whether the finger's effort counts as evidence.
        detector: What finds objects: color, network, both.
        parameters: `node.param=value` of nodes of the graph.
        ray: Address of a Ray cluster whose machines run the workers; "": this machine.
    """

    set_name: str = "nominal"
    seeds: tuple[int, ...] = ()
    workers: int = 1
    noise: bool = False
    mount_seeds: tuple[int, ...] = ()
    use_effort: bool = True
    detector: DetectorKind = "color"
    parameters: tuple[str, ...] = ()
    ray: str = ""

    def settings(self) -> dict[str, Any]:
        """What must be the same for rows to belong together."""
        return {
            "set": self.set_name,
            "noise": self.noise,
            "mount_seeds": list(self.mount_seeds),
            "use_effort": self.use_effort,
            **({"detector": self.detector} if self.detector != "color" else {}),
            **({"parameters": list(self.parameters)} if self.parameters else {}),
        }

    def graph_parameters(self) -> tuple[str, ...]:
        """Return the parameters of the graph that the options stand for, as `node.param=value`."""
        return (
            f"mujoco_bridge.depth_noise.enabled={str(self.noise).lower()}",
            f"grasp.held.use_effort={str(self.use_effort).lower()}",
            *(f"{node}.detector={self.detector}" for node in ("detector", "wrist_detector")),
            *self.parameters,
        )

    def command(self, seed: int) -> str:
        """The command that runs one row again."""
        parts = [
            "./openarm campaign",
            f"--suite {self.set_name}" if self.set_name != "nominal" else "",
            f"--seeds {seed}",
        ]
        parts.append("--noise" if self.noise else "")
        parts.append("--mount-seeds " + ",".join(map(str, self.mount_seeds)) if self.mount_seeds else "")
        parts.append("" if self.use_effort else "--no-effort")
        parts.append(f"--detector {self.detector}" if self.detector != "color" else "")
        parts += [f"--set {shlex.quote(item)}" for item in self.parameters]
        return " ".join(part for part in parts if part)
