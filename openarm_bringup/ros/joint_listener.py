# SPDX-License-Identifier: Apache-2.0
"""Where the joints of a running robot rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from sensor_msgs.msg import JointState

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.client import ContextNode
from openarm_common.ros.convert import joints_from_msg
from openarm_common.ros.node import QOS_COMMAND

#: Joint states of which the mean is taken, and how far apart they may be, rad.
_STATES, _AT_REST = 20, 2e-3


class JointListener(ContextNode):
    """Receives joint states."""

    def __init__(self) -> None:
        super().__init__("joint_listener", bare=True)
        self._states: list[dict[str, float]] = []
        self._node.create_subscription(JointState, "/joint_states", self._receive, QOS_COMMAND)

    def at_rest(self, names: Sequence[str], timeout: float = 10.0) -> dict[str, float]:
        """Return the mean position of joints over some states, rad.

        Raises:
            OpenArmError: TIMEOUT, when none come with these joints; MOVING.
        """
        self._states.clear()
        self.spin_until(lambda: len(self._with(names)) >= _STATES, timeout)
        found = self._with(names)
        if len(found) < _STATES:
            text = f"{len(found)} of {_STATES} messages with {', '.join(names)} on /joint_states within {timeout:g} s"
            raise OpenArmError(Code.TIMEOUT, f"{text}; is the graph up?")
        q = np.array(found)
        apart = np.ptp(q, axis=0)
        if apart.max() > _AT_REST:
            joint = names[int(apart.argmax())]
            raise OpenArmError(Code.MOVING, f"{joint} moves: {apart.max():.4f} rad within {len(q)} joint states")
        return dict(zip(names, q.mean(axis=0).tolist(), strict=True))

    def _with(self, names: Sequence[str]) -> list[list[float]]:
        return [[state[name] for name in names] for state in self._states if all(name in state for name in names)]

    def _receive(self, message: JointState) -> None:
        try:
            sound = joints_from_msg(message)
        except OpenArmError:
            return
        self._states.append(dict(zip(sound.name, sound.position, strict=True)))
