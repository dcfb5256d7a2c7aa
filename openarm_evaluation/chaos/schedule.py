# SPDX-License-Identifier: Apache-2.0
"""The requests and faults of a seed: the same seed gives the same ones, in the same order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from openarm_common.camera.cameras import depth_cameras, detector_nodes
from openarm_common.errors import Code, OpenArmError

#: Kinds of faults and what each does.
KINDS: Mapping[str, str] = {
    "kill": "SIGKILL of a node",
    "stop": "SIGSTOP of a node, later SIGCONT",
    "commands": "hostile messages to /joint_commands",
    "services": "a flood of calls of services",
    "disk": "a full run folder",
    "camera": "frames that are lost, late or frozen",
    "joints": "gaps in /joint_states",
    "detector": "objects that the detector misses",
    "plans": "plans that fail",
    "intruder": "valid /joint_commands of another client",
    "rival": "requests and goals of another client",
}
#: States of the grasp that a fault waits for; "" is before the request.
STATES = ("", "DETECT", "PLAN", "MOVE_TO_PREGRASP", "MOVE_TO_GRASP", "CLOSE_GRIPPER", "LIFT", "PLACE", "RESET")
#: Those in which the grasp holds an arm.
HOLDING = ("MOVE_TO_PREGRASP", "MOVE_TO_GRASP", "CLOSE_GRIPPER", "LIFT", "PLACE")

_CAMERA_FAULTS: Sequence[tuple[str, Mapping[str, Any]]] = (
    ("camera_drop", {"share": 1.0}),
    ("camera_delay", {"seconds": 0.5}),
    ("camera_freeze", {}),
)


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong once.

    Attributes:
        kind: One of `KINDS`.
        when: State of the grasp in which it begins; "": before the request.
        after: Time from the beginning of that state, s.
        seconds: Duration; 0 for a kill.
        node: Node that is killed or stopped, or whose parameters change.
        injected: Name and parameters of the simulation's fault.
        share: Parameter of the node that is the share of what fails, and its value.
    """

    kind: str
    when: str
    after: float
    seconds: float
    node: str = ""
    injected: tuple[str, Mapping[str, Any]] | None = None
    share: tuple[str, float] = ("", 0.0)

    @property
    def target(self) -> str:
        """What it hits: a node, or a camera; "" where the kind says it."""
        return f"{self.injected[0]} {self.injected[1].get('camera', '')}".strip() if self.injected else self.node

    def __str__(self) -> str:
        what = f"{self.target} {self.share[1]:.0%}" if self.share[0] else self.target
        lasting = f" for {self.seconds:.1f} s" if self.seconds else ""
        return f"{self.kind} {what}".strip() + f"{lasting}, {self.after:.1f} s into {self.when or 'rest'}"


@dataclass(frozen=True)
class Round:
    """One request and what goes wrong meanwhile.

    Attributes:
        number: Number of the request, from 0.
        pick: Number that chooses one of the objects on the table.
        arm: auto, or an arm of the robot.
        worded: Ask by color and shape, not by the label.
        fault: None: nothing goes wrong.
    """

    number: int
    pick: int
    arm: str
    worded: bool
    fault: Fault | None = field(default=None)


def known_kinds(kinds: Sequence[str]) -> tuple[str, ...]:
    """Return the kinds of faults that a user named; `none` is no fault, nothing named is all.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for another kind.
    """
    if list(kinds) == ["none"]:
        return ()
    if wrong := [kind for kind in kinds if kind not in KINDS]:
        choices = ", ".join(KINDS)
        raise OpenArmError(Code.INVALID_ARGUMENT, f"no fault is called {wrong[0]!r}; choose of {choices}, or none")
    return tuple(kinds) or tuple(KINDS)


def rounds(seed: int, kinds: Sequence[str], nodes: Sequence[str], arms: Sequence[str]) -> Iterator[Round]:
    """Yield requests and their faults without end; every kind comes once before any comes again, and so does each node.

    Args:
        seed: Seed of all draws.
        kinds: Kinds of faults; none: only requests.
        nodes: Nodes that may be killed and stopped.
        arms: Arms of the robot; every other request or so is for a particular one.
    """
    rng = np.random.default_rng([seed, 18])
    bags = {name: _in_turn(rng, choices) for name, choices in (("", kinds), ("kill", nodes), ("stop", nodes))}
    number = 0
    while True:
        arm = ("auto", *arms)[int(rng.choice(1 + len(arms), p=[0.6, *[0.4 / len(arms)] * len(arms)]))]
        pick, worded = int(rng.integers(1_000)), bool(rng.integers(2))
        yield Round(number, pick, arm, worded, _fault(rng, bags) if kinds else None)
        number += 1


def _fault(rng: np.random.Generator, bags: Mapping[str, Iterator[str]]) -> Fault:
    kind = next(bags[""])
    when, after = STATES[int(rng.integers(len(STATES)))], round(float(rng.uniform(0.0, 0.6)), 2)
    seconds = round(float(rng.uniform(1.0, 4.0)), 1)
    if kind in ("kill", "stop"):
        return Fault(kind, when, after, 0.0 if kind == "kill" else seconds, node=next(bags[kind]))
    if kind == "camera":
        name, parameters = _CAMERA_FAULTS[int(rng.integers(len(_CAMERA_FAULTS)))]
        cameras = tuple(depth_cameras())
        camera = cameras[int(rng.integers(len(cameras)))]
        return Fault(kind, when, after, seconds, injected=(name, {"camera": camera, **parameters}))
    if kind == "joints":
        return Fault(kind, when, after, seconds, injected=("joint_state_gap", {"ms": int(rng.integers(50, 400))}))
    if kind in ("detector", "plans"):
        names = tuple(detector_nodes().values()) if kind == "detector" else ("motion",)
        parameter = "faults.miss_share" if kind == "detector" else "faults.no_plan_share"
        node, share = names[int(rng.integers(len(names)))], (0.5, 1.0)[int(rng.integers(2))]
        return Fault(kind, when, after, seconds, node, share=(parameter, share))
    if kind in ("intruder", "rival"):
        when = HOLDING[int(rng.integers(len(HOLDING)))]
    return Fault(kind, when, after, seconds)


def _in_turn(rng: np.random.Generator, choices: Sequence[str]) -> Iterator[str]:
    while choices:
        yield from (str(one) for one in rng.permutation(list(choices)))
