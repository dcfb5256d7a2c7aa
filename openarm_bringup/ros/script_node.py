# SPDX-License-Identifier: Apache-2.0
"""Node `script`: takes part in a lock-step, asks for grasps at set times, and writes what came of it.

What it writes tells two runs apart: SHA-256 of every joint state (stamp, positions rounded to 1e-9) and of every
transition of the grasp. It ends by itself, with 0, when the last grasp has ended and the robot has gone on for a while.
"""

from __future__ import annotations

import hashlib
import json
import struct
from pathlib import Path
from typing import Any

from openarm_interfaces.msg import GraspStatus
from openarm_interfaces.srv import Grasp
from pydantic import Field
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from openarm_common.config import Config
from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.node import QOS_COMMAND, BaseNode, run

#: Positions that differ by less than half of this are the same, rad or m.
_SAME = 1e-9
_LOOK_S = 0.1


class ScriptConfig(Config):
    """What is asked for, and where the outcome is written."""

    labels: tuple[str, ...] = Field(default=("red",), description="objects to pick, one after the other")
    dry_run: bool = Field(default=False, description="plan only, move nothing")
    begin: float = Field(default=1.0, ge=0.0, description="simulated time of the first request, s")
    rest: float = Field(default=1.0, ge=0.0, description="simulated time between a grasp and what follows, s")
    result: str = Field(default="lockstep.json", description="file that is written at the end")


class Digest:
    """A hash of a sequence, which is equal for equal sequences only."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self.n = 0

    def joints(self, t_ns: int, positions: list[float]) -> None:
        """Add a joint state."""
        rounded = [round(value / _SAME) for value in positions]
        self._hash.update(struct.pack(f"<{1 + len(rounded)}q", t_ns, *rounded))
        self.n += 1

    def text(self, line: str) -> None:
        """Add a line."""
        self._hash.update(line.encode() + b"\n")
        self.n += 1

    def __str__(self) -> str:
        return self._hash.hexdigest()


class ScriptNode(BaseNode[ScriptConfig]):
    """Asks, listens, writes, ends."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("script", ScriptConfig, **kwargs)
        self._joints, self._states = Digest(), Digest()
        self._log: list[str] = []
        self._answers: list[dict[str, Any]] = []
        self._t_ns = 0
        self._next_s = self.config.begin
        self._asking = False
        self.create_subscription(JointState, "/joint_states", self._on_joints, QOS_COMMAND)
        all_of_them = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
        self.create_subscription(GraspStatus, "/grasp/status", self._on_status, all_of_them)
        self._client = self.create_client(Grasp, "/grasp")
        self.create_timer(_LOOK_S, self._look, clock=self.wall_clock)

    def _on_joints(self, message: JointState) -> None:
        self._t_ns = stamp_to_ns(message.header.stamp)
        self._joints.joints(self._t_ns, list(message.position))

    def _on_status(self, status: GraspStatus) -> None:
        line = (
            f"{stamp_to_ns(status.header.stamp)} {status.previous_state} {status.state} {status.attempt}"
            f" {status.label} {status.arm}: {status.reason}"
        )
        self._log.append(line)
        self._states.text(line)

    async def _look(self) -> None:
        if self._asking or self._t_ns * 1e-9 < self._next_s:
            return
        if len(self._answers) == len(self.config.labels):
            self._end()
            return
        self._asking = True
        request = Grasp.Request(label=self.config.labels[len(self._answers)], dry_run=self.config.dry_run)
        answer: Any = await self._client.call_async(request)
        self._answers.append({"success": answer.success, "code": answer.code, "message": answer.message})
        self._next_s = self._t_ns * 1e-9 + self.config.rest
        self._asking = False

    def _end(self) -> None:
        report = {
            "joint_states": {"n": self._joints.n, "sha256": str(self._joints)},
            "grasp_states": {"n": self._states.n, "sha256": str(self._states), "log": self._log},
            "answers": self._answers,
            "sim_s": self._t_ns * 1e-9,
        }
        Path(self.config.result).write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
        self.get_logger().info(f"wrote {self.config.result}")
        self.context.try_shutdown()


def main() -> None:
    """Run the node."""
    run(ScriptNode)


if __name__ == "__main__":
    main()
